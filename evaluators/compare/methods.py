"""Methods of `mapper compare`: odometries and registrations, each of which serves as the other."""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np

from mapper.core.errors import FrameError
from mapper.core.frames import Frame, RgbdFrame, Scan
from mapper.core.geometry import Transform, interpolate, inverse, nearest_rotation, transform
from mapper.core.trajectory import Trajectory, trajectory_from
from mapper.evaluators.compare.config import RgbdCompareConfig
from mapper.graph.model import PoseGraph
from mapper.odometry.base import FrameOdometry, FrameResult
from mapper.pipeline.disconnected_components import largest_component
from mapper.pipeline.tracking_result import TrackingResult
from mapper.registration.base import Alignment, failed
from mapper.runtime.progress import SILENT
from mapper.sources.base import FrameRef

# An optical frame looks along z with y down; methods for scans expect x ahead and z up.
_T_OPTICAL_UPRIGHT = np.array(
    [[0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
)


@dataclass(frozen=True, slots=True, eq=False)
class PreparedFrame:
    """One frame as the methods get it.

    Attributes:
        frame: Frame as the log has it; an RGB-D frame is grey.
        scan: Its points in an upright frame: x ahead, z up.
        T_body_scan: (4, 4) pose of that frame in the body.
    """

    frame: Frame
    scan: Scan
    T_body_scan: Transform

    def upright(self, T_body_body: Transform) -> Transform:
        """Return a motion of the body as a motion of the scans' frame."""
        return inverse(self.T_body_scan) @ T_body_body @ self.T_body_scan


class FrameReader:
    """Reads frames, and counts the CPU time of reading.

    Attributes:
        read_s: Seconds of the CPU for reading and decoding.
        scan_s: Seconds of the CPU for making scans of depth images.
    """

    def __init__(self, config: RgbdCompareConfig) -> None:
        """Begin at zero.

        Args:
            config: Settings by which depth images become scans.
        """
        self._config = config
        self.read_s = self.scan_s = 0.0

    def read(self, entry: FrameRef) -> PreparedFrame:
        """Return a frame of the log.

        Raises:
            FrameError: It cannot be read.
        """
        began = time.process_time()
        frame = entry.load(colour=False)
        loaded = time.process_time()
        prepared = self._prepared(frame)
        self.read_s += loaded - began
        self.scan_s += time.process_time() - loaded
        return prepared

    def _prepared(self, frame: Frame) -> PreparedFrame:
        if not isinstance(frame, RgbdFrame):
            # Without times no method deskews: registrations of pairs could not, for they know no motion.
            return PreparedFrame(frame, replace(frame, times_s=None), np.eye(4))
        scan = frame.scan(stride_px=self._config.stride_px, max_depth_m=self._config.max_depth_m)
        R_body_scan = _T_OPTICAL_UPRIGHT[:3, :3]
        points = np.ascontiguousarray(scan.points_body @ R_body_scan.astype(np.float32))
        return PreparedFrame(
            frame, Scan(scan.stamp_ns, points, scan.origin_body @ R_body_scan), _T_OPTICAL_UPRIGHT
        )


Align = Callable[[Any, Transform], Alignment]
"""Registers a source, of frames or of scans, to one target, from a guess if the method has use for one."""


class Tracker(Protocol):
    """A method that follows a whole log."""

    def add(self, frame: Any, /) -> bool:
        """Add the next frame, in time order, and return whether the method found its pose."""
        ...

    def trajectory(self) -> Trajectory:
        """Return the poses of all frames that have one, the first at the origin or near it."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class Method:
    """A method of the comparison.

    Attributes:
        name: Its name, on the command line too.
        sees_images: It gets the log's frames; otherwise the scans that are the same for all.
        uses_guess: Its registration begins at a guess.
        tracker: Makes one for a log.
        registration: Binds one for pairs to a target; None if it only follows whole logs.
        sees_times: It gets the log's scans with the times of their points.
    """

    name: str
    sees_images: bool
    uses_guess: bool
    tracker: Callable[[], Tracker]
    registration: Callable[[Any], Align] | None
    sees_times: bool = False

    def view(self, frame: PreparedFrame) -> Frame:
        """Return what the method gets of a frame."""
        return frame.frame if self.sees_images or self.sees_times else frame.scan


def odometry_method(name: str, build: Callable[[], FrameOdometry[Any]], *, sees_images: bool) -> Method:
    """Return an odometry of the project as a method."""
    return Method(
        name,
        sees_images=sees_images,
        uses_guess=not sees_images,
        tracker=lambda: OdometryTracker(build()),
        registration=lambda target: _aligned_by(build(), target),
    )


def registration_method(
    name: str, aligner_to: Callable[[Any], Any], *, uses_guess: bool, sees_images: bool = False
) -> Method:
    """Return a registration as a method; as an odometry it registers each frame to the one before it."""

    def bind(target: Frame) -> Align:
        align: Align = aligner_to(target).align
        return align

    return Method(
        name,
        sees_images=sees_images,
        uses_guess=uses_guess,
        tracker=lambda: FrameToFrame(bind),
        registration=bind,
    )


def reason_of(error: Exception) -> str:
    """Return an exception in one line."""
    return f"{type(error).__name__}: {' '.join(str(error).split())}"


class OdometryTracker:
    """Tracker by an odometry of the project: no loops, and nothing solved afterwards."""

    def __init__(self, odometry: FrameOdometry[Any]) -> None:
        self._odometry = odometry
        self._tracks: list[FrameResult] = []

    def add(self, frame: Frame) -> bool:
        """Observe and track the frame; one that cannot be used is lost."""
        try:
            observation = self._odometry.observe(frame)
        except FrameError:
            return False
        track = self._odometry.track(observation)
        self._tracks.append(track)
        return track.node is not None

    def trajectory(self) -> Trajectory:
        """Return the largest connected part of the path."""
        graph = PoseGraph()
        for track in self._tracks:
            if track.is_keyframe and track.node is not None:
                graph.add_node(track.node, track.stamp_ns, track.T_world_body)
        graph.add_factors(factor for track in self._tracks for factor in track.factors)
        graph.add_factors(self._odometry.finish())
        tracking = TrackingResult(tuple(self._tracks), (), graph, (), {})
        return largest_component(tracking, progress=SILENT).trajectory()


def _aligned_by(odometry: FrameOdometry[Any], target: Frame) -> Align:
    """Return the registration by an odometry, which is given the target, then the source, and nothing else.

    An odometry takes no guess. A scan is moved by the guess before the odometry gets it, which is equivalent;
    an image cannot be moved, so there the guess is not used. It is good for one alignment, as an odometry
    keeps every frame.
    """
    before = odometry.track(odometry.observe(target))

    def align(source: Frame, T_target_source: Transform) -> Alignment:
        if before.node is None:
            return failed("the target alone was lost")
        if isinstance(source, Scan):
            source, guess = source.moved(T_target_source), T_target_source
        else:
            guess = np.eye(4)
        track = odometry.track(odometry.observe(source))
        if track.node is None:
            return failed("the source was lost")
        return Alignment(
            inverse(before.T_world_body) @ track.T_world_body @ guess,
            converged=True,
            inlier_ratio=track.diagnostics.inliers / max(track.diagnostics.matches, 1),
            inlier_rmse_m=track.diagnostics.residual if track.diagnostics.residual_unit == "m" else np.nan,
            pairs=track.diagnostics.inliers,
        )

    return align


class FrameToFrame:
    """Tracker by a registration of every frame to the one before it, from the motion before it.

    Where that does not converge, the motion before is repeated: every frame has a pose.
    """

    def __init__(self, bind: Callable[[Any], Align]) -> None:
        self._bind = bind
        self._align: Align | None = None
        self._poses: list[tuple[int, Transform]] = []
        self._T_before_last = np.eye(4)
        self._before_ns = 0  # from the frame before the last to the last

    def add(self, frame: Frame) -> bool:
        """Register the frame to the last one, and make it the next one's target."""
        if self._align is None:
            self._align = self._bind(frame)
            self._poses.append((frame.stamp_ns, np.eye(4)))
            return True
        last_ns, T_world_last = self._poses[-1]
        guess = self._guess(frame.stamp_ns - last_ns)
        alignment = self._align(frame, guess)
        T_last_this = alignment.T_target_source if alignment.converged else guess
        T = T_world_last @ T_last_this
        self._poses.append((frame.stamp_ns, transform(nearest_rotation(T[:3, :3]), T[:3, 3])))
        self._T_before_last, self._before_ns = T_last_this, frame.stamp_ns - last_ns
        self._align = self._bind(frame)
        return alignment.converged

    def trajectory(self) -> Trajectory:
        """Return every frame's pose in the first frame."""
        return trajectory_from(self._poses)

    def _guess(self, gap_ns: int) -> Transform:
        if self._before_ns == 0:
            return np.eye(4)
        return interpolate(np.eye(4), self._T_before_last, gap_ns / self._before_ns)
