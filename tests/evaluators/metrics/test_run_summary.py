"""A run in one row, and its errors in one picture."""

import numpy as np
import pytest

from mapper.config.build import BuildConfig
from mapper.core.errors import DataError
from mapper.core.geometry import exp, transform
from mapper.core.trajectory import Trajectory
from mapper.evaluators.metrics.evaluate import assess
from mapper.evaluators.pictures.errors import write_trajectory_errors
from mapper.evaluators.sweep.build_job import summary
from mapper.run import files
from mapper.run.folder import Run
from mapper.run.manifest import Counts, Manifest
from mapper.run.manifest_logs import Input
from mapper.sources.trajectory_files import write_tum

STAMPS_NS = 1_305_031_102_000_000_000 + np.arange(120, dtype=np.int64) * 100_000_000
ERRORS = ("ate_m", "rpe_1s_m", "rpe_1s_rad", "relative_translation_ratio", "relative_rotation_radpm")


def path_of(*, scale=1.0):
    """Ahead at 1 m/s, with a turn."""
    poses = [
        exp(np.array([0.0, 0.0, 0.005 * k]), np.zeros(3)) @ transform(np.eye(3), [0.1 * k, 0.0, 0.0])
        for k in range(120)
    ]
    trajectory = Trajectory(STAMPS_NS, np.array(poses))
    trajectory.T_world_body[:, :3, 3] *= scale
    return trajectory


def run_in(folder, estimate, truth):
    write_tum(folder / files.TRAJECTORY, estimate)
    if truth is not None:
        write_tum(folder / files.TRUTH, truth)
    manifest = Manifest(
        status="complete",
        input=Input(path="log", kind="tum", fingerprint="0"),
        counts=Counts(listed=150, tracked=120, loops=3),
    )
    return Run(folder, BuildConfig(), manifest)


def test_a_row_says_how_wrong_a_path_is_and_of_how_much_of_the_log(tmp_path):
    row = summary(run_in(tmp_path, path_of(scale=1.1), path_of()))
    found = assess(path_of(scale=1.1), path_of())
    values = {metric.name: metric.value for metric in found.metrics}

    assert (row["listed_frames"], row["tracked_frames"], row["coverage_ratio"]) == (150, 120, 0.8)
    assert (row["matched_poses"], row["loops"]) == (120, 3)
    assert row["ate_m"] == pytest.approx(values["ATE RMSE, SE(3)-aligned"])
    assert row["rpe_1s_m"] == pytest.approx(0.1, rel=0.15)
    assert row["relative_translation_ratio"] * 100.0 == pytest.approx(
        values["relative translation mean, all lengths"]
    )
    assert row["relative_translation_ratio"] == pytest.approx(0.1, rel=0.15)
    assert row["relative_rotation_radpm"] < 1e-6
    assert row["path_m"] == pytest.approx(1.1 * path_of().path_length_m)


def test_what_is_not_known_is_none(tmp_path):
    elsewhen = Trajectory(STAMPS_NS + 10**12, path_of().T_world_body)
    for name, truth in (("none", None), ("elsewhen", elsewhen)):
        (tmp_path / name).mkdir()
        row = summary(run_in(tmp_path / name, path_of(), truth))
        assert row["matched_poses"] == 0
        assert [row[key] for key in ERRORS] == [None] * len(ERRORS)
        assert row["path_m"] > 11.0


@pytest.mark.parametrize("stamps_ns", [STAMPS_NS, np.arange(120)], ids=["timed", "numbered"])
def test_the_picture_of_a_path_is_drawn_with_times_or_without(stamps_ns, tmp_path):
    estimate, truth = (Trajectory(stamps_ns, path_of(scale=scale).T_world_body) for scale in (1.1, 1.0))
    picture = write_trajectory_errors(tmp_path / "plots", assess(estimate, truth), title="1.1 times")
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_there_is_nothing_to_draw_without_a_truth_or_into_a_file(tmp_path):
    with pytest.raises(DataError, match="nothing to draw without a truth"):
        write_trajectory_errors(tmp_path / "plots", assess(path_of(), None), title="")
    (tmp_path / "taken").write_text("")
    with pytest.raises(DataError, match="want a folder for pictures"):
        write_trajectory_errors(tmp_path / "taken", assess(path_of(), path_of()), title="")
