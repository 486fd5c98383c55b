"""Parts of drawn textures: smooth noise, tints and scattered marks."""

import cv2
import numpy as np
from numpy.typing import NDArray

from mapper.core.frames import Image

Field32 = NDArray[np.float32]
Color = tuple[int, int, int]


def fractal(
    rng: np.random.Generator, shape: tuple[int, int], *, cell_px: tuple[float, float], octaves: int = 4
) -> Field32:
    """Return (H, W) value noise of mean ≈ 0 and standard deviation 1.

    Args:
        rng: Source of the noise.
        shape: (H, W) in pixels.
        cell_px: Height and width of the largest blobs; each octave halves size and amplitude.
        octaves: Number of sizes that are summed.
    """
    total = np.zeros(shape, dtype=np.float32)
    for octave in range(octaves):
        cells = (max(cell_px[0] / 2**octave, 1.0), max(cell_px[1] / 2**octave, 1.0))
        grid = (max(round(shape[0] / cells[0]), 2), max(round(shape[1] / cells[1]), 2))
        values = rng.standard_normal(grid, dtype=np.float32)
        total += cv2.resize(values, shape[::-1], interpolation=cv2.INTER_CUBIC) * np.float32(0.5**octave)
    return np.asarray(total / total.std(), dtype=np.float32)


def tinted(color: Color, gain: Field32) -> Image:
    """Return the (H, W, 3) image of one colour whose brightness is multiplied by ``1 + gain``."""
    return np.clip(np.array(color, np.float32) * (1.0 + gain)[:, :, None], 0, 255).astype(np.uint8)


def shaded(image: Image, gain: Field32) -> Image:
    """Return the image with every pixel's brightness multiplied by ``1 + gain``."""
    return np.clip(image * (1.0 + gain)[:, :, None], 0, 255).astype(np.uint8, order="C")


def jittered(rng: np.random.Generator, color: Color, levels: float) -> Color:
    """Return a colour near the given one: mostly lighter or darker, a little another hue."""
    change = rng.normal(0.0, levels) + rng.normal(0.0, 0.3 * levels, 3)
    red, green, blue = np.clip(np.array(color) + change, 0, 255)
    return int(red), int(green), int(blue)


def muted_color(rng: np.random.Generator) -> Color:
    """Return a colour furniture might be painted in."""
    red, green, blue = np.array(any_color(rng)) * 0.35 + rng.uniform(30, 150)
    return int(red), int(green), int(blue)


def any_color(rng: np.random.Generator) -> Color:
    """Return a colour a printer might use: any hue, seldom grey."""
    hue, saturation, value = rng.uniform(0, 180), rng.uniform(60, 230), rng.uniform(50, 240)
    hsv = np.array([[[hue, saturation, value]]]).astype(np.uint8)
    pixel = cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB)[0, 0]
    return int(pixel[0]), int(pixel[1]), int(pixel[2])


def scatter(
    rng: np.random.Generator, shape: tuple[int, int], *, px_per_m: float, per_m2: float
) -> NDArray[np.float64]:
    """Return (N, 2) random pixel positions (column, row), N so that a square metre gets ``per_m2``."""
    area_m2 = shape[0] * shape[1] / px_per_m**2
    return rng.uniform(0.0, 1.0, (round(area_m2 * per_m2), 2)) * [shape[1], shape[0]]


def blobs(
    rng: np.random.Generator, centers: NDArray[np.float64], *, radii_px: NDArray[np.float64], corners: int
) -> NDArray[np.int32]:
    """Return (N, corners, 2) irregular polygons for ``cv2.fillPoly`` around (N, 2) centres."""
    angles = np.sort(rng.uniform(0.0, 2.0 * np.pi, (len(centers), corners)), axis=1)
    reach_px = radii_px[:, None] * rng.uniform(0.5, 1.1, (len(centers), corners))
    spokes = np.stack([np.cos(angles), np.sin(angles)], axis=2)
    polygons: NDArray[np.int32] = np.rint(centers[:, None] + reach_px[:, :, None] * spokes).astype(np.int32)
    return polygons


def blob(
    rng: np.random.Generator, center: NDArray[np.float64], *, radius_px: float, corners: int
) -> NDArray[np.int32]:
    """Return one irregular polygon, (corners, 2)."""
    polygon: NDArray[np.int32] = blobs(rng, center[None], radii_px=np.array([radius_px]), corners=corners)[0]
    return polygon
