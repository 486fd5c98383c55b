"""Wheel odometry: from encoders and files to factors that connect what the camera lost."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from mapper.config.build import BuildConfig
from mapper.config.loading import load_config
from mapper.core.errors import SourceError
from mapper.core.geometry import angle_between, exp, inverse, transform
from mapper.core.trajectory import Trajectory
from mapper.graph.config import WheelFactorsConfig
from mapper.graph.model import BetweenFactor, PoseGraph
from mapper.graph.wheel_factors import WheelMeasurements, wheel_conflict
from mapper.pipeline.components import largest_component
from mapper.pipeline.solve import solve
from mapper.pipeline.track import track_log
from mapper.runtime.progress import SILENT
from mapper.sensing.wheel_kinematics import driven, pose_at
from mapper.simulation.config import SynthConfig
from mapper.simulation.source import CameraSimulator
from mapper.sources import open_source
from mapper.sources.config import SourceConfig, WheelsConfig
from mapper.sources.trajectory_files import write_tum
from tests.support.planar import at

S = 1_000_000_000
R_BASE_OPTICAL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


def on_a_line(n, *, step_m=0.5, turn_rad=0.0):
    T = [np.linalg.matrix_power(at(step_m, 0.0, turn_rad), k) for k in range(n)]
    return Trajectory(np.arange(n, dtype=np.int64) * S // 10, np.array(T))


def wheel_factors(stamps_ns, wheels, config):
    """The factors of nodes that come in time order."""
    measurements = WheelMeasurements(wheels, config)
    return [factor for node, stamp_ns in stamps_ns.items() for factor in measurements.link(node, stamp_ns)]


def test_a_held_wheel_drives_an_exact_arc_at_any_rate():
    wheelbase_m, steering_rad = 0.8, 0.3
    radius_m = wheelbase_m / np.tan(steering_rad)
    for n in (2, 7):
        path_m = np.linspace(5.0, 5.0 + radius_m * np.pi / 2.0, n)
        wheels = driven(
            np.arange(n, dtype=np.int64), path_m, np.full(n, steering_rad), wheelbase_m=wheelbase_m
        )
        np.testing.assert_allclose(wheels.T_world_body[0], np.eye(4), atol=0)
        quarter = at(radius_m, radius_m, np.pi / 2.0)
        np.testing.assert_allclose(wheels.T_world_body[-1], quarter, atol=1e-12)


def test_driving_back_the_same_path_ends_where_it_began():
    path_m = np.array([0.0, 1.0, 2.5, 1.0, 0.0])
    steering_rad = np.array([0.1, -0.3, 0.2, -0.3, 0.1])
    wheels = driven(np.arange(5, dtype=np.int64), path_m, steering_rad, wheelbase_m=0.5)
    np.testing.assert_allclose(wheels.T_world_body[-1], np.eye(4), atol=1e-12)


def test_poses_are_interpolated_but_never_guessed():
    wheels = on_a_line(3)
    at = {stamp_ns: pose_at(wheels, stamp_ns, max_gap_ns=S // 10) for stamp_ns in (-1, 0, S // 40, S // 5)}
    assert at[-1] is None
    assert pose_at(wheels, S // 5 + 1, max_gap_ns=S) is None
    assert (at[0][0, 3], at[S // 5][0, 3]) == (0.0, 1.0)
    assert at[S // 40][0, 3] == pytest.approx(0.125)
    assert pose_at(wheels, S // 40, max_gap_ns=S // 10 - 1) is None


def test_factors_follow_time_and_are_less_certain_the_longer_the_path():
    wheels = on_a_line(11, turn_rad=0.1)
    stamps_ns = {7: 0, 3: S // 10, 5: S, 9: 2 * S}  # node 9 comes after the wheels stopped
    config = WheelFactorsConfig()
    near, far = wheel_factors(stamps_ns, wheels, config)
    assert [(f.i, f.j, f.origin) for f in (near, far)] == [(7, 3, "wheel"), (3, 5, "wheel")]
    np.testing.assert_allclose(near.T_i_j, at(0.5, 0.0, 0.1), atol=1e-12)
    np.testing.assert_allclose(
        far.T_i_j, inverse(wheels.T_world_body[1]) @ wheels.T_world_body[10], atol=1e-12
    )
    sigma_rad, sigma_m = far.information[0, 0] ** -0.5, far.information[5, 5] ** -0.5
    assert sigma_m == pytest.approx(config.least_m + config.path_share * 4.5)
    assert sigma_rad == pytest.approx(config.least_rad + config.turn_share * 0.9 + config.rad_per_m * 4.5)
    assert near.information[5, 5] > far.information[5, 5]


def test_there_and_back_is_a_long_path():
    wheels = on_a_line(11)
    there_and_back = replace(wheels, T_world_body=wheels.T_world_body[[*range(6), 4, 3, 2, 1, 0]])
    (factor,) = wheel_factors({0: 0, 1: S}, there_and_back, WheelFactorsConfig())
    np.testing.assert_allclose(factor.T_i_j, np.eye(4), atol=1e-12)
    assert factor.information[5, 5] ** -0.5 == pytest.approx(0.01 + 0.05 * 5.0)


def test_a_motion_that_the_wheels_did_not_make_is_named():
    wheels = WheelMeasurements(on_a_line(21), WheelFactorsConfig())
    driven = transform(np.eye(3), [10.0, 0.0, 0.0])
    assert wheels.contradiction(driven, 0, 2 * S) == ""
    assert wheels.contradiction(transform(np.eye(3), [9.0, 0.5, 0.0]), 0, 2 * S) == ""  # 5 % of the way
    assert wheels.contradiction(np.eye(4), 0, 2 * S).startswith("10.00 m and 0.00 rad off, at most 2.")
    assert wheels.contradiction(np.eye(4), 0, 9 * S) == ""  # no readings, so nothing is known
    assert WheelMeasurements(None, WheelFactorsConfig()).contradiction(np.eye(4), 0, 2 * S) == ""


def test_wheels_that_slip_are_told():
    stamps_ns = {k: k * S // 2 for k in range(5)}
    graph = PoseGraph()
    for k, stamp_ns in stamps_ns.items():  # the third step has two metres, of which the wheels know nothing
        graph.add_node(k, stamp_ns, at(2.5 * k + (2.0 if k > 2 else 0.0), 0.0, 0.0))
    steps = [BetweenFactor(k, k + 1, np.eye(4), np.eye(6)) for k in range(4)]
    driven = wheel_factors(stamps_ns, on_a_line(21), WheelFactorsConfig())
    connected, broken = (PoseGraph(graph.T_world_node, stamps_ns, kept) for kept in (steps, steps[:2]))
    said = wheel_conflict(connected, driven)
    assert said.startswith("the wheels contradict the odometry in 1 of 4 steps between keyframes, by 2.00 m")
    assert wheel_conflict(broken, driven) == ""  # the odometry measured nothing there
    assert wheel_conflict(connected, []) == ""


def test_without_wheels_or_when_switched_off_there_are_no_factors():
    stamps_ns = {0: 0, 1: S // 10}
    assert wheel_factors(stamps_ns, None, WheelFactorsConfig()) == []
    assert wheel_factors(stamps_ns, on_a_line(3), WheelFactorsConfig(use=False)) == []
    assert wheel_factors({0: 5 * S}, on_a_line(3), WheelFactorsConfig()) == []


def test_poses_beside_a_log_are_led_to_a_camera_that_looks_forward(tiny_tum_log):
    log = tiny_tum_log(3)
    base = on_a_line(4, turn_rad=0.2)
    write_tum(log / "wheels.txt", base)
    source = open_source(log)
    assert source.notes == ["wheels.txt: wheel odometry, 4 poses"]
    expected = base.T_world_body @ transform(R_BASE_OPTICAL, np.zeros(3))
    np.testing.assert_allclose(source.wheels.T_world_body, expected, atol=1e-12)
    assert len(open_source(log, SourceConfig(first_frame=1)).wheels) == 4
    mounted = WheelsConfig(body_in_base=(0.1, 0.0, 0.4, 0.0, 0.0, 0.0, 1.0))
    wheels = open_source(log, SourceConfig(wheels=mounted)).wheels
    np.testing.assert_allclose(wheels.T_world_body[0][:3, 3], [0.1, 0.0, 0.4], atol=1e-12)


def test_encoders_beside_a_log_want_a_wheelbase(tiny_tum_log):
    log = tiny_tum_log(3)
    (log / "encoders.txt").write_text("# stamp path_m steering_rad\n2.0 1.5 0.0\n1.0 0.5 0.0\n")
    with pytest.raises(
        SourceError, match=r"encoders.txt: the wheelbase is unknown; --set source.wheels.whee"
    ):
        open_source(log)
    source = open_source(log, SourceConfig(wheels=WheelsConfig(wheelbase_m=0.5)))
    assert source.wheels.stamps_ns.tolist() == [S, 2 * S]
    np.testing.assert_allclose(source.wheels.positions_world, [[0, 0, 0], [1, 0, 0]], atol=1e-12)


@pytest.mark.parametrize(
    ("name", "text", "why"),
    [
        ("encoders.txt", "1.0 2.0\n", r"encoders.txt:1: 2 columns, want 3: stamp path_m steering_rad"),
        ("encoders.txt", "1.0 2.0 1.6\n", r"encoders.txt:1: .* within ±π/2 rad"),
        ("encoders.txt", "# none\n", r"encoders.txt: no readings"),
        ("wheels.txt", "1.0 0 0 0\n", r"wheels.txt:1: 4 columns, want 8"),
    ],
)
def test_malformed_files_are_named(tiny_tum_log, name, text, why):
    log = tiny_tum_log(2)
    (log / name).write_text(text)
    with pytest.raises(SourceError, match=why):
        open_source(log, SourceConfig(wheels=WheelsConfig(wheelbase_m=0.5)))


def test_a_mounting_without_a_rotation_is_refused(tiny_tum_log):
    log = tiny_tum_log(2)
    write_tum(log / "wheels.txt", on_a_line(2))
    with pytest.raises(SourceError, match=r"body_in_base=\(0.0, .* its quaternion is zero"):
        open_source(log, SourceConfig(wheels=WheelsConfig(body_in_base=(0.0,) * 7)))


@pytest.fixture(scope="module")
def interrupted():
    """A walk during which the lens is covered for five seconds, and wheels that drift on the way."""
    source = CameraSimulator(
        SynthConfig(
            duration_s=11.0,
            frame_rate_hz=15.0,
            width_px=320,
            height_px=240,
            texture_px_per_m=96,
            blackout_start_s=3.0,
            blackout_duration_s=5.0,
        )
    ).log()
    rng = np.random.default_rng(4)
    truth, T = source.truth.T_world_body, [np.eye(4)]
    for before, after in pairwise(truth):
        step = inverse(before) @ after
        step[:3, 3] *= 1.02
        T.append(T[-1] @ step @ exp(rng.normal(0.0, 5e-4, 3), rng.normal(0.0, 5e-4, 3)))
    return replace(source, wheels=Trajectory(source.stamps_ns, np.array(T)))


def mapped(source, config):
    tracking = largest_component(track_log(source, config, progress=SILENT), progress=SILENT)
    solved = solve(tracking.graph, tracking.loops, config.graph)
    return replace(tracking, graph=solved.graph).trajectory()


@pytest.mark.slow
def test_wheels_connect_what_is_before_and_after_a_covered_lens(interrupted):
    config: BuildConfig = load_config(None, ["loops.kind=none"])
    alone = mapped(
        interrupted,
        config.model_copy(
            update={"graph": config.graph.model_copy(update={"wheels": WheelFactorsConfig(use=False)})}
        ),
    )
    connected = mapped(interrupted, config)
    covered, begun_anew_after = 75, config.odometry.max_lost_frames
    assert len(alone) < 60
    assert len(connected) == len(interrupted) - covered - begun_anew_after
    first, last = (np.searchsorted(interrupted.truth.stamps_ns, connected.stamps_ns[k]) for k in (0, -1))
    truth = interrupted.truth.T_world_body
    want = inverse(truth[first]) @ truth[last]
    got = inverse(connected.T_world_body[0]) @ connected.T_world_body[-1]
    assert np.linalg.norm(got[:3, 3] - want[:3, 3]) < 0.15
    assert angle_between(got[:3, :3], want[:3, :3]) < 0.05
