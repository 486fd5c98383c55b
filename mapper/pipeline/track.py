"""The first pass over a log: every frame tracked in order, and the pose graph that grows from it."""

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

from mapper.config.build import BuildConfig
from mapper.core.errors import ConfigError, FrameError, TrackingError
from mapper.core.frames import Sensor
from mapper.core.trajectory import Trajectory, trajectory_from
from mapper.features.frame_view import FrameView
from mapper.graph.model import BetweenFactor, PoseGraph
from mapper.graph.wheel_factors import WheelMeasurements, wheel_conflict
from mapper.loops.closure import LoopClosure, accepted_loops
from mapper.loops.detector import LoopDetector
from mapper.loops.factory import build_loop_detector, build_verifier
from mapper.loops.place_file import AnyPlace, write_places
from mapper.loops.verification_log import VerificationLog
from mapper.odometry.base import FrameResult, HindsightOdometry, Odometry, SensorCheck
from mapper.odometry.factory import build_odometry, odometry_for
from mapper.pipeline.tracking_checkpoints import FrameCheckpoint, TrackingCheckpoints
from mapper.run import files
from mapper.run.doubtful_frames import placed_by_neighbours
from mapper.run.frame_outcomes import records_of
from mapper.run.manifest import RunWarning
from mapper.run.observers import NULL_OBSERVER, Observer, Step
from mapper.run.stored_tracking import StoredTracking
from mapper.run.writer import RunWriter
from mapper.runtime.ordered_map import ordered_map
from mapper.runtime.progress import Progress
from mapper.sources.base import FrameRef, Log, Skipped
from mapper.sources.depth_scale import depth_warnings
from mapper.sources.reading_checks import ReadingChecks

_BY_POSES = ("wheels", "given")
"""Kinds of odometry without tracking: frames have the poses of wheels, or known ones."""

_HINTS: Mapping[str, str] = {
    "rgbd": "is there texture, and depth in the images?",
    "lidar": "do the scans overlap, and are their units metres?",
    "wheels": "do the wheels' readings cover the frames' times, without gaps beyond odometry.max_gap_s?",
    "given": "do the given poses cover the frames' times, without gaps beyond odometry.max_gap_s?",
}


@dataclass(frozen=True, slots=True, eq=False)
class TrackingResult:
    """Result of the first pass over a log.

    Attributes:
        tracks: One per frame that could be read, in time order.
        skipped: The frames that could not be read.
        graph: Nodes at the odometry's estimates, with every factor, those of the loops last.
        loops: Every loop candidate with its verdict.
        frame_ms: Wall milliseconds that each frame took to read, detect and track, by stamp.
        warnings: What is suspicious about the frames that were read.
        places: What the nodes are recognised by, of those that were searched for loops.
    """

    tracks: tuple[FrameResult, ...]
    skipped: tuple[Skipped, ...]
    graph: PoseGraph
    loops: tuple[LoopClosure, ...]
    frame_ms: Mapping[int, float]
    warnings: Sequence[RunWarning] = ()
    places: Mapping[int, AnyPlace] = field(default_factory=dict)

    @property
    def placed(self) -> list[FrameResult]:
        """The results of the frames that were not lost."""
        return [track for track in self.tracks if track.node is not None]

    @property
    def tracked(self) -> list[FrameResult]:
        """The results of the frames that were placed without a doubt."""
        return [track for track in self.placed if not track.doubts]

    def trajectory(self) -> Trajectory:
        """Return T_world_body = T_world_node · T_node_body of every frame that was not lost."""
        return self._poses(self.placed)

    def tracked_trajectory(self) -> Trajectory:
        """Return the same of the frames that were placed without a doubt."""
        return self._poses(self.tracked)

    def _poses(self, tracks: Sequence[FrameResult]) -> Trajectory:
        return trajectory_from(
            (track.stamp_ns, self.graph.T_world_node[track.node] @ track.T_node_body)
            for track in tracks
            if track.node is not None
        )


@dataclass(frozen=True, slots=True, eq=False)
class Start:
    """State that tracking begins with.

    Attributes:
        odometry: Before its first frame.
        detector: Loop detector with the places of earlier sessions.
        graph: Graph of earlier sessions, without loops.
        loops: The candidates of earlier sessions.
        searches: The detector's verifier, if its searches can be repeated; None if there are none.
    """

    odometry: Odometry[Any]
    detector: LoopDetector
    graph: PoseGraph
    loops: Sequence[LoopClosure] = ()
    searches: VerificationLog | None = None


def first_session(
    source: Log, config: BuildConfig, odometry: Odometry[Any] | Trajectory | None = None
) -> Start:
    """Return the start of a log that is the first of its place.

    Args:
        source: The log.
        config: All settings.
        odometry: A caller's own, before its first frame, or its poses; None is that of the configuration.

    Raises:
        ConfigError: The odometry needs wheels or poses and there are none, or the loops need feature counts.
    """
    if config.odometry.kind in _BY_POSES and config.loops.kind == "thesis":
        raise ConfigError(
            "loops.kind=thesis looks from frames with many features, and "
            f"odometry.kind={config.odometry.kind} counts none; want loops.kind=places, scans or none"
        )
    if odometry is None:
        odometry = odometry_for(config.odometry, source, wheel_measurements(source, config))
    elif isinstance(odometry, Trajectory):
        odometry = build_odometry(config.odometry, odometry)
    loops = config.loops
    searches = None if loops.kind == "none" else VerificationLog(build_verifier(loops.verification))
    detector = build_loop_detector(loops, config.graph.solve, searches)
    return Start(odometry, detector, PoseGraph(), searches=searches)


def track_log(
    source: Log,
    config: BuildConfig,
    *,
    progress: Progress,
    start: Start | None = None,
    observer: Observer = NULL_OBSERVER,
    checkpoints: TrackingCheckpoints | None = None,
) -> TrackingResult:
    """Track every frame of a log, in time order; reading and detecting run ahead in threads.

    A frame that cannot be read is skipped and reported, not fatal.

    Args:
        source: The log.
        config: All settings.
        progress: Receives the stage, its counts, and notes.
        start: Odometry, loop detector and graph to begin with: the graph and the loops that are returned are
            those of all sessions, the tracks those of this log. None is those of a first session.
        observer: Receives every frame that is tracked now.
        checkpoints: Tracking goes on after the frames that these have; None makes none.

    Raises:
        ConfigError: The odometry needs wheels or poses and there are none, or the loops need feature counts.
    """
    start = start or first_session(source, config)
    odometry, checks = start.odometry, ReadingChecks(source)
    known: Sequence[FrameCheckpoint] = ()
    if checkpoints is not None:
        state = checkpoints.restore(odometry, checks)
        odometry, known = state.odometry, state.frames
    searches = start.searches or VerificationLog(None)
    first_pass = _FirstPass(start, wheel_measurements(source, config))
    first_pass.repeat(known, searches)
    entries = map(checks.log.entry_at, range(len(known), len(source)))
    observations = ordered_map(partial(_observe, odometry), entries, workers=config.workers)
    with progress.stage("track") as report:
        for done, (entry, observation, observed_s) in enumerate(observations, start=len(known) + 1):
            report(done, len(source))
            ms, result = 0.0, observation
            if isinstance(observation, Skipped):
                first_pass.skipped.append(observation)
                progress.note(f"skipped: {observation.reason}")
            else:
                began = time.perf_counter()
                result = odometry.track(observation)
                view = partial(odometry.view, observation, result.twist)
                first_pass.add(result, view)
                ms = first_pass.frame_ms[result.stamp_ns] = 1e3 * (observed_s + time.perf_counter() - began)
                observer.on_frame(Step(entry, result, view, odometry.matches, start.detector))
            search = searches.take()
            if checkpoints is not None:
                checkpoints.add(FrameCheckpoint(result, search, ms, checks.reading(done - 1)), odometry)
    return first_pass.result(odometry, checks, progress)


def _observe(odometry: Odometry[Any], entry: FrameRef) -> tuple[FrameRef, Any, float]:
    """Return a frame with what odometry needs of it, or why it is skipped, and the seconds that took."""
    began = time.perf_counter()
    try:
        observation = odometry.read(entry)
    except FrameError as error:
        observation = Skipped(entry.stamp_ns, str(error))
    return entry, observation, time.perf_counter() - began


class _FirstPass:
    """First pass over a log, as far as it has come.

    Attributes:
        skipped: The frames that could not be read.
        frame_ms: Wall milliseconds that each frame took, by stamp.
    """

    def __init__(self, start: Start, wheels: WheelMeasurements) -> None:
        """Begin behind earlier sessions.

        Args:
            start: Graph, loops and loop detector of these.
            wheels: Measurements of the log's wheels.
        """
        before = start.graph
        self.skipped: list[Skipped] = []
        self.frame_ms: dict[int, float] = {}
        self._start = start
        self._graph = PoseGraph(dict(before.T_world_node), dict(before.stamps_ns), list(before.factors))
        self._tracks: list[FrameResult] = []
        self._wheels = wheels
        self._wheel_factors: list[BetweenFactor] = []

    def add(self, track: FrameResult, view: Callable[[], FrameView]) -> None:
        """Add a tracked frame; loops are searched from keyframes, whose views are made where needed."""
        if track.is_keyframe and track.node is not None:
            self._graph.add_node(track.node, track.stamp_ns, track.T_world_body)
            driven = self._wheels.link(track.node, track.stamp_ns)
            self._start.detector.add(track.node, replace(track, links=(*track.links, *driven)), view)
            self._wheel_factors.extend(driven)
        self._graph.add_factors(track.factors)
        self._tracks.append(track)

    def repeat(self, frames: Iterable[FrameCheckpoint], searches: VerificationLog) -> None:
        """Add frames that an earlier process has tracked, with what its searches for loops found."""
        for frame in frames:
            if isinstance(frame.result, Skipped):
                self.skipped.append(frame.result)
                continue
            searches.repeat(frame.search)
            self.add(frame.result, searches.view)
            self.frame_ms[frame.result.stamp_ns] = frame.frame_ms
        searches.repeat(None)

    def result(self, odometry: Odometry[Any], checks: ReadingChecks, progress: Progress) -> TrackingResult:
        """Return the result of all frames; nothing is added afterwards."""
        tracks = _in_hindsight(self._tracks, odometry, checks)
        self._graph.add_factors(odometry.finish())
        warnings = self._warnings(odometry, checks)
        for warning in warnings:
            progress.note(warning.sentence)
        self._graph.add_factors(self._wheel_factors)
        detector = self._start.detector
        loops = (*self._start.loops, *detector.closures())
        self._graph.add_factors(loop.factor for loop in accepted_loops(loops))
        return TrackingResult(
            tuple(tracks),
            tuple(self.skipped),
            self._graph,
            loops,
            self.frame_ms,
            warnings,
            detector.places(),
        )

    def _warnings(self, odometry: Odometry[Any], checks: ReadingChecks) -> list[RunWarning]:
        """Return what is suspicious about the frames that were read."""
        conflicts = self._start.detector.notes()
        if conflict := wheel_conflict(self._graph, self._wheel_factors):
            conflicts = [*conflicts, conflict]
        warnings = [
            *(RunWarning(kind="frozen", sentence=note, weight="doubt") for note in checks.frozen()),
            *(RunWarning(kind="far returns", sentence=note) for note in checks.far_returns()),
            *(RunWarning(kind="conflict", sentence=note, weight="doubt") for note in conflicts),
        ]
        if isinstance(odometry, SensorCheck):
            wrong = odometry.calibration_doubts()
            warnings += [RunWarning(kind="camera", sentence=sentence, weight="doubt") for sentence in wrong]
            warnings += [RunWarning(kind="shutter", sentence=note) for note in odometry.sensor_notes()]
        return warnings


def _in_hindsight(
    tracks: Iterable[FrameResult], odometry: Odometry[Any], checks: ReadingChecks
) -> list[FrameResult]:
    """Return the frames' results with the doubts that later frames and the readings add."""
    if isinstance(odometry, HindsightOdometry):
        tracks = map(odometry.in_hindsight, tracks)
    doubts = checks.doubts()
    return [
        replace(track, doubts=track.doubts or tuple(doubts.get(track.stamp_ns, ())))
        if track.node is not None
        else track
        for track in tracks
    ]


def wheel_measurements(source: Log, config: BuildConfig) -> WheelMeasurements:
    """Return the log's wheel measurements, for factors; none where wheels are the odometry."""
    wheels = None if config.odometry.kind in _BY_POSES else source.wheels
    return WheelMeasurements(wheels, config.graph.wheels)


def refuse_a_fragment(tracking: TrackingResult, config: BuildConfig, *, sensor: Sensor) -> None:
    """Refuse to make a map from too little.

    Raises:
        TrackingError: Fewer frames were tracked, without a doubt, than the configuration asks for.
    """
    read, tracked = len(tracking.tracks), len(tracking.tracked)
    enough = max(config.min_tracked_frames, config.min_tracked_ratio * read)
    if tracked >= enough:
        return
    if read == 0 and tracking.skipped:
        raise TrackingError(
            f"none of {len(tracking.skipped)} frames could be read; the first: {tracking.skipped[0].reason}"
        )
    unread = ""
    if tracking.skipped:
        unread = f"; {len(tracking.skipped)} could not be read, the first: {tracking.skipped[0].reason}"
    if tracked == read:
        raise TrackingError(
            f"only {read} {'frame was' if read == 1 else 'frames were'} read, want at least {enough:.0f} "
            f"(min_tracked_frames); give more of the log{unread}"
        )
    hint = _HINTS[config.odometry.kind if config.odometry.kind in _BY_POSES else sensor]
    doubtful = len(tracking.placed) - tracked
    found = f"only {tracked} of {read} frames read could be tracked"
    if doubtful:
        found += f", {doubtful} more are doubtful"
    raise TrackingError(
        f"{found}, want at least {enough:.0f}; {hint} "
        f"(min_tracked_frames and min_tracked_ratio set the limit){unread}"
    )


def save_places(writer: RunWriter, tracking: TrackingResult) -> None:
    """Write the places of the nodes that are in the graph; none, if no loops were searched."""
    nodes = [node for node in tracking.places if node in tracking.graph.T_world_node]
    if nodes:
        write_places(writer.folder / files.PLACES, tracking.places, nodes)


def depth_cautions(source: Log) -> list[RunWarning]:
    """Return what is implausible about an RGB-D log's depth, before it is tracked."""
    return [RunWarning(kind="depth", sentence=text, weight="doubt") for text in depth_warnings(source)]


def from_tracking(tracking: TrackingResult, truth: Trajectory | None) -> StoredTracking:
    """Return what the first pass over a log found."""
    records = records_of(tracking.tracks, tracking.skipped)
    return StoredTracking(
        records=records,
        skipped=tracking.skipped,
        frame_ms=tracking.frame_ms,
        trajectory=placed_by_neighbours(tracking.trajectory(), tracking.graph, records),
        graph=tracking.graph,
        loops=tracking.loops,
        truth=truth,
    )
