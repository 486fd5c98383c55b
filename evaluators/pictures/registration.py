"""Picture and recording of two clouds, before and after they were registered."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from mapper.core.frames import Points32, Sensor
from mapper.core.geometry import Array, Transform, apply
from mapper.core.timebase import NS_PER_S
from mapper.export.figures import (
    END,
    ESTIMATE,
    FAINT,
    HEAD_IN,
    STRAY_PERCENT,
    TEXT,
    TRUTH,
    WIDE_IN,
    fit_to_window,
    hex_of,
    new_figure,
    quiet_frame,
    save,
)
from mapper.export.mcap_log import McapLog
from mapper.export.mcap_messages import Value
from mapper.registration.config import VOXEL_M
from mapper.registration.kd_tree import kd_tree

_DRAWN = 60_000
_MIN_ROW_IN = 0.8
_MARGIN = 0.05
_OF_SCANS = {
    "from above": np.array([[1.0, 0, 0], [0, 1, 0]]),
    "from the side": np.array([[1.0, 0, 0], [0, 0, 1]]),
}
_VIEWS: dict[Sensor, dict[str, Array]] = {
    "lidar": _OF_SCANS,
    "lidar-2d": _OF_SCANS,
    "rgbd": {
        "from above": np.array([[1.0, 0, 0], [0, 0, 1]]),
        "from the side": np.array([[0.0, 0, 1], [0, -1, 0]]),
    },
}
"""Rows: what points right and what points up. A camera's y points down, its z into the scene."""


def write_before_and_after(
    path: Path,
    points_target: Points32,
    points_source: Points32,
    stages: Sequence[tuple[str, Transform]],
    *,
    sensor: Sensor,
    title: str,
) -> None:
    """Draw the target blue, the source red, and its points that lie on the target dark.

    There is a column for each stage, all at one scale.

    Args:
        path: PNG file to write.
        points_target: (N, 3) metres.
        points_source: (M, 3) metres, source frame.
        stages: Name and T_target_source of each.
        sensor: Sensor that took them, which determines the direction up.
        title: Headline.
    """
    target, source = _thinned(points_target), _thinned(points_source)
    moved = [apply(T, source) for _, T in stages]
    tree, near_m = kd_tree(points_target), VOXEL_M[sensor]
    on_target = [tree.nearest(cloud)[1] <= near_m for cloud in moved]
    views = _VIEWS[sensor]
    windows = [_window(moved[-1] @ axes_of.T) for axes_of in views.values()]
    heights_in = [max(WIDE_IN * float(np.divide(*(high - low)[::-1])), _MIN_ROW_IN) for low, high in windows]
    figure = new_figure(WIDE_IN * len(stages), sum(heights_in) + HEAD_IN * (len(views) + 1))
    grid = figure.add_gridspec(len(views), len(stages), height_ratios=heights_in)
    for row, (view, axes_of) in enumerate(views.items()):
        low, high = windows[row]
        for column, ((name, _), cloud, on) in enumerate(zip(stages, moved, on_target, strict=True)):
            axes = figure.add_subplot(grid[row, column])
            for points, color in ((target, TRUTH), (cloud[~on], ESTIMATE), (cloud[on], END)):
                right, up = (points @ axes_of.T).T
                axes.plot(right, up, ",", color=hex_of(color), alpha=0.5)
            fit_to_window(axes, low, high)
            share = f", {on.mean():.0%} within {near_m:g} m (dark)" if row == 0 else ""
            axes.set_title(f"{name}, {view}{share}", fontsize=9, color=FAINT)
            quiet_frame(axes, label_size=7)
    figure.suptitle(title, fontsize=11, color=TEXT)
    figure.tight_layout()
    save(figure, path)


def _thinned(points: Points32) -> Array:
    step = max(len(points) // _DRAWN, 1)
    return points[::step].astype(np.float64)


def _window(flat: Array) -> tuple[Array, Array]:
    low, high = np.percentile(flat, (STRAY_PERCENT, 100.0 - STRAY_PERCENT), axis=0)
    margin = _MARGIN * float((high - low).max()) + 1e-3
    return low - margin, high + margin


def write_registration_log(
    path: Path,
    points_target: Points32,
    points_source: Points32,
    stages: Sequence[tuple[Transform, Mapping[str, Value]]],
) -> None:
    """Write /map/target, /map/source and /registration; stage k is at second k, so the playhead shows them.

    Args:
        path: MCAP file to write.
        points_target: (N, 3) metres; the recording's world is the target's frame.
        points_source: (M, 3) metres, source frame.
        stages: T_target_source after each, and a record with the same fields every time.
    """
    with McapLog(path) as log:
        log.cloud(0, points_target, colors=_one_color(points_target, TRUTH), name="target")
        for second, (T_target_source, record) in enumerate(stages):
            stamp_ns = second * NS_PER_S
            moved = apply(T_target_source, points_source.astype(np.float64))
            log.cloud(stamp_ns, moved, colors=_one_color(points_source, ESTIMATE), name="source")
            log.record("/registration", "mapper/msg/Registration", stamp_ns, record)


def _one_color(
    points: Points32, color: tuple[int, int, int]
) -> np.ndarray[tuple[int, ...], np.dtype[np.uint8]]:
    return np.broadcast_to(np.array(color, np.uint8), points.shape)
