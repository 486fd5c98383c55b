"""The 2D slice as the PGM + YAML pair that ROS map_server and nav2 load, and as a picture."""

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from mapper.core.errors import DataError
from mapper.export.figures import (
    FREE_CELL,
    IMAGE_PX,
    INK,
    MOST_CELLS,
    OCCUPIED_CELL,
    PAPER,
    UNKNOWN_CELL,
    round_length,
)
from mapper.octree.grid import (
    FREE,
    FREE_PIXEL,
    FREE_THRESHOLD,
    OCCUPIED,
    OCCUPIED_PIXEL,
    OCCUPIED_THRESHOLD,
    UNKNOWN_PIXEL,
    OccupancyGrid,
    shrunk,
)
from mapper.runtime.atomic import write_bytes, write_text

_STRIP_PX = 36
_BAR_SHARE = 0.25  # of the picture's width


def write_grid(folder: Path, stem: str, grid: OccupancyGrid) -> None:
    """Write ``stem.pgm``, ``stem.yaml`` and ``stem.png``, each atomically; the YAML comes last.

    Args:
        folder: Folder of the files; made if missing.
        stem: Name of the files without ending.
        grid: The slice; the world frame becomes the ROS map frame.
    """
    pixels = np.full(grid.cells.shape, UNKNOWN_PIXEL, np.uint8)
    pixels[grid.cells == FREE] = FREE_PIXEL
    pixels[grid.cells == OCCUPIED] = OCCUPIED_PIXEL
    _write_picture(folder / f"{stem}.png", grid)
    write_values(folder, stem, pixels, grid, mode="trinary")


def write_values(
    folder: Path, stem: str, values: NDArray[np.uint8], geometry: OccupancyGrid, *, mode: str = "raw"
) -> None:
    """Write ``stem.pgm`` and ``stem.yaml`` for map_server, each atomically.

    Args:
        folder: Folder of the files; made if missing.
        stem: Name of the files without ending.
        values: (H, W) what the cells are published as: 0 … 100, or 255 for unknown; pixels in mode "trinary".
        geometry: A grid of these cells.
        mode: Mode of map_server.
    """
    height, width = values.shape
    header = f"P5\n# CREATOR: mapper {geometry.resolution_m:.3f} m/pix\n{width} {height}\n255\n"
    write_bytes(folder / f"{stem}.pgm", header.encode("ascii") + values[::-1].tobytes())
    x, y = (float(value) for value in geometry.origin_world_m)
    settings = {
        "image": f"{stem}.pgm",
        "mode": mode,
        "resolution": repr(float(geometry.resolution_m)),
        "origin": f"[{x!r}, {y!r}, 0.0]",
        "negate": "0",
        "occupied_thresh": str(OCCUPIED_THRESHOLD),
        "free_thresh": str(FREE_THRESHOLD),
    }
    write_text(folder / f"{stem}.yaml", "".join(f"{key}: {value}\n" for key, value in settings.items()))


def grid_image(grid: OccupancyGrid) -> NDArray[np.uint8]:
    """Return the cells as (H, W, 3) uint8 RGB, row 0 = lowest y."""
    image = np.empty((*grid.cells.shape, 3), np.uint8)
    image[:] = UNKNOWN_CELL
    image[grid.cells == FREE] = FREE_CELL
    image[grid.cells == OCCUPIED] = OCCUPIED_CELL
    return image


def _write_picture(path: Path, grid: OccupancyGrid) -> None:
    grid = shrunk(grid, MOST_CELLS)
    enlargement = -(-IMAGE_PX // max(grid.cells.shape))
    image = grid_image(grid)[::-1].repeat(enlargement, axis=0).repeat(enlargement, axis=1)
    image = np.vstack([image, _scale_and_legend(image.shape[1], grid.resolution_m / enlargement)])
    write_bytes(path, encode_png(path, image[:, :, ::-1]))


def encode_png(path: Path, pixels: NDArray[np.uint8]) -> bytes:
    """Return the PNG file of (H, W, 3 or 4) pixels in OpenCV's order.

    Raises:
        DataError: It has too many pixels for a PNG; the message names the path.
    """
    encoded, png = cv2.imencode(".png", pixels)
    if not encoded:
        raise DataError(f"{path}: a grid of {pixels.shape[:2]} cells cannot be written as PNG")
    return png.tobytes()


def _scale_and_legend(width_px: int, pixel_m: float) -> NDArray[np.uint8]:
    """Return the strip below a picture: how long a bar is, and what the colours are."""
    font, size = cv2.FONT_HERSHEY_SIMPLEX, 0.5
    strip = np.empty((_STRIP_PX, width_px, 3), np.uint8)
    strip[:] = PAPER
    length_m = round_length(_BAR_SHARE * width_px * pixel_m)
    end = 10 + round(length_m / pixel_m)
    cv2.rectangle(strip, (10, 16), (end, 20), INK, thickness=-1)
    left, baseline = end + 8, 23
    named = (("occupied", OCCUPIED_CELL), ("free", FREE_CELL), ("unknown", UNKNOWN_CELL))
    for label, color in ((f"{length_m:g} m", None), *named):
        (text_px, _), _ = cv2.getTextSize(label, font, size, 1)
        if left + text_px + 30 > width_px:
            break  # a narrow map has no room for all
        if color is not None:
            cv2.rectangle(strip, (left, 11), (left + 14, 25), color, thickness=-1)
            cv2.rectangle(strip, (left, 11), (left + 14, 25), INK, thickness=1)
            left += 20
        cv2.putText(strip, label, (left, baseline), font, size, INK, 1, cv2.LINE_AA)
        left += text_px + 16
    return strip
