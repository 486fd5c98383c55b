"""Pictures of a coloured cloud, from above and from the side."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mapper.core.frames import Points32
from mapper.core.geometry import Array
from mapper.core.trajectory import Trajectory
from mapper.export.page import LINE, hex_of, new_figure, save, scale_bar
from mapper.export.palette import ESTIMATE, Rgb

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_MARGIN_M = 0.3
_HEADROOM_M = 0.3  # above the highest camera position; what lies higher would hide the rooms from above
_VIEW_PX = 900
_TILT_RAD = np.deg2rad(32.0)
_TURN_RAD = np.deg2rad(-35.0)
_BACKDROP: Rgb = (22, 24, 30)


def write_cloud_views(
    path: Path, points: Points32, colors: NDArray[np.uint8], trajectory: Trajectory
) -> None:
    """Draw a coloured cloud from above and from an oblique side, with the trajectory through it.

    Points above the highest camera position are left out of both, so that ceilings do not hide the rooms.

    Args:
        path: PNG file to write.
        points: (N, 3) float32 metres, world frame, z up; N ≥ 1.
        colors: (N, 3) uint8 RGB.
        trajectory: World frame.
    """
    positions = trajectory.positions_world
    below = points[:, 2] <= positions[:, 2].max() + _HEADROOM_M
    if below.any():
        points, colors = points[below], colors[below]
    figure = new_figure(13.0, 6.6, background=_BACKDROP)
    views = {"from above": _view(0.0, np.pi / 2), "from the side": _view(_TURN_RAD, _TILT_RAD)}
    for column, (name, R_view_world) in enumerate(views.items()):
        axes = figure.add_axes((0.01 + 0.5 * column, 0.02, 0.48, 0.9))
        _draw_view(axes, R_view_world, points, colors=colors, positions=positions)
        axes.set_title(name, color=LINE, fontsize=11)
    save(figure, path)


def _draw_view(
    axes: "Axes", R_view_world: Array, points: Points32, *, colors: NDArray[np.uint8], positions: Array
) -> None:
    cloud, path = points @ R_view_world.T.astype(np.float32), positions @ R_view_world.T
    # A few stray points must not shrink the scene.
    low, high = np.percentile(cloud[:, :2], [0.5, 99.5], axis=0)
    low = np.minimum(low, path[:, :2].min(axis=0)) - _MARGIN_M
    high = np.maximum(high, path[:, :2].max(axis=0)) + _MARGIN_M
    pixel_m = float((high - low).max()) / _VIEW_PX
    image = splat(cloud, colors, low=low, pixel_m=pixel_m, shape=np.ceil((high - low)[::-1] / pixel_m))
    axes.imshow(image, origin="lower", interpolation="antialiased", extent=(low[0], high[0], low[1], high[1]))
    axes.plot(*path[:, :2].T, color="white", linewidth=2.4, alpha=0.75)
    axes.plot(*path[:, :2].T, color=hex_of(ESTIMATE), linewidth=1.3)
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
    image = np.empty((height + 2, width + 2, 3), np.uint8)
    image[:] = _BACKDROP
    cell = np.floor((cloud[:, :2] - low) / pixel_m).astype(np.int64) + 1
    inside = (cell >= 1).all(axis=1) & (cell[:, 0] <= width) & (cell[:, 1] <= height)
    nearest_last = np.flatnonzero(inside)[np.argsort(cloud[inside, 2], kind="stable")]
    flat = cell[nearest_last, 1] * (width + 2) + cell[nearest_last, 0]
    rank = np.full(image.shape[0] * image.shape[1], -1, np.int64)
    for row in (-1, 0, 1):
        for column in (-1, 0, 1):
            np.maximum.at(rank, flat + row * (width + 2) + column, np.arange(len(flat)))
    covered = rank >= 0
    image.reshape(-1, 3)[covered] = colors[nearest_last[rank[covered]]]
    return image[1:-1, 1:-1]


def _view(turn_rad: float, tilt_rad: float) -> Array:
    """Return the rotation to (right, up, towards the viewer) of a viewer at an azimuth and elevation."""
    towards = np.array(
        [np.sin(turn_rad) * np.cos(tilt_rad), -np.cos(turn_rad) * np.cos(tilt_rad), np.sin(tilt_rad)]
    )
    right = np.array([np.cos(turn_rad), np.sin(turn_rad), 0.0])
    return np.array([right, np.cross(towards, right), towards])
