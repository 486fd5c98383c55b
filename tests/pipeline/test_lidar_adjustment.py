"""Poses of LiDAR logs, adjusted to the surfaces that scans share where other points show a gain."""

import pytest

from mapper.config.loading import load_config
from mapper.evaluators.metrics.evaluate import evaluate
from mapper.pipeline.build import build
from mapper.simulation.config import LIDAR_SCENES
from mapper.simulation.lidar import write_lidar_log
from mapper.sources import open_source
from tests.support.paths import DATA


def built(log, out, planes):
    source = open_source(log)
    return build(source, load_config(None, [f"graph.planes={planes}"], sensor=source.sensor), out)


def both(log, folder):
    """The ATE without and with the adjustment, and the run that has it."""
    off, auto = (built(log, folder / planes, planes) for planes in ("off", "auto"))
    assert off.manifest.solve.planes is None
    return *(evaluate(run).ate_m for run in (off, auto)), auto


def test_rooms_are_more_accurate_and_the_manifest_says_so(tmp_path):
    flat = LIDAR_SCENES["flat"].model_copy(update={"duration_s": 20.0, "seed": 1})
    write_lidar_log(tmp_path / "log", flat)

    off_m, auto_m, run = both(tmp_path / "log", tmp_path)

    assert auto_m < 0.7 * off_m
    record = run.manifest.solve.planes
    assert record.is_kept
    assert record.thinner_sigmas > 3.0
    assert record.thickness_m < record.thickness_before_m
    assert 0.0 < record.moved_m < 0.1


@pytest.mark.parametrize("name", ["kitti_00", "mulran_kaist03", "courtyard_2hz"])
def test_real_logs_are_not_less_accurate(name, tmp_path):
    if not (DATA / name).exists():
        pytest.skip(f"no {name}")

    off_m, auto_m, run = both(DATA / name, tmp_path)

    assert auto_m < 1.05 * off_m
    planes = run.manifest.solve.planes
    assert (planes is None) == (len(run.graph.T_world_node) < 30)
    if planes is None or not planes.is_kept:
        assert auto_m == off_m


def test_images_are_not_adjusted(desk_run):
    assert desk_run.manifest.solve.planes is None
