"""Rows of houses: facades with windows and doors set back, balconies, cornices, gaps between them."""

import numpy as np

from mapper.simulation.builder import Place
from mapper.simulation.lidar.solids import Site

_FOOT_M = 1.5
"""Depth of walls below the ground at their middle, so that none floats above a slope."""
_NARROWEST_M, _WIDEST_M = 7.0, 17.0
_GAP_CHANCE = 0.18


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
