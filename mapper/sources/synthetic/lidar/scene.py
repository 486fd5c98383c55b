"""Outdoor scenes around a closed way: a block of streets, or a yard with few things in it."""

import math
from dataclasses import dataclass, field

import numpy as np

from mapper.config.synthetic import LidarSynthConfig
from mapper.geometry import Array
from mapper.sources.synthetic.builder import Place
from mapper.sources.synthetic.lidar import things
from mapper.sources.synthetic.lidar.cast import World, sort_into_cells
from mapper.sources.synthetic.lidar.facades import row
from mapper.sources.synthetic.lidar.ground import Ground, make_ground
from mapper.sources.synthetic.lidar.route import Route, make_route
from mapper.sources.synthetic.lidar.solids import Site, Solids
from mapper.sources.synthetic.streams import Stream, rng_of

_FACADE_M = 8.0
"""From the middle of the road to the houses."""
_SMALLEST_BLOCK_M = 10.0
_CLEARANCE_M = 1.5
_YARD_MARGIN_M = 5.0
_TRIES = 40


@dataclass(frozen=True, slots=True, eq=False)
class OutdoorScene:
    """A world that can be scanned.

    Attributes:
        solids: Everything that stands on the ground.
        ground: The ground.
        route: The free way round.
        world: Both for the ray caster.
    """

    solids: Solids
    ground: Ground
    route: Route
    world: World = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "world", sort_into_cells(self.solids, self.ground))


def make_outdoor_scene(config: LidarSynthConfig) -> OutdoorScene:
    """Return the scene of a configuration; its seed decides everything that is left open."""
    route = make_route(config)
    ground = make_ground(
        rng_of(config.seed, Stream.GROUND), slope_rad=config.slope_rad, undulation_m=config.undulation_m
    )
    site = Site(ground)
    rng = rng_of(config.seed, Stream.FURNITURE)
    build = _street if config.scene == "street" else _courtyard
    build(site, route, rng)
    return OutdoorScene(site.solids(), ground, route)


def _street(site: Site, route: Route, rng: np.random.Generator) -> None:
    """Houses on both sides of a rectangle of streets, and what stands before them."""
    width, depth = route.size_m
    for side in _sides(width + 2 * _FACADE_M, depth + 2 * _FACADE_M):
        row(site, side.outwards(), side.length_m, depth_m=12.0, rng=rng.spawn(1)[0])
    block = (width - 2 * _FACADE_M, depth - 2 * _FACADE_M)
    if min(block) >= _SMALLEST_BLOCK_M:
        for side in _sides(*block):
            row(site, side.start, side.length_m, depth_m=min(block) / 2.2, rng=rng.spawn(1)[0])
    free = _free_points(route)
    for side in _sides(width, depth):
        for line in (side.start, side.outwards()):
            _kerb(site, line, side.length_m, free=free, rng=rng.spawn(1)[0])


def _courtyard(site: Site, route: Route, rng: np.random.Generator) -> None:
    """Walls on two or three sides, a few trees, benches and bicycles, and nothing else."""
    width, depth = (size + 2 * _YARD_MARGIN_M for size in route.size_m)
    sides = _sides(width, depth)
    for number in rng.permutation(4)[: int(rng.integers(2, 4))]:
        side, height = sides[number], float(rng.uniform(2.2, 7.0))
        center = (side.length_m / 2.0, 0.2, height / 2.0 - 0.75)
        site.add("wall", side.outwards(), center=center, size=(side.length_m, 0.4, height + 1.5))
    free, taken = _free_points(route), np.empty((0, 2))
    counts = (things.tree, 4, 7), (things.bench, 2, 4), (things.bicycle, 2, 5), (things.bin_, 0, 2)
    for build, fewest, most in counts:
        for _ in range(int(rng.integers(fewest, most + 1))):
            for _ in range(_TRIES):
                spot = rng.uniform(-0.5, 0.5, 2) * (width - 2.0, depth - 2.0)
                if _distance_m(spot, free) > _CLEARANCE_M + 0.5 and _distance_m(spot, taken) > 2.5:
                    taken = np.vstack([taken, spot])
                    place = Place(float(spot[0]), float(spot[1]), float(rng.uniform(-np.pi, np.pi)))
                    build(site, place, rng)
                    break


def _kerb(site: Site, line: Place, length_m: float, *, free: Array, rng: np.random.Generator) -> None:
    """Set things along one side of a street, whose middle is x of ``line`` and whose houses lie at +y."""
    shares = np.array([kind.share for kind in things.KINDS])
    at_m = float(rng.uniform(0.0, 4.0))
    while at_m < length_m:
        kind = things.KINDS[int(rng.choice(len(things.KINDS), p=shares / shares.sum()))]
        x, y = line.world(at_m + kind.along_m / 2.0, float(rng.uniform(*kind.offset_m)))
        turn_rad = float(rng.normal(0.0, 0.02))
        if _distance_m(np.array([x, y]), free) > _CLEARANCE_M + kind.across_m:
            kind.build(site, Place(x, y, line.yaw_rad + turn_rad), rng)
        at_m += kind.along_m + float(rng.exponential(2.5))


@dataclass(frozen=True, slots=True)
class _Side:
    """One side of a rectangle around the origin.

    Attributes:
        start: Its first corner; x runs along it, anticlockwise, and y points inwards.
        length_m: Its length.
    """

    start: Place
    length_m: float

    def outwards(self) -> Place:
        """Return its other corner; x runs back along it and y points outwards."""
        x, y = self.start.world(self.length_m, 0.0)
        return Place(x, y, self.start.yaw_rad + math.pi)


def _sides(width_m: float, depth_m: float) -> list[_Side]:
    corners = ((-1, -1, width_m), (1, -1, depth_m), (1, 1, width_m), (-1, 1, depth_m))
    return [
        _Side(Place(x * width_m / 2.0, y * depth_m / 2.0, turn * math.pi / 2.0), length_m)
        for turn, (x, y, length_m) in enumerate(corners)
    ]


def _free_points(route: Route) -> Array:
    """Return (N, 2) points of the way, about 25 cm apart."""
    return route.points(np.linspace(0.0, route.length_m, int(4.0 * route.length_m)))


def _distance_m(spot: Array, points: Array) -> float:
    """Return the distance from a (2,) place to the nearest of (N, 2); inf if there are none."""
    return float(np.linalg.norm(points - spot, axis=1).min(initial=np.inf))
