"""Time offsets of all that a log has beside its frames, by the motion that its odometry tracks."""

from collections.abc import Sequence
from contextlib import suppress
from math import inf
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from mapper.config.build import BuildConfig
from mapper.core.errors import FrameError
from mapper.core.frames import PinholeCamera
from mapper.core.geometry import Array, angle_of
from mapper.core.timebase import GAP_INTERVALS, NS_PER_S, Stamps
from mapper.core.trajectory import Trajectory
from mapper.odometry.given_poses import poses_for
from mapper.pipeline.track import track_log
from mapper.pipeline.tracking_result import BY_POSES
from mapper.runtime.progress import SILENT, Progress
from mapper.sensing.gyroscope import Gyroscope
from mapper.sensing.wheel_kinematics import step_sizes
from mapper.sources.base import CameraImages, Log
from mapper.sources.depth_time import depth_time_offset
from mapper.sources.time_offsets import TimeOffset, peak_of, time_offset

_STEP_NS = NS_PER_S // 10
"""Least time over which motion is compared: in less, noise of poses is as large."""
_OFFSETS_S = 0.01 * np.arange(-100, 101)
"""Offsets that are tried, a tenth of a step apart: the peak of correlations is as wide as a step."""
_AROUND = 20
"""Offsets on either side of the log's best among which that of a part of it is searched."""
_MOST_PARTS, _FEWEST_STEPS = 8, 10
"""Parts of a log that have an estimate each, and steps that a part has."""
_LEAST_CORRELATION = 0.5
"""At the best offset: of steps of another motion it is less."""
_MOST_IMAGES, _IMAGE_WIDTH_PX, _FEWEST_MATCHES, _EPIPOLAR_PX = 600, 640, 20, 1.5
"""Images of a camera that are matched, a minute of them, the width to which they are reduced, and matches of
two and their distances from epipolar lines that tell a turn."""

_Features = tuple[Array, Any]
"""(N, 2) rays of features, and their descriptors or None."""


class _Motion(NamedTuple):
    """Motion up to (N,) times, nanoseconds, in any unit: metres travelled, or radians turned."""

    stamps_ns: Stamps
    travelled: Array

    def during(self, begins_ns: Stamps, ends_ns: Stamps) -> Array:
        """Return the motion from some times to later ones; NaN where that is not known."""
        origin_ns = self.stamps_ns[0]  # nanoseconds since 1970 are too many for a float
        known_ns = (self.stamps_ns - origin_ns).astype(np.float64)
        begun, ended = (
            np.interp(at_ns - origin_ns, known_ns, self.travelled, left=np.nan, right=np.nan)
            for at_ns in (begins_ns, ends_ns)
        )
        moved: Array = ended - begun
        return moved


def measure_time_offsets(log: Log, config: BuildConfig, *, progress: Progress = SILENT) -> list[TimeOffset]:
    """Return how late the stamps are of depth, gyroscope, wheels, truth, a device's poses, and cameras.

    That of depth puts its outlines on edges of the images, and is searched within 0.3 s. All others are
    searched within 1 s: at the true offset, what a sensor turns or travels in steps of 0.1 s correlates best
    with what the tracked frames do, whatever its mounting and unit. A camera beside a LiDAR turns as its
    images do. Poses that are the odometry are left out, and sensors that are fused are listed unmeasured.

    Args:
        log: The log.
        config: Settings of its odometry, and the offsets that are applied already.
        progress: Receives the stage of tracking.

    Raises:
        ConfigError: The odometry needs wheels or poses and there are none.
    """
    source = config.source
    found = [depth_time_offset(log, source)] if log.sensor == "rgbd" else []
    others: list[tuple[str, Trajectory | Gyroscope | CameraImages | None, str, float]] = [
        ("gyroscope", log.gyroscope, "source.imu_offset_s", source.imu_offset_s),
        ("wheels", log.wheels, "source.wheels_offset_s", source.wheels_offset_s),
        ("truth", log.truth, "source.truth_offset_s", source.truth_offset_s),
        ("device poses", log.device_poses, "", 0.0),
        *((one.name, one, "source.images_offset_s", source.images_offset_s) for one in log.images),
    ]
    unmeasured = [TimeOffset(one.log.name, None, None, is_measured=False) for one in log.beside]
    own = poses_for(config.odometry, log) if config.odometry.kind in BY_POSES else None
    present = [one for one in others if one[1] is not None and one[1] is not own]
    if not present:
        return [*found, *unmeasured]
    path = track_log(log, config, progress=progress).tracked_trajectory()
    for name, other, setting, set_s in present:
        assert other is not None
        tried = [
            time_offset(name, late_s, setting=setting, set_s=set_s) for late_s in _estimates(path, other)
        ]
        found.append(min(tried, key=lambda one: inf if one.sigma_s is None else one.sigma_s))
    return [*found, *unmeasured]


def _estimates(path: Trajectory, other: Trajectory | Gyroscope | CameraImages) -> list[Sequence[float]]:
    """Return a sensor's delays in parts of the log: by turns, by ways travelled, or both."""
    if isinstance(other, CameraImages):
        return [_delays_s(_motions(path)[1], _turns_of(other))]
    if isinstance(other, Gyroscope):
        return [_delays_s(_motions(path)[1], _Motion(other.stamps_ns, other.turned_rad()))]
    both = zip(_motions(path), _motions(other), strict=True)
    return [_delays_s(own, others) for own, others in both]


def _apart(stamps_ns: Stamps) -> NDArray[np.intp]:
    """Return the indices of stamps that are at least 0.1 s apart."""
    kept = [0] if len(stamps_ns) else []
    for k, stamp_ns in enumerate(stamps_ns.tolist()):
        if stamp_ns - stamps_ns[kept[-1]] >= _STEP_NS:
            kept.append(k)
    return np.array(kept, np.intp)


def _turns_of(images: CameraImages) -> _Motion:
    """Return the radians that a camera turned, by the essential matrices of images at least 0.1 s apart."""
    kept = _apart(images.stamps_ns)
    kept = kept[(skipped := max(len(kept) - _MOST_IMAGES, 0) // 2) : skipped + _MOST_IMAGES]
    orb, matcher = cv2.ORB.create(1000), cv2.BFMatcher.create(cv2.NORM_HAMMING, crossCheck=True)
    reduced = max(1, images.camera.width_px // _IMAGE_WIDTH_PX)
    turned_rad, before = [0.0], None
    for index in kept.tolist():
        points, descriptors = np.empty((0, 2)), None
        with suppress(FrameError):
            image = images.image_at(index)
            grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) if image.ndim == 3 else image
            keypoints, descriptors = orb.detectAndCompute(grey[::reduced, ::reduced], None)
            points = reduced * np.array([keypoint.pt for keypoint in keypoints]).reshape(-1, 2)
        rays = images.camera.rays(images.camera.undistort(points))
        if before is not None:
            turned_rad.append(turned_rad[-1] + _turn_rad(matcher, before, (rays, descriptors), images.camera))
        before = rays, descriptors
    return _Motion(images.stamps_ns[kept], np.array(turned_rad))


def _turn_rad(matcher: Any, one: _Features, other: _Features, camera: PinholeCamera) -> float:
    """Return the angle between two views; 0 where too few features match."""
    if one[1] is None or other[1] is None:
        return 0.0
    pairs = np.array([(m.queryIdx, m.trainIdx) for m in matcher.match(one[1], other[1])], np.intp).reshape(
        -1, 2
    )
    if len(pairs) < _FEWEST_MATCHES:
        return 0.0
    rays = one[0][pairs[:, 0]], other[0][pairs[:, 1]]
    essential, _ = cv2.findEssentialMat(*rays, np.eye(3), threshold=_EPIPOLAR_PX / camera.fx_px)
    if essential is None or essential.shape != (3, 3):
        return 0.0
    R_a, R_b, _ = cv2.decomposeEssentialMat(essential)  # one is the other turned by 180° about the way
    return min(angle_of(R_a), angle_of(R_b))


def _motions(path: Trajectory) -> tuple[_Motion, _Motion]:
    """Return the metres travelled and the radians turned, at poses at least 0.1 s apart."""
    apart = path[_apart(path.stamps_ns)]
    metres, radians = (np.concatenate([[0.0], np.cumsum(steps)]) for steps in step_sizes(apart))
    return _Motion(apart.stamps_ns, metres), _Motion(apart.stamps_ns, radians)


def _delays_s(own: _Motion, other: _Motion) -> list[float]:
    """Return how much later the other's stamps are, in parts of the log; none if its motion is another."""
    steps_ns = np.diff(own.stamps_ns)
    if len(steps_ns) < 2 * _FEWEST_STEPS or len(other.stamps_ns) < 2:
        return []
    is_step = steps_ns <= GAP_INTERVALS * np.median(steps_ns)
    begins_ns, ends_ns = own.stamps_ns[:-1][is_step], own.stamps_ns[1:][is_step]
    moved = np.diff(own.travelled)[is_step]
    shifts_ns = np.round(_OFFSETS_S * NS_PER_S).astype(np.int64)
    others = np.array([other.during(begins_ns + ns, ends_ns + ns) for ns in shifts_ns])
    everywhere = np.arange(len(moved))
    correlations = _correlations(moved, others, everywhere)
    best = int(correlations.argmax())
    if correlations[best] < _LEAST_CORRELATION:
        return []
    near = slice(max(best - _AROUND, 0), best + _AROUND + 1)
    found = []
    for part in np.array_split(everywhere, min(len(moved) // _FEWEST_STEPS, _MOST_PARTS)):
        scores = _correlations(moved, others[near], part)
        if 0 < scores.argmax() < len(scores) - 1:
            found.append(peak_of(_OFFSETS_S[near], scores))
    return found


def _correlations(moved: Array, others: Array, part: NDArray[np.intp]) -> Array:
    """Return the correlations of (N,) steps with each of (M, N) others, in a part of them; 0 of few steps."""
    own, known = moved[part], np.isfinite(others[:, part])
    fewest = max(_FEWEST_STEPS // 2, known.sum(axis=1).max() // 2)
    correlations = np.zeros(len(others))
    for k, is_known in enumerate(known):
        a, b = own[is_known], others[k, part][is_known]
        if len(a) >= fewest and a.std() > 0.0 and b.std() > 0.0:
            correlations[k] = np.corrcoef(a, b)[0, 1]
    return correlations
