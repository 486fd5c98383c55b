"""Staircase of several storeys that are alike: two flights a storey, a landing at each end, walls around."""

import math

import numpy as np
from numpy.typing import NDArray

from mapper.core.geometry import Array
from mapper.simulation.builder import ORIGIN
from mapper.simulation.lidar.solids import Shape, Site

STOREY_M = 3.0
ROUTE_SIZE_M = (4.0, 1.3)
"""Width and depth of the rectangle that one walks, up both flights, once a storey."""

_FLIGHT_M, _STEPS = 3.0, 9
_HALF_LENGTH_M, _HALF_WIDTH_M, _WALL_M, _SLAB_M = 2.7, 1.35, 0.2, 0.2
_WELL_M = 0.1
"""Half the gap between the flights."""


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
    """Add the stairs of so many storeys, their railings, a door and a radiator on each, walls and roof."""
    top_m = STOREY_M * (storeys + 1)
    length_m, width_m = 2.0 * _HALF_LENGTH_M, 2.0 * _HALF_WIDTH_M

    def block(
        name: str, low: tuple[float, float, float], size: tuple[float, float, float], shape: Shape = Shape.BOX
    ) -> None:
        center = (low[0] + size[0] / 2.0, low[1] + size[1] / 2.0, low[2] + size[2] / 2.0)
        site.add(name, ORIGIN, center=center, size=size, shape=shape)

    for y in (-_HALF_WIDTH_M - _WALL_M, _HALF_WIDTH_M):
        block("wall", (-_HALF_LENGTH_M, y, -0.5), (length_m, _WALL_M, top_m + 0.5))
    for x in (-_HALF_LENGTH_M - _WALL_M, _HALF_LENGTH_M):
        block("wall", (x, -_HALF_WIDTH_M, -0.5), (_WALL_M, width_m, top_m + 0.5))
    block("roof", (-_HALF_LENGTH_M, -_HALF_WIDTH_M, top_m), (length_m, width_m, _SLAB_M))
    landing_m = _HALF_LENGTH_M - _FLIGHT_M / 2.0
    run_m, rise_m = _FLIGHT_M / _STEPS, STOREY_M / 2.0 / _STEPS
    for storey in range(storeys):
        base_m = STOREY_M * storey
        for begin, y in ((base_m, -_HALF_WIDTH_M), (base_m + STOREY_M / 2.0, _WELL_M)):
            ahead = 1.0 if y < 0.0 else -1.0
            for step in range(_STEPS):
                middle = ahead * (-_FLIGHT_M / 2.0 + (step + 0.5) * run_m)
                z = begin + (step + 1) * rise_m
                tread = (run_m, _HALF_WIDTH_M - _WELL_M, _SLAB_M)
                block("step", (middle - run_m / 2.0, y, z - _SLAB_M), tread)
                if step % 2 == 0:
                    post = (middle - 0.02, -ahead * _WELL_M - 0.02, z)
                    block("railing", post, (0.04, 0.04, 0.95), Shape.CYLINDER)
        for x, z in ((_FLIGHT_M / 2.0, base_m + STOREY_M / 2.0), (-_HALF_LENGTH_M, base_m + STOREY_M)):
            block("landing", (x, -_HALF_WIDTH_M, z - _SLAB_M), (landing_m, width_m, _SLAB_M))
        block("door", (-_HALF_LENGTH_M, -0.3, base_m), (0.08, 1.0, 2.1))
        block("radiator", (_HALF_LENGTH_M - 0.15, -0.5, base_m + 1.6), (0.15, 0.9, 0.6))


def storeys_of(laps: float) -> int:
    """Return how many storeys one needs to go round so often."""
    return math.ceil(laps) + 1
