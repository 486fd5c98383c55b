"""Plausibility of an RGB-D log's depth: its range, and its scale against the true or the wheels' motion."""

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass

import cv2
import numpy as np

from mapper.core.frames import RgbdFrame
from mapper.core.geometry import Array, Transform, apply, inverse, length_and_angle
from mapper.core.timebase import NS_PER_S
from mapper.core.trajectory import Trajectory, with_rotations
from mapper.core.units import MM_PER_M
from mapper.sensing.wheel_kinematics import pose_at
from mapper.sources.base import Log, read_depth
from mapper.sources.depth_outlines import why_flipped
from mapper.sources.image_files.reading import TUM_UNITS_PER_M, are_swapped

_LOOKED_AT = 8
"""Frames, spread over the log, whose depth is looked at, and from which pairs begin."""

_MIN_MEASURED_SHARE = 0.05
_NEAR_M, _FAR_M = 0.1, 8.0
"""Least median and largest 90th percentile of depth that cameras deliver; farther surfaces return little."""
_POSSIBLE_M = 0.02, 150.0
"""Median depths outside of which units are wrong: microscopes see nearer, and stereo pairs not as far. A room
in units 1000 times too large or too small lies outside."""
_USUALLY_NEAR_M = 0.3
"""Least depth of most cameras and ways to hold them: nearer values may be millimetres taken for TUM's fifths
of these, unless units are stated and the values are whole millimetres in them."""
_OBJECT_M = 0.7
"""Depth of most of an object before a camera that sees nearer than usual, and of rooms in centimetres."""
_DESK_M = 1.5
"""Depth of most of a desk or an object; nearer than that a whole room is not."""
_USUAL_UNITS_PER_M = (MM_PER_M, TUM_UNITS_PER_M, 10_000.0, 100.0)
_CHANGE = 3.0
"""Ratio of the median depths of two consecutive frames by which units change, if all frames before are more
like the one and all after more like the other: usual units differ by 4 or 5, or by 1000."""

_PILED_SHARE, _PILED_TIMES, _NEXT_FARTHEST = 0.01, 2.0, 0.95
"""Share of an image that is exactly the log's farthest depth if that stands for none, and how often it is
as much as those next to it, from this ratio of the farthest on. Of what is measured 0.4 % and 0.5 times."""

_WIDTH_PX, _WINDOW_PX, _STRAIGHT, _FEWEST_WINDOWS, _LEAST_INVERSE = 320, 32, 0.16, 10, 0.8
"""Least width of the depth images in which planes are looked for, size of the windows, largest residual in
the square of the slant (where one of z and 1/z is linear, that of the other is 0.07), and number and share of
windows. Of seven real and made logs z is straighter than 1/z in 0 to 14 % of 14 to 354 windows."""

_ROUNDING = 0.05
"""Error of 16 bits in float32 metres, in units."""
_PAIR_WITHIN_NS = NS_PER_S // 2
_MIN_MOTION_M = 0.03
_MAX_TURN_RAD = 0.2
"""A pair's motion: far enough for the noise of depth, and little turned, for mountings are not exact."""

_MIN_AGREEING = 20
_MAX_RESIDUAL_SHARE = 0.25
"""A match agrees with a scale if its points then lie within this share of the motion from each other."""

_MIN_PAIRS = 3
_MAX_SCALE_ERROR = 1.25
"""Depth cameras, truth and wheels err by a few per cent; wrong units by a factor of 4 or 5, or of 1000."""


@dataclass(frozen=True, slots=True, eq=False)
class _Features:
    """ORB features that have depth: (N, 3) points in the camera's frame, and (N, 32) descriptors."""

    points_camera: Array
    descriptors: cv2.typing.MatLike


def read_spread(log: Log) -> dict[int, RgbdFrame]:
    """Return a few frames of an RGB-D log by index, for the checks of depth; none of other logs."""
    if log.sensor != "rgbd":
        return {}
    read = ((index, read_depth(log.entry_at(index))) for index in log.spread_indices(_LOOKED_AT))
    return {index: frame for index, frame in read if frame is not None}


def why_no_depth(log: Log, frames: Mapping[int, RgbdFrame]) -> str | None:
    """Return why a log's depth is none that a camera measures, by :func:`read_spread`; None if it may be."""
    if _has_swapped_bytes(log, frames.values()):
        return (
            "depth: the two bytes of its numbers are in the wrong order: neighbours differ as random numbers "
            "do, and swapped they do not; write the images again with bytes swapped (NumPy: units.byteswap())"
        )
    medians_m = [_median_m(frame) for frame in frames.values() if frame.depth_m.any()]
    if frames and not medians_m:
        return f"no depth in any of {len(frames)} frames looked at: all of it is 0, or the limit of 16 bits"
    least_m, most_m = _POSSIBLE_M
    if not medians_m or least_m < np.median(medians_m) < most_m:
        return why_flipped(frames.values())
    if inverse := _inverse_warning(frames.values()):
        return inverse[0]
    median_m, units_per_m = float(np.median(medians_m)), _units_per_m(log)
    setting = "source.camera.depth_factor" + ("" if units_per_m is None else f"={units_per_m:g}")
    return (
        f"depth of {median_m:.2g} m (median), where cameras measure {least_m:g} to {most_m:g} m; "
        f"is {setting} right, in units per metre?{_fitting_units(units_per_m, median_m, median_m)}"
    )


def depth_warnings(log: Log, frames: Mapping[int, RgbdFrame]) -> list[str]:
    """Return what is implausible about a log's depth, a sentence each; ``frames`` are of :func:`read_spread`.

    Scale: features that are matched between two frames move by the known motion, of truth or else of wheels,
    at one scale of depth only. Range: without such a motion there is no scale to compare with, but cameras
    deliver depth of some ranges only.
    """
    if not frames or _has_swapped_bytes(log, frames.values()):
        return []
    measured = float(np.median([(frame.depth_m > 0.0).mean() for frame in frames.values()]))
    if measured < _MIN_MEASURED_SHARE:
        return [f"depth: {1.0 - measured:.1%} of the pixels measured nothing: 0, or the limit of 16 bits"]
    values = frames.values()
    if odd := _change_warning(log, frames) or _pile_warning(values) or _inverse_warning(values):
        return odd
    if (scale := _scale_of_log(log, frames)) is None:
        return _range_warning(log, frames.values())
    if 1.0 / _MAX_SCALE_ERROR < scale < _MAX_SCALE_ERROR:
        return []
    wrong = f"{1.0 / scale:.2g} times too large" if scale < 1.0 else f"{scale:.2g} times too small"
    whose = "wheels' motion" if log.truth is None else "true motion"
    median_m = np.median([_median_m(frame) for frame in frames.values() if frame.depth_m.any()])
    if _NEAR_M < median_m < _FAR_M and not _NEAR_M < scale * median_m < _FAR_M:
        return [f"depth: the {whose} of the camera is {scale:.3g} times that by depth; is it in metres?"]
    units_per_m = _units_per_m(log)
    fitting = "" if units_per_m is None else f"={_rounded(units_per_m / scale):g} fits, not {units_per_m:g}"
    return [
        f"depth: {wrong} for the {whose} of the camera; source.camera.depth_factor{fitting or ' is wrong'}"
    ]


def _range_warning(log: Log, frames: Collection[RgbdFrame]) -> list[str]:
    spans_m = [
        np.percentile(frame.depth_m[frame.depth_m > 0.0], (5.0, 50.0, 90.0))
        for frame in frames
        if frame.depth_m.any()
    ]
    near_m, median_m, far_m = np.median(spans_m, axis=0)
    least_m = _NEAR_M
    if median_m < _NEAR_M:
        found = f"half of it is within {median_m:.2g} m"
    elif near_m < _USUALLY_NEAR_M and (log.are_units_assumed or not _are_whole_millimetres(log, frames)):
        found, least_m = f"a twentieth of it is within {near_m:.2g} m", _USUALLY_NEAR_M
    elif near_m < _USUALLY_NEAR_M and far_m < _OBJECT_M:
        found, least_m = f"nine tenths of it is within {far_m:.2g} m", _USUALLY_NEAR_M
    elif log.are_units_assumed and far_m < _DESK_M and not _are_whole_millimetres(log, frames):
        found = f"nine tenths of it is within {far_m:.2g} m and it is no whole millimetres"
    elif far_m > _FAR_M:
        found = f"a tenth of it is beyond {far_m:.2g} m"
    else:
        return []
    units_per_m = _units_per_m(log)
    setting = "source.camera.depth_factor" + ("" if units_per_m is None else f"={units_per_m:g}")
    return [
        f"depth: {found}, but cameras measure {least_m:g} to {_FAR_M:g} m; is {setting} right?"
        f"{_fitting_units(units_per_m, median_m, far_m)}"
    ]


def _fitting_units(units_per_m: float | None, median_m: float, far_m: float) -> str:
    """Return which usual units give depth that cameras measure, and by what factor it differs; or nothing."""
    for other in _USUAL_UNITS_PER_M:
        factor = (units_per_m or other) / other
        if factor != 1.0 and factor * median_m >= _USUALLY_NEAR_M and factor * far_m <= _FAR_M:
            where = "farther" if factor > 1.0 else "nearer"
            return f" {other:g} reads it {max(factor, 1.0 / factor):g} times {where}"
    return ""


def _change_warning(log: Log, frames: Mapping[int, RgbdFrame]) -> list[str]:
    """Return a sentence on the frame from which on depth is in other units than before, if there is one."""
    found = {index: _median_m(frame) for index, frame in frames.items() if frame.depth_m.any()}
    indices, medians_m = list(found), np.array(list(found.values()))
    for k in range(2, len(indices) - 1):
        last, first = indices[k - 1], indices[k]
        last_m, first_m = float(medians_m[k - 1]), float(medians_m[k])
        is_after = abs(np.log(medians_m / first_m)) < abs(np.log(medians_m / last_m))
        if max(first_m / last_m, last_m / first_m) <= _CHANGE or is_after[:k].any() or not is_after[k:].all():
            continue
        while first - last > 1:
            middle = (first + last) // 2
            frame = read_depth(log.entry_at(middle))
            middle_m = last_m if frame is None or not frame.depth_m.any() else _median_m(frame)
            if abs(np.log(middle_m / last_m)) < abs(np.log(middle_m / first_m)):
                last, last_m = middle, middle_m
            else:
                first, first_m = middle, middle_m
        ratio = first_m / last_m
        if max(ratio, 1.0 / ratio) > _CHANGE:
            return [
                f"depth: from frame {first} on it is {ratio:.2g} times as far as before; did its units "
                "change? map the parts apart (source.first_frame, source.last_frame)"
            ]
    return []


def _pile_warning(frames: Collection[RgbdFrame]) -> list[str]:
    """Return a sentence on a depth that fills pixels without a measurement, or at which depth was cut off."""
    far_m = max(float(frame.depth_m.max()) for frame in frames)
    leasts_m = far_m, _NEXT_FARTHEST * far_m
    at_end, near_end = np.median(
        [[(frame.depth_m >= least_m).mean() for least_m in leasts_m] for frame in frames], axis=0
    )
    if at_end < max(_PILED_SHARE, _PILED_TIMES * (near_end - at_end)) or at_end == 1.0:
        return []
    return [
        f"depth: {at_end:.0%} of it is exactly {far_m:.4g} m, the farthest: do pixels without a measurement "
        f"have this value? --set source.body.max_range_m={0.999 * far_m:.4g} leaves them out"
    ]


def _inverse_warning(frames: Collection[RgbdFrame]) -> list[str]:
    """Return a sentence on depth that seems to be disparity: on a plane 1/z is linear in the pixel, z is not.

    Both are fitted in windows on slanted surfaces.
    """
    rows, columns = np.mgrid[:_WINDOW_PX, :_WINDOW_PX] / _WINDOW_PX - 0.5
    plane = np.column_stack([np.ones(rows.size), rows.ravel(), columns.ravel()])
    windows = [np.empty((0, rows.size))]
    for frame in frames:
        step = frame.camera.width_px // _WIDTH_PX
        if min(step, frame.camera.height_px // _WINDOW_PX) < 1:
            continue
        depth_m = frame.depth_m[::step, ::step]
        shown = np.lib.stride_tricks.sliding_window_view(depth_m, (_WINDOW_PX, _WINDOW_PX))
        whole = shown[:: _WINDOW_PX // 2, :: _WINDOW_PX // 2].reshape(-1, rows.size).astype(np.float64)
        windows.append(whole[(whole > 0.0).all(axis=1)])
    z = np.concatenate(windows)
    values = np.stack([z, 1.0 / z])
    values /= values.mean(axis=2, keepdims=True)
    fits = values @ np.linalg.pinv(plane).T
    residuals = np.linalg.norm(values - fits @ plane.T, axis=2) / np.sqrt(rows.size)
    slanted = residuals.min(axis=0) < _STRAIGHT * np.linalg.norm(fits[0, :, 1:], axis=1) ** 2
    of_z, of_inverse = residuals[:, slanted]
    if len(of_z) < _FEWEST_WINDOWS or (of_z < of_inverse).mean() < _LEAST_INVERSE:
        return []
    return [
        f"depth: planes are straight in it as in disparity ({(of_z < of_inverse).mean():.0%} of {len(of_z)} "
        "windows); is it disparity or inverse depth? write focal length · baseline / disparity"
    ]


def _has_swapped_bytes(log: Log, frames: Collection[RgbdFrame]) -> bool:
    """Return whether depth was recorded in 16 bits of the wrong order of bytes."""
    units_per_m = _units_per_m(log) or MM_PER_M
    for frame in frames:
        units = frame.depth_m.astype(np.float64) * units_per_m
        whole = np.rint(units)
        is_recorded = np.abs(units - whole).max() < _ROUNDING and whole.max() <= np.iinfo(np.uint16).max
        if not is_recorded or not are_swapped(whole.astype(np.uint16)):
            return False
    return bool(frames)


def _median_m(frame: RgbdFrame) -> float:
    return float(np.median(frame.depth_m[frame.depth_m > 0.0]))


def _are_whole_millimetres(log: Log, frames: Collection[RgbdFrame]) -> bool:
    """Return whether depth was recorded in whole millimetres, as cameras deliver it, and scaled since."""
    units_per_m = _units_per_m(log) or MM_PER_M
    units_per_mm = (units_per_m if units_per_m >= MM_PER_M else TUM_UNITS_PER_M) / MM_PER_M
    units = np.concatenate([np.rint(frame.depth_m * units_per_mm * MM_PER_M) for frame in frames])
    return bool((np.remainder(units, units_per_mm) == 0.0).all())


def _scale_of_log(log: Log, frames: Mapping[int, RgbdFrame]) -> float | None:
    """Return the factor that depth lacks by several pairs of frames; None where too few agree on one."""
    motion = log.wheels if (truth := with_rotations(log.truth)) is None else truth
    if motion is None:
        return None
    scales = []
    for first, second, T_first_second in _pairs(log, motion, frames.keys()):
        frame = read_depth(log.entry_at(second))
        if frame is not None and (scale := _scale(frames[first], frame, T_first_second)) is not None:
            scales.append(scale)
    median = float(np.median(scales)) if scales else 1.0
    agreeing = [scale for scale in scales if 1.0 / _MAX_SCALE_ERROR < scale / median < _MAX_SCALE_ERROR]
    return median if len(agreeing) >= _MIN_PAIRS else None


def _pairs(log: Log, motion: Trajectory, anchors: Collection[int]) -> Iterator[tuple[int, int, Transform]]:
    """Yield each anchor, the frame soon after it that moved farthest, and T_first_second."""

    def pose(index: int) -> Transform | None:
        return pose_at(motion, int(log.stamps_ns[index]), max_gap_ns=_PAIR_WITHIN_NS)

    for first in anchors:
        T_world_first = pose(first)
        if T_world_first is None:
            continue
        last_ns = log.stamps_ns[first] + _PAIR_WITHIN_NS
        end = max(first + 2, int(np.searchsorted(log.stamps_ns, last_ns, side="right")))
        farthest_m, farthest = _MIN_MOTION_M, None
        for second in range(first + 1, min(end, len(log))):
            T_world_second = pose(second)
            if T_world_second is None:
                continue
            T_first_second = inverse(T_world_first) @ T_world_second
            distance_m, turn_rad = length_and_angle(T_first_second)
            if distance_m >= farthest_m and turn_rad <= _MAX_TURN_RAD:
                farthest_m, farthest = distance_m, (first, second, T_first_second)
        if farthest is not None:
            yield farthest


def _scale(first: RgbdFrame, second: RgbdFrame, T_first_second: Transform) -> float | None:
    """Return the factor that depth lacks for the matched points to move as known; None if matches disagree.

    With scale s a point of both frames has s·p₁ = R·s·p₂ + t, so s·(p₁ − R·p₂) = t.
    """
    one, other = _features(first), _features(second)
    pairs = _matched(one, other)
    R = T_first_second.copy()
    R[:3, 3] = 0.0
    t = T_first_second[:3, 3]
    distance_m = float(np.linalg.norm(t))
    moved = one.points_camera[pairs[:, 0]] - apply(R, other.points_camera[pairs[:, 1]])
    along_m = moved @ t / distance_m
    candidates = distance_m / along_m[along_m > 0.0]
    if not len(candidates):
        return None
    residuals_m = np.linalg.norm(candidates[:, None, None] * moved - t, axis=2)
    agreeing = residuals_m < _MAX_RESIDUAL_SHARE * distance_m
    best = agreeing[int(agreeing.sum(axis=1).argmax())]
    return float(distance_m / np.median(along_m[best])) if best.sum() >= _MIN_AGREEING else None


def _features(frame: RgbdFrame) -> _Features:
    keypoints, descriptors = cv2.ORB.create().detectAndCompute(frame.gray, None)
    pixels = np.array([keypoint.pt for keypoint in keypoints]).reshape(-1, 2)
    columns, rows = np.rint(pixels).astype(int).T
    depth_m = frame.depth_m[rows, columns].astype(np.float64)
    kept = depth_m > 0.0
    camera = frame.camera
    rays = camera.rays(camera.undistort(pixels[kept]))
    points = np.column_stack([rays, np.ones(len(rays))]) * depth_m[kept, None]
    return _Features(points, np.zeros((0, 32), np.uint8) if descriptors is None else descriptors[kept])


def _matched(one: _Features, other: _Features) -> Array:
    """Return (N, 2) indices of features that are each other's nearest."""
    if not len(one.descriptors) or not len(other.descriptors):  # OpenCV refuses a black image's none
        return np.empty((0, 2), int)
    matches = cv2.BFMatcher.create(cv2.NORM_HAMMING, crossCheck=True).match(
        one.descriptors, other.descriptors
    )
    return np.array([(match.queryIdx, match.trainIdx) for match in matches], dtype=int).reshape(-1, 2)


def _units_per_m(log: Log) -> float | None:
    files = log.entry_at(0).files
    return None if files is None else files.recorded_units_per_m or files.depth_units_per_m


def _rounded(units_per_m: float) -> float:
    """Return a number of two digits, or of one where that is within the error of the scale."""
    coarse = float(f"{units_per_m:.1g}")
    return coarse if abs(coarse / units_per_m - 1.0) < 0.1 else float(f"{units_per_m:.2g}")
