"""Houses and objects of streets and yards, and a staircase of storeys that are alike.

Objects are built about a place on the ground, x along the kerb. A storey has two flights and two landings.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapper.core.geometry import Array
from mapper.simulation.builder import ORIGIN, Place
from mapper.simulation.lidar.solids import Shape, Site

_FOOT_M = 1.5
"""Depth of walls below the ground at their middle, so that none floats above a slope."""
_NARROWEST_M, _WIDEST_M = 7.0, 17.0
_GAP_CHANCE = 0.18
STOREY_M = 3.0
ROUTE_SIZE_M = (4.0, 1.3)
"""Width and depth of the rectangle that one walks, up both flights, once a storey."""
_FLIGHT_M, _STEPS = 3.0, 9
_HALF_LENGTH_M, _HALF_WIDTH_M, _THICK_M = 2.7, 1.35, 0.2
_WELL_M = 0.1
"""Half the gap between the flights."""


def car(site: Site, place: Place, rng: np.random.Generator) -> None:
    """A saloon or, one time in five, a van."""
    length, width = float(rng.uniform(3.7, 4.8)), float(rng.uniform(1.65, 1.85))
    if rng.random() < 0.2:
        height = float(rng.uniform(1.9, 2.5))
        site.add("car", place, center=(0.0, 0.0, 0.3 + height / 2), size=(length + 0.8, width, height))
        return
    body, cabin = float(rng.uniform(0.6, 0.8)), float(rng.uniform(0.5, 0.65))
    shift = float(rng.uniform(-0.5, 0.1))
    site.add("car", place, center=(0.0, 0.0, 0.22 + body / 2), size=(length, width, body))
    top = (shift, 0.0, 0.22 + body + cabin / 2)
    site.add("car", place, center=top, size=(0.5 * length, width - 0.25, cabin))


def tree(site: Site, place: Place, rng: np.random.Generator) -> None:
    """A trunk and a crown that begins above head height."""
    trunk, clear = float(rng.uniform(0.2, 0.5)), float(rng.uniform(2.3, 3.2))
    wide, high = float(rng.uniform(2.0, 4.2)), float(rng.uniform(2.0, 5.0))
    middle = (float(rng.normal(0.0, 0.2)), float(rng.normal(0.0, 0.2)), clear + high / 2)
    stem = clear + 0.4 * high
    site.add(
        "tree", place, center=(0.0, 0.0, stem / 2), size=(trunk, trunk, stem + 0.6), shape=Shape.CYLINDER
    )
    crown = (wide, wide * float(rng.uniform(0.8, 1.2)), high)
    site.add("tree", place, center=middle, size=crown, shape=Shape.ELLIPSOID)


def pole(site: Site, place: Place, rng: np.random.Generator) -> None:
    """A lamp post, its arm over the road."""
    thick, height = float(rng.uniform(0.12, 0.22)), float(rng.uniform(4.5, 8.0))
    post = (thick, thick, height + 0.4)
    site.add("pole", place, center=(0.0, 0.0, height / 2), size=post, shape=Shape.CYLINDER)
    if rng.random() < 0.6:
        site.add("pole", place, center=(0.0, -0.6, height - 0.1), size=(0.25, 1.4, 0.12))


def sign(site: Site, place: Place, rng: np.random.Generator) -> None:
    """A traffic sign."""
    height, plate = float(rng.uniform(2.1, 2.8)), float(rng.uniform(0.5, 0.9))
    site.add(
        "sign", place, center=(0.0, 0.0, height / 2), size=(0.08, 0.08, height + 0.4), shape=Shape.CYLINDER
    )
    site.add("sign", place, center=(-0.06, 0.0, height - plate / 2), size=(0.03, plate, plate))


def bench(site: Site, place: Place, rng: np.random.Generator) -> None:
    """A seat with a back, on two blocks."""
    length = float(rng.uniform(1.4, 2.2))
    site.add("bench", place, center=(0.0, 0.0, 0.43), size=(length, 0.45, 0.06))
    site.add("bench", place, center=(0.0, 0.24, 0.65), size=(length, 0.05, 0.4))
    for side in (-0.4, 0.4):
        site.add("bench", place, center=(side * length, 0.0, 0.15), size=(0.1, 0.4, 0.5))


def bicycle(site: Site, place: Place, rng: np.random.Generator) -> None:
    """Two flat wheels, a frame and a handlebar."""
    base = float(rng.uniform(0.95, 1.1))
    for side in (-0.5, 0.5):
        site.add(
            "bicycle",
            place,
            center=(side * base, 0.0, 0.34),
            size=(0.68, 0.06, 0.68),
            shape=Shape.ELLIPSOID,
        )
    site.add("bicycle", place, center=(0.0, 0.0, 0.62), size=(0.75 * base, 0.06, 0.3))
    site.add("bicycle", place, center=(0.4 * base, 0.0, 1.0), size=(0.06, 0.55, 0.06))


def bin_(site: Site, place: Place, rng: np.random.Generator) -> None:
    """A litter bin."""
    wide, height = float(rng.uniform(0.4, 0.6)), float(rng.uniform(0.8, 1.2))
    size = (wide, wide, height + 0.4)
    site.add("bin", place, center=(0.0, 0.0, height / 2), size=size, shape=Shape.CYLINDER)


def bush(site: Site, place: Place, rng: np.random.Generator) -> None:
    """A round shrub."""
    size = (float(rng.uniform(0.8, 2.0)), float(rng.uniform(0.7, 1.2)), float(rng.uniform(0.9, 1.8)))
    site.add("bush", place, center=(0.0, 0.0, 0.35 * size[2]), size=size, shape=Shape.ELLIPSOID)


@dataclass(frozen=True, slots=True)
class Kind:
    """A thing and where on a street it is found.

    Attributes:
        build: Adds one at a place.
        offset_m: Distance from the middle of the road, lowest and highest.
        along_m: Space it needs along the kerb.
        across_m: Half its width.
        share: Frequency relative to other kinds.
        is_movable: Whether it may be gone or elsewhere on another day.
    """

    build: Callable[[Site, Place, np.random.Generator], None]
    offset_m: tuple[float, float]
    along_m: float
    across_m: float
    share: float
    is_movable: bool = False


KINDS: tuple[Kind, ...] = (
    Kind(car, (3.5, 3.8), 5.8, 0.95, 5.0, is_movable=True),
    Kind(tree, (5.2, 5.8), 3.0, 0.4, 2.5),
    Kind(pole, (5.0, 5.4), 1.0, 0.3, 1.5),
    Kind(sign, (5.0, 5.6), 1.0, 0.5, 1.2),
    Kind(bench, (6.2, 6.8), 2.6, 0.4, 0.8),
    Kind(bicycle, (6.0, 6.9), 1.8, 0.4, 1.0, is_movable=True),
    Kind(bin_, (5.2, 6.8), 0.8, 0.3, 0.8, is_movable=True),
    Kind(bush, (6.0, 6.6), 2.2, 0.6, 0.8),
)


def row(
    site: Site, start: Place, length_m: float, *, depth_m: float, behind_m: float, rng: np.random.Generator
) -> None:
    """Build houses side by side, with alleys and side streets between some.

    Args:
        site: The world.
        start: Their first corner; x runs along the row, and the houses face −y.
        length_m: Length of the row; under 7 m nothing fits.
        depth_m: Depth of the houses.
        behind_m: Depth of a gap, which ends at another house; 0 leaves it open.
        rng: Source of the row.
    """
    at_m = 0.0
    while length_m - at_m >= _NARROWEST_M:
        if at_m > 0.0 and rng.random() < _GAP_CHANCE:
            gap_m = float(rng.uniform(2.5, 8.0))
            if behind_m > 0.0:
                x, y = start.world(at_m + gap_m / 2.0, depth_m + float(rng.uniform(0.1, 1.0)) * behind_m)
                _close(site, Place(x, y, start.yaw_rad), gap_m + 6.0, rng=rng)
            at_m += gap_m
            continue
        width_m = float(min(rng.uniform(_NARROWEST_M, _WIDEST_M), length_m - at_m))
        if length_m - at_m - width_m < _NARROWEST_M:
            width_m = length_m - at_m
        x, y = start.world(at_m, float(rng.uniform(0.0, 1.2)))
        house(site, Place(x, y, start.yaw_rad), width_m, depth_m=depth_m, rng=rng)
        at_m += width_m


def _close(site: Site, place: Place, width_m: float, *, rng: np.random.Generator) -> None:
    """Build the house that is seen through a gap, its middle at a place."""
    height_m = float(rng.uniform(4.0, 12.0))
    center, size = (0.0, 2.0, (height_m - _FOOT_M) / 2.0), (width_m, 4.0, height_m + _FOOT_M)
    site.add("house", place, center=center, size=size)


def house(site: Site, place: Place, width_m: float, *, depth_m: float, rng: np.random.Generator) -> None:
    """Build one house from its left front corner: a body, and piers and bands that frame its windows."""
    storey_m, storeys = float(rng.uniform(2.8, 3.6)), int(rng.integers(2, 6))
    height_m, recess_m = storey_m * storeys + float(rng.uniform(0.3, 1.0)), float(rng.uniform(0.12, 0.35))
    bays = max(round(width_m / float(rng.uniform(2.3, 3.8))), 2)
    bay_m = width_m / bays
    pier_m = bay_m * float(rng.uniform(0.3, 0.6))

    def block(name: str, x: tuple[float, float], y: tuple[float, float], z: tuple[float, float]) -> None:
        spans = (x, y, z)
        cx, cy, cz = ((low + high) / 2.0 for low, high in spans)
        sx, sy, sz = (high - low for low, high in spans)
        site.add(name, place, center=(cx, cy, cz), size=(sx, sy, sz))

    block("house", (0.0, width_m), (recess_m, depth_m), (-_FOOT_M, height_m))
    for edge in range(bays + 1):
        x0, x1 = max(edge * bay_m - pier_m / 2, 0.0), min(edge * bay_m + pier_m / 2, width_m)
        block("house", (x0, x1), (0.0, recess_m), (-_FOOT_M, height_m))
    sill_m, lintel_m = float(rng.uniform(0.7, 1.1)), float(rng.uniform(0.3, 0.7))
    for storey in range(1, storeys + 1):
        top = height_m if storey == storeys else storey * storey_m + sill_m
        block("house", (0.0, width_m), (0.03, recess_m), (storey * storey_m - lintel_m, top))
    door = int(rng.integers(bays))
    for bay in range(bays):
        if bay != door:
            block("house", (bay * bay_m, (bay + 1) * bay_m), (0.03, recess_m), (-_FOOT_M, sill_m))
    if rng.random() < 0.5:
        block("house", (0.0, width_m), (-0.25, recess_m), (height_m - 0.3, height_m))
    if rng.random() < 0.5:
        for storey in range(1, storeys):
            for bay in range(bays):
                if rng.random() < 0.4:
                    x, floor = ((bay + 0.1) * bay_m, (bay + 0.9) * bay_m), storey * storey_m
                    block("balcony", x, (-0.95, 0.05), (floor - 0.15, floor))
                    block("balcony", x, (-0.95, -0.9), (floor, floor + 0.95))


def heights_m(points_xy: Array, laps: Array) -> Array:
    """Return (N,) heights of the stairs above the ground floor under (N, 2) places of the way.

    The first flight rises along +x at y < 0, the second back at y > 0.

    Args:
        points_xy: Places on the way.
        laps: (N,) how often one was round before; the way begins in the middle of the first flight.
    """
    x, y = points_xy.T
    first = y < 0.0
    share = np.clip(np.where(first, x, -x) / _FLIGHT_M + 0.5, 0.0, 1.0)
    on_next: NDArray[np.bool_] = first & (laps % 1.0 > 0.5)
    storeys = np.floor(laps) + on_next
    heights: Array = STOREY_M * (storeys + 0.5 * share + 0.5 * ~first)
    return heights


def build_staircase(site: Site, *, storeys: int) -> None:
    """Add the stairs of all storeys, their railings, a door and a radiator on each, walls and roof."""
    top_m = STOREY_M * (storeys + 1)
    length_m, width_m = 2.0 * _HALF_LENGTH_M, 2.0 * _HALF_WIDTH_M

    def block(
        name: str, low: tuple[float, float, float], size: tuple[float, float, float], shape: Shape = Shape.BOX
    ) -> None:
        center = (low[0] + size[0] / 2.0, low[1] + size[1] / 2.0, low[2] + size[2] / 2.0)
        site.add(name, ORIGIN, center=center, size=size, shape=shape)

    for y in (-_HALF_WIDTH_M - _THICK_M, _HALF_WIDTH_M):
        block("wall", (-_HALF_LENGTH_M, y, -0.5), (length_m, _THICK_M, top_m + 0.5))
    for x in (-_HALF_LENGTH_M - _THICK_M, _HALF_LENGTH_M):
        block("wall", (x, -_HALF_WIDTH_M, -0.5), (_THICK_M, width_m, top_m + 0.5))
    block("roof", (-_HALF_LENGTH_M, -_HALF_WIDTH_M, top_m), (length_m, width_m, _THICK_M))
    landing_m = _HALF_LENGTH_M - _FLIGHT_M / 2.0
    run_m, rise_m = _FLIGHT_M / _STEPS, STOREY_M / 2.0 / _STEPS
    for storey in range(storeys):
        base_m = STOREY_M * storey
        for begin, y in ((base_m, -_HALF_WIDTH_M), (base_m + STOREY_M / 2.0, _WELL_M)):
            ahead = 1.0 if y < 0.0 else -1.0
            for step in range(_STEPS):
                middle = ahead * (-_FLIGHT_M / 2.0 + (step + 0.5) * run_m)
                z = begin + (step + 1) * rise_m
                tread = (run_m, _HALF_WIDTH_M - _WELL_M, _THICK_M)
                block("step", (middle - run_m / 2.0, y, z - _THICK_M), tread)
                if step % 2 == 0:
                    post = (middle - 0.02, -ahead * _WELL_M - 0.02, z)
                    block("railing", post, (0.04, 0.04, 0.95), Shape.CYLINDER)
        for x, z in ((_FLIGHT_M / 2.0, base_m + STOREY_M / 2.0), (-_HALF_LENGTH_M, base_m + STOREY_M)):
            block("landing", (x, -_HALF_WIDTH_M, z - _THICK_M), (landing_m, width_m, _THICK_M))
        block("door", (-_HALF_LENGTH_M, -0.3, base_m), (0.08, 1.0, 2.1))
        block("radiator", (_HALF_LENGTH_M - 0.15, -0.5, base_m + 1.6), (0.15, 0.9, 0.6))


def storeys_of(laps: float) -> int:
    """Return the number of storeys for a number of laps."""
    return math.ceil(laps) + 1
