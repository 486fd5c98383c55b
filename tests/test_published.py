"""The papers' figures, and the harness that measures the thesis's columns again."""

import tomllib
from pathlib import Path

import numpy as np
import pytest

from evaluators.published import isvd_tables, published
from mapper.config import load_config
from mapper.config.features import OrbConfig
from mapper.config.odometry import IsvdOdometryConfig
from mapper.errors import DataError
from mapper.sources import open_source

ROOT = Path(__file__).parents[1]
FR1_XYZ = ROOT.parent / "shared/data/tum_fr1_xyz"
THESIS = sorted((ROOT / "configs/thesis").glob("*.toml"))


def test_every_table_names_its_source():
    assert all(table["source"] for name, table in published().items() if name != "_note")
    assert published()["isvd_previous_frames"]["rows"]["fr1/xyz"] == [0.0216, 0.0198, 0.0197, 0.0232, 0.0236]


@pytest.mark.parametrize("path", THESIS, ids=lambda path: path.stem)
def test_thesis_settings_load_and_only_override(path):
    config = load_config(path)

    assert isinstance(config.odometry, IsvdOdometryConfig)
    assert config.odometry.detector.kind == "surf"
    assert config.odometry.match.filter == "homography"
    loops = ("thesis", "proportional") if "LC" in path.stem else ("none", "none")
    assert (config.loops.kind, config.graph.solve) == loops
    odometry = tomllib.loads(path.read_text())["odometry"]
    defaults = IsvdOdometryConfig()
    named_by_file_name = {"kind", "previous_frames"}
    assert all(
        value != getattr(defaults, key) for key, value in odometry.items() if key not in named_by_file_name
    )


def test_thesis_names_are_all_there():
    names = {"ISVD", "ISVD+DIF", "ISVD+LC", "ISVD+LC+DIF", "MP1", "MP2", "MP3", "MP4", "MP6"}
    assert {path.stem for path in THESIS} >= names
    assert load_config(ROOT / "configs/thesis/MP6.toml").odometry.previous_frames == 6
    assert load_config(ROOT / "configs/thesis/ISVD+DIF.toml").odometry.depth_filter


@pytest.mark.skipif(not FR1_XYZ.is_dir(), reason=f"{FR1_XYZ} is not here")
def test_tables_of_a_real_log():
    source = open_source(FR1_XYZ, load_config(overrides=["source.last_frame=24"]).source)
    config = IsvdOdometryConfig(detector=OrbConfig(max_features=300))

    cells = list(isvd_tables(source, log_name="fr1/xyz", config=config))

    assert [cell.setting for cell in cells][:3] == ["1 iterations", "3 iterations", "4 iterations"]
    assert [cell.setting for cell in cells][-5:] == ["MP1", "MP2", "MP3", "MP4", "MP6"]
    assert len(cells) == 17
    ours_m = {cell.setting: cell.ours_m for cell in cells}
    assert ours_m["auto"] == ours_m["MP4"] < 0.03
    assert ours_m["1 iterations"] > ours_m["7 iterations"]
    assert all(cell.lost == 0 for cell in cells)


@pytest.mark.skipif(not FR1_XYZ.is_dir(), reason=f"{FR1_XYZ} is not here")
def test_a_log_that_the_thesis_does_not_list_is_refused():
    source = open_source(FR1_XYZ, load_config(overrides=["source.last_frame=1"]).source)

    with pytest.raises(DataError, match="fr9/xyz"):
        next(isvd_tables(source, log_name="fr9/xyz", config=IsvdOdometryConfig(detector=OrbConfig())))


@pytest.mark.skipif(not FR1_XYZ.is_dir(), reason=f"{FR1_XYZ} is not here")
def test_isvd_as_published_follows_the_first_second_of_a_real_log():
    source = open_source(FR1_XYZ, load_config(overrides=["source.last_frame=19"]).source)

    cells = isvd_tables(
        source, log_name="fr1/xyz", config=load_config(ROOT / "configs/thesis/MP4.toml").odometry
    )

    assert np.mean([cell.ours_m for cell in cells if cell.setting == "MP4"]) < 0.01
