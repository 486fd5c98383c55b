"""Textures of walls, floors and ceilings: plaster, brick, wallpaper, planks, terrazzo, carpet.

Every function draws (H, W, 3) uint8 RGB of a given scale, so that a room of another size shows
bricks of the same size.
"""

from collections.abc import Callable

import cv2
import numpy as np

from mapper.core.frames import Image
from mapper.simulation.noise import (
    Color,
    any_color,
    blob,
    blobs,
    fractal,
    jittered,
    muted_color,
    scatter,
    shaded,
    tinted,
)

Surface = Callable[[np.random.Generator, tuple[int, int], float], Image]
"""(rng, (H, W) in pixels, pixels per metre) -> image."""

_PLASTERS: tuple[Color, ...] = ((214, 205, 186), (186, 202, 196), (208, 186, 164), (196, 196, 206))
_PAINTS: tuple[Color, ...] = ((214, 212, 204), (204, 210, 206), (216, 206, 190))
_WALLPAPERS: tuple[Color, ...] = ((206, 196, 160), (150, 170, 150), (172, 150, 150), (140, 156, 180))
WOODS: tuple[Color, ...] = (
    (168, 120, 76),
    (112, 74, 48),
    (196, 160, 116),
    (92, 72, 62),
    (206, 200, 190),
    (132, 76, 58),
)


def plaster(rng: np.random.Generator, shape: tuple[int, int], px_per_m: float) -> Image:
    """Old plaster: clouds, stains, chips and cracks."""
    gain = 0.05 * fractal(rng, shape, cell_px=(0.6 * px_per_m, 0.6 * px_per_m))
    gain += 0.03 * fractal(rng, shape, cell_px=(0.03 * px_per_m, 0.03 * px_per_m), octaves=2)
    image = tinted(_PLASTERS[rng.integers(len(_PLASTERS))], gain)
    stains = np.zeros(shape, dtype=np.float32)
    for center in scatter(rng, shape, px_per_m=px_per_m, per_m2=3.0):
        outline = blob(rng, center, radius_px=rng.uniform(0.04, 0.2) * px_per_m, corners=12)
        cv2.fillPoly(stains, [outline], float(rng.uniform(-0.28, 0.12)), cv2.LINE_AA)
    image = shaded(image, cv2.GaussianBlur(stains, (0, 0), max(0.008 * px_per_m, 0.3)))
    _crack(rng, image, px_per_m)
    _chip(rng, image, px_per_m, per_m2=24.0)
    return image


def painted(rng: np.random.Generator, shape: tuple[int, int], px_per_m: float) -> Image:
    """An even coat of paint with few marks, as in offices."""
    gain = 0.03 * fractal(rng, shape, cell_px=(1.5 * px_per_m, 1.5 * px_per_m), octaves=3)
    image = tinted(_PAINTS[rng.integers(len(_PAINTS))], gain)
    _chip(rng, image, px_per_m, per_m2=2.5)
    return image


def linoleum(rng: np.random.Generator, shape: tuple[int, int], px_per_m: float) -> Image:
    """A plain marbled floor with scuffs and joints every two metres."""
    gain = 0.04 * fractal(rng, shape, cell_px=(0.15 * px_per_m, 0.15 * px_per_m), octaves=4)
    image = tinted(jittered(rng, (134, 142, 138), 14.0), gain)
    image[:: max(int(2.0 * px_per_m), 1)] = (96, 100, 98)
    _chip(rng, image, px_per_m, per_m2=5.0)
    return image


def brick(rng: np.random.Generator, shape: tuple[int, int], px_per_m: float) -> Image:
    """Bricks of 22 × 7 cm, each of its own tint, with broken edges."""
    height, width = shape
    image = tinted((150, 142, 130), 0.06 * fractal(rng, shape, cell_px=(8, 8), octaves=2))
    base = jittered(rng, (158, 92, 70), 14.0)
    long_px, high_px, gap_px = 0.232 * px_per_m, 0.082 * px_per_m, 0.012 * px_per_m
    for row in range(int(height / high_px) + 1):
        for column in range(-1, int(width / long_px) + 1):
            left = (column + 0.5 * (row % 2)) * long_px + rng.uniform(-0.2, 0.2) * gap_px
            corners = np.array([left, row * high_px]) + np.array(
                [[0, 0], [long_px - gap_px, 0], [long_px - gap_px, high_px - gap_px], [0, high_px - gap_px]]
            )
            corners += rng.normal(0.0, 0.2 * gap_px, corners.shape)
            cv2.fillPoly(image, [np.round(corners).astype(np.int32)], jittered(rng, base, 22.0))
    image = shaded(image, 0.10 * fractal(rng, shape, cell_px=(0.05 * px_per_m, 0.05 * px_per_m)))
    _chip(rng, image, px_per_m, per_m2=40.0)
    return image


def wallpaper(rng: np.random.Generator, shape: tuple[int, int], px_per_m: float) -> Image:
    """Hand-printed motifs that never repeat."""
    base = jittered(rng, _WALLPAPERS[rng.integers(len(_WALLPAPERS))], 10.0)
    image = tinted(base, 0.04 * fractal(rng, shape, cell_px=(0.5 * px_per_m, 0.02 * px_per_m)))
    inks = [any_color(rng) for _ in range(5)]
    for center in scatter(rng, shape, px_per_m=px_per_m, per_m2=45.0):
        ink = inks[rng.integers(len(inks))]
        reach = rng.uniform(0.015, 0.055) * px_per_m
        column, row = (int(value) for value in center)
        motif = rng.integers(3)
        if motif == 0:
            for angle in rng.uniform(0, np.pi) + np.linspace(
                0.0, 2.0 * np.pi, int(rng.integers(3, 7)), endpoint=False
            ):
                tip = tuple((center + reach * np.array([np.cos(angle), np.sin(angle)])).astype(int).tolist())
                axes = (max(int(reach * 0.7), 1), max(int(reach * 0.25), 1))
                cv2.ellipse(image, tip, axes, float(np.degrees(angle)), 0, 360, ink, -1, cv2.LINE_AA)
        elif motif == 1:
            cv2.circle(image, (column, row), max(int(reach), 1), ink, max(int(0.3 * reach), 1), cv2.LINE_AA)
            cv2.circle(image, (column, row), max(int(0.4 * reach), 1), inks[0], -1, cv2.LINE_AA)
        else:
            star = blob(rng, center, radius_px=1.3 * reach, corners=int(rng.integers(5, 9)))
            cv2.fillPoly(image, [star], ink, cv2.LINE_AA)
    return shaded(image, 0.03 * fractal(rng, shape, cell_px=(px_per_m, px_per_m)))


def planks(rng: np.random.Generator, shape: tuple[int, int], px_per_m: float) -> Image:
    """A floor of boards, 12 cm wide, running along the rows."""
    wood = jittered(rng, WOODS[rng.integers(4)], 8.0)
    image = _grained(rng, shape, px_per_m, wood)
    high_px = 0.12 * px_per_m
    dark = np.zeros(shape, dtype=np.float32)
    for row in range(int(shape[0] / high_px) + 1):
        top, bottom = int(row * high_px), int((row + 1) * high_px)
        left = -rng.uniform(0.0, 1.0) * px_per_m
        while left < shape[1]:
            right = left + rng.uniform(0.5, 1.3) * px_per_m
            dark[top:bottom, max(int(left), 0) : int(right)] = rng.normal(0.0, 0.13)
            dark[top:bottom, max(int(right) - 1, 0) : int(right) + 1] = -0.6
            left = right
        dark[top : top + max(int(0.006 * px_per_m), 1)] = -0.6
    image = shaded(image, dark)
    _chip(rng, image, px_per_m, per_m2=35.0)
    return image


def terrazzo(rng: np.random.Generator, shape: tuple[int, int], px_per_m: float) -> Image:
    """Stone chips in cement."""
    image = tinted((176, 172, 164), 0.04 * fractal(rng, shape, cell_px=(0.4 * px_per_m, 0.4 * px_per_m)))
    inks = [jittered(rng, (120, 110, 100), 45.0) for _ in range(6)]
    centers = scatter(rng, shape, px_per_m=px_per_m, per_m2=180.0)
    outlines = blobs(rng, centers, radii_px=rng.uniform(0.006, 0.03, len(centers)) * px_per_m, corners=7)
    for outline, ink in zip(outlines, rng.integers(len(inks), size=len(centers)), strict=True):
        cv2.fillPoly(image, [outline], inks[ink], cv2.LINE_AA)
    return image


def tiles(rng: np.random.Generator, shape: tuple[int, int], px_per_m: float) -> Image:
    """Stone tiles of 30 cm, veined, each of its own tint."""
    veins = 0.10 * fractal(rng, shape, cell_px=(0.2 * px_per_m, 0.2 * px_per_m), octaves=5)
    image = tinted((186, 178, 166), veins)
    side_px, gap_px = 0.3 * px_per_m, max(int(0.006 * px_per_m), 1)
    dark = np.zeros(shape, dtype=np.float32)
    for row in range(int(shape[0] / side_px) + 1):
        for column in range(int(shape[1] / side_px) + 1):
            top, left = int(row * side_px), int(column * side_px)
            tile = dark[top : int((row + 1) * side_px), left : int((column + 1) * side_px)]
            tile[:] = rng.normal(-0.25 if (row + column) % 2 else 0.05, 0.06)
            tile[:gap_px], tile[:, :gap_px] = -0.55, -0.55
    image = shaded(image, dark)
    _crack(rng, image, px_per_m)
    _chip(rng, image, px_per_m, per_m2=60.0)
    return image


def carpet(rng: np.random.Generator, shape: tuple[int, int], px_per_m: float) -> Image:
    """Woven diamonds and specks."""
    base = jittered(rng, (120, 84, 78), 26.0)
    image = tinted(base, 0.08 * fractal(rng, shape, cell_px=(4, 4), octaves=2))
    inks = [any_color(rng) for _ in range(4)]
    for center in scatter(rng, shape, px_per_m=px_per_m, per_m2=28.0):
        reach = rng.uniform(0.02, 0.08) * px_per_m
        diamond = center + reach * np.array([[0, -1], [0.7, 0], [0, 1], [-0.7, 0]])
        cv2.fillPoly(image, [np.round(diamond).astype(np.int32)], inks[rng.integers(4)], cv2.LINE_AA)
        cv2.polylines(image, [np.round(center + 0.5 * (diamond - center)).astype(np.int32)], True, inks[0])
    return shaded(image, 0.07 * fractal(rng, shape, cell_px=(3, 3), octaves=1))


def wood(rng: np.random.Generator, shape: tuple[int, int], px_per_m: float, *, tone: Color) -> Image:
    """One board of furniture, its grain along the rows, with knots and scratches."""
    image = _grained(rng, shape, px_per_m, jittered(rng, tone, 10.0))
    for center in scatter(rng, shape, px_per_m=px_per_m, per_m2=10.0):
        reach = rng.uniform([0.01, 0.006], [0.03, 0.012]) * px_per_m
        axes, place = (max(int(reach[0]), 1), max(int(reach[1]), 1)), (int(center[0]), int(center[1]))
        ink = jittered(rng, (0.4 * np.array(tone)).astype(int).tolist(), 6.0)
        cv2.ellipse(image, place, axes, rng.uniform(-15, 15), 0, 360, ink, -1, cv2.LINE_AA)
    _chip(rng, image, px_per_m, per_m2=25.0)
    return image


def fabric(rng: np.random.Generator, shape: tuple[int, int], px_per_m: float) -> Image:
    """Upholstery: weave, uneven stripes, stitched dots."""
    image = tinted(muted_color(rng), 0.07 * fractal(rng, shape, cell_px=(3, 3), octaves=1))
    left = 0.0
    while left < shape[1]:
        right = left + rng.uniform(0.01, 0.09) * px_per_m
        if rng.random() < 0.5:
            stripe = image[:, int(left) : int(right) + 1]
            stripe[:] = (0.6 * stripe + 0.4 * np.array(muted_color(rng))).astype(np.uint8)
        left = right
    _chip(rng, image, px_per_m, per_m2=70.0)
    return image


def _grained(rng: np.random.Generator, shape: tuple[int, int], px_per_m: float, base: Color) -> Image:
    gain = 0.12 * fractal(rng, shape, cell_px=(0.025 * px_per_m, 0.8 * px_per_m), octaves=3)
    return tinted(base, gain + 0.03 * fractal(rng, shape, cell_px=(2, 12), octaves=1))


def _chip(rng: np.random.Generator, image: Image, px_per_m: float, *, per_m2: float) -> None:
    """Small marks, darker or lighter than what they are on."""
    centers = scatter(rng, image.shape[:2], px_per_m=px_per_m, per_m2=per_m2)
    outlines = blobs(rng, centers, radii_px=rng.uniform(0.004, 0.022, len(centers)) * px_per_m, corners=6)
    darker = rng.random(len(centers)) < 0.7
    factors = np.where(darker, rng.uniform(0.35, 0.75, len(centers)), rng.uniform(1.2, 1.5, len(centers)))
    columns, rows = centers.astype(np.intp).T
    inks = np.clip(image[rows, columns] * factors[:, None], 0, 255).astype(np.uint8).tolist()
    for outline, ink in zip(outlines, inks, strict=True):
        cv2.fillPoly(image, [outline], ink, cv2.LINE_AA)


def _crack(rng: np.random.Generator, image: Image, px_per_m: float) -> None:
    for start in scatter(rng, image.shape[:2], px_per_m=px_per_m, per_m2=0.8):
        steps = rng.normal(0.0, 0.035, (int(rng.integers(6, 22)), 2)) + rng.normal(0.0, 0.03, 2)
        line = np.round(start + px_per_m * np.cumsum(steps, axis=0)).astype(np.int32)
        cv2.polylines(image, [line], False, jittered(rng, (70, 62, 56), 10.0), 1, cv2.LINE_AA)


WALLS: tuple[Surface, ...] = (plaster, brick, wallpaper)
FLOORS: tuple[Surface, ...] = (planks, terrazzo, carpet, tiles)
