"""2D maps as pictures with world files, by which programs for GIS place them."""

from pathlib import Path

import cv2
import numpy as np

from mapper.export.export_folders import export_folder
from mapper.export.grid import encode_png, grid_image
from mapper.octree.grid import UNKNOWN, OccupancyGrid
from mapper.run.map_folder import MapFolder
from mapper.runtime.atomic import write_bytes, write_text
from mapper.runtime.progress import Progress


def gis(run: MapFolder, path: Path, _progress: Progress) -> None:
    """Write a folder of PNGs with world files: a pixel a cell, transparent where unknown.

    It replaces an earlier one.

    Raises:
        RunError: PATH holds something else.
    """
    grids = {"slice": run.slice, "traversable": run.traversable, "keepout": run.keepout}
    with export_folder(run, path, "gis", files=("*.png", "*.pgw")) as folder:
        for stem, grid in grids.items():
            if grid is not None:
                alpha = np.where(grid.cells == UNKNOWN, 0, 255).astype(np.uint8)
                rgba = np.dstack([grid_image(grid), alpha])[::-1]
                picture = folder / f"{stem}.png"
                write_bytes(picture, encode_png(picture, cv2.cvtColor(rgba, cv2.COLOR_RGBA2BGRA)))
                write_text(folder / f"{stem}.pgw", _world_file(grid))


def _world_file(grid: OccupancyGrid) -> str:
    """Return a pixel's width, two shears, minus its height, and x and y of the upper left one's centre."""
    size_m, (x, y) = float(grid.resolution_m), grid.origin_world_m.tolist()
    top = y + (len(grid.cells) - 0.5) * size_m
    return "".join(f"{value!r}\n" for value in (size_m, 0.0, 0.0, -size_m, x + 0.5 * size_m, top))
