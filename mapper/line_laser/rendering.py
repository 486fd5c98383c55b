"""Rendered images of a line laser: a room, a pinhole camera, a sheet of light, and disturbances.

Camera and laser look level and straight ahead, one above the other, and the sheet falls to the floor at
the reach. So the stripe's height in the image is a/d + b of the distance d, whatever the column, which for
b near 0 is the power law of Somlyai (PhD thesis), eq. 2.44. The lateral law (eq. 2.45) has another horizon,
b = 8.9 on the scale of 100, which no pinhole with a flat sheet can have beside the first; here it comes out
near 0 too.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from mapper.core.frames import Image
from mapper.core.geometry import Array, Transform
from mapper.line_laser.config import LineLaserSynthConfig
from mapper.simulation.noise import Field32, fractal
from mapper.simulation.streams import Stream, rng_of

ROOM_M = (4.4, 3.6)
BLOCK_M = (2.0, 1.2)
TURN_RADIUS_M = 0.6
_HEIGHT_M = 0.8  # the camera sees no higher where the laser shows anything
_WALL_LIGHTNESS = (0.45, 0.95)
_FLOOR_LIGHTNESS = (0.3, 0.6)
_WOOD = np.array([0.0, 0.25, 0.5])  # what the brownest of floors takes away of red, green and blue
_CAMERA_M, _LASER_M = 0.324, 0.615
"""Heights above the floor; with the default focal length and reach they put the stripe within 0.3 % of where
eq. 2.44 has it."""
_LASER_LEVELS = 600.0
"""Brightness that the laser adds to a white wall 1 m away, where 255 is the most a pixel can show: the stripe
is seen on the floor at its reach, where the thesis measured its farthest point."""
_STRIPE_M = 0.004  # four standard deviations
_GLOSS = 0.15  # share of light that the floor reflects like a mirror
_JPEG_QUALITY = 85
_LENS_PX = 0.9
_TEXTURE_PX_PER_M = 150.0
_TEXTURE_GAIN = 0.08
_LIGHT_FROM = np.array([0.8, 0.6])
_FAR_M = 50.0
_NOWHERE = 0.3  # what is beyond all walls returns of the room's light
_BLOOM_PX, _BLOOM_RATIO = 7.0, 0.12
_CROSSTALK = 0.1  # of the laser's light, in the pixels of the other colours
_SPILL = 0.6  # of what is too bright for the red ones
_SPECKLE = 0.25


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


@dataclass(frozen=True, slots=True, eq=False)
class Shot:
    """An image and the truth about its stripe.

    Attributes:
        jpeg: The image file.
        rows: (W,) row of the stripe's middle, NaN in columns without a stripe.
        ranges_m: (W,) how far ahead it lies, NaN likewise.
    """

    jpeg: bytes
    rows: Array
    ranges_m: Array


@dataclass(frozen=True, slots=True, eq=False)
class _View:
    """Directions of the image's columns and pixels.

    Attributes:
        sight_world: (W, 2) direction of a column, one metre ahead.
        depth_m: (W,) to its wall, metres ahead.
        wall: (W,) which, −1 for none.
        along_m: (W,) where on the wall.
        slant: (W,) cosine between the viewing ray and the wall's normal.
        up_m: (H, W) height on the wall; below the floor, where its mirror image is.
    """

    sight_world: Array
    depth_m: Array
    wall: NDArray[np.int64]
    along_m: Array
    slant: Array
    up_m: Array


def take(
    room: Room, config: LineLaserSynthConfig, T_world_sensor: Transform, *, rng: np.random.Generator
) -> Shot:
    """Return an image from a pose of the sensor on the floor, x ahead."""
    view = _looked(room, config, T_world_sensor)
    light = _lit_by_room(room, config, view, T_world_sensor[:2, 3], rng=rng)
    for patch in room.patches:
        _paint(light, patch, view, config)
    light = cv2.GaussianBlur(light, (0, 0), _LENS_PX)
    rows, ranges_m, levels = _stripe(room, config, view)
    laser = _stripe_light(config, rows, ranges_m, levels, rng=rng)
    light += laser[:, :, None] * np.array([1.0, _CROSSTALK, _CROSSTALK], np.float32)
    ghost_rows = (config.height_px - 1) - rows + 2.0 * config.focal_px * _CAMERA_M / ranges_m
    mirrored = _stripe_light(config, ghost_rows, ranges_m, _GLOSS * levels, rng=rng)
    light[:, :, 0] += np.where(view.up_m < 0.0, mirrored, np.float32(0.0))
    visible = (levels > 0.0) & (rows >= 0.0) & (rows <= config.height_px - 1)
    return Shot(
        _encoded(_developed(light, config, rng=rng)),
        np.where(visible, rows, np.nan),
        np.where(visible, ranges_m, np.nan),
    )


def _looked(room: Room, config: LineLaserSynthConfig, T_world_sensor: Transform) -> _View:
    ahead, left = T_world_sensor[:2, 0], T_world_sensor[:2, 1]
    slope = (np.arange(config.width_px) - 0.5 * (config.width_px - 1)) / config.focal_px
    sight_world = ahead - slope[:, None] * left
    begin, along = room.ends_world[:, 0], room.ends_world[:, 1] - room.ends_world[:, 0]
    to_begin = begin - T_world_sensor[:2, 3]
    across = _cross(sight_world[:, None], along)
    with np.errstate(divide="ignore", invalid="ignore"):
        depth_m = _cross(to_begin, along) / across
        share = _cross(to_begin, sight_world[:, None]) / across
    met = (depth_m > 0.0) & (share >= 0.0) & (share <= 1.0)
    depth_m = np.where(met, depth_m, np.inf)
    wall = depth_m.argmin(axis=1)
    column = np.arange(config.width_px)
    nearest_m = depth_m[column, wall]
    length_m = np.linalg.norm(along, axis=1)
    slant = np.abs(across[column, wall]) / length_m[wall] / np.linalg.norm(sight_world, axis=1)
    nearest_m, wall = np.minimum(nearest_m, _FAR_M), np.where(np.isfinite(nearest_m), wall, -1)
    below = np.arange(config.height_px)[:, None] - 0.5 * (config.height_px - 1)
    up_m = _CAMERA_M - below * nearest_m / config.focal_px
    return _View(sight_world, nearest_m, wall, share[column, wall] * length_m[wall], slant, up_m)


def _cross(a: Array, b: Array) -> Array:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def _lit_by_room(
    room: Room, config: LineLaserSynthConfig, view: _View, position: Array, *, rng: np.random.Generator
) -> Field32:
    """Return (H, W, 3) levels of bare walls and floor."""
    height = config.height_px
    below = np.maximum(np.arange(height) - 0.5 * (height - 1), 0.5)[:, None]
    floor_m = config.focal_px * _CAMERA_M / below
    floor_world = position + floor_m[:, :, None] * view.sight_world
    is_floor = view.up_m < 0.0
    s = np.where(is_floor, floor_world[:, :, 0], view.along_m + 1.7 * view.wall)
    t = np.where(is_floor, floor_world[:, :, 1], view.up_m)
    tile = fractal(np.random.default_rng(config.seed), (256, 256), cell_px=(64, 64), octaves=5)
    # Back and forth over the tile, so that it has no seams.
    x, y = (np.abs(_TEXTURE_PX_PER_M * c % 510.0 - 255.0).astype(np.float32) for c in (s, t))
    texture = 1.0 + _TEXTURE_GAIN * cv2.remap(tile, x, y, cv2.INTER_LINEAR)
    normals = (room.ends_world[:, 1] - room.ends_world[:, 0])[:, ::-1]
    facing = np.abs(normals @ _LIGHT_FROM) / np.linalg.norm(normals, axis=1)
    painted = (room.colors * (0.7 + 0.3 * facing[:, None])).astype(np.float32)
    walls = np.where(view.wall[:, None] >= 0, painted[view.wall], np.float32(_NOWHERE))
    color = np.where(is_floor[:, :, None], room.floor.astype(np.float32), walls)
    exposure = 255.0 * config.ambient * rng.uniform(0.9, 1.1)
    light: Field32 = exposure * color * texture[:, :, None]
    return light


def _paint(light: Field32, patch: Patch, view: _View, config: LineLaserSynthConfig) -> None:
    """Draw a patch into the (H, W, 3) levels, which are written."""
    columns = _columns_of(patch, view)
    up_m, part = view.up_m[:, columns], light[:, columns]
    bright = 255.0 * (1.0 if patch.kind == "lamp" else config.ambient) * np.array(patch.color)
    part[(up_m >= patch.up_m[0]) & (up_m <= patch.up_m[1])] = bright
    if patch.kind == "lamp":
        part[(-up_m >= patch.up_m[0]) & (-up_m <= patch.up_m[1])] += _GLOSS * bright
    light[:, columns] = part


def _columns_of(patch: Patch, view: _View) -> NDArray[np.intp]:
    begin_m, end_m = patch.along_m
    return np.flatnonzero((view.wall == patch.wall) & (view.along_m >= begin_m) & (view.along_m <= end_m))


def _stripe(room: Room, config: LineLaserSynthConfig, view: _View) -> tuple[Array, Array, Array]:
    """Return row, range and brightness of the stripe in each column: on the wall, or else on the floor."""
    on_floor = view.depth_m >= config.reach_m
    ranges_m = np.where(on_floor, config.reach_m, view.depth_m)
    height_m = _LASER_M * (1.0 - ranges_m / config.reach_m)
    rows = 0.5 * (config.height_px - 1) + config.focal_px * (_CAMERA_M - height_m) / ranges_m
    returned = room.colors[view.wall, 0]
    for patch in room.patches:
        columns = _columns_of(patch, view)
        lit = columns[(height_m[columns] >= patch.up_m[0]) & (height_m[columns] <= patch.up_m[1])]
        returned[lit] = 0.0 if patch.kind == "dull" else min(patch.color[0], 1.0)
    grazing = _LASER_M / np.hypot(_LASER_M, config.reach_m)
    share = np.where(on_floor, room.floor[0] * grazing, returned * view.slant)
    return rows, ranges_m, _LASER_LEVELS * share / ranges_m


def _stripe_light(
    config: LineLaserSynthConfig, rows: Array, ranges_m: Array, levels: Array, *, rng: np.random.Generator
) -> Field32:
    """Return (H, W) levels that the laser adds."""
    sigma_px = np.hypot(_LENS_PX, 0.25 * config.focal_px * _STRIPE_M / ranges_m)
    noise = cv2.GaussianBlur(rng.standard_normal((1, config.width_px)), (0, 0), 1.0)[0]
    speckle = np.exp(_SPECKLE * noise / noise.std())
    offset = np.arange(config.height_px)[:, None] - rows
    falls = (-0.5 * (offset / sigma_px) ** 2).astype(np.float32)
    light: Field32 = (levels * speckle).astype(np.float32) * np.exp(falls)
    return light


def _developed(light: Field32, config: LineLaserSynthConfig, *, rng: np.random.Generator) -> Image:
    """Return the image of (H, W, 3) levels: spilt and bloomed where too bright, with noise, 8 bits."""
    seen = light.copy()
    glare = cv2.GaussianBlur(np.maximum(seen - 255.0, 0.0), (0, 0), _BLOOM_PX)
    seen[:, :, 1:] += _SPILL * np.maximum(seen[:, :, :1] - 255.0, 0.0)
    seen += _BLOOM_RATIO * glare
    seen += config.noise_levels * rng.standard_normal(seen.shape, dtype=np.float32)
    return np.clip(np.rint(seen), 0, 255).astype(np.uint8)


def _encoded(image: Image) -> bytes:
    bgr = np.ascontiguousarray(image[:, :, ::-1])
    _, jpeg = cv2.imencode(".jpg", bgr, (cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY))
    return jpeg.tobytes()
