"""2D occupancy grid in the ground plane, with the codes of ROS, and the PGM + YAML pair that nav2 loads."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from mapper.core.errors import DataError, MapFileError
from mapper.core.geometry import Array
from mapper.core.trajectory import plan_axes
from mapper.runtime.regular_files import read_text

if TYPE_CHECKING:
    from matplotlib.axes import Axes

UNKNOWN, FREE, OCCUPIED = -1, 0, 100
"""ROS OccupancyGrid codes, ordered so that the maximum over a column is its state."""

FREE_PIXEL, OCCUPIED_PIXEL, UNKNOWN_PIXEL = 254, 0, 205
OCCUPIED_THRESHOLD = 0.65
FREE_THRESHOLD = 0.196  # 0.25, often seen, would load pixel 205 (0.19608) as free


@dataclass(frozen=True, slots=True, eq=False)
class OccupancyGrid:
    """2D occupancy grid in the ground plane.

    Attributes:
        cells: (H, W) int8 of UNKNOWN, FREE and OCCUPIED; row 0 has the lowest y, column 0 the lowest x.
        origin_world_m: (2,) x and y of the lower left corner of cell (0, 0), metres.
        resolution_m: Edge of a cell.
    """

    cells: NDArray[np.int8]
    origin_world_m: Array
    resolution_m: float

    @property
    def grid(self) -> NDArray[np.int8]:
        """(H, W) int8: ``cells``."""
        return self.cells

    @property
    def resolution(self) -> float:
        """Edge of a cell, metres: ``resolution_m``."""
        return self.resolution_m

    @property
    def origin(self) -> Array:
        """(2,) x and y of the lower left corner, metres, world frame: ``origin_world_m``."""
        return self.origin_world_m

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of ``cells``."""
        rows, columns = self.cells.shape
        return rows, columns

    def plot(self, axes: "Axes | None" = None) -> "Axes":
        """Draw the grid: free cells white, occupied ones black, unknown ones grey.

        Args:
            axes: Matplotlib's axes to draw on; None makes a figure of pyplot's.

        Returns:
            The axes, in metres of the world.
        """
        axes = plan_axes(axes)
        x, y = self.origin_world_m.tolist()
        rows, columns = self.shape
        extent = (x, x + columns * self.resolution_m, y, y + rows * self.resolution_m)
        shades = np.select([self.cells == FREE, self.cells == OCCUPIED], [1.0, 0.0], 0.8)
        axes.imshow(shades, cmap="gray", vmin=0.0, vmax=1.0, origin="lower", extent=extent)
        return axes

    def __repr__(self) -> str:
        rows, columns = self.shape
        return f"OccupancyGrid of {rows} × {columns} cells of {self.resolution_m:g} m"

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        return np.array(self.cells, dtype=dtype, copy=copy)

    def __post_init__(self) -> None:
        if self.cells.ndim != 2 or self.cells.size == 0 or self.cells.dtype != np.int8:
            raise DataError(
                f"grid: cells {self.cells.shape} {self.cells.dtype}, want (H, W) int8 of some size"
            )
        codes = np.unique(self.cells)
        if not np.isin(codes, (UNKNOWN, FREE, OCCUPIED)).all():
            raise DataError(f"grid: codes {codes.tolist()}, want only {UNKNOWN}, {FREE} and {OCCUPIED}")
        if self.origin_world_m.shape != (2,) or not np.isfinite(self.origin_world_m).all():
            raise DataError(f"grid: origin {self.origin_world_m}, want two finite numbers")
        if not 0.0 < self.resolution_m < np.inf:
            raise DataError(f"grid: resolution {self.resolution_m} m, want > 0")
        with np.errstate(over="ignore"):
            if not np.isfinite(self.origin_world_m / self.resolution_m).all():
                raise DataError(f"grid: origin {self.origin_world_m} m in cells of {self.resolution_m} m")


def overlap_of(
    corner: ArrayLike, size: tuple[int, ...], shape: tuple[int, ...]
) -> tuple[tuple[slice, ...], tuple[slice, ...]]:
    """Return the rows and columns that a window covers of an array, in the array and in the window.

    Args:
        corner: (2,) row and column of the window's first cell in the array; it may lie outside.
        size: H, W of the window.
        shape: H, W of the array.
    """
    low, high = (np.clip(np.add(corner, beyond), 0, shape) for beyond in (0, size))
    inside, own = (
        tuple(slice(*ends) for ends in zip((low - begin).tolist(), (high - begin).tolist(), strict=True))
        for begin in (0, corner)
    )
    return inside, own


def with_obstacles(grid: OccupancyGrid, others: OccupancyGrid | None) -> OccupancyGrid:
    """Return a grid with what is occupied in another of the same cells, if there is one, occupied too."""
    if others is None:
        return grid
    cells = np.where(others.cells == OCCUPIED, others.cells, grid.cells)
    return OccupancyGrid(cells, grid.origin_world_m, grid.resolution_m)


def shrunk(grid: OccupancyGrid, most_cells: int) -> OccupancyGrid:
    """Return a grid of no more cells along an edge, for a picture: a cell is the maximum of those in it."""
    factor = -(-max(grid.cells.shape) // most_cells)
    if factor == 1:
        return grid
    padding = [(0, -size % factor) for size in grid.cells.shape]
    cells = np.pad(grid.cells, padding, constant_values=UNKNOWN)
    rows, columns = (size // factor for size in cells.shape)
    cells = cells.reshape(rows, factor, columns, factor).max(axis=(1, 3))
    return OccupancyGrid(cells, grid.origin_world_m, factor * grid.resolution_m)


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
