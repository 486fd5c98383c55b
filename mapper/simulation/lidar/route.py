"""Route of the simulated LiDAR: a closed rounded rectangle, and the sensor's motion along it."""

import math
from dataclasses import dataclass
from typing import assert_never

import numpy as np

from mapper.core.geometry import Array, distances_along
from mapper.core.rotations import rotation_from_quaternion
from mapper.core.timebase import NS_PER_S, Stamps
from mapper.simulation.config import LidarSynthConfig, SynthConfig
from mapper.simulation.lidar.solids import Ground
from mapper.simulation.lidar.things import ROUTE_SIZE_M, heights_m
from mapper.simulation.path import START_NS
from mapper.simulation.plan import closed_spline, make_plan
from mapper.simulation.streams import Stream, rng_of

_CONTROL_STEP_M = 2.0
_SAMPLES_PER_STEP = 40
_LARGEST_CORNER_M = 8.0
_CORNER_SHARE = 0.35
_SWAY_M = 0.4
_ASIDE_M = 0.5
"""Largest distance of another day's line from the first day's."""
_TUNNEL_TURN_M = 1.0
_TUNNEL_START_SHARE = 0.77
"""Share of the way from the middle of the lower side: just after the turn at the left end."""
_SPEED_SWING, _SPEED_PERIOD_S = 0.25, 9.0


@dataclass(frozen=True, slots=True, eq=False)
class Route:
    """A closed way in the ground plan, anticlockwise around the origin.

    Attributes:
        control: (R, 2) control points of its spline, metres.
        size_m: Width and depth of the rectangle that it follows.
        travelled_m: (S + 1,) distance from the start at equal steps of the spline's parameter; the last is
            the length of the whole way.
        climbs: Whether it leads up a staircase.
    """

    control: Array
    size_m: tuple[float, float]
    travelled_m: Array
    climbs: bool = False

    @property
    def length_m(self) -> float:
        """Once round."""
        return float(self.travelled_m[-1])

    def points(self, along_m: Array) -> Array:
        """Return (N, 2) positions at (N,) distances from the start; they repeat with every lap."""
        return closed_spline(self.control, self._parameter(along_m))

    def headings_rad(self, along_m: Array) -> Array:
        """Return (N,) directions of travel."""
        u = self._parameter(along_m)
        ahead = closed_spline(self.control, u + 1e-3) - closed_spline(self.control, u - 1e-3)
        return np.arctan2(ahead[:, 1], ahead[:, 0])

    def heights_m(self, along_m: Array) -> Array:
        """Return (N,) heights of the way above the ground at (N,) distances from the start."""
        if not self.climbs:
            return np.zeros(len(along_m))
        return heights_m(self.points(along_m), along_m / self.length_m)

    def _parameter(self, along_m: Array) -> Array:
        grid = np.linspace(0.0, len(self.control), len(self.travelled_m))
        return np.interp(np.mod(along_m, self.length_m), self.travelled_m, grid)


def make_route(config: LidarSynthConfig) -> Route:
    """Return the way of a configuration: about ``loop_m`` long, swaying a little in its lane."""
    match config.scene:
        case "street" | "courtyard" | "field":
            return _round_a_block(config)
        case "tunnel":
            size_m = (config.loop_m / 2.0, 2.0 * _TUNNEL_TURN_M)
            control = _rounded_rectangle(size_m, radius_m=_TUNNEL_TURN_M, step_m=_TUNNEL_TURN_M)
            start = round(_TUNNEL_START_SHARE * len(control))
            control = np.roll(control, -start, axis=0)
            return Route(control, size_m, _travelled_m(control))
        case "staircase":
            control = _rounded_rectangle(ROUTE_SIZE_M, radius_m=ROUTE_SIZE_M[1] / 2.0, step_m=0.3)
            return Route(control, ROUTE_SIZE_M, _travelled_m(control), climbs=True)
        case "flat":
            control = make_plan(flat_of(config), rng_of(config.seed, Stream.PLAN)).route
            width_m, depth_m = np.ptp(control, axis=0).tolist()
            return Route(control, (width_m, depth_m), _travelled_m(control))
        case _:
            assert_never(config.scene)


def flat_of(config: LidarSynthConfig) -> SynthConfig:
    """Return the flat in which a LiDAR moves."""
    return SynthConfig(seed=config.seed, day=config.day, texture_px_per_m=16)


def _round_a_block(config: LidarSynthConfig) -> Route:
    rng = rng_of(config.seed, Stream.PLAN)
    aspect = rng.uniform(1.2, 1.6)
    # A rectangle of this perimeter, made longer by what its rounded corners cut off.
    short_m = config.loop_m / (2.0 * (1.0 + aspect) - (8.0 - 2.0 * math.pi) * _CORNER_SHARE)
    radius_m = _CORNER_SHARE * short_m
    if radius_m > _LARGEST_CORNER_M:
        radius_m = _LARGEST_CORNER_M
        short_m = (config.loop_m + (8.0 - 2.0 * math.pi) * radius_m) / (2.0 * (1.0 + aspect))
    size_m = (aspect * short_m, short_m)
    control = _rounded_rectangle(size_m, radius_m=radius_m, step_m=_CONTROL_STEP_M)
    angle_rad = np.linspace(0.0, 2.0 * np.pi, len(control), endpoint=False)
    rates, phases_rad = np.arange(2, 7), rng.uniform(0.0, 2.0 * np.pi, 5)
    sway_m = _SWAY_M * np.sin(angle_rad[:, None] * rates + phases_rad).mean(axis=1)
    along = np.roll(control, -1, axis=0) - np.roll(control, 1, axis=0)
    left = np.column_stack([-along[:, 1], along[:, 0]]) / np.linalg.norm(along, axis=1, keepdims=True)
    control = control + sway_m[:, None] * left
    return Route(control, size_m, _travelled_m(control))


def _travelled_m(control: Array) -> Array:
    parameter = np.linspace(0.0, len(control), _SAMPLES_PER_STEP * len(control) + 1)
    return distances_along(closed_spline(control, parameter))


def _rounded_rectangle(size_m: tuple[float, float], *, radius_m: float, step_m: float) -> Array:
    """Return (R, 2) points around the origin, anticlockwise from the middle of the lower side."""
    half_sides = np.array([size_m[0], size_m[1], size_m[0], size_m[1]]) / 2.0 - radius_m
    corner_m = math.pi / 2.0 * radius_m
    # The heading turns by a right angle along every corner and stays along every side.
    lengths = [half_sides[0], corner_m]
    for half in (half_sides[1], half_sides[2], half_sides[3]):
        lengths += [2.0 * half, corner_m]
    knots_m = np.cumsum([0.0, *lengths, half_sides[0]])
    headings_rad = np.repeat(np.arange(5) * math.pi / 2.0, 2)
    count = round(knots_m[-1] / step_m)
    fine = 200 * count
    middles_m = (np.arange(fine) + 0.5) * knots_m[-1] / fine
    heading = np.interp(middles_m, knots_m, headings_rad)
    steps = np.column_stack([np.cos(heading), np.sin(heading)]) * knots_m[-1] / fine
    start = np.array([0.0, -size_m[1] / 2.0])
    points: Array = start + np.cumsum(steps, axis=0)[::200]
    return points


@dataclass(frozen=True, slots=True, eq=False)
class Drive:
    """Motion of a sensor: its pose at any time.

    Attributes:
        config: Settings of the motion.
        route: Along which way.
        ground: Over which ground.
        phases_rad: (3,) of its swings.
        aside_m: Distance that it keeps to the left of the route.
    """

    config: LidarSynthConfig
    route: Route
    ground: Ground
    phases_rad: Array
    aside_m: float = 0.0

    def poses(self, times_s: Array) -> Array:
        """Return (N, 4, 4) T_world_lidar (x forward, y left, z up) at (N,) seconds after the start."""
        config = self.config
        along_m = config.speed_mps * self._eased_s(times_s)
        heading = self.route.headings_rad(along_m)
        points = self.route.points(along_m)
        points = points + self.aside_m * np.column_stack([-np.sin(heading), np.cos(heading)])
        yaw = heading + config.yaw_swing_rad * self._sine(times_s, 0.17, 0)
        up = self.ground.normals(points)
        forward = np.column_stack([np.cos(yaw), np.sin(yaw), np.zeros(len(yaw))])
        left = np.cross(up, forward)
        left /= np.linalg.norm(left, axis=1, keepdims=True)
        T_world_lidar = np.tile(np.eye(4), (len(times_s), 1, 1))
        T_world_lidar[:, :3, :3] = np.stack([np.cross(left, up), left, up], axis=2)
        T_world_lidar[:, :2, 3] = points
        height_m = self.ground.height_m(points) + config.mount_height_m
        T_world_lidar[:, 2, 3] = height_m + self.route.heights_m(along_m)
        if config.tilt_rad > 0.0:
            half_rad = 0.5 * config.tilt_rad * self._sine(times_s, 0.23, 1)
            toward_rad = 2.0 * np.pi * 0.07 * times_s + self.phases_rad[2]
            x, y = np.sin(half_rad) * np.cos(toward_rad), np.sin(half_rad) * np.sin(toward_rad)
            tilts = rotation_from_quaternion(np.column_stack([x, y, 0.0 * x, np.cos(half_rad)]))
            T_world_lidar[:, :3, :3] @= tilts
        return T_world_lidar

    def _eased_s(self, times_s: Array) -> Array:
        """Return times that run a quarter faster and slower by turns, as traffic does."""
        rate = 2.0 * np.pi / _SPEED_PERIOD_S
        return times_s + _SPEED_SWING / rate * np.sin(rate * times_s)

    def _sine(self, times_s: Array, rate_hz: float, phase: int) -> Array:
        wave: Array = np.sin(2.0 * np.pi * rate_hz * times_s + self.phases_rad[phase])
        return wave


def make_drive(config: LidarSynthConfig, route: Route, ground: Ground) -> Drive:
    """Return the motion of a configuration."""
    rng = rng_of(config.seed, Stream.PATH, config.day)
    phases_rad = rng.uniform(0.0, 2.0 * np.pi, 3)
    aside_m = float(rng.uniform(-_ASIDE_M, _ASIDE_M)) if config.day > 0 and config.scene == "street" else 0.0
    return Drive(config, route, ground, phases_rad, aside_m)


def scan_stamps(config: LidarSynthConfig, route: Route) -> Stamps:
    """Return (N,) int64 stamps of all scans: when each sweep begins."""
    duration_s = config.duration_s
    if duration_s is None:
        duration_s = (config.laps * route.length_m + config.overlap_m) / config.speed_mps
    count = int(duration_s * config.rate_hz) + 1
    return START_NS + np.round(np.arange(count) * (NS_PER_S / config.rate_hz)).astype(np.int64)
