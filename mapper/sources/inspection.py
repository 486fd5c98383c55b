"""Facts of a log, without building anything from it."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mapper.core.errors import DataError, DependencyError, FrameError, SourceError
from mapper.core.frames import Frame, PinholeCamera, RgbdFrame, Scan, Sensor
from mapper.core.timebase import GAP_INTERVALS, MAX_TRUTH_GAP_NS, NS_PER_S, Stamps, check_stamps, nearest
from mapper.core.trajectory import Positions, Trajectory
from mapper.runtime.ordered_map import ordered_map
from mapper.sources import RECORDING, format_of, open_source
from mapper.sources.base import Log
from mapper.sources.config import SourceConfig
from mapper.sources.depth_scale import read_spread, why_no_depth
from mapper.sources.frame_selection import selected
from mapper.sources.image_quality import ImageChecks, ImageQuality
from mapper.sources.plausibility import log_warnings
from mapper.sources.reading_checks import ReadingChecks
from mapper.sources.ros import files as recordings
from mapper.sources.ros.message_index import Series
from mapper.sources.ros.reader import RecordingReader
from mapper.sources.ros.source import recording_log
from mapper.sources.time_offsets import TimeOffset
from mapper.sources.valid_returns import FARTHEST_M
from mapper.sources.vehicle import Box, vehicle_box

_MOST_LOADED = 200
"""Frames of an RGB-D log that are loaded, evenly spread: a second or two of reading, whatever its length."""
_FEW_SCANS = 40
"""Scans of a LiDAR's log that are loaded if it has no more; as text, a single one may take seconds."""

_AT_STAMP = 0.05
"""Part of a sweep within which its first or last point counts as measured at the stamp."""


@dataclass(frozen=True, slots=True)
class Timing:
    """Rate and gaps of messages or frames.

    Attributes:
        count: Number of stamps.
        first_ns: Stamp of the first.
        duration_s: Time from the first to the last.
        rate_hz: One over the median time between two; 0 with fewer than two.
        gaps: Pauses of more than three usual periods.
        longest_gap_s: The longest time between two.
    """

    count: int
    first_ns: int
    duration_s: float
    rate_hz: float
    gaps: int
    longest_gap_s: float


@dataclass(frozen=True, slots=True)
class TopicFacts:
    """Topic of a recording."""

    name: str
    type: str
    encoding: str
    timing: Timing


@dataclass(frozen=True, slots=True)
class LogFacts:
    """Facts of a log that can be mapped.

    Attributes:
        name: Name that the log gives itself.
        kind: Format of the log.
        sensor: "rgbd", "lidar" or "lidar-2d".
        frames: Timing of its frames.
        usable: Number of its frames that can be read and do not repeat one before, by those looked at.
        content: The first frame that can be read, in words, or that none can.
        images: Blur, exposure and overlap of the images; None of a LiDAR, and of small ones.
        point_times: The times of the first scan's points, in words; None without.
        calibration: The camera, in words; None of a LiDAR.
        truth: Description of its truth; None without.
        device_poses: Description of a phone's own estimate of its path; None without.
        wheels: Timing of its wheels' readings; None without.
        wheels_path_m: Length of their path, metres.
        readings: Number of accelerations.
        gyroscope: Timing of its angular velocities; None without.
        gnss: Timing of its GNSS fixes; None without.
        gnss_status: Number of fixes by their status, in words.
        gnss_sigma_m: Median of their horizontal standard deviations, metres; None where none is stated.
        notes: Sentences on what opening it left out or assumed.
        warnings: Sentences on what is implausible about its stamps, depth or scans.
        vehicle: Box around the sensor's own vehicle, least x y z and largest, metres, body frame; None where
            none is seen.
    """

    name: str
    kind: str
    sensor: Sensor
    frames: Timing
    usable: int
    content: str
    images: ImageQuality | None
    point_times: str | None
    calibration: str | None
    truth: str | None
    device_poses: str | None
    wheels: Timing | None
    wheels_path_m: float
    readings: int
    gyroscope: Timing | None
    gnss: Timing | None
    gnss_status: str
    gnss_sigma_m: float | None
    notes: Sequence[str]
    warnings: Sequence[str]
    vehicle: Box | None


@dataclass(frozen=True, slots=True)
class Inspection:
    """Facts of a log, and of a recording's topics.

    Attributes:
        path: File or folder that was opened.
        topics: Every topic, of a recording.
        log: Its frames; None if it has none.
        problem: Why nothing can be mapped; None if something can.
        time_offsets: How late the stamps of its sensors are; None if that was not measured.
    """

    path: Path
    topics: Sequence[TopicFacts]
    log: LogFacts | None
    problem: str | None
    time_offsets: Sequence[TimeOffset] | None = None


def inspect_log(
    path: Path,
    config: SourceConfig,
    *,
    check: Callable[[Log], str | None] = lambda _: None,
    time_offsets: Callable[[Log], Sequence[TimeOffset]] | None = None,
) -> Inspection:
    """Return what is in a log of any kind.

    Args:
        path: The log.
        config: Settings by which it is opened.
        check: Returns why nothing of it can be mapped, as only the settings of the odometry tell; None if
            something can.
        time_offsets: Measures those of a log that can be mapped; None for none.

    Raises:
        SourceError: It is no log of a known format, or is damaged beyond reading.
    """
    if not ((path.is_dir() or path.is_file()) and format_of(path) == RECORDING):
        return _inspected(path, [], open_source(path, config), config, check, time_offsets)
    reader = RecordingReader(recordings.open_recording(path))
    topics = [_topic(series) for series in reader.series.values()]
    try:
        log = selected(recording_log(reader, config), config)
    except (DependencyError, SourceError) as error:
        return Inspection(path, topics, None, str(error))
    return _inspected(path, topics, log, config, check, time_offsets)


def timing_of(stamps_ns: Stamps) -> Timing:
    """Return rate and gaps of one or more stamps in any order."""
    ordered_ns = np.sort(stamps_ns)
    apart_s = np.diff(ordered_ns) / NS_PER_S
    usual_s = float(np.median(apart_s)) if len(apart_s) else 0.0
    return Timing(
        count=len(stamps_ns),
        first_ns=int(ordered_ns[0]),
        duration_s=int(ordered_ns[-1] - ordered_ns[0]) / NS_PER_S,
        rate_hz=1.0 / usual_s if usual_s > 0.0 else 0.0,
        gaps=int((apart_s > GAP_INTERVALS * usual_s).sum()) if usual_s > 0.0 else 0,
        longest_gap_s=float(apart_s.max(initial=0.0)),
    )


def _topic(series: Series) -> TopicFacts:
    topic = series.topic
    return TopicFacts(topic.name, topic.type, topic.encoding, timing_of(series.stamps_ns))


def _inspected(
    path: Path,
    topics: Sequence[TopicFacts],
    source: Log,
    config: SourceConfig,
    check: Callable[[Log], str | None],
    time_offsets: Callable[[Log], Sequence[TimeOffset]] | None,
) -> Inspection:
    checks = ReadingChecks(source)
    images = ImageChecks(len(source))
    readable, damage = _damage(checks, images)  # loads grey images, before the first is loaded in colour
    first, problem = _first_frame(checks.log)
    frames = read_spread(source)
    timing = timing_of(source.stamps_ns)
    log = LogFacts(
        name=source.name,
        kind=source.kind,
        sensor=source.sensor,
        frames=timing,
        usable=readable - len(checks.doubts()),
        content=problem if first is None else _content_text(first),
        images=images.quality(),
        point_times=_times_text(first, timing) if isinstance(first, Scan) else None,
        calibration=_calibration_text(first.camera) if isinstance(first, RgbdFrame) else None,
        truth=None if source.truth is None else _truth_text(source.truth, source.stamps_ns),
        device_poses=None
        if source.device_poses is None
        else _truth_text(source.device_poses, source.stamps_ns),
        wheels=None if source.wheels is None else timing_of(source.wheels.stamps_ns),
        wheels_path_m=0.0 if source.wheels is None else source.wheels.path_length_m,
        readings=0 if source.accelerations is None else len(source.accelerations.stamps_ns),
        gyroscope=None if source.gyroscope is None else timing_of(source.gyroscope.stamps_ns),
        gnss=None if source.gnss is None else timing_of(source.gnss.stamps_ns),
        gnss_status="" if source.gnss is None else source.gnss.status_text,
        gnss_sigma_m=None if source.gnss is None else source.gnss.median_sigma_m,
        notes=[*source.sentences, *damage, *(sentence for _, sentence in checks.notes())],
        warnings=[sentence for _, sentence in log_warnings(source, frames)],
        vehicle=vehicle_box(source) if config.body.finds_box else None,
    )
    why = problem or why_no_depth(source, frames) or _unwritable(source) or check(source)
    offsets = None if why is not None or time_offsets is None else time_offsets(source)
    return Inspection(path, topics, log, why, offsets)


def _unwritable(source: Log) -> str | None:
    """Return why no run can have the log's stamps; None if it can."""
    try:
        check_stamps(source.stamps_ns)
    except DataError as error:
        return str(error)
    return None


def _first_frame(source: Log) -> tuple[Frame | None, str]:
    """Return the first frame that can be read, else None and the reason."""
    reason = ""
    for entry in source.entries():
        try:
            frame = entry.load()
        except FrameError as error:
            reason = reason or str(error)
            continue
        if not isinstance(frame, Scan) or len(frame.points_body):
            return frame, ""
        if not frame.far_returns:
            reason = reason or "it has no returns"
        else:
            reason = reason or (
                f"all {frame.far_returns} returns are farther than {FARTHEST_M:g} m from the origin of their "
                "frame; are they in coordinates of a map (UTM) and not around the sensor?"
            )
    return None, f"no frame can be read: {reason or 'there is none'}"


def _times_text(scan: Scan, timing: Timing) -> str | None:
    """Return when a scan's points were measured, and how much of the time to the next scan that covers."""
    if scan.times_s is None or not len(scan.times_s):
        return None
    first_ms, last_ms = (1e3 * float(extreme) for extreme in (scan.times_s.min(), scan.times_s.max()))
    near_ms = _AT_STAMP * (last_ms - first_ms)
    at = next((name for name, ms in (("first", first_ms), ("last", last_ms)) if abs(ms) <= near_ms), None)
    which = "" if at is None else f", which is that of the {at} point"
    text = f"{first_ms:.1f} … {last_ms:.1f} ms after the stamp{which}"
    if timing.rate_hz == 0.0:
        return text
    return f"{text}, {(last_ms - first_ms) / 1e3 * timing.rate_hz:.0%} of the time between scans"


def _content_text(frame: Frame) -> str:
    if isinstance(frame, Scan):
        far_m = float(np.linalg.norm(frame.points_body, axis=1).max(initial=0.0))
        timed = "with" if frame.times_s is not None else "without"
        return f"scans, the first of {len(frame.points_body)} points to {far_m:.0f} m, {timed} times"
    measured = float((frame.depth_m > 0.0).mean())
    colour = "colour" if frame.image.ndim == 3 else "grey"
    size = f"{frame.camera.width_px}×{frame.camera.height_px} px"
    return f"{colour} and depth of {size}, the first {measured:.0%} measured"


def _calibration_text(camera: PinholeCamera) -> str:
    numbers = ", ".join(f"{v:g}" for v in camera.intrinsics)
    distortion = ", ".join(f"{k:g}" for k in camera.distortion) if any(camera.distortion) else "none"
    return f"fx fy cx cy {numbers} px, distortion {distortion}"


def _damage(checks: ReadingChecks, images: ImageChecks) -> tuple[int, list[str]]:
    """Load frames from all over a log; return how many can be read, and a note if some cannot.

    Around images that repeat all frames are loaded, so that the checks find where that begins and ends; and
    some beside those looked at, which share their view.
    """
    frames = len(checks.log)
    if checks.log.sensor != "rgbd" and frames > _FEW_SCANS:
        return frames, []
    step = -(-frames // _MOST_LOADED)
    looked_at = range(0, frames, step)
    reasons = _unreadable(checks.log, looked_at, images)
    notes = []
    if reasons:
        notes = [
            f"{len(reasons)} of {len(looked_at)} frames looked at cannot be read; the first: {reasons[0]}"
        ]
    for run in (*checks.repeated("image", fewest=2), *checks.repeated("depth", fewest=2)):
        _unreadable(checks.log, range(max(run.start - step, 0), run.start))
        _unreadable(checks.log, range(run.stop, min(run.stop + step, frames)))
    _unreadable(checks.log, images.missing, images)
    return round(frames * (1.0 - len(reasons) / len(looked_at))), notes


def _unreadable(log: Log, indices: Iterable[int], images: ImageChecks | None = None) -> list[str]:
    """Load some frames, whose images are measured, and return why others cannot be loaded."""

    def reason(index: int) -> str | None:
        try:
            frame = log.entry_at(index).load(colour=False)
        except FrameError as error:
            return str(error)
        if images is not None and isinstance(frame, RgbdFrame):
            images.add(index, frame)
        return None

    reasons = ordered_map(reason, indices)
    return [why for why in reasons if why is not None]


def _truth_text(truth: Trajectory, stamps_ns: Stamps) -> str:
    _, gap_ns = nearest(truth.stamps_ns, stamps_ns)
    near = int((gap_ns <= MAX_TRUTH_GAP_NS).sum())
    what = "positions" if isinstance(truth, Positions) else "poses"
    return (
        f"{len(truth)} {what} over {truth.path_length_m:.1f} m, "
        f"within {MAX_TRUTH_GAP_NS / 1e6:g} ms of {near} of {len(stamps_ns)} frames"
    )
