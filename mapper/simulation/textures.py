"""Textures, drawn as (H, W, 3) uint8 RGB.

Walls, floors and ceilings have a given scale, so that a room of another size shows bricks of the same size:
plaster, brick, wallpaper, planks, terrazzo, carpet. Prints have a shape of their own: posters, book spines,
papers, screens, cartons, cabinet fronts.
"""

import string
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
_FONTS = (
    cv2.FONT_HERSHEY_SIMPLEX,
    cv2.FONT_HERSHEY_DUPLEX,
    cv2.FONT_HERSHEY_TRIPLEX,
    cv2.FONT_HERSHEY_COMPLEX,
)
_BLACK: Color = (40, 40, 46)
_WHITE: Color = (236, 230, 214)
_LETTERS = np.array(list(string.ascii_uppercase + string.digits))


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


def poster(rng: np.random.Generator, shape: tuple[int, int]) -> Image:
    """A print with a frame: sky, random shapes, a title."""
    height, width = shape
    top, bottom = np.array(any_color(rng), np.float32), np.array(any_color(rng), np.float32)
    ramp = np.linspace(0.0, 1.0, height, dtype=np.float32)[:, None, None]
    image = np.broadcast_to((1 - ramp) * top + ramp * bottom, (height, width, 3)).astype(np.uint8)
    image = shaded(image, 0.10 * fractal(rng, shape, cell_px=(height / 3, width / 3), octaves=5))
    for _ in range(int(rng.integers(14, 30))):
        center = rng.uniform(0.05, 0.95, 2) * [width, height]
        radius = rng.uniform(0.02, 0.18) * min(shape)
        place, ink = (int(center[0]), int(center[1])), any_color(rng)
        kind = rng.integers(4)
        if kind == 0:
            cv2.circle(image, place, max(int(radius), 1), ink, -1, cv2.LINE_AA)
            cv2.circle(image, place, max(int(0.5 * radius), 1), any_color(rng), 2, cv2.LINE_AA)
        elif kind == 1:
            cv2.fillPoly(image, [blob(rng, center, radius_px=1.3 * radius, corners=6)], ink, cv2.LINE_AA)
        elif kind == 2:
            far = tuple(int(value) for value in center + rng.normal(0.0, 2.0 * radius, 2))
            cv2.line(image, place, far, ink, int(rng.integers(1, 5)), cv2.LINE_AA)
        else:
            _write(rng, image, place, height_px=max(0.35 * radius, 5.0))
    _write(rng, image, (int(0.08 * width), int(0.93 * height)), height_px=0.06 * height)
    thick = max(int(0.025 * min(shape)), 2)
    cv2.rectangle(image, (0, 0), (width - 1, height - 1), jittered(rng, (50, 40, 34), 20.0), 2 * thick)
    return image


def document(rng: np.random.Generator, shape: tuple[int, int]) -> Image:
    """White paper with lines of words, a heading and a chart."""
    height, width = shape
    image = tinted((236, 234, 228), 0.01 * fractal(rng, shape, cell_px=(height, width), octaves=1))
    line_px = max(height // 16, 4)
    _write(rng, image, (width // 10, 2 * line_px), height_px=0.9 * line_px, ink=_BLACK)
    for row in range(3 * line_px, height - line_px, line_px):
        column = width // 10
        while column < 0.85 * width:
            length = int(rng.uniform(0.04, 0.16) * width) + 1
            end = min(column + length, int(0.9 * width))
            cv2.line(image, (column, row), (end, row), (60, 60, 70), max(line_px // 3, 1))
            column += length + max(width // 40, 1)
    left, top = int(rng.uniform(0.1, 0.5) * width), int(rng.uniform(0.35, 0.6) * height)
    cv2.rectangle(image, (left, top), (left + width // 3, top + height // 4), any_color(rng), -1)
    return image


def spines(rng: np.random.Generator, shape: tuple[int, int]) -> Image:
    """A row of books seen from the front; the image is as high as the tallest."""
    height, width = shape
    image = np.zeros((height, width, 3), dtype=np.uint8)
    left = 0
    while left < width:
        thick = int(rng.uniform(0.07, 0.2) * height) + 1
        right = min(left + thick, width)
        ink, trim = any_color(rng), any_color(rng)
        image[:, left:right] = ink
        for row in rng.uniform(0.05, 0.95, int(rng.integers(1, 4))):
            image[int(row * height) : int(row * height) + max(height // 40, 1), left:right] = trim
        title = np.zeros((thick, height, 3), dtype=np.uint8)
        _write(rng, title, (int(0.15 * height), int(0.7 * thick)), height_px=0.45 * thick, ink=_WHITE)
        lettering = cv2.rotate(title, cv2.ROTATE_90_CLOCKWISE)[:, : right - left]
        image[:, left:right] = np.maximum(image[:, left:right], lettering)
        image[:, left : left + max(thick // 12, 1)] //= 3
        left = right
    return shaded(image, 0.06 * fractal(rng, shape, cell_px=(6, 6), octaves=2))


def screen(rng: np.random.Generator, shape: tuple[int, int]) -> Image:
    """A monitor showing windows of text inside its black bezel."""
    height, width = shape
    glow = 0.3 * fractal(rng, shape, cell_px=(height / 2, width / 2))
    image = tinted(jittered(rng, (40, 70, 100), 20.0), glow)
    for _ in range(4):
        corner = (rng.uniform(0.05, 0.6, 2) * [width, height]).astype(int)
        size = (rng.uniform(0.25, 0.4, 2) * [width, height]).astype(int)
        window = image[corner[1] : corner[1] + size[1], corner[0] : corner[0] + size[0]]
        window[:] = document(rng, (window.shape[0], window.shape[1]))
    cv2.rectangle(image, (0, 0), (width - 1, height - 1), (24, 24, 26), max(int(0.07 * height), 2))
    return image


def carton(rng: np.random.Generator, shape: tuple[int, int]) -> Image:
    """Corrugated board with tape, stamps and a bar code."""
    height, width = shape
    flutes = 0.05 * fractal(rng, shape, cell_px=(height, 5), octaves=2)
    image = tinted(jittered(rng, (176, 138, 96), 10.0), flutes)
    band = slice(int(0.44 * height), int(0.56 * height))
    image[band] = (0.6 * image[band] + 0.4 * np.array(jittered(rng, (206, 180, 130), 20.0))).astype(np.uint8)
    for _ in range(3):
        place = tuple((rng.uniform(0.05, 0.6, 2) * [width, height] + [0, 0.25 * height]).astype(int))
        _write(rng, image, (int(place[0]), int(place[1])), height_px=0.09 * height, ink=_BLACK)
    left, top = int(rng.uniform(0.1, 0.6) * width), int(rng.uniform(0.62, 0.75) * height)
    image[top : top + height // 6, left : left + width // 4] = 232
    for column in left + (rng.uniform(0.05, 0.95, 14) * (width // 4)).astype(int):
        image[top : top + height // 7, column : column + max(width // 120, 1)] = 30
    return shaded(image, 0.05 * fractal(rng, shape, cell_px=(height / 4, width / 4)))


def cabinet_front(rng: np.random.Generator, board: Image, *, columns: int, rows: int) -> Image:
    """Return the board with doors or drawers cut into it, each with a knob and its own tint."""
    image = board.copy()
    height, width = image.shape[:2]
    for row in range(rows):
        for column in range(columns):
            top, bottom = row * height // rows, (row + 1) * height // rows
            left, right = column * width // columns, (column + 1) * width // columns
            door = image[top:bottom, left:right]
            door[:] = np.clip(door * rng.uniform(0.8, 1.15), 0, 255).astype(np.uint8)
            cv2.rectangle(image, (left, top), (right - 1, bottom - 1), (40, 30, 24), 2)
            inset = max(min(height // rows, width // columns) // 8, 3)
            groove = ((left + inset, top + inset), (right - inset, bottom - inset))
            cv2.rectangle(image, *groove, (70, 52, 40), 1)
            knob = (left + 2 * inset if column % 2 else right - 2 * inset, (top + bottom) // 2)
            cv2.circle(image, knob, max(inset // 3, 2), (216, 206, 170), -1, cv2.LINE_AA)
    return image


def _write(
    rng: np.random.Generator,
    image: Image,
    place: tuple[int, int],
    *,
    height_px: float,
    ink: Color | None = None,
) -> None:
    lengths = rng.integers(3, 8, int(rng.integers(1, 4)))
    words = " ".join("".join(rng.choice(_LETTERS, length)) for length in lengths)
    font = int(rng.choice(_FONTS))
    cv2.putText(
        image,
        words,
        place,
        font,
        height_px / 22.0,
        ink or any_color(rng),
        max(int(height_px / 12.0), 1),
        cv2.LINE_AA,
    )


WALLS: tuple[Surface, ...] = (plaster, brick, wallpaper)
FLOORS: tuple[Surface, ...] = (planks, terrazzo, carpet, tiles)
