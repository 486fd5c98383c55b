"""Traffic of the simulated LiDAR: cars, cyclists and pedestrians that follow the route, beside its middle."""

import math
from dataclasses import dataclass, replace

import numpy as np

from mapper.core.geometry import Array
from mapper.simulation.builder import ORIGIN
from mapper.simulation.config import LidarSynthConfig
from mapper.simulation.lidar import things
from mapper.simulation.lidar.cast import cast, sort_into_cells
from mapper.simulation.lidar.route import Route
from mapper.simulation.lidar.solids import Ground, Shape, Site, Solids
from mapper.simulation.streams import Stream, rng_of

_LANE_M = 1.75
"""From the middle of the road to the middle of the oncoming lane."""
_CYCLE_LANE_M = (1.5, 2.1)
_PAVEMENT_M = (7.2, 7.6)
_ROAMING_M = (1.5, 4.0)
_LEAST_GAP_M = 12.0
_CAR_MPS, _CYCLIST_MPS, _PEDESTRIAN_MPS = (4.0, 9.0), (3.0, 6.0), (0.7, 1.6)


@dataclass(frozen=True, slots=True)
class _Mover:
    """A thing that follows the route, stopping now and then.

    Attributes:
        solids: Its parts, standing on the world's origin, facing along x.
        start_m: Position along the route at the start.
        offset_m: Distance that it keeps to the left of the route.
        speed_mps: Its speed while it goes; negative against the sensor's direction.
        go_s: Duration of motion.
        stop_s: Duration of the stop after it.
        phase_s: Time from its last departure to the start of the log.
    """

    solids: Solids
    start_m: float
    offset_m: float
    speed_mps: float
    go_s: float
    stop_s: float
    phase_s: float

    def along_m(self, times_s: Array) -> Array:
        """Return (N,) distances along the route at (N,) seconds after the start."""
        cycles, into_s = np.divmod(times_s + self.phase_s, self.go_s + self.stop_s)
        gone_s = cycles * self.go_s + np.minimum(into_s, self.go_s)
        return self.start_m + self.speed_mps * (gone_s - min(self.phase_s, self.go_s))


@dataclass(frozen=True, slots=True, eq=False)
class Traffic:
    """All that moves in an outdoor scene.

    Attributes:
        movers: Each of them.
        route: Route that they follow.
        ground: Ground on which they stand.
    """

    movers: tuple[_Mover, ...]
    route: Route
    ground: Ground

    def __len__(self) -> int:
        return len(self.movers)

    def ranges_m(
        self, origins: Array, directions: Array, max_range_m: float, *, start_s: float, fired_s: Array
    ) -> Array:
        """Return (A, E) ranges to the nearest mover along unit rays, metres; inf where none is met.

        Args:
            origins: (A, 3) world frame, metres.
            directions: (A, E, 3) world frame.
            max_range_m: Length of the rays.
            start_s: When the sweep begins, seconds after the log does.
            fired_s: (A,) seconds after that at which each column is fired.
        """
        nearest = np.full(directions.shape[:2], np.inf)
        middle_world = origins[len(origins) // 2]
        for mover in self.movers:
            ends_s = np.array([start_s, start_s + fired_s[-1] + 1e-3])
            places, yaws_rad = self._places(mover, ends_s)
            if np.linalg.norm(places[0] - middle_world) > max_range_m + 5.0:
                continue
            world = sort_into_cells(_placed(mover.solids, places[0], float(yaws_rad[0])), self.ground)
            # Seen from the mover the sensor moves: one world serves the whole sweep.
            velocity_mps = (places[1] - places[0]) / (ends_s[1] - ends_s[0])
            moved = np.ascontiguousarray(origins - fired_s[:, None] * velocity_mps)
            np.minimum(nearest, cast(world, moved, directions, max_range_m, False), out=nearest)
        return nearest

    def _places(self, mover: _Mover, times_s: Array) -> tuple[Array, Array]:
        along_m = mover.along_m(times_s)
        headings_rad = self.route.headings_rad(along_m)
        left = np.column_stack([-np.sin(headings_rad), np.cos(headings_rad)])
        points_xy = self.route.points(along_m) + mover.offset_m * left
        facing_rad = headings_rad + (math.pi if mover.speed_mps < 0.0 else 0.0)
        return np.column_stack([points_xy, self.ground.height_m(points_xy)]), facing_rad


def make_traffic(config: LidarSynthConfig, route: Route, ground: Ground) -> Traffic:
    """Return the traffic of a configuration; its seed determines what each looks like and how it moves."""
    rng, movers = rng_of(config.seed, Stream.MOVERS), []
    for _ in range(config.cars):
        ahead = rng.random() < 0.4
        # Cars ahead keep to the sensor's lane and its speed; the others come towards it.
        speed_mps = config.speed_mps if ahead else -float(rng.uniform(*_CAR_MPS))
        start_m = float(rng.uniform(_LEAST_GAP_M, 40.0) if ahead else rng.uniform(0.0, route.length_m))
        mover = _mover(_car(rng), rng, start_m=start_m, offset_m=0.0 if ahead else _LANE_M, mps=speed_mps)
        movers.append(replace(mover, stop_s=0.0) if ahead else mover)
    for _ in range(config.cyclists):
        side = float(rng.choice([-1.0, 1.0]))
        speed_mps, offset_m = (
            -side * float(rng.uniform(*_CYCLIST_MPS)),
            side * float(rng.uniform(*_CYCLE_LANE_M)),
        )
        start_m = float(rng.uniform(0.0, route.length_m))
        movers.append(_mover(_cyclist(rng), rng, start_m=start_m, offset_m=offset_m, mps=speed_mps))
    beside_m = _PAVEMENT_M if config.scene == "street" else _ROAMING_M
    for _ in range(config.pedestrians):
        offset_m = float(rng.choice([-1.0, 1.0]) * rng.uniform(*beside_m))
        speed_mps = float(rng.choice([-1.0, 1.0]) * rng.uniform(*_PEDESTRIAN_MPS))
        start_m = float(rng.uniform(0.0, route.length_m))
        movers.append(_mover(_pedestrian(rng), rng, start_m=start_m, offset_m=offset_m, mps=speed_mps))
    return Traffic(tuple(movers), route, ground)


def _mover(
    solids: Solids, rng: np.random.Generator, *, start_m: float, offset_m: float, mps: float
) -> _Mover:
    go_s, stop_s = float(rng.uniform(6.0, 14.0)), float(rng.uniform(0.0, 4.0))
    return _Mover(solids, start_m, offset_m, mps, go_s, stop_s, float(rng.uniform(0.0, go_s)))


def _placed(solids: Solids, place: Array, yaw_rad: float) -> Solids:
    """Return solids that stand on the origin moved to a (3,) place and turned there."""
    hulls, (cosine, sine) = solids.hulls, (math.cos(yaw_rad), math.sin(yaw_rad))
    R = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    centers_world = hulls.centers_world @ R.T + place
    return Solids(
        replace(hulls, centers_world=centers_world, yaws_rad=hulls.yaws_rad + yaw_rad), solids.shapes
    )


def _site() -> Site:
    return Site(Ground(np.zeros(2), np.zeros((0, 4))))


def _car(rng: np.random.Generator) -> Solids:
    site = _site()
    things.car(site, ORIGIN, rng)
    for x in (-1.25, 1.25):
        for y in (-0.75, 0.75):
            site.add("car", ORIGIN, center=(x, y, 0.31), size=(0.62, 0.2, 0.62), shape=Shape.ELLIPSOID)
    return site.solids()


def _cyclist(rng: np.random.Generator) -> Solids:
    site = _site()
    things.bicycle(site, ORIGIN, rng)
    site.add("cyclist", ORIGIN, center=(0.0, 0.0, 0.7), size=(0.4, 0.34, 0.6), shape=Shape.ELLIPSOID)
    site.add("cyclist", ORIGIN, center=(0.1, 0.0, 1.2), size=(0.35, 0.45, 0.65), shape=Shape.ELLIPSOID)
    site.add("cyclist", ORIGIN, center=(0.25, 0.0, 1.6), size=(0.22, 0.2, 0.26), shape=Shape.ELLIPSOID)
    return site.solids()


def _pedestrian(rng: np.random.Generator) -> Solids:
    site, height_m = _site(), float(rng.uniform(1.3, 1.9))
    legs, trunk, head = 0.48 * height_m, 0.38 * height_m, 0.14 * height_m
    for side in (-0.1, 0.1):
        size = (0.16, 0.14, legs)
        center = (2.0 * side * float(rng.uniform(0.2, 1.0)), side, legs / 2.0)
        site.add("pedestrian", ORIGIN, center=center, size=size, shape=Shape.CYLINDER)
    size = (0.26, 0.44, trunk)
    site.add("pedestrian", ORIGIN, center=(0.0, 0.0, legs + trunk / 2.0), size=size, shape=Shape.CYLINDER)
    center, size = (0.0, 0.0, height_m - head / 2.0), (0.2, 0.18, head)
    site.add("pedestrian", ORIGIN, center=center, size=size, shape=Shape.ELLIPSOID)
    return site.solids()
