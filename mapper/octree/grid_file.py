"""Occupancy grids read from the PGM + YAML pair that ROS map_server and nav2 load."""

from pathlib import Path
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from mapper.core.errors import MapFileError
from mapper.octree.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from mapper.runtime.regular_files import read_text

FREE_PIXEL, OCCUPIED_PIXEL, UNKNOWN_PIXEL = 254, 0, 205
OCCUPIED_THRESHOLD = 0.65
FREE_THRESHOLD = 0.196  # 0.25, often seen, would load pixel 205 (0.19608) as free


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


class _Folder(Protocol):
    """Run or merged map."""

    @property
    def path(self) -> Path: ...

    def file(self, name: str, /) -> Path: ...


def stored_grid(folder: _Folder, stem: str) -> OccupancyGrid:
    """Return a grid of a run or of a merged map, such as its slice.

    Raises:
        RunError: A file is not as it was written.
        MapperError: As for ``read_grid``.
    """
    folder.file(f"{stem}.pgm")
    return read_grid(folder.file(f"{stem}.yaml"))


def stored_grid_if_any(folder: _Folder, stem: str) -> OccupancyGrid | None:
    """Return a grid as :func:`stored_grid` does; None if there is none of this name."""
    return stored_grid(folder, stem) if (folder.path / f"{stem}.yaml").exists() else None


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
    # OpenCV reads every variant of PGM, and returns None for other data.
    pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED) if data else None
    if pixels is None or pixels.ndim != 2 or pixels.dtype != np.uint8:
        raise MapFileError(f"{path}: not a grey 8-bit image")
    return np.asarray(pixels, np.uint8)
