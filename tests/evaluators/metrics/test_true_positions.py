"""Truth as tables of other programs, and of positions alone: a total station's, or GNSS'."""

import numpy as np
import pytest

from mapper.core.errors import ConfigError
from mapper.core.geometry import exp
from mapper.core.rotations import row_of_pose
from mapper.core.trajectory import Positions, Trajectory
from mapper.evaluators.metrics.evaluate import evaluate
from mapper.odometry.config import GivenOdometryConfig
from mapper.odometry.given_poses import poses_for
from mapper.sources import open_source
from mapper.sources.trajectory_files import read_tum, write_tum
from tests.support.tum_logs import FIRST_NS, PERIOD_NS, write_tiny_log

LEVER = np.array([0.1, -0.2, 0.3])


def walk(n=40):
    rng = np.random.default_rng(3)
    T, poses = np.eye(4), []
    for _ in range(n):
        T = T @ exp(rng.normal(0.0, 0.2, 3), rng.normal(0.0, 0.2, 3))
        poses.append(T)
    return Trajectory(FIRST_NS // 1000 * 1000 + np.arange(n) * PERIOD_NS, np.array(poses))


WALK = walk()
PRISM = WALK.positions + WALK.T_world_body[:, :3, :3] @ LEVER
SECONDS = [f"{ns / 1e9:.6f}" for ns in WALK.stamps_ns]
ROWS = row_of_pose(WALK.T_world_body)


def table(path, header, stamps, numbers, separator=","):
    rows = zip(stamps, numbers.tolist(), strict=True)
    lines = [separator.join([str(stamp), *map(repr, row)]) for stamp, row in rows]
    path.write_text("\n".join([header, *lines]) + "\n")
    return path


ANGLES = np.tile([0.1, 0.2, 0.3], (len(WALK), 1))
POSITIONS = {
    "TUM": ("# timestamp tx ty tz", SECONDS, PRISM, " "),
    "no header": ("", SECONDS, PRISM, " "),
    "EuRoC": ("#timestamp [ns], p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m]", WALK.stamps_ns, PRISM, ","),
    "Boreas": (
        "GPSTime,easting,northing,altitude,vel_east,vel_north,vel_up,roll,pitch,heading",
        WALK.stamps_ns // 1000,
        np.hstack([PRISM, ANGLES, ANGLES]),
        ",",
    ),
    "NCLT": ("", WALK.stamps_ns // 1000, np.hstack([PRISM, ANGLES]), ","),
    "semicolons": ("time;x;y;z", SECONDS, PRISM, ";"),
}


@pytest.mark.parametrize("form", POSITIONS.values(), ids=POSITIONS.keys())
def test_positions_are_read_by_their_columns(tmp_path, form):
    read = read_tum(table(tmp_path / "a.csv", *form))
    assert isinstance(read, Positions)
    assert isinstance(read[3:].moved(exp(np.ones(3), np.ones(3))), Positions)
    np.testing.assert_allclose(read.positions, PRISM)
    np.testing.assert_allclose(read.stamps_ns, WALK.stamps_ns, atol=1000)


def split(stamps_ns):
    return [f"{ns // 10**9},{ns % 10**9}" for ns in stamps_ns.tolist()]


W_FIRST = [0, 1, 2, 6, 3, 4, 5]
POSES = {
    "Newer College": ("# sec,nsec,x,y,z,qx,qy,qz,qw", split(WALK.stamps_ns), ROWS),
    "ROS": (
        "%time,field.pose.position.x,field.pose.position.y,field.pose.position.z,"
        "field.pose.orientation.x,field.pose.orientation.y,field.pose.orientation.z,field.pose.orientation.w",
        WALK.stamps_ns,
        ROWS,
    ),
    "w first": ("time_s,pos_x,pos_y,pos_z,quat_w,quat_x,quat_y,quat_z", SECONDS, ROWS[:, W_FIRST]),
    "numbered": ("time,frame,x,y,z,qx,qy,qz,qw", SECONDS, np.hstack([np.arange(len(WALK))[:, None], ROWS])),
}


@pytest.mark.parametrize("form", POSES.values(), ids=POSES.keys())
def test_poses_are_read_by_the_names_of_their_columns(tmp_path, form):
    read = read_tum(table(tmp_path / "a.csv", *form))
    assert not isinstance(read, Positions)
    np.testing.assert_allclose(read.T_world_body, WALK.T_world_body, atol=1e-9)
    np.testing.assert_allclose(read.stamps_ns, WALK.stamps_ns, atol=1000)


def test_positions_are_compared_without_rotations_and_with_a_lever_arm(tmp_path):
    found = evaluate(WALK, table(tmp_path / "a.txt", *POSITIONS["TUM"]))
    names = [metric.name for metric in found]
    assert not [name for name in names if name.startswith(("RPE", "relative", "segments"))]
    assert found["ATE RMSE"] > 0.1
    assert found["lever arm of the true positions: ATE RMSE"] < 1e-5
    assert found.metrics[names.index("lever arm of the true positions")].value == pytest.approx(
        np.linalg.norm(LEVER), abs=1e-3
    )


def test_poses_that_never_turn_are_positions_where_they_are_the_truth(tmp_path):
    unturned = np.hstack([PRISM, np.tile([0.0, 0.0, 0.0, 1.0], (len(WALK), 1))])
    path = table(tmp_path / "a.txt", "", SECONDS, unturned, " ")
    assert not isinstance(read_tum(path), Positions)
    found = evaluate(WALK, path)
    assert found["lever arm of the true positions: ATE RMSE"] < 1e-5
    assert found.ate_m == pytest.approx(evaluate(read_tum(path), WALK).ate_m, rel=0.1)


def test_units_of_stamps_may_stand_in_the_header(tmp_path):
    path = table(tmp_path / "a.csv", "time [ms],x,y,z", np.arange(len(WALK)) * 100, PRISM)
    assert np.diff(read_tum(path).stamps_ns).tolist() == [100_000_000] * (len(WALK) - 1)


def test_a_log_may_have_true_positions(tmp_path):
    log_path = write_tiny_log(tmp_path / "log", 6)
    positions = Positions(WALK.stamps_ns[:6], WALK.T_world_body[:6])
    write_tum(log_path / "groundtruth.txt", positions)
    log = open_source(log_path)
    assert isinstance(log.truth, Positions)
    assert poses_for(GivenOdometryConfig(), log) is None
    with pytest.raises(ConfigError, match="positions alone"):
        poses_for(GivenOdometryConfig(path=log_path / "groundtruth.txt"), log)
