"""The 2D slice as the PGM + YAML pair that ROS map_server and nav2 load, and as a picture."""

from pathlib import Path
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from mapper.core.errors import DataError, MapFileError
from mapper.core.geometry import Array
from mapper.export.palette import FREE_CELL, OCCUPIED_CELL, UNKNOWN_CELL
from mapper.octree.slice import FREE, OCCUPIED, UNKNOWN, OccupancyGrid, shrunk
from mapper.runtime.atomic import write_bytes, write_text
from mapper.runtime.regular_files import read_text

FREE_PIXEL, OCCUPIED_PIXEL, UNKNOWN_PIXEL = 254, 0, 205
OCCUPIED_THRESHOLD = 0.65
FREE_THRESHOLD = 0.196  # 0.25, often seen, would load pixel 205 (0.19608) as free

_PICTURE_PX = 800
_MOST_PX = 4000


def write_grid(folder: Path, stem: str, grid: OccupancyGrid) -> None:
    """Write ``stem.pgm``, ``stem.yaml`` and ``stem.png``, each atomically; the YAML comes last.

    Args:
        folder: Where; made if missing.
        stem: Name of the files without ending.
        grid: The slice; the world frame becomes the ROS map frame.
    """
    pixels = np.full(grid.cells.shape, UNKNOWN_PIXEL, np.uint8)
    pixels[grid.cells == FREE] = FREE_PIXEL
    pixels[grid.cells == OCCUPIED] = OCCUPIED_PIXEL
    _write_picture(folder / f"{stem}.png", grid)
    _write_image(folder, stem, pixels, grid, mode="trinary")


def write_values(folder: Path, stem: str, values: NDArray[np.uint8], geometry: "_Geometry") -> None:
    """Write ``stem.pgm`` and ``stem.yaml`` in map_server's mode "raw", each atomically.

    Args:
        folder: Where; made if missing.
        stem: Name of the files without ending.
        values: (H, W) what the cells are published as: 0 … 100, or 255 for unknown.
        geometry: A grid or costmap of these cells.
    """
    _write_image(folder, stem, values, geometry, mode="raw")


def _write_image(
    folder: Path, stem: str, pixels: NDArray[np.uint8], geometry: "_Geometry", *, mode: str
) -> None:
    height, width = pixels.shape
    header = f"P5\n# CREATOR: mapper {geometry.resolution_m:.3f} m/pix\n{width} {height}\n255\n"
    write_bytes(folder / f"{stem}.pgm", header.encode("ascii") + pixels[::-1].tobytes())
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


def read_grid(path: Path) -> OccupancyGrid:
    """Read a map by the rules of nav2's map_server in trinary mode.

    Args:
        path: The YAML file; its image is looked for beside it.

    Raises:
        MapFileError: A missing file or key, another mode, a turned map, or an image that is no 8-bit PGM.
    """
    settings = _read_settings(path)
    try:
        origin = [float(word) for word in settings["origin"].strip("[]").split(",")]
        resolution_m = float(settings["resolution"])
        occupied, free = float(settings["occupied_thresh"]), float(settings["free_thresh"])
        negate = int(settings["negate"]) != 0
        image = path.parent / settings["image"].strip("'\"")
    except (KeyError, ValueError) as error:
        raise MapFileError(f"{path}: {error}: missing or not a number") from None
    if settings.get("mode", "trinary") != "trinary":
        raise MapFileError(f"{path}: mode {settings['mode']!r}; only trinary maps can be read")
    if len(origin) != 3 or origin[2] != 0.0:
        raise MapFileError(f"{path}: origin {origin}; want [x, y, 0.0], turned maps cannot be read")
    pixels = _read_pgm(image)[::-1]
    darkness = (pixels if negate else 255.0 - pixels) / 255.0
    cells = np.full(pixels.shape, UNKNOWN, np.int8)
    cells[darkness < free] = FREE
    cells[darkness > occupied] = OCCUPIED
    return OccupancyGrid(cells, np.array(origin[:2]), resolution_m)


class _Geometry(Protocol):
    """Where the cells of a grid or a costmap lie."""

    @property
    def resolution_m(self) -> float: ...

    @property
    def origin_world_m(self) -> Array: ...


class _Folder(Protocol):
    """A run or a merged map."""

    def file(self, name: str, /) -> Path: ...


def stored_grid(folder: _Folder, stem: str) -> OccupancyGrid:
    """Return a grid of a run or of a merged map: its slice, or its traversable floor.

    Raises:
        RunError: A file is not as it was written.
        MapperError: As for ``read_grid``.
    """
    folder.file(f"{stem}.pgm")
    return read_grid(folder.file(f"{stem}.yaml"))


def grid_image(grid: OccupancyGrid) -> NDArray[np.uint8]:
    """Return the cells as (H, W, 3) uint8 RGB, row 0 = lowest y."""
    image = np.empty((*grid.cells.shape, 3), np.uint8)
    image[:] = UNKNOWN_CELL
    image[grid.cells == FREE] = FREE_CELL
    image[grid.cells == OCCUPIED] = OCCUPIED_CELL
    return image


def _write_picture(path: Path, grid: OccupancyGrid) -> None:
    grid = shrunk(grid, _MOST_PX)
    enlargement = -(-_PICTURE_PX // max(grid.cells.shape))
    image = grid_image(grid)[::-1].repeat(enlargement, axis=0).repeat(enlargement, axis=1)
    encoded, png = cv2.imencode(".png", image[:, :, ::-1])
    if not encoded:
        raise DataError(f"{path}: a grid of {grid.cells.shape} cells cannot be written as PNG")
    write_bytes(path, png.tobytes())


def _read_settings(path: Path) -> dict[str, str]:
    """Parse the flat subset of YAML that map_server writes."""
    lines = read_text(path, error=MapFileError).splitlines()
    pairs = (line.split("#")[0].partition(":") for line in lines)
    return {key.strip(): value.strip() for key, colon, value in pairs if colon}


def _read_pgm(path: Path) -> NDArray[np.uint8]:
    try:
        data = path.read_bytes()
    except OSError as error:
        raise MapFileError(f"{path}: cannot be read: {error.strerror}") from None
    # OpenCV reads every PGM flavour; it answers None to what is none.
    pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED) if data else None
    if pixels is None or pixels.ndim != 2 or pixels.dtype != np.uint8:
        raise MapFileError(f"{path}: not a grey 8-bit image")
    return np.asarray(pixels, np.uint8)
