"""Pictures of a coloured cloud, from above and from the side."""

from collections.abc import Collection
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from mapper.core.frames import Points32
from mapper.core.geometry import Array
from mapper.core.trajectory import Trajectory
from mapper.export.figures import (
    BACKDROP,
    ESTIMATE,
    HEAD_IN,
    IMAGE_PX,
    LINE,
    MARGIN_M,
    STRAY_PERCENT,
    WIDE_IN,
    hex_of,
    mark_ends,
    new_figure,
    save,
    scale_bar,
)
from mapper.mapping.cloud import height_colors, thinned_to_view

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_TILT_RAD = np.deg2rad(32.0)
_TURN_RAD = np.deg2rad(-35.0)
_WIDEST = 2.0  # width over height
_GAP_IN = 0.15
_FLAT_M = 1e-3  # a cloud of less height is of a 2D laser


def write_cloud_views(
    path: Path,
    points: Points32,
    colors: NDArray[np.uint8],
    trajectory: Trajectory,
    *,
    has_colors: bool = True,
) -> None:
    """Draw a coloured cloud from above and from an oblique side, with the trajectory through it.

    Points above the highest camera position are left out of both, so that ceilings do not hide the rooms.

    Args:
        path: PNG file to write.
        points: (N, 3) float32 metres, world frame, z up; N ≥ 1.
        colors: (N, 3) uint8 RGB.
        trajectory: World frame.
        has_colors: Whether the sensor saw the colours; if not, points are coloured by their height.
    """
    positions = trajectory.positions_world
    points, colors = thinned_to_view(points, colors)
    below = points[:, 2] <= positions[:, 2].max() + MARGIN_M
    if below.any():
        points, colors = points[below], colors[below]
    heights_m = None
    is_flat = not has_colors and len(points) > 0 and float(np.ptp(points[:, 2])) < _FLAT_M
    if not has_colors and not is_flat:
        low_m, high_m = np.percentile(points[:, 2], [STRAY_PERCENT, 100.0 - STRAY_PERCENT]).tolist()
        heights_m = low_m, high_m
        colors = height_colors(points[:, 2], between_m=heights_m)
    views = {"from above": _View(_turned(0.0, np.pi / 2), points, positions)}
    if not is_flat:
        views["from the side"] = _View(_turned(_TURN_RAD, _TILT_RAD), points, positions)
    figure, panels = _page_for(views.values())
    for axes, (name, view) in zip(panels, views.items(), strict=True):
        _draw_view(axes, view, colors)
        axes.set_title(name, color=LINE, fontsize=11, y=1.0)  # else placed by ticks that are not shown
    figure.legend(
        *panels[-1].get_legend_handles_labels(),
        loc="lower left",
        ncols=3,
        frameon=False,
        labelcolor=LINE,
        fontsize=9,
        bbox_to_anchor=(0.0, 0.0),
    )
    if heights_m is not None:
        _height_legend(figure, heights_m)
    save(figure, path)


class _View:
    """A cloud and a path as seen from one side, and the part of them that a picture shows."""

    def __init__(self, R_view_world: Array, points: Points32, positions: Array) -> None:
        self.cloud = points @ R_view_world.T.astype(np.float32)
        self.path = positions @ R_view_world.T
        # A few stray points must not shrink the scene.
        low, high = np.percentile(self.cloud[:, :2], [STRAY_PERCENT, 100.0 - STRAY_PERCENT], axis=0)
        self.low: Array = np.minimum(low, self.path[:, :2].min(axis=0)) - MARGIN_M
        self.high: Array = np.maximum(high, self.path[:, :2].max(axis=0)) + MARGIN_M

    @property
    def aspect(self) -> float:
        """Width over height."""
        width, height = self.high - self.low
        return float(width / height)


def _page_for(views: Collection[_View]) -> "tuple[Figure, list[Axes]]":
    """Return a page with axes side by side, one for each view, all of one height."""
    widths_in = [WIDE_IN * min(view.aspect, _WIDEST) for view in views]
    width_in = sum(widths_in) + (len(views) + 1) * _GAP_IN
    height_in = WIDE_IN + 2.0 * HEAD_IN
    figure = new_figure(width_in, height_in, background=BACKDROP)
    axes, left_in = [], _GAP_IN
    for view_in in widths_in:
        axes.append(
            figure.add_axes(
                (left_in / width_in, HEAD_IN / height_in, view_in / width_in, WIDE_IN / height_in)
            )
        )
        left_in += view_in + _GAP_IN
    return figure, axes


def _height_legend(figure: "Figure", heights_m: tuple[float, float]) -> None:
    """Draw what height each colour is, in the lower right corner."""
    ramp = height_colors(np.linspace(0.0, 1.0, 256), between_m=(0.0, 1.0))[np.newaxis]
    width_in, height_in = figure.get_size_inches()
    axes = figure.add_axes((1.0 - 2.6 / width_in, 0.2 / height_in, 1.6 / width_in, 0.1 / height_in))
    axes.imshow(ramp, aspect="auto")
    axes.set_axis_off()
    for x, (label, alignment) in zip(
        (-8, 264), ((f"{heights_m[0]:.2g} m", "right"), (f"{heights_m[1]:.2g} m", "left")), strict=True
    ):
        axes.text(x, 0.0, label, color=LINE, fontsize=9, ha=alignment, va="center")


def _draw_view(axes: "Axes", view: _View, colors: NDArray[np.uint8]) -> None:
    cloud, path, low, high = view.cloud, view.path, view.low, view.high
    pixel_m = float((high - low).max()) / IMAGE_PX
    image = splat(cloud, colors, low=low, pixel_m=pixel_m, shape=np.ceil((high - low)[::-1] / pixel_m))
    box = axes.get_window_extent()
    scale = min(1.0, box.width / image.shape[1], box.height / image.shape[0])
    image = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)  # matplotlib's is slow
    axes.imshow(image, origin="lower", interpolation="nearest", extent=(low[0], high[0], low[1], high[1]))
    axes.plot(*path[:, :2].T, color="white", linewidth=2.4, alpha=0.75)
    axes.plot(*path[:, :2].T, color=hex_of(ESTIMATE), linewidth=1.3, label="path")
    mark_ends(axes, path)
    scale_bar(axes, low, high, color="white")
    axes.set_axis_off()


def splat(
    cloud: Points32, colors: NDArray[np.uint8], *, low: Array, pixel_m: float, shape: Array
) -> NDArray[np.uint8]:
    """Return an orthographic image in which the nearest point wins every pixel.

    A point covers 3×3 pixels, so that a cloud thinned to voxels still looks closed.

    Args:
        cloud: (N, 3) float32 metres: right, up, and towards the viewer.
        colors: (N, 3) uint8 RGB.
        low: (2,) right and up of the image's corner, metres.
        pixel_m: Size of a pixel.
        shape: Height and width in pixels.

    Returns:
        (H, W, 3) uint8 RGB, row 0 = lowest.
    """
    height, width = (int(n) for n in shape)
    cell = np.floor((cloud[:, :2] - low) / pixel_m).astype(np.int32)
    inside = (cell >= 0).all(axis=1) & (cell[:, 0] < width) & (cell[:, 1] < height)
    nearest_last = np.flatnonzero(inside)[np.argsort(cloud[inside, 2], kind="stable")]
    rank = np.full((height, width), -1.0, np.float32)  # of points in that order, exact up to 2**24
    rank[cell[nearest_last, 1], cell[nearest_last, 0]] = np.arange(len(nearest_last))
    rank = cv2.dilate(rank, np.ones((3, 3), np.uint8))
    image = np.empty((height, width, 3), np.uint8)
    image[:] = BACKDROP
    covered = rank >= 0
    image[covered] = colors[nearest_last[rank[covered].astype(np.intp)]]
    return image


def _turned(turn_rad: float, tilt_rad: float) -> Array:
    """Return the rotation to (right, up, towards the viewer) of a viewer at an azimuth and elevation."""
    towards = np.array(
        [np.sin(turn_rad) * np.cos(tilt_rad), -np.cos(turn_rad) * np.cos(tilt_rad), np.sin(tilt_rad)]
    )
    right = np.array([np.cos(turn_rad), np.sin(turn_rad), 0.0])
    return np.array([right, np.cross(towards, right), towards])
