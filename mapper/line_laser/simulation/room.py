"""Walls in plan view, pictures on them, and the vehicle's path."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from mapper.core.geometry import Array
from mapper.line_laser.config import LineLaserSynthConfig
from mapper.simulation.streams import Stream, rng_of

ROOM_M = (4.4, 3.6)
BLOCK_M = (2.0, 1.2)
TURN_RADIUS_M = 0.6
_HEIGHT_M = 0.8  # the camera sees no higher where the laser shows anything
_WALL_LIGHTNESS = (0.45, 0.95)
_FLOOR_LIGHTNESS = (0.3, 0.6)
_WOOD = np.array([0.0, 0.25, 0.5])  # what the brownest of floors takes away of red, green and blue


@dataclass(frozen=True, slots=True)
class Patch:
    """Something flat on a wall.

    Attributes:
        wall: Wall that the patch is on.
        along_m: From where to where along the wall.
        up_m: From where to where above the floor.
        kind: "lamp" shines by itself, "red" is painted, "dull" returns no laser light.
        color: (R, G, B): share of light returned, or of a lamp times what a pixel can show.
    """

    wall: int
    along_m: tuple[float, float]
    up_m: tuple[float, float]
    kind: Literal["lamp", "red", "dull"]
    color: tuple[float, float, float]


@dataclass(frozen=True, slots=True, eq=False)
class Room:
    """Walls that stand upright on a level floor and are higher than the camera sees.

    Attributes:
        ends_world: (S, 2, 2) both ends of each wall from above, metres.
        colors: (S, 3) share of red, green and blue light each returns.
        patches: Pictures on them; later ones cover earlier ones.
        floor: (3,) share of red, green and blue light that the floor returns.
    """

    ends_world: Array
    colors: Array
    patches: Sequence[Patch]
    floor: Array


def make_room(config: LineLaserSynthConfig) -> Room:
    """Return a room with a block in its middle; the way round begins at the origin, along x."""
    centre = (0.0, 0.25 * (ROOM_M[1] + BLOCK_M[1]))
    return furnished(np.concatenate([_box(centre, ROOM_M), _box(centre, BLOCK_M)]), config)


def make_board(config: LineLaserSynthConfig, *, range_m: float, width_m: float) -> Room:
    """Return a board that faces an observer at the origin who looks along x."""
    half = 0.5 * width_m
    return furnished(np.array([[[range_m, -half], [range_m, half]]]), config)


def furnished(ends_world: Array, config: LineLaserSynthConfig) -> Room:
    """Return (S, 2, 2) walls in colours of their own, and random things on them."""
    rng = rng_of(config.seed, Stream.SURFACES)
    lightness = rng.uniform(*_WALL_LIGHTNESS, (len(ends_world), 1))
    colors = np.clip(lightness * rng.uniform(0.92, 1.0, (len(ends_world), 3)), 0.0, 1.0)
    per_m = {"dull": config.dull_things, "red": config.red_things, "lamp": config.lamps}
    patches: list[Patch] = []
    for wall, (begin, end) in enumerate(ends_world):
        length_m = float(np.linalg.norm(end - begin))
        for kind, rate in per_m.items():
            patches.extend(_patch(rng, wall, length_m, kind) for _ in range(rng.poisson(rate * length_m)))
    floor = rng.uniform(*_FLOOR_LIGHTNESS) * (1.0 - rng.uniform() * _WOOD)
    return Room(ends_world, colors, patches, floor)


def curvature_at(path_m: Array) -> Array:
    """Return (N,) turns per metre after (N,) metres of the way round, half way between room and block."""
    centre_m = (np.array(ROOM_M) + BLOCK_M) / 2.0
    along_m, across_m = centre_m - 2.0 * TURN_RADIUS_M
    quarter_m = 0.5 * np.pi * TURN_RADIUS_M
    pieces = [along_m / 2, quarter_m, across_m, quarter_m, along_m, quarter_m, across_m, quarter_m]
    ends_m = np.cumsum([*pieces, along_m / 2])
    piece = np.searchsorted(ends_m, path_m % ends_m[-1], side="right")
    return np.where(piece % 2 == 1, 1.0 / TURN_RADIUS_M, 0.0)


def lap_m() -> float:
    """Return the length of the way round."""
    straight_m = (np.array(ROOM_M) + BLOCK_M).sum() - 8.0 * TURN_RADIUS_M
    return float(straight_m + 2.0 * np.pi * TURN_RADIUS_M)


def _box(centre: tuple[float, float], size: tuple[float, float]) -> Array:
    corners = np.array(centre) + 0.5 * np.array(size) * [[-1, -1], [1, -1], [1, 1], [-1, 1]]
    return np.stack([corners, np.roll(corners, -1, axis=0)], axis=1)


def _patch(rng: np.random.Generator, wall: int, length_m: float, kind: str) -> Patch:
    middle_m, low_m = rng.uniform(0.0, length_m), rng.uniform(0.0, 0.8 * _HEIGHT_M)
    width_m, height_m = rng.uniform(0.04, 0.25), rng.uniform(0.03, 0.3)
    along_m, up_m = (middle_m - 0.5 * width_m, middle_m + 0.5 * width_m), (low_m, low_m + height_m)
    if kind == "lamp":
        brightness = float(np.exp(rng.uniform(0.2, 2.0)))
        return Patch(wall, along_m, up_m, "lamp", (brightness, 0.95 * brightness, 0.85 * brightness))
    if kind == "dull":
        return Patch(wall, along_m, up_m, "dull", (0.04, 0.04, 0.04))
    red = float(rng.uniform(0.45, 0.95))
    return Patch(wall, along_m, up_m, "red", (red, 0.25 * red, 0.2 * red))
