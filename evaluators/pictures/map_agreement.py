"""Picture of a map over its reference: where they agree, and what the map has too much or misses."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mapper.core.geometry import Array
from mapper.evaluators.metrics.occupancy import OccupancyCheck
from mapper.evaluators.pictures.path_errors import made_folder
from mapper.export.figures import (
    ESTIMATE,
    OCCUPIED_CELL,
    TRUTH,
    UNKNOWN_CELL,
    Rgb,
    caption,
    hex_of,
    page,
    panel,
    save,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes

MAP = "map.png"

AGREED: Rgb = OCCUPIED_CELL
EXTRA: Rgb = ESTIMATE
MISSING: Rgb = TRUTH

_WIDTH_IN = 6.4
_MARGIN_CELLS = 3
_ERROR_WEIGHT = 3.0  # against voxels that agree, or a wrong one in a wall would not be seen
_FAINTEST = 0.35  # of the colour of a column with a single voxel, so that it is seen


def write_map_errors(folder: Path, check: OccupancyCheck, *, title: str) -> Path:
    """Draw voxels from above and from the side; a column that is not all of one kind mixes the colours.

    Args:
        folder: Gets ``map.png``; made if it is not there.
        check: The map and its reference.
        title: Headline.

    Returns:
        The picture.

    Raises:
        DataError: The folder cannot be made.
    """
    picture = made_folder(folder) / MAP
    agreed, extra, missing = check.centres_world
    edge_m = check.resolution_m
    kinds = {
        f"agreed, {len(agreed)} voxels": (agreed, AGREED),
        f"only in the map, {len(extra)}": (extra, EXTRA),
        f"missing in the map, {len(missing)}": (missing, MISSING),
    }
    points = [voxels for voxels, _ in kinds.values()]
    cells = [np.round(voxels / edge_m - 0.5).astype(np.int64) for voxels in points]
    paints = [(AGREED, 1.0), (EXTRA, _ERROR_WEIGHT), (MISSING, _ERROR_WEIGHT)]
    figure = page(title, columns=2, rows=1, width_in=_WIDTH_IN, height_in=0.9 * _WIDTH_IN)
    for number, (name, axes_xyz) in enumerate((("from above", (0, 1)), ("from the side", (0, 2)))):
        axes = panel(figure, number, columns=2, rows=1)
        _draw(axes, [cell[:, axes_xyz] for cell in cells], paints, edge_m=edge_m)
        caption(axes, title=name, x="x (m)", y="xyz"[axes_xyz[1]] + " (m)")
    for kind, (_, color) in kinds.items():
        axes.plot([], [], "s", color=hex_of(color), label=kind)
    axes.legend(loc="upper right", fontsize=8, framealpha=0.92)
    save(figure, picture)
    return picture


def _draw(
    axes: "Axes", cells: list[NDArray[np.int64]], paints: list[tuple[Rgb, float]], *, edge_m: float
) -> None:
    low = np.concatenate(cells).min(axis=0) - _MARGIN_CELLS
    columns, rows = np.concatenate(cells).max(axis=0) + _MARGIN_CELLS + 1 - low
    total, mixed = np.zeros(rows * columns), np.zeros((rows * columns, 3))
    for places, (color, weight) in zip(cells, paints, strict=True):
        counts = weight * np.bincount(
            (places[:, 1] - low[1]) * columns + places[:, 0] - low[0], minlength=len(total)
        )
        total += counts
        mixed += counts[:, None] * np.array(color, dtype=np.float64)
    known = total > 0
    strength: Array = _FAINTEST + (1.0 - _FAINTEST) * (total[known] / total.max())[:, None] ** 0.5
    image = np.full((rows * columns, 3), UNKNOWN_CELL, dtype=np.float64)
    image[known] = strength * (mixed[known] / total[known, None]) + (1.0 - strength) * image[known]
    left, bottom = low * edge_m
    axes.imshow(
        image.reshape(rows, columns, 3).astype(np.uint8),
        origin="lower",
        interpolation="nearest",
        extent=(left, left + columns * edge_m, bottom, bottom + rows * edge_m),
    )
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_facecolor(hex_of(UNKNOWN_CELL))
