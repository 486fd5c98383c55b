"""Preview of a build: the path and some points from above, drawn anew while the log is tracked."""

import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from mapper.core.errors import FrameError, WriteError
from mapper.core.geometry import Array, Transform, apply
from mapper.export.figures import ESTIMATE, FREE_CELL, OCCUPIED_CELL, START, STRAY_PERCENT, Rgb
from mapper.features.frame_view import ImageView
from mapper.mapping.body_axes import AXES
from mapper.run.observers import Step
from mapper.runtime.atomic import atomic_file
from mapper.sources.base import Log

if TYPE_CHECKING:  # a build begins without what its end needs
    from mapper.mapping.map_building import Maps
    from mapper.run.folder import Run
    from mapper.run.results import RunResults

PREVIEW = "preview.png"

_FIRST_S, _REFRESH_S = 5.0, 2.0
_CPU_SHARE = 0.008
"""Largest share of the build's CPU time that goes into points, and into pictures after the first."""
_WIDTH_PX, _HEIGHT_PX, _MARGIN_PX = 640, 480, 24
_POINTS_OF_KEYFRAME = 500


class Preview:
    """Observer that keeps a picture of the build in a file, and removes it once the maps are made.

    The first picture comes after 5 s. Points of keyframes are kept, and further pictures drawn, only while
    that has taken less than 1 % of the build's CPU time.
    """

    def __init__(
        self,
        path: Path,
        source: Log,
        *,
        on_first: Callable[[], None],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Begin without a picture.

        Args:
            path: File to write; its folder exists when frames arrive.
            source: The log that is mapped.
            on_first: Called once there is a picture.
            clock: Seconds, by which pictures are due.
        """
        self._path = path
        self._on_first = on_first
        self._clock = clock
        self._frames_in_all = len(source)
        axes = AXES[source.sensor]
        # From above, upright only by guess: to the right, and forward.
        self._right_forward = np.array([np.cross(axes.forward, axes.up), axes.forward])
        self._drawn_s = clock()
        self._began_cpu_s = time.process_time()
        self._cpu_s = 0.0
        self._frames = 0
        self._positions: list[Array] = []
        self._points: dict[int, Array] = {}
        self._has_picture = self._is_off = False

    def on_frame(self, step: Step, /) -> None:
        """Take the frame's position, a keyframe's points, and draw when a picture is due."""
        self._frames += 1
        if self._is_off:
            return
        track = step.track
        if track.node is not None:
            self._positions.append(track.T_world_body[:3, 3])
        began_cpu_s = time.thread_time()
        if track.is_keyframe and track.node is not None and self._is_cheap():
            self._keep_points(track.node, step)
        if self._is_due():
            self._draw(step)
            self._drawn_s = self._clock()
        self._cpu_s += time.thread_time() - began_cpu_s

    def on_levelled(self, T_level_world: Transform, /) -> None:
        """Ignore the world."""

    def on_mapped(self, run: "Run", results: "RunResults", maps: "Maps", /) -> None:  # noqa: ARG002
        """Remove the picture: the run has better ones now."""
        self._path.unlink(missing_ok=True)

    def _is_due(self) -> bool:
        waited_s = self._clock() - self._drawn_s
        if not self._has_picture:
            return waited_s >= _FIRST_S and bool(self._positions)
        return waited_s >= _REFRESH_S and self._is_cheap()

    def _is_cheap(self) -> bool:
        return self._cpu_s <= _CPU_SHARE * (time.process_time() - self._began_cpu_s)

    def _keep_points(self, node: int, step: Step) -> None:
        try:
            view = step.view()
        except FrameError:
            return  # fusing reports it
        if isinstance(view, ImageView):
            points = apply(view.T_body_camera, view.points_camera[np.isfinite(view.points_camera[:, 2])])
        else:
            points = view.points_body.astype(np.float64)
        self._points[node] = points[:: max(1, len(points) // _POINTS_OF_KEYFRAME)]

    def _draw(self, step: Step) -> None:
        seen = [apply(step.detector.current_estimate(node), points) for node, points in self._points.items()]
        path = np.array(self._positions) @ self._right_forward.T
        points = np.concatenate([*seen, np.empty((0, 3))]) @ self._right_forward.T
        picture = drawn(path, points, text=self._text())
        try:
            with atomic_file(self._path) as part:
                cv2.imwrite(str(part), picture)
        except WriteError:
            self._is_off = True  # the build itself reports a full disk
            return
        if not self._has_picture:
            self._has_picture = True
            self._on_first()

    def _text(self) -> str:
        share = self._frames / max(self._frames_in_all, 1)
        return f"{self._frames} of {self._frames_in_all} frames tracked, {share:.0%}"


def drawn(path: Array, points: Array, *, text: str) -> NDArray[np.uint8]:
    """Return a picture (H, W, 3) uint8, B, G, R, of a path over points, with a scale bar.

    Args:
        path: (N, 2) metres, to the right and upwards; at least one.
        points: (M, 2) the same.
        text: Caption.
    """
    picture = np.full((_HEIGHT_PX, _WIDTH_PX, 3), FREE_CELL[::-1], np.uint8)
    low, high = path.min(axis=0), path.max(axis=0)
    if len(points):
        spread = np.percentile(points, [STRAY_PERCENT, 100.0 - STRAY_PERCENT], axis=0)
        low, high = np.minimum(low, spread[0]), np.maximum(high, spread[1])
    size_px = np.array([_WIDTH_PX - 2 * _MARGIN_PX, _HEIGHT_PX - 2 * _MARGIN_PX - _MARGIN_PX])
    px_per_m = float((size_px / np.maximum(high - low, 1e-2)).min())
    middle = (low + high) / 2.0

    centre_px = np.array([_WIDTH_PX / 2, (_HEIGHT_PX - _MARGIN_PX) / 2])

    def to_px(positions: Array) -> NDArray[np.int32]:
        right_down: Array = centre_px + (positions - middle) * px_per_m * np.array([1.0, -1.0])
        return right_down.round().astype(np.int32)

    columns, rows = to_px(points).T
    inside = (columns >= 0) & (columns < _WIDTH_PX) & (rows >= 0) & (rows < _HEIGHT_PX - _MARGIN_PX)
    picture[rows[inside], columns[inside]] = OCCUPIED_CELL[::-1]
    line = to_px(path)
    cv2.polylines(picture, [line], False, _bgr(ESTIMATE), 2, cv2.LINE_AA)
    cv2.circle(picture, tuple(map(int, line[0])), 5, _bgr(START), -1, cv2.LINE_AA)
    cv2.circle(picture, tuple(map(int, line[-1])), 5, _bgr(ESTIMATE), -1, cv2.LINE_AA)
    length_m = 10.0 ** np.floor(np.log10(_WIDTH_PX / 3 / px_per_m))
    right, below = _WIDTH_PX - _MARGIN_PX, _HEIGHT_PX - 10
    cv2.line(picture, (int(right - length_m * px_per_m), below), (right, below), _bgr(OCCUPIED_CELL), 2)
    label = f"{length_m:g} m"
    (width, _), _ = cv2.getTextSize(label, cv2.FONT_HERSHEY_SIMPLEX, 0.45, 1)
    for words, column, row in ((text, _MARGIN_PX, below), (label, right - width, below - 6)):
        cv2.putText(
            picture, words, (column, row), cv2.FONT_HERSHEY_SIMPLEX, 0.45, _bgr(OCCUPIED_CELL), 1, cv2.LINE_AA
        )
    return picture


def _bgr(color: Rgb) -> tuple[int, int, int]:
    red, green, blue = color
    return blue, green, red
