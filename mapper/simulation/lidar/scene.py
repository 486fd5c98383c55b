"""Scenes around a closed route: streets, a yard, a field, a tunnel, a staircase, a flat."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import compress
from typing import assert_never

import numpy as np

from mapper.core.geometry import Array
from mapper.simulation.builder import ORIGIN, Place
from mapper.simulation.config import LidarSynthConfig
from mapper.simulation.lidar import things
from mapper.simulation.lidar.cast import World, sort_into_cells
from mapper.simulation.lidar.route import Route, flat_of, make_route
from mapper.simulation.lidar.solids import Ground, Shape, Site, Solids, make_ground
from mapper.simulation.lidar.things import build_staircase, storeys_of
from mapper.simulation.scene import make_scene
from mapper.simulation.streams import TRIES, Stream, rng_of

_FACADE_M = 8.0
"""From the middle of the road to the houses."""
_HOUSE_M, _SMALLEST_BLOCK_M = 11.0, 10.0
_CLEARANCE_M, _YARD_CLEARANCE_M = 1.5, 2.0
_YARD_MARGIN_M = 5.0
_FIELD_MARGIN_M = 25.0
_TUNNEL_END_M, _TUNNEL_SIDE_M, _TUNNEL_HEIGHT_M = 3.0, 2.5, 4.5
_STAYING_SHARE = 0.4
"""Share of the movable things that are there on another day too, if at another spot."""

Count = tuple[Callable[[Site, Place, np.random.Generator], None], int, int]
"""A thing, and how many of it there are at least and at most."""
_YARD_THINGS: Sequence[Count] = (
    (things.tree, 4, 7),
    (things.bench, 2, 4),
    (things.bicycle, 2, 5),
    (things.bin_, 0, 2),
)
_FIELD_THINGS: Sequence[Count] = ((things.tree, 3, 5), (things.bush, 2, 4), (things.pole, 1, 2))


@dataclass(frozen=True, slots=True, eq=False)
class OutdoorScene:
    """World that can be scanned.

    Attributes:
        solids: Everything that stands on the ground.
        ground: The ground.
        route: The free way round.
        world: Solids and ground, for the ray caster.
    """

    solids: Solids
    ground: Ground
    route: Route
    world: World = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "world", sort_into_cells(self.solids, self.ground))


def make_outdoor_scene(config: LidarSynthConfig) -> OutdoorScene:
    """Return the scene of a configuration; its seed determines everything that is left open."""
    route = make_route(config)
    ground = make_ground(
        rng_of(config.seed, Stream.GROUND), slope_rad=config.slope_rad, undulation_m=config.undulation_m
    )
    site = Site(ground)
    rng = rng_of(config.seed, Stream.FURNITURE)
    match config.scene:
        case "street":
            _street(site, route, rng, rng_of(config.seed, Stream.DAY, config.day) if config.day else None)
        case "courtyard":
            _courtyard(site, route, rng)
        case "field":
            _scatter(site, route, rng, _FIELD_THINGS, margin_m=_FIELD_MARGIN_M)
        case "tunnel":
            _tunnel(site, route)
        case "staircase":
            build_staircase(site, storeys=storeys_of(config.laps))
        case "flat":
            boxes = make_scene(flat_of(config)).boxes
            return OutdoorScene(Solids(boxes, np.full(len(boxes), Shape.BOX)), ground, route)
        case _:
            assert_never(config.scene)
    return OutdoorScene(site.solids(), ground, route)


def _street(
    site: Site, route: Route, rng: np.random.Generator, another_day: np.random.Generator | None
) -> None:
    """Houses on both sides of a rectangle of streets, and what stands before them."""
    width, depth = route.size_m
    for side in _sides(width + 2 * _FACADE_M, depth + 2 * _FACADE_M):
        house_rng = rng.spawn(1)[0]
        things.row(site, side.outwards(), side.length_m, depth_m=_HOUSE_M, behind_m=20.0, rng=house_rng)
    block = (width - 2 * _FACADE_M, depth - 2 * _FACADE_M)
    if min(block) >= _SMALLEST_BLOCK_M:
        _block(site, block, rng)
    free = _free_points(route)
    for side in _sides(width, depth):
        for line in (side.start, side.outwards()):
            _kerb(site, line, side.length_m, free=free, rng=rng.spawn(1)[0], another_day=another_day)


def _block(site: Site, size_m: tuple[float, float], rng: np.random.Generator) -> None:
    """Houses around a yard: the short rows lie between the gables of the long ones."""
    deep_m = min(_HOUSE_M, min(size_m) / 2.2)
    for number, side in enumerate(_sides(*size_m)):
        inset_m = deep_m if number % 2 else 0.0
        start = Place(*side.start.world(inset_m, 0.0), side.start.yaw_rad)
        length_m = side.length_m - 2 * inset_m
        things.row(site, start, length_m, depth_m=deep_m, behind_m=0.0, rng=rng.spawn(1)[0])


def _courtyard(site: Site, route: Route, rng: np.random.Generator) -> None:
    """Walls on two or three sides, a few trees, benches and bicycles, and nothing else."""
    width, depth = (size + 2 * _YARD_MARGIN_M for size in route.size_m)
    sides = _sides(width, depth)
    for number in rng.permutation(4)[: int(rng.integers(2, 4))]:
        side, height = sides[number], float(rng.uniform(2.2, 7.0))
        center = (side.length_m / 2.0, 0.2, height / 2.0 - 0.75)
        site.add("wall", side.outwards(), center=center, size=(side.length_m, 0.4, height + 1.5))
    _scatter(site, route, rng, _YARD_THINGS, margin_m=_YARD_MARGIN_M - 1.0)


def _scatter(
    site: Site, route: Route, rng: np.random.Generator, counts: Sequence[Count], *, margin_m: float
) -> None:
    """Set things anywhere but on the way, up to a distance outside of it."""
    width, depth = (size + 2 * margin_m for size in route.size_m)
    free, taken = _free_points(route), np.empty((0, 2))
    for build, fewest, most in counts:
        for _ in range(int(rng.integers(fewest, most + 1))):
            spots = rng.uniform(-0.5, 0.5, (TRIES, 2)) * (width, depth)
            fits = (_distance_m(s, free) > _YARD_CLEARANCE_M and _distance_m(s, taken) > 2.5 for s in spots)
            spot = next(compress(spots, fits), None)
            if spot is not None:
                taken = np.vstack([taken, spot])
                place = Place(float(spot[0]), float(spot[1]), float(rng.uniform(-np.pi, np.pi)))
                build(site, place, rng)


def _tunnel(site: Site, route: Route) -> None:
    """Two walls, a roof and a wall at each end, all smooth."""
    length, width = route.size_m[0] + 2 * _TUNNEL_END_M, route.size_m[1] + 2 * _TUNNEL_SIDE_M
    high, thick = _TUNNEL_HEIGHT_M, 0.4
    for side in (-0.5, 0.5):
        across, along = side * (width + thick), side * (length + thick)
        site.add("wall", ORIGIN, center=(0.0, across, high / 2 - 0.25), size=(length, thick, high + 0.5))
        site.add("wall", ORIGIN, center=(along, 0.0, high / 2 - 0.25), size=(thick, width, high + 0.5))
    site.add("roof", ORIGIN, center=(0.0, 0.0, high + thick / 2), size=(length, width, thick))


def _kerb(
    site: Site,
    line: Place,
    length_m: float,
    *,
    free: Array,
    rng: np.random.Generator,
    another_day: np.random.Generator | None,
) -> None:
    """Set things along one side of a street, whose middle is x of ``line`` and whose houses lie at +y."""
    shares = np.array([kind.share for kind in things.KINDS])
    at_m = float(rng.uniform(0.0, 4.0))
    while at_m < length_m:
        kind = things.KINDS[int(rng.choice(len(things.KINDS), p=shares / shares.sum()))]
        offset_m, turn_rad = float(rng.uniform(*kind.offset_m)), float(rng.normal(0.0, 0.02))
        spots = [line.world(at_m + share * kind.along_m, offset_m) for share in (0.0, 0.5, 1.0)]
        if min(_distance_m(np.array(spot), free) for spot in spots) > _CLEARANCE_M + kind.across_m:
            into, spot = site, spots[1]
            if another_day is not None and kind.is_movable:
                stays, shift_m = another_day.random() < _STAYING_SHARE, float(another_day.uniform(-2.0, 2.0))
                into = site if stays else Site(site.ground)  # built there, it draws the same and is gone
                spot = line.world(at_m + 0.5 * kind.along_m + shift_m, offset_m)
            kind.build(into, Place(*spot, line.yaw_rad + turn_rad), rng)
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
