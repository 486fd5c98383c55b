"""Scans at 2 Hz in fast turns, tracked with the gyroscope of the log."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mapper.core.geometry import fit_rigid
from mapper.odometry.factory import odometry_for
from mapper.odometry.motion_prior import MotionPrior
from mapper.odometry.scans.config import GicpOdometryConfig
from mapper.odometry.scans.motion_model import MotionModel
from mapper.pipeline.track import begin_calibrated
from mapper.sensing.gyroscope import Gyroscope
from mapper.simulation.config import LidarSensorConfig, LidarSynthConfig, SynthImuConfig
from mapper.simulation.lidar.source import LidarSimulator
from mapper.sources.base import FrameRef, Log

IMU = SynthImuConfig()
SWINGING = LidarSynthConfig(
    scene="courtyard",
    seed=2,
    loop_m=60.0,
    rate_hz=2.0,
    duration_s=12.0,
    speed_mps=1.2,
    tilt_rad=0.3,
    yaw_swing_rad=1.5,
    imu=IMU,
    sensor=LidarSensorConfig(rings=16, lowest_ring_rad=-0.26, highest_ring_rad=0.26, azimuth_steps=450),
)


def stated(log: Log) -> Log:
    R_body_imu = Rotation.from_rotvec(IMU.mounting_rad).as_matrix()
    return replace(log, gyroscope=replace(log.gyroscope, R_body_imu=R_body_imu))


@pytest.mark.parametrize("is_stated", [True, False])
def test_scans_are_deskewed_by_the_gyroscope_from_the_first_on(is_stated):
    log = LidarSimulator(SWINGING).log()
    log = stated(log) if is_stated else log
    odometry = odometry_for(GicpOdometryConfig(), log)
    begin_calibrated(odometry, log, workers=0)
    results = [odometry.track(odometry.read(entry)) for entry in log.entries()]
    positions = np.array([result.T_world_body[:3, 3] for result in results])
    true = log.truth.positions_world
    T, _ = fit_rigid(true, positions)
    errors_m = np.linalg.norm(positions @ T[:3, :3].T + T[:3, 3] - true, axis=1)
    assert np.sqrt((errors_m**2).mean()) < 0.03
    assert not any(result.doubts for result in results)
    assert any("offset 7 ±" in note for note in odometry.gyroscope_notes())


@pytest.mark.parametrize("without", [True, False])
def test_no_scan_is_read_in_advance_where_nothing_is_to_be_calibrated(without):
    log = LidarSimulator(SWINGING).log()
    log = replace(log, gyroscope=None) if without else stated(log)
    begin_calibrated(odometry_for(GicpOdometryConfig(), log), replace(log, entry_at=None), workers=0)


def thrice(log: Log, read: list[int]) -> Log:
    """A log three times over; ``read`` keeps the indices of its scans that are read."""

    def entry_at(index: int) -> FrameRef:
        read.append(index)
        return log.entry_at(index % len(log))

    stamps_ns = log.stamps_ns[0] + 500_000_000 * np.arange(3 * len(log))
    return replace(log, stamps_ns=stamps_ns, entry_at=entry_at)


@pytest.mark.parametrize(("turns", "fewest", "most"), [(1.0, 8, 20), (0.0, 40, 40)])
def test_scans_are_read_in_advance_until_they_show_the_mounting_but_not_all(turns, fewest, most):
    log, read = LidarSimulator(SWINGING).log(), []
    log = replace(log, gyroscope=replace(log.gyroscope, rates_radps=turns * log.gyroscope.rates_radps))
    begin_calibrated(odometry_for(GicpOdometryConfig(), log), thrice(log, read), workers=0)
    assert fewest <= len(read) <= most


def swinging_model(frames: int) -> tuple[MotionModel, list[int], np.ndarray]:
    """A motion model after some frames at 2 Hz of a body that swings; its gyroscope ends after 20 s."""
    readings_s = np.arange(0.0, 20.0, 0.005)
    rates = np.column_stack([0.3 * np.cos(1.1 * readings_s), np.zeros(4000), 2.0 * np.cos(1.7 * readings_s)])
    rates[:, 0] += 1e-3 * np.random.default_rng(1).standard_normal(4000)
    gyroscope = Gyroscope("imu", np.round(readings_s * 1e9).astype(np.int64), rates, np.eye(3))
    stamps_ns = (np.arange(0.5, 30.0, 0.5) * 1e9).astype(np.int64).tolist()
    turns = Rotation.from_rotvec(0.005 * rates)
    R = [Rotation.identity()]
    for turn in turns:
        R.append(R[-1] * turn)
    T = np.tile(np.eye(4), (len(stamps_ns), 1, 1))
    T[:, :3, :3] = [R[min(stamp_ns // 5_000_000, 4000)].as_matrix() for stamp_ns in stamps_ns]
    model = MotionModel(stamps_ns[0], T[0], MotionPrior(gyroscope))
    for k in range(1, frames):
        model.follow(stamps_ns[k], T[k])
    return model, stamps_ns, T


def test_a_pose_is_ruled_out_that_turns_otherwise_than_the_gyroscope():
    model, stamps_ns, T = swinging_model(30)
    half_turn = np.diag([-1.0, -1.0, 1.0, 1.0])
    assert model.is_ruled_out(stamps_ns[30], T[30] @ half_turn)
    assert not model.is_ruled_out(stamps_ns[30], T[30])
    for _ in range(20):  # of one frame, of which the right pose is accepted
        model.is_ruled_out(stamps_ns[30], T[30] @ half_turn)
    model.follow(stamps_ns[30], T[30])
    assert model.is_ruled_out(stamps_ns[31], T[31] @ half_turn)


def test_where_the_gyroscope_has_no_readings_constant_velocity_errs_as_it_does():
    """Not as the gyroscope does: a pose would be taken for a surprise, and a bent sweep for a rigid one."""
    known, stamps_ns, _ = swinging_model(35)
    unknown, _, _ = swinging_model(40)
    by_gyroscope, by_velocity = known.spread(stamps_ns[35]), unknown.spread(stamps_ns[40])
    assert by_velocity.rotation_rad > 5.0 * by_gyroscope.rotation_rad
    assert known.velocity_sigmas(stamps_ns[35])[0] > 0.3  # its velocity changes, whoever predicts the pose
