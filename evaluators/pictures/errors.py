"""Pictures of a path's errors (where along it, when, over which lengths) and of a map's voxels."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mapper.core.errors import DataError
from mapper.core.geometry import Array
from mapper.core.timebase import NS_PER_S
from mapper.evaluators.metrics.evaluate import Assessment, have_clock
from mapper.evaluators.metrics.occupancy import OccupancyCheck
from mapper.evaluators.metrics.trajectory_errors import Matched
from mapper.export.figures import (
    END,
    ESTIMATE,
    FAINT,
    LINE,
    OCCUPIED_CELL,
    START,
    TEXT,
    TRUTH,
    UNKNOWN_CELL,
    WIDE_IN,
    Rgb,
    caption,
    draw_boxes,
    extent,
    fit_to_window,
    hex_of,
    panels,
    save,
    widest_axes,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.collections import LineCollection

TRAJECTORY = "trajectory.png"

_COLOR_MAP = "turbo"


def write_trajectory_errors(folder: Path, found: Assessment, *, title: str) -> Path:
    """Draw a path coloured by its error, its errors over time, and boxes of those over segments.

    Args:
        folder: Gets ``trajectory.png``; made if it is not there.
        found: The trajectory, assessed against a truth.
        title: Headline.

    Returns:
        The picture.

    Raises:
        DataError: There was no truth, or the folder cannot be made.
    """
    matched = found.matched
    if matched is None:
        raise DataError(f"{folder}: nothing to draw without a truth; give one with --truth")
    picture = made_folder(folder) / TRAJECTORY
    timed = have_clock(matched.stamps_ns)
    elapsed = (matched.stamps_ns - matched.stamps_ns[0]).astype(np.float64)
    errors_m = matched.position_errors_m
    relative_percent = {
        f"{length.length_m:g} m": 100.0 * length.translation_ratio for length in found.lengths if len(length)
    }
    figure, panes = panels(title, 4, columns=2, width_in=WIDE_IN)
    path_axes, position_axes, length_axes, rotation_axes = panes
    caption(path_axes, title="over the truth, seen from where it is widest")
    add_color_bar(path_axes, draw_path(path_axes, matched, errors_m))
    for axes, values, quantity in (
        (position_axes, errors_m, "distance from the truth, m"),
        (rotation_axes, np.degrees(matched.rotation_errors_rad), "angle to the truth, °"),
    ):
        _draw_over_time(axes, elapsed / NS_PER_S if timed else elapsed, values, quantity=quantity)
        caption(axes, x="s" if timed else "poses")
    if relative_percent:
        draw_boxes(length_axes, relative_percent)
        caption(length_axes, x="error of the translation over a segment, %")
    else:
        length_axes.text(0.5, 0.5, "too short a path", color=FAINT, transform=length_axes.transAxes)
    save(figure, picture)
    return picture


def made_folder(folder: Path) -> Path:
    """Return a folder for pictures, made if it is not there.

    Raises:
        DataError: It cannot be made.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise DataError(f"{folder}: cannot be made: {error.strerror}; want a folder for pictures") from None
    return folder


def draw_path(
    axes: "Axes", matched: Matched, errors_m: Array, *, most_m: float | None = None
) -> "LineCollection":
    """Draw a path over the truth, from the side on which that is widest, coloured by its error.

    Args:
        axes: Axes to draw on.
        matched: The path, aligned with the truth.
        errors_m: (N,) distances from the truth.
        most_m: Error of the strongest colour; None is the largest.

    Returns:
        What ``add_color_bar`` takes.
    """
    from matplotlib.collections import LineCollection

    positions, truth = matched.T_map_body[:, :3, 3], matched.T_truth_body[:, :3, 3]
    axes_world = widest_axes(truth)
    seen, true = positions @ axes_world.T, truth @ axes_world.T
    axes.plot(*true.T, color=hex_of(TRUTH), linewidth=3.0, alpha=0.3)
    colored = LineCollection(list(np.stack([seen[:-1], seen[1:]], axis=1)), cmap=_COLOR_MAP, linewidths=1.6)
    colored.set_array(0.5 * (errors_m[:-1] + errors_m[1:]))
    colored.set_clim(0.0, float(errors_m.max()) if most_m is None else most_m)
    axes.add_collection(colored)
    axes.plot(*seen[0], "o", color=hex_of(START), markersize=5)
    axes.plot(*seen[-1], "s", color=hex_of(END), markersize=5)
    low, high = extent(np.concatenate([seen, true]))
    fit_to_window(axes, low, high)
    caption(axes, x="m", y="m")
    return colored


def add_color_bar(axes: "Axes", colored: "LineCollection") -> None:
    """Add the scale of the colours of ``draw_path`` in a corner."""
    place = axes.inset_axes((0.6, 0.95, 0.36, 0.025))
    bar = axes.figure.colorbar(colored, cax=place, orientation="horizontal")
    bar.ax.tick_params(labelsize=7, colors=FAINT)
    bar.set_label("distance from the truth, m", fontsize=7, color=FAINT)


def _draw_over_time(axes: "Axes", elapsed: Array, values: Array, *, quantity: str) -> None:
    axes.plot(elapsed, values, color=hex_of(ESTIMATE), linewidth=1.0)
    for name, value, style in (
        ("RMSE", float(np.sqrt(np.mean(values**2))), "dashed"),
        ("median", float(np.median(values)), "dotted"),
    ):
        axes.axhline(value, color=TEXT, linewidth=0.8, linestyle=style, label=f"{name} {value:.3g}")
    axes.set_ylim(bottom=0.0)
    caption(axes, y=quantity)
    axes.grid(color=LINE, linewidth=0.4)
    axes.legend(loc="best", fontsize=7, framealpha=0.9, edgecolor=LINE)


MAP = "map.png"

AGREED: Rgb = OCCUPIED_CELL
EXTRA: Rgb = ESTIMATE
MISSING: Rgb = TRUTH

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
    figure, panes = panels(title, 2, width_in=WIDE_IN)
    for axes, name, axes_xyz in zip(panes, ("from above", "from the side"), ((0, 1), (0, 2)), strict=True):
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
