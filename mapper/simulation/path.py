"""Paths of the camera: round the flat, small motions before a desk, turns on the spot, or still at a wall."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from mapper.core.errors import SourceError
from mapper.core.geometry import Array
from mapper.core.timebase import NS_PER_S, Stamps
from mapper.simulation.config import SynthConfig
from mapper.simulation.plan import DESK_SIZE_M, Plan, closed_spline
from mapper.simulation.scene import Scene
from mapper.simulation.streams import Stream, rng_of

START_NS = 1_700_000_000 * NS_PER_S
"""Stamp of every log's first frame."""

_SAMPLES_PER_M = 1000
_EASE_M = 0.3
_EYE_HEIGHT_M = 1.35
_LOOK_DOWN_RAD = -0.17
_STILL_S = 20.0


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """Motion of a camera: its pose at any time.

    Attributes:
        duration_s: Time from the first to the last frame.
        steady: Maps (N,) seconds to position (N, 3) metres and yaw, pitch, roll (N, 3) radians.
        shake: Maps (N,) seconds to what an unsteady hand adds to each of these six, (N, 6).
    """

    duration_s: float
    steady: Callable[[Array], tuple[Array, Array]]
    shake: Callable[[Array], Array]

    def poses(self, times_s: Array) -> Array:
        """Return (N, 4, 4) T_world_camera at (N,) seconds after the start."""
        positions, angles_rad = self.steady(times_s)
        shake = self.shake(times_s)
        T_world_camera = np.tile(np.eye(4), (len(times_s), 1, 1))
        T_world_camera[:, :3, :3] = _look(angles_rad + shake[:, 3:])
        T_world_camera[:, :3, 3] = positions + shake[:, :3]
        return T_world_camera


def make_motion(config: SynthConfig, scene: Scene) -> Motion:
    """Return the motion of a configuration; it keeps at least 0.3 m from every solid of its scene."""
    rng = rng_of(config.seed, Stream.PATH, config.day)
    if config.path == "loop":
        duration_s, steady = _loop(config, scene.plan, rng)
    elif config.path == "desk":
        duration_s, steady = _STILL_S, _before_desk(scene.plan, rng)
    elif config.path == "spin":
        duration_s, steady = _STILL_S, _spin(config, scene.plan)
    else:
        duration_s, steady = _STILL_S, _before_wall(config, scene.plan)
    if config.duration_s is not None:
        duration_s = config.duration_s
    return Motion(duration_s, steady, _shake(config, rng))


def frame_stamps(config: SynthConfig, motion: Motion) -> Stamps:
    """Return (N,) int64 stamps of all frames, dropped ones included; exact multiples of the frame time."""
    count = int(motion.duration_s * config.frame_rate_hz) + 1
    return START_NS + np.round(np.arange(count) * (NS_PER_S / config.frame_rate_hz)).astype(np.int64)


def seconds_of(stamps_ns: Stamps) -> Array:
    """Return (N,) seconds after the start."""
    return (stamps_ns - START_NS) / NS_PER_S


def _look(angles_rad: Array) -> Array:
    """Return (N, 3, 3) R_world_camera of yaw about z, pitch upwards, roll about the optical axis."""
    yaw, pitch, roll = angles_rad.T
    zero = np.zeros_like(yaw)
    forward = np.stack([np.cos(pitch) * np.cos(yaw), np.cos(pitch) * np.sin(yaw), np.sin(pitch)], axis=1)
    level_right = np.stack([np.sin(yaw), -np.cos(yaw), zero], axis=1)
    level_down = np.cross(forward, level_right)
    cosine, sine = np.cos(roll)[:, None], np.sin(roll)[:, None]
    right, down = cosine * level_right + sine * level_down, cosine * level_down - sine * level_right
    return np.stack([right, down, forward], axis=2)


def _shake(config: SynthConfig, rng: np.random.Generator) -> Callable[[Array], Array]:
    """Return the sway of each axis by time: three sines between breathing and walking pace."""
    amplitudes = np.array([config.shake_m] * 3 + [config.shake_rad] * 3) * (config.wheels is None)
    rates_hz = rng.uniform([[0.2], [0.6], [1.2]], [[0.5], [1.1], [1.9]], (3, 6))
    phases_rad = rng.uniform(0.0, 2.0 * np.pi, (3, 6))
    shares = np.array([0.55, 0.3, 0.15])[:, None]

    def shake(times_s: Array) -> Array:
        waves = np.sin(2.0 * np.pi * rates_hz * times_s[:, None, None] + phases_rad)
        swayed: Array = amplitudes * (shares * waves).sum(axis=1)
        return swayed

    return shake


@dataclass(frozen=True, slots=True, eq=False)
class _Lap:
    """A closed route by the distance along it.

    Attributes:
        route: (K, 2) points of the spline, metres.
        length_m: Length of a lap.
        parameters: (P,) parameters of the spline, densely, from the start to the end of a lap.
        travelled_m: (P,) distance up to each.
    """

    route: Array
    length_m: float
    parameters: Array
    travelled_m: Array

    def parameter_at(self, in_lap_m: Array) -> Array:
        """Return the (N,) parameters of the spline at (N,) distances within the lap."""
        return np.interp(in_lap_m, self.travelled_m, self.parameters)

    def heading_rad(self, along_m: Array) -> Array:
        """Return the (N,) yaw of the route at (N,) distances."""
        u = self.parameter_at(np.mod(along_m, self.length_m))
        ahead = closed_spline(self.route, u + 0.15) - closed_spline(self.route, u - 0.15)
        return np.arctan2(ahead[:, 1], ahead[:, 0])

    def phase_rad(self, along_m: Array, count: int) -> Array:
        """Return the (N,) phase of a wave that repeats ``count`` times a lap."""
        return 2.0 * np.pi * count * along_m / self.length_m


def _lap_of(route: Array) -> _Lap:
    parameters = np.linspace(0.0, len(route), 400 * len(route), endpoint=False)
    points = closed_spline(route, parameters)
    steps_m = np.linalg.norm(np.diff(points, axis=0, append=points[:1]), axis=1)
    travelled_m = np.concatenate([[0.0], np.cumsum(steps_m)])
    return _Lap(route, float(steps_m.sum()), np.append(parameters, len(route)), travelled_m)


def _loop(
    config: SynthConfig, plan: Plan, rng: np.random.Generator
) -> tuple[float, Callable[[Array], tuple[Array, Array]]]:
    """Return the duration, and positions and gaze by time, of walking the route: both repeat every lap."""
    lap = _lap_of(plan.route)
    lap_m = lap.length_m
    glances = max(round(lap_m / 4.0), 1)
    phases_rad = rng.uniform(0.0, 2.0 * np.pi, 3)
    nods = config.wheels is None
    grid_m = np.linspace(0.0, lap_m, round(_SAMPLES_PER_M * lap_m), endpoint=False)
    glance_rad = 0.25 * np.sin(lap.phase_rad(grid_m, glances) + phases_rad[0])
    yaw = np.unwrap(lap.heading_rad(grid_m) + glance_rad)
    lap_turn = 2.0 * np.pi * round((yaw[-1] - yaw[0]) / (2.0 * np.pi))
    closed_grid_m = np.append(grid_m, lap_m)
    closed_yaw = np.append(yaw, yaw[0] + lap_turn)
    clock_s = _walked_s(config, closed_yaw, lap_m / len(grid_m))
    lap_s = float(clock_s[-1])

    def walked_m(times_s: Array) -> Array:
        laps = np.floor(times_s / lap_s)
        distance_m: Array = laps * lap_m + np.interp(times_s - laps * lap_s, clock_s, closed_grid_m)
        return distance_m

    def steady(times_s: Array) -> tuple[Array, Array]:
        along_m = walked_m(times_s)
        laps = np.floor(along_m / lap_m)
        in_lap_m = along_m - laps * lap_m
        height_m = _EYE_HEIGHT_M + nods * 0.08 * np.sin(lap.phase_rad(along_m, 2) + phases_rad[1])
        pitch = _LOOK_DOWN_RAD + nods * 0.10 * np.sin(lap.phase_rad(along_m, glances + 1) + phases_rad[2])
        gaze = laps * lap_turn + np.interp(in_lap_m, closed_grid_m, closed_yaw)
        positions = np.column_stack([closed_spline(plan.route, lap.parameter_at(in_lap_m)), height_m])
        return positions, np.column_stack([gaze, pitch, np.zeros(len(pitch))])

    overlap_s = float(np.interp(config.overlap_m, closed_grid_m, clock_s))
    return config.laps * lap_s + overlap_s, steady


def _walked_s(config: SynthConfig, yaw_rad: Array, step_m: float) -> Array:
    """Return the (N,) seconds at which (N,) points of a lap, a step apart, are passed; turns take longer."""
    yaw_rad_per_m = np.diff(yaw_rad) / step_m
    turning_mps = config.max_yaw_rate_rad_s / np.maximum(np.abs(yaw_rad_per_m), 1e-9)
    speed_mps = np.minimum(config.speed_mps, turning_mps)
    return np.concatenate([[0.0], np.cumsum(step_m / _eased(speed_mps, round(_EASE_M / step_m)))])


def _eased(speed_mps: Array, window: int) -> Array:
    """Return a smooth periodic speed that nowhere exceeds the given one.

    The lowest speed of a window, averaged over windows of the same total length, cannot exceed the
    speed in their common middle.
    """
    half = max(window // 2, 1)
    n = len(speed_mps)
    padded = np.concatenate([speed_mps[-2 * half :], speed_mps, speed_mps[: 2 * half]])
    lowest = np.lib.stride_tricks.sliding_window_view(padded, 4 * half + 1).min(axis=1)
    smooth: Array = lowest
    for _ in range(2):  # twice a box is once a triangle: no jump in acceleration
        around = np.concatenate([smooth[-half:], smooth, smooth[:half]])
        total = np.concatenate([[0.0], np.cumsum(around)])
        smooth = (total[2 * half + 1 :] - total[: -(2 * half + 1)]) / (2 * half + 1)
    return smooth[:n]


def _before_desk(plan: Plan, rng: np.random.Generator) -> Callable[[Array], tuple[Array, Array]]:
    """Return positions and gaze by time that sway an arm's length from the desk, as in TUM's fr1_xyz."""
    center = np.array([plan.desk_center[0], plan.desk_center[1] + 1.0, DESK_SIZE_M[2] + 0.5])
    phases_rad = rng.uniform(0.0, 2.0 * np.pi, 3)
    rates_hz, reach_m = np.array([0.21, 0.13, 0.29]), np.array([0.3, 0.18, 0.18])

    def steady(times_s: Array) -> tuple[Array, Array]:
        positions = center + reach_m * np.sin(2.0 * np.pi * rates_hz * times_s[:, None] + phases_rad)
        still = np.ones(len(times_s))
        return positions, np.column_stack([-np.pi / 2 * still, -0.42 * still, 0.0 * still])

    return steady


def _before_wall(config: SynthConfig, plan: Plan) -> Callable[[Array], tuple[Array, Array]]:
    """Return positions and gaze by time, facing the first room's wall x = x0, which has no door."""
    room = plan.rooms[0]
    if config.wall_distance_m > room.x1_m - room.x0_m:
        raise SourceError(
            f"wall_distance_m {config.wall_distance_m:g}: the room is {room.x1_m - room.x0_m:.2f} m wide; "
            "make it wider by --set room_size_m=…"
        )
    position = [room.x0_m + config.wall_distance_m, 0.5 * (room.y0_m + room.y1_m), _EYE_HEIGHT_M]

    def steady(times_s: Array) -> tuple[Array, Array]:
        count = len(times_s)
        return np.tile(position, (count, 1)), np.tile([np.pi, 0.0, 0.0], (count, 1))

    return steady


def _spin(config: SynthConfig, plan: Plan) -> Callable[[Array], tuple[Array, Array]]:
    """Return positions and gaze by time, turning in the first room's middle at up to the highest rate."""
    spot = closed_spline(plan.route, np.zeros(1))[0]
    fastest, breath_hz, nods = config.max_yaw_rate_rad_s, 0.2, config.wheels is None

    def steady(times_s: Array) -> tuple[Array, Array]:
        phase_rad = 2.0 * np.pi * breath_hz * times_s
        drift = 0.08 * np.column_stack([np.sin(phase_rad), np.cos(phase_rad)])
        positions = np.column_stack([spot + drift, np.full(len(drift), _EYE_HEIGHT_M)])
        yaw = fastest * (0.65 * times_s + 0.35 * (1.0 - np.cos(phase_rad)) / (2.0 * np.pi * breath_hz))
        pitch = _LOOK_DOWN_RAD + nods * 0.12 * np.sin(0.7 * phase_rad)
        return positions, np.column_stack([yaw, pitch, np.zeros(len(yaw))])

    return steady
