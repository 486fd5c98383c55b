"""Errors by known relations between poses."""

import json
from pathlib import Path

import numpy as np
import pytest

from mapper.core.errors import DataError, SourceError
from mapper.core.geometry import transform
from mapper.core.rotations import rotation_from_euler
from mapper.core.timebase import NS_PER_S
from mapper.core.trajectory import Trajectory
from mapper.evaluators.metrics.relations import read_relations, relation_metrics
from tests.support.command_line import invoke


def _circle() -> Trajectory:
    """Return 21 poses of a path on a circle of 1 m radius, 1 rad in 10 s."""
    angles = np.linspace(0.0, 1.0, 21)
    poses = [
        transform(rotation_from_euler(0.0, 0.0, angle), np.array([np.sin(angle), 1.0 - np.cos(angle), 0.0]))
        for angle in angles
    ]
    return Trajectory((np.arange(21) * NS_PER_S) // 2, np.array(poses))


def _values(tmp_path: Path, text: str) -> dict[str, float]:
    path = tmp_path / "intel.relations"
    path.write_text(text)
    return {metric.name: metric.value for metric in relation_metrics(_circle(), read_relations(path))}


def test_errors_are_those_of_the_relative_pose_in_the_first_poses_frame(tmp_path: Path) -> None:
    # 0.5 rad on the circle is (sin 0.5, 1 - cos 0.5) wherever it begins; the second relation is 3 cm and
    # 0.1 rad off it.
    x, y = np.sin(0.5), 1.0 - np.cos(0.5)
    found = _values(
        tmp_path,
        f"# time1 time2 x y z roll pitch yaw\n0.0 5.0 {x} {y} 0 0 0 0.5\n5.0 10.0 {x} {y} 0.03 0 0 0.4\n",
    )
    assert found["relations"] == 2
    assert found["relations outside the path"] == 0
    assert found["relations' translation mean"] == pytest.approx(0.015, abs=1e-9)
    assert found["relations' translation std"] == pytest.approx(0.015, abs=1e-9)
    assert found["relations' translation RMSE"] == pytest.approx(0.03 / np.sqrt(2.0), abs=1e-9)
    assert found["relations' rotation mean"] == pytest.approx(0.05, abs=1e-9)


def test_turns_are_roll_then_pitch_then_yaw_about_fixed_axes(tmp_path: Path) -> None:
    path = tmp_path / "intel.relations"
    path.write_text("0 1 0 0 0 0.3 0.2 0.1\n")
    x_axis = read_relations(path).T_begin_end[0, :3, 0]
    np.testing.assert_allclose(
        x_axis, [np.cos(0.1) * np.cos(0.2), np.sin(0.1) * np.cos(0.2), -np.sin(0.2)], atol=1e-12
    )


def test_poses_are_interpolated_and_relations_outside_the_path_counted(tmp_path: Path) -> None:
    found = _values(tmp_path, "0.25 0.25 0 0 0 0 0 0\n9.0 11.0 0 0 0 0 0 0\n-1.0 2.0 0 0 0 0 0 0\n")
    assert (found["relations"], found["relations outside the path"]) == (1, 2)
    assert found["relations' translation RMSE"] == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize(
    ("text", "error"),
    [
        ("", DataError),
        ("0 1 2 3 4 5 6\n", SourceError),
        ("0 1 0 0 0 0 0 x\n", DataError),
        ("0 1 0 0 0 0 0 nan\n", DataError),
        ("a 1 0 0 0 0 0 0\n", SourceError),
        ("20 21 0 0 0 0 0 0\n", DataError),
    ],
)
def test_unusable_files_are_refused(tmp_path: Path, text: str, error: type[Exception]) -> None:
    with pytest.raises(error):
        _values(tmp_path, text)


def test_eval_prints_them_beside_the_other_metrics(tmp_path: Path) -> None:
    estimate, relations = tmp_path / "path.tum", tmp_path / "intel.relations"
    _circle().write(estimate)
    relations.write_text("5 10 0 0 0 0 0 0.4\n")
    result = invoke("eval", estimate, "--relations", relations, "--json")
    values = {one["name"]: one["value"] for one in json.loads(result.stdout)["metrics"]}
    assert values["relations' rotation mean"] == pytest.approx(0.1, abs=1e-9)
    assert values["relations' translation mean"] == pytest.approx(2.0 * np.sin(0.25), abs=1e-9)
