"""Textures with a shape of their own: posters, book spines, papers, screens, cartons, cabinet fronts."""

import string

import cv2
import numpy as np

from mapper.core.frames import Image
from mapper.simulation.noise import Color, any_color, blob, fractal, jittered, shaded, tinted

_FONTS = (
    cv2.FONT_HERSHEY_SIMPLEX,
    cv2.FONT_HERSHEY_DUPLEX,
    cv2.FONT_HERSHEY_TRIPLEX,
    cv2.FONT_HERSHEY_COMPLEX,
)
_BLACK: Color = (40, 40, 46)
_WHITE: Color = (236, 230, 214)
_LETTERS = np.array(list(string.ascii_uppercase + string.digits))


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
