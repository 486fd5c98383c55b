"""Bridging by inertial readings: lost frames, parts of a path, motions that surfaces leave open."""

import re
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mapper.core.doubts import Doubt
from mapper.core.geometry import exp, inverse, length_and_angle, log
from mapper.core.timebase import NS_PER_S, nearest
from mapper.graph.components import components
from mapper.graph.model import BetweenFactor, PoseGraph
from mapper.odometry.base import Diagnostics, FrameResult, lost_frame
from mapper.odometry.gyroscope_calibration import GyroscopeCalibration, body_readings
from mapper.pipeline.inertial_bridging import bridge, check_accelerations, with_body_readings
from mapper.pipeline.tracking_result import TrackingResult
from mapper.runtime.progress import SILENT
from mapper.sensing.inertial import InertialReadings
from mapper.simulation.config import SynthImuConfig
from mapper.simulation.path import START_NS
from mapper.simulation.readings import measure_imu
from tests.support.logs import log_in_memory

SIGMAS = np.array([1e-3] * 3 + [3e-3] * 3)
TILTED = exp(np.array([0.3, -0.2, 0.5]), np.zeros(3))  # the world of an odometry is not level
IMU = SynthImuConfig(bias_radps=0.0, mounting_rad=(0.1, -0.2, 1.5))
CALIBRATION = GyroscopeCalibration(
    Rotation.from_rotvec(IMU.mounting_rad).as_matrix(), np.zeros(3), IMU.offset_s, 1.0, np.eye(7) * 1e-8
)


@cache
def walk(seed):
    """T_world_body at times in seconds: a smooth walk that turns and sways."""
    rng = np.random.default_rng(seed)
    hz, phase = rng.uniform(0.05, 0.4, (6, 4)), rng.uniform(0.0, 2.0 * np.pi, (6, 4))
    size = np.array([0.15, 0.15, 0.4, 0.6, 0.6, 0.1])[:, None] * rng.uniform(0.5, 1.0, (6, 4))

    def poses(times_s):
        waves = (size[:, :, None] * np.sin(2.0 * np.pi * hz[:, :, None] * times_s + phase[:, :, None])).sum(1)
        T = np.tile(np.eye(4), (len(times_s), 1, 1))
        T[:, :3, :3] = Rotation.from_euler("zyx", waves[[2, 1, 0]].T).as_matrix()
        T[:, :3, 3] = waves[3:].T + np.array([0.8, 0.0, 0.0]) * times_s[:, None]
        return T

    return poses


@cache
def made(seed, *, lost=(), seconds=16.0):
    """A log with readings, what its frames say at 10 Hz, each fifth a keyframe, and their true poses.

    Frames of ``lost`` are lost; after them the odometry begins a part in a world of its own.
    """
    rng = np.random.default_rng(100 + seed)
    times_s = np.arange(0.5, seconds, 0.1)
    truth = walk(seed)(times_s)
    gyroscope, accelerations = measure_imu(IMU, walk(seed), duration_s=seconds + 1.0, rng=rng)
    log_ = log_in_memory([], gyroscope=gyroscope, accelerations=accelerations)
    graph, tracks, node, at, T_world_true = PoseGraph(), [], None, 0, TILTED
    for k, T_true in enumerate(truth):
        stamp_ns = START_NS + round(times_s[k] * NS_PER_S)
        if k in lost:
            tracks.append(lost_frame(stamp_ns, np.eye(4)))
            node, T_world_true = None, np.eye(4)
            continue
        noise = SIGMAS * rng.standard_normal(6)
        is_keyframe = node is None or k % 5 == 0
        before, number = node, len(graph.T_world_node)
        T_node_body = np.eye(4)
        if before is not None:
            T_node_body = inverse(truth[at]) @ T_true @ exp(noise[:3], noise[3:])
        if is_keyframe:
            graph.add_node(number, stamp_ns, T_world_true @ T_true)
            if before is not None:
                graph.add_factors([BetweenFactor(before, number, T_node_body, np.diag(SIGMAS**-2.0))])
            node, at, T_node_body = number, k, np.eye(4)
        tracks.append(
            FrameResult(
                stamp_ns,
                node,
                T_node_body,
                np.eye(4),
                is_keyframe,
                Diagnostics(),
                covariance=np.diag(SIGMAS**2),
            )
        )
    return log_, TrackingResult(tuple(tracks), (), graph, (), {}, gyroscope=CALIBRATION), truth


def felt_times(log_, factor):
    felt = log_.accelerations
    return replace(log_, accelerations=replace(felt, acceleration_mps2=factor * felt.acceleration_mps2))


def relative(result, truth, a, b):
    """Error (rotation, translation) of frame b's pose relative to frame a's."""
    poses = [result.graph.T_world_node[result.tracks[k].node] @ result.tracks[k].T_node_body for k in (a, b)]
    return np.concatenate(log(inverse(inverse(truth[a]) @ truth[b]) @ inverse(poses[0]) @ poses[1]))


@pytest.mark.parametrize("seed", range(3))
def test_two_seconds_without_a_view_are_bridged(seed):
    lost = range(70, 90)
    log_, tracking, truth = made(seed, lost=lost)
    assert len(components(tracking.graph)) == 2
    found = bridge(log_, tracking, progress=SILENT)
    assert len(components(found.graph)) == 1
    for k in (*lost, 95, 110):
        error = relative(found, truth, 69, k)
        assert np.linalg.norm(error[:3]) < 0.01
        assert np.linalg.norm(error[3:]) < 0.03
    assert all(found.tracks[k].doubts[0].kind == "unobservable" for k in lost)
    assert not any(found.tracks[k].doubts for k in range(len(truth)) if k not in lost)


def test_the_covariance_of_a_bridge_is_that_of_its_errors():
    chi2 = []
    for seed in range(12):
        log_, tracking, truth = made(seed, lost=range(70, 100))
        found = bridge(log_, tracking, progress=SILENT)
        factor = found.graph.factors[-1]
        ends = [k for k, t in enumerate(found.tracks) if t.is_keyframe and t.node in (factor.i, factor.j)]
        error = np.concatenate(log(inverse(inverse(truth[ends[0]]) @ truth[ends[1]]) @ factor.T_i_j))
        chi2.append(error @ factor.information @ error)
    assert 0.3 < np.mean(chi2) / 6.0 < 2.0


@pytest.mark.parametrize("is_open", [True, False])
def test_a_motion_that_surfaces_hardly_show_is_the_readings(is_open):
    """As in a tunnel: for six seconds the motion along x is off by a tenth, as a guess or by few surfaces."""
    log_, tracking, truth = made(3)
    open_ = range(51, 111)
    wide = np.array([*SIGMAS[:3], 0.5, *SIGMAS[4:]])
    doubts = (Doubt("unobservable", "translation along x is not seen but predicted"),) if is_open else ()
    stretch = np.eye(4)
    tracks, factors = list(tracking.tracks), list(tracking.graph.factors)
    for k in open_:
        T = tracks[k].T_node_body.copy()
        T[0, 3] *= 1.1
        tracks[k] = replace(
            tracks[k], T_node_body=T, covariance=np.diag(wide**2), doubts=doubts,
            diagnostics=Diagnostics(unobservable="translation along x" if is_open else ""),
        )  # fmt: skip
    nodes = {tracks[k].node for k in open_ if tracks[k].is_keyframe}
    for n, factor in enumerate(factors):
        if factor.j in nodes:
            stretch = factor.T_i_j.copy()
            stretch[0, 3] *= 1.1
            factors[n] = replace(factor, T_i_j=stretch, information=np.diag(wide**-2.0))
    graph = tracking.graph.with_factors(factors)
    found = bridge(log_, replace(tracking, tracks=tuple(tracks), graph=graph), progress=SILENT)
    assert not any(track.doubts for track in found.tracks)
    T_first_last, whole = np.eye(4), np.zeros((6, 6))
    for factor in found.graph.factors:
        if factor.j in nodes:
            T_first_last = T_first_last @ factor.T_i_j
            whole += np.linalg.inv(factor.information)
    off_m = length_and_angle(inverse(inverse(truth[50]) @ truth[110]) @ T_first_last)[0]
    assert off_m < min(0.12, 3.0 * np.trace(whole[3:, 3:]) ** 0.5)
    assert whole[3, 3] ** 0.5 < 0.1


@pytest.mark.parametrize("sigma_m", [0.003, 0.03])
def test_a_pose_that_the_readings_contradict_is_replaced(sigma_m):
    """A keyframe 0.3 m off, of which its factor is more or less certain."""
    log_, tracking, _ = made(4)
    wrong = next(k for k, factor in enumerate(tracking.graph.factors) if factor.j == 12)
    factors = list(tracking.graph.factors)
    aside = exp(np.zeros(3), 0.3 * np.eye(3)[0])
    information = np.diag([*SIGMAS[:3] ** -2.0, *[sigma_m**-2.0] * 3])
    factors[wrong] = replace(factors[wrong], T_i_j=factors[wrong].T_i_j @ aside, information=information)
    graph = tracking.graph.with_factors(factors)
    found = bridge(log_, replace(tracking, graph=graph), progress=SILENT)
    factor = found.graph.factors[wrong]
    assert length_and_angle(inverse(tracking.graph.factors[wrong].T_i_j) @ factor.T_i_j)[0] < 0.01
    assert [k for k, one in enumerate(found.graph.factors) if one is not factors[k]] == [wrong]


def test_where_the_path_is_too_short_for_the_sign_that_one_is_used_by_which_readings_fit_it():
    log_, tracking, _ = made(4, seconds=2.2)
    factors = list(tracking.graph.factors)
    factors[1] = replace(factors[1], T_i_j=factors[1].T_i_j @ exp(np.zeros(3), 0.3 * np.eye(3)[0]))
    tracking = replace(tracking, graph=tracking.graph.with_factors(factors))
    given = felt_times(log_, -1.0)
    assert [check_accelerations(one, tracking)[2] for one in (log_, given)] == [False, False]
    right, reversed_ = (bridge(one, tracking, progress=SILENT).graph.factors for one in (log_, given))
    for one, other in zip(right, reversed_, strict=True):
        np.testing.assert_allclose(one.T_i_j, other.T_i_j, atol=1e-9)
    assert length_and_angle(inverse(factors[1].T_i_j) @ right[1].T_i_j)[0] > 0.2


@pytest.mark.parametrize("seed", [9, 10])
def test_a_unit_beside_the_body_bridges_as_well(seed):
    """Its mounting is a rotation alone: 0.1 m of lever arm, unknown, are errors of the accelerations."""
    log_, tracking, truth = made(seed, lost=range(70, 90))
    aside = exp(np.zeros(3), np.array([0.1, 0.0, 0.05]))
    gyroscope, accelerations = measure_imu(
        IMU, lambda times_s: walk(seed)(times_s) @ aside, duration_s=17.0, rng=np.random.default_rng(seed)
    )
    found = bridge(replace(log_, gyroscope=gyroscope, accelerations=accelerations), tracking, progress=SILENT)
    assert len(components(found.graph)) == 1
    assert np.linalg.norm(relative(found, truth, 69, 95)[3:]) < 0.1
    assert all(f in tracking.graph.factors for f in found.graph.factors[:-1])


def test_readings_of_a_unit_whose_place_is_stated_are_those_at_the_origin():
    place_m, exact = np.array([0.8, -0.4, 0.3]), IMU.model_copy(update={"accelerometer_noise_mps2": 0.0})
    aside = exp(np.zeros(3), place_m)

    def felt_by(place, stated):
        rng = np.random.default_rng(0)
        poses = walk(2)
        gyroscope, felt = measure_imu(exact, lambda times_s: poses(times_s) @ place, duration_s=9.0, rng=rng)
        log_ = log_in_memory([], gyroscope=gyroscope, accelerations=replace(felt, place_body=stated))
        readings = body_readings(log_, CALIBRATION)
        return np.cumsum(readings.accelerations_mps2, axis=0)[::40] / IMU.rate_hz  # velocities, 5 a second

    at_origin = np.diff(felt_by(np.eye(4), None), axis=0)
    unstated, stated = (np.diff(felt_by(aside, place), axis=0) - at_origin for place in (None, place_m))
    assert np.median(np.linalg.norm(stated, axis=1)) < 0.01
    assert np.median(np.linalg.norm(unstated, axis=1)) > 0.03


def late(log_):
    return replace(log_.accelerations, stamps_ns=log_.accelerations.stamps_ns + NS_PER_S // 2)


def of_another_walk(_):
    return made(12)[0].accelerations


@pytest.mark.parametrize("fault", [late, of_another_walk])
def test_accelerations_that_contradict_the_path_are_not_used_and_named(fault):
    log_, tracking, _ = made(5, lost=range(70, 90))
    found = bridge(replace(log_, accelerations=fault(log_)), tracking, progress=SILENT)
    assert len(components(found.graph)) == 2
    assert found.tracks == tracking.tracks
    assert [warning.kind for warning in found.warnings] == ["imu"]


FLIPPED, TURNED = np.diag([1.0, -1.0, 1.0]), np.eye(3)[[1, 2, 0]]


@pytest.mark.parametrize("seed", [5, 6])
@pytest.mark.parametrize(
    ("of_rates", "of_felt", "notes"),
    [(np.eye(3), FLIPPED, 2), (np.eye(3), TURNED, 1), (FLIPPED, np.eye(3), 1), (FLIPPED, FLIPPED, 1)],
    ids=["flipped", "turned", "gyroscope flipped", "both flipped"],
)
def test_accelerations_in_other_axes_than_the_angular_velocities_bridge_as_well(
    seed, of_rates, of_felt, notes
):
    log_, tracking, truth = made(seed, lost=range(70, 90))
    gyroscope, felt = log_.gyroscope, log_.accelerations
    log_ = replace(
        log_,
        gyroscope=replace(gyroscope, rates_radps=gyroscope.rates_radps @ of_rates),
        accelerations=replace(felt, acceleration_mps2=felt.acceleration_mps2 @ of_felt),
    )
    handed = float(np.linalg.det(of_rates))
    calibration = replace(CALIBRATION, scale=handed, R_body_imu=handed * CALIBRATION.R_body_imu @ of_rates)
    found = bridge(log_, replace(tracking, gyroscope=calibration), progress=SILENT)
    assert len(components(found.graph)) == 1
    assert np.linalg.norm(relative(found, truth, 69, 95)[3:]) < 0.04
    assert len(found.warnings) == notes + 1


def test_accelerations_of_a_gyroscope_with_a_flipped_axis_are_not_used_where_the_path_is_short():
    log_, tracking, _ = made(4, seconds=2.2)
    left_handed = replace(tracking, gyroscope=replace(CALIBRATION, scale=-1.0))
    assert check_accelerations(log_, tracking)[0].accelerations is not None
    assert check_accelerations(log_, left_handed)[0].accelerations is None


def test_a_gap_of_the_accelerations_is_one_of_the_readings():
    log_, _, _ = made(5)
    felt = log_.accelerations
    kept = (felt.stamps_ns < START_NS + 5 * NS_PER_S) | (felt.stamps_ns > START_NS + 6 * NS_PER_S)
    gapped = replace(felt, stamps_ns=felt.stamps_ns[kept], acceleration_mps2=felt.acceleration_mps2[kept])
    whole, found = (body_readings(replace(log_, accelerations=one), CALIBRATION) for one in (felt, gapped))
    second = START_NS + np.arange(3, 10) * NS_PER_S
    spans = [(int(begin_ns), int(begin_ns) + NS_PER_S) for begin_ns in second]
    assert [whole.covers(*span) for span in spans] == [True] * 7
    assert [found.covers(*span) for span in spans] == [True, False, False, True, True, True, True]


@pytest.mark.parametrize(("factor", "notes"), [(1.0 / 9.80665, 0), (-1.0, 1)], ids=["in g", "reversed"])
def test_accelerations_in_g_and_of_the_opposite_sign_bridge_as_well(factor, notes):
    log_, tracking, truth = made(6, lost=range(70, 90))
    found = bridge(felt_times(log_, factor), tracking, progress=SILENT)
    assert len(components(found.graph)) == 1
    assert np.linalg.norm(relative(found, truth, 69, 95)[3:]) < 0.04
    assert sum("opposite sign" in warning.sentence for warning in found.warnings) == notes


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_accelerations_of_either_sign_point_up_at_rest_and_are_the_body_s_by_the_mounting(seed, sign):
    log_, tracking, truth = made(seed)
    given = felt_times(log_, sign)
    checked, warnings, _ = check_accelerations(given, tracking)
    assert np.array_equal(checked.accelerations.acceleration_mps2, log_.accelerations.acceleration_mps2)
    assert [(warning.kind, warning.weight) for warning in warnings] == [("imu", "note")] * (sign < 0.0)
    found = with_body_readings(given, tracking).accelerations
    assert (found.are_axes_stated, found.are_checked) == (True, True)
    at_ns = np.array([track.stamp_ns for track in tracking.tracks])
    felt_world = np.einsum(
        "nij,nj->ni", truth[:, :3, :3], found.acceleration_mps2[nearest(found.stamps_ns, at_ns)[0]]
    )
    mean = felt_world.mean(axis=0)
    assert np.degrees(np.arccos(mean[2] / np.linalg.norm(mean))) < 2.0  # IMU.mounting_rad is 13°


def test_accelerations_stay_in_their_own_axes_where_the_mounting_is_not_known():
    log_, tracking, _ = made(0)
    unsure = replace(CALIBRATION, covariance=np.eye(7))
    found = with_body_readings(log_, replace(tracking, gyroscope=unsure)).accelerations
    assert found is log_.accelerations


@pytest.mark.parametrize("is_exact", [True, False])
def test_no_scale_is_found_where_nothing_moved(is_exact):
    stamps_ns = 5_000_000 * np.arange(4000)
    felt = np.tile([0.0, 0.0, 9.81], (4000, 1))
    if not is_exact:
        felt += np.random.default_rng(0).normal(0.0, 0.05, felt.shape)
    readings = InertialReadings(stamps_ns, np.zeros_like(felt), felt, 20_000_000)
    assert readings.path_scale(100_000_000 * np.arange(1, 180), np.tile(np.eye(4), (179, 1, 1))) is None


def test_the_path_is_compared_with_readings_where_there_are_any():
    log_, tracking, _ = made(1)
    felt, rates = log_.accelerations, log_.gyroscope
    since_s = (felt.stamps_ns - felt.stamps_ns[0]) / NS_PER_S
    kept = (since_s < 5.0) | (since_s > 7.0)
    given = replace(
        log_,
        accelerations=replace(
            felt, stamps_ns=felt.stamps_ns[kept], acceleration_mps2=felt.acceleration_mps2[kept]
        ),
        gyroscope=replace(rates, stamps_ns=rates.stamps_ns[kept], rates_radps=rates.rates_radps[kept]),
    )
    assert check_accelerations(given, tracking) == (given, (), True)


@pytest.mark.parametrize("unit", [0.3048, 1.0, 5.0])
def test_lengths_that_are_no_metres_are_doubted(unit):
    log_, tracking, _ = made(1)
    graph = tracking.graph.with_poses(
        {node: enlarged(T, 1.0 / unit) for node, T in tracking.graph.T_world_node.items()}
    )
    tracks = [replace(t, T_node_body=enlarged(t.T_node_body, 1.0 / unit)) for t in tracking.tracks]
    _, warnings, _ = check_accelerations(log_, replace(tracking, graph=graph, tracks=tuple(tracks)))
    assert [warning.weight for warning in warnings] == ["doubt"] * (unit != 1.0)
    if warnings:
        times = float(re.search(r"is ([\d.]+) times", warnings[0].sentence)[1])
        assert times == pytest.approx(unit, rel=0.05)


def enlarged(T, scale):
    larger = T.copy()
    larger[:3, 3] *= scale
    return larger


def test_frames_that_surfaces_do_not_place_tell_nothing_of_accelerations():
    log_, tracking, _ = made(1)
    unseen = Diagnostics(unobservable="translation along x")
    tracks = tuple(replace(track, diagnostics=unseen) for track in tracking.tracks)
    given = felt_times(log_, -1.0)
    assert check_accelerations(given, replace(tracking, tracks=tracks)) == (given, (), False)


@pytest.mark.parametrize("seed", range(4))
def test_a_sensor_that_stands_tells_nothing_of_accelerations(seed):
    rng = np.random.default_rng(seed)
    log_, tracking, _ = made(seed)
    still = np.tile(np.array([0.1, 0.2, 9.8]), (len(log_.accelerations.stamps_ns), 1))
    felt = still + rng.normal(0.0, 0.05, still.shape)
    standing = PoseGraph({0: np.eye(4)}, {0: tracking.tracks[0].stamp_ns})
    tracks = [
        replace(track, node=0, T_node_body=exp(*(SIGMAS * rng.standard_normal(6)).reshape(2, 3)))
        for track in tracking.tracks
    ]
    rates = replace(log_.gyroscope, rates_radps=rng.normal(0.0, 1e-3, log_.gyroscope.rates_radps.shape))
    given = replace(log_, gyroscope=rates, accelerations=replace(log_.accelerations, acceleration_mps2=-felt))
    checked, warnings, _ = check_accelerations(given, replace(tracking, tracks=tuple(tracks), graph=standing))
    assert (checked, warnings) == (given, ())


def test_a_gap_of_the_readings_is_not_bridged():
    log_, tracking, _ = made(7, lost=range(70, 90))
    begin_ns = tracking.tracks[75].stamp_ns
    kept = abs(log_.gyroscope.stamps_ns - begin_ns) > NS_PER_S // 4
    gyroscope = replace(
        log_.gyroscope, stamps_ns=log_.gyroscope.stamps_ns[kept], rates_radps=log_.gyroscope.rates_radps[kept]
    )
    found = bridge(replace(log_, gyroscope=gyroscope), tracking, progress=SILENT)
    assert len(components(found.graph)) == 2


def test_a_log_that_shows_everything_stays_as_it_is():
    log_, tracking, _ = made(8)
    found = bridge(log_, tracking, progress=SILENT)
    assert found.tracks == tracking.tracks
    assert found.graph.factors == tracking.graph.factors
    assert bridge(replace(log_, accelerations=None), tracking, progress=SILENT) is tracking
