"""The first pass over a log: every frame tracked in order, and the pose graph that grows from it."""

import time
from collections.abc import Callable, Iterable, Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from mapper.config.build import BuildConfig
from mapper.core.errors import ConfigError, DataError, FrameError
from mapper.core.trajectory import Trajectory
from mapper.features.frame_view import FrameView
from mapper.graph.components import component_numbers
from mapper.graph.model import BetweenFactor, PoseGraph
from mapper.graph.wheel_factors import WheelMeasurements, wheel_conflict
from mapper.loops.closure import LoopClosure, accepted_loops
from mapper.loops.detector import LoopDetector
from mapper.loops.factory import build_loop_detector, build_verifier
from mapper.loops.verification_log import VerificationLog
from mapper.odometry.base import FrameResult, GyroscopeUser, Odometry, SensorCheck
from mapper.odometry.factory import build_odometry, odometry_for
from mapper.odometry.gyroscope_calibration import with_body_rates
from mapper.pipeline.disconnected_components import without_doubtful_ends
from mapper.pipeline.tracking_checkpoints import FrameCheckpoint, TrackingCheckpoints
from mapper.pipeline.tracking_result import BY_POSES, TrackingResult
from mapper.pipeline.trajectory_spikes import with_doubtful_spikes
from mapper.run.manifest import RunWarning
from mapper.run.observers import NULL_OBSERVER, Observer, Step
from mapper.runtime.ordered_map import ordered_map
from mapper.runtime.progress import Progress
from mapper.sensing.gyroscope import Gyroscope
from mapper.sources.base import FrameRef, Log, Skipped
from mapper.sources.depth_scale import read_spread, why_no_depth
from mapper.sources.merged_scans import with_merged_scans
from mapper.sources.plausibility import log_warnings
from mapper.sources.reading_checks import ReadingChecks

_MOST_TRACKED_TWICE = 40
"""Scans by which a gyroscope is calibrated in advance; 8 to 21 show a mounting if the sensor turns."""
_LOOKED_AT = 6
"""Frames, spread over a log, that are tried before it is said that none can be tracked."""


@dataclass(frozen=True, slots=True, eq=False)
class Start:
    """State that tracking begins with.

    Attributes:
        odometry: Before its first frame; its node 0 gets the number after those of ``graph``.
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

    @property
    def first_node(self) -> int:
        """Number of the odometry's first node."""
        return max(self.graph.T_world_node, default=-1) + 1


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
    if config.odometry.kind in BY_POSES and config.loops.kind == "thesis":
        raise ConfigError(
            "loops.kind=thesis looks from frames with many features, and "
            f"odometry.kind={config.odometry.kind} counts none; want loops.kind=places, scans or none"
        )
    if odometry is None:
        odometry = session_odometry(source, config)
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
        checkpoints: Checkpoints, after whose frames tracking is resumed; None makes none.

    Raises:
        ConfigError: The odometry needs wheels or poses and there are none, or the loops need feature counts.
    """
    start = start or first_session(source, config)
    odometry, first_node, checks = start.odometry, start.first_node, ReadingChecks(source)
    read = with_merged_scans(checks.log) if config.source.topics.others == "tracked" else checks.log
    known: Sequence[FrameCheckpoint] = ()
    if checkpoints is not None:
        state = checkpoints.restore(odometry, checks)
        odometry, known = state.odometry, state.frames
    searches = start.searches or VerificationLog(None)
    first_pass = _FirstPass(
        start, _wheel_measurements(source, config), are_predicted=source.sensor == "lidar-2d"
    )
    first_pass.repeat(known, searches)
    if not known and source.sensor != "rgbd":
        begin_calibrated(odometry, read, config.workers)
    entries = map(read.entry_at, range(len(known), len(source)))
    observations = ordered_map(partial(_observe, odometry), entries, workers=config.workers)
    with progress.stage("track") as report:
        for done, observed in enumerate(observations, start=len(known) + 1):
            report(done, len(source))
            result: FrameResult | Skipped
            if isinstance(observed.observation, Skipped):
                result, ms = observed.observation, 0.0
                first_pass.skipped.append(result)
                progress.note(f"skipped: {result.reason}")
            else:
                began = time.perf_counter()
                result = odometry.track(observed.observation).renumbered(first_node)
                view = partial(odometry.view, observed.observation, result.twist)
                first_pass.add(result, view)
                ms = 1e3 * (observed.seconds + time.perf_counter() - began)
                first_pass.frame_ms[result.stamp_ns] = ms
                observer.on_frame(Step(observed.entry, result, view, odometry.matches, start.detector))
            search = searches.take()
            if checkpoints is not None:
                checkpoints.add(FrameCheckpoint(result, search, ms, checks.reading(done - 1)), odometry)
    return first_pass.result(odometry, checks, progress)


def begin_calibrated(odometry: Odometry[Any], log: Log, workers: int) -> None:
    """Calibrate the gyroscope of an odometry before its first frame, by tracking the first scans in advance.

    LI-Init (Zhu et al. 2022) does so, too: sweeps are bent until the gyroscope's mounting is known. Nothing
    happens where the log has no gyroscope, states its mounting, or its first scans do not show it.
    """
    if log.gyroscope is None or log.gyroscope.R_body_imu is not None:
        return
    if not isinstance(odometry, GyroscopeUser):
        return
    trial = deepcopy(odometry)
    entries = map(log.entry_at, range(min(len(log), _MOST_TRACKED_TWICE)))
    for frames, observed in enumerate(ordered_map(partial(_observe, trial), entries, workers=workers), 1):
        if isinstance(observed.observation, Skipped):
            continue
        trial.track(observed.observation)
        calibration = trial.gyroscope_calibration()
        if calibration is not None and calibration.is_mounting_known:
            odometry.begin_calibrated(calibration, frames)
            return


@dataclass(frozen=True, slots=True, eq=False)
class _Observed:
    """A frame that has been read.

    Attributes:
        entry: The frame.
        observation: What the odometry needs of it, or why it is skipped.
        seconds: Time that reading took.
    """

    entry: FrameRef
    observation: Any
    seconds: float


def _observe(odometry: Odometry[Any], entry: FrameRef) -> _Observed:
    """Read a frame as the odometry needs it."""
    began = time.perf_counter()
    try:
        observation = odometry.read(entry)
    except FrameError as error:
        observation = Skipped(entry.stamp_ns, str(error))
    return _Observed(entry, observation, time.perf_counter() - began)


class _FirstPass:
    """First pass over a log, as far as it has come.

    Attributes:
        skipped: The frames that could not be read.
        tracks: The others' results.
        frame_ms: Wall milliseconds that each frame took, by stamp.
    """

    def __init__(self, start: Start, wheels: WheelMeasurements, *, are_predicted: bool) -> None:
        """Begin behind earlier sessions.

        Args:
            start: Graph, loops and loop detector of these.
            wheels: Measurements of the log's wheels.
            are_predicted: The odometry's own factors have what the wheels measured.
        """
        self.skipped: list[Skipped] = []
        self.frame_ms: dict[int, float] = {}
        self._start = start
        self.tracks: list[FrameResult] = []
        self._wheels, self._are_predicted = wheels, are_predicted
        self._wheel_factors: list[BetweenFactor] = []

    def add(self, track: FrameResult, view: Callable[[], FrameView]) -> None:
        """Add a tracked frame; loops are searched from keyframes, whose views are made where needed."""
        if track.is_keyframe and track.node is not None:
            driven = self._wheels.link(track.node, track.stamp_ns)
            self._start.detector.add(track.node, replace(track, links=(*track.links, *driven)), view)
            self._wheel_factors.extend(driven)
        self.tracks.append(track)

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

    def result(
        self,
        odometry: Odometry[Any],
        checks: ReadingChecks,
        progress: Progress,
    ) -> TrackingResult:
        """Return the result of all frames; nothing is added afterwards."""
        calibration = odometry.gyroscope_calibration() if isinstance(odometry, GyroscopeUser) else None
        gyroscope = None if calibration is None else with_body_rates(checks.log, calibration).gyroscope
        last = [factor.renumbered(self._start.first_node) for factor in odometry.finish()]
        tracks = _in_hindsight(self.tracks, last, checks, gyroscope)
        before = self._start.graph
        graph = PoseGraph(
            dict(before.T_world_node), dict(before.stamps_ns), list(before.factors), fixes=before.fixes
        )
        for track in tracks:
            if track.is_keyframe and track.node is not None:
                graph.add_node(track.node, track.stamp_ns, track.T_world_body)
            graph.add_factors(track.factors)
        warnings = self._warnings(graph, odometry, checks)
        for warning in warnings:
            progress.note(warning.sentence)
        graph.add_factors(self._new_wheel_factors(graph))
        detector = self._start.detector
        loops = (*self._start.loops, *detector.closures())
        graph.add_factors(loop.factor for loop in accepted_loops(loops))
        tracks, graph = without_doubtful_ends(tracks, graph)
        return TrackingResult(
            tuple(tracks),
            tuple(self.skipped),
            graph,
            loops,
            self.frame_ms,
            warnings,
            detector.places(),
            calibration,
        )

    def _new_wheel_factors(self, graph: PoseGraph) -> list[BetweenFactor]:
        """Return the wheel factors that tell more than the odometry's: none within a part that it predicted.

        Wheels that slip alike all the time would stretch the path by a little in every step.
        """
        if not self._are_predicted:
            return self._wheel_factors
        part_of = component_numbers(graph)
        return [factor for factor in self._wheel_factors if part_of[factor.i] != part_of[factor.j]]

    def _warnings(self, graph: PoseGraph, odometry: Odometry[Any], checks: ReadingChecks) -> list[RunWarning]:
        """Return what is suspicious about the frames that were read, and their graph without wheels."""
        conflicts = self._start.detector.notes()
        if conflict := wheel_conflict(graph, self._wheel_factors):
            conflicts = [*conflicts, conflict]
        warnings = [
            *(RunWarning(kind=kind, sentence=sentence) for kind, sentence in checks.notes()),
            *(RunWarning(kind="conflict", sentence=note, weight="doubt") for note in conflicts),
        ]
        if isinstance(odometry, SensorCheck):
            wrong = odometry.calibration_warnings()
            warnings += [RunWarning(kind="camera", sentence=sentence, weight="doubt") for sentence in wrong]
            warnings += [RunWarning(kind="shutter", sentence=note) for note in odometry.sensor_notes()]
        if isinstance(odometry, GyroscopeUser):
            warnings += [RunWarning(kind="imu", sentence=note) for note in odometry.gyroscope_notes()]
        return warnings


def _in_hindsight(
    tracks: Sequence[FrameResult],
    last: Sequence[BetweenFactor],
    checks: ReadingChecks,
    gyroscope: Gyroscope | None,
) -> list[FrameResult]:
    """Return the frames' results with the ``last`` factors, and with what later frames and readings add.

    ``gyroscope`` gives the angular velocities of the body, if they are known.
    """
    if tracks:
        tracks = [*tracks[:-1], replace(tracks[-1], factors=(*tracks[-1].factors, *last))]
    tracks, doubts = with_doubtful_spikes(tracks, gyroscope), checks.doubts()
    return [
        replace(track, doubts=track.doubts or tuple(doubts.get(track.stamp_ns, ())))
        if track.node is not None
        else track
        for track in tracks
    ]


def session_odometry(source: Log, config: BuildConfig) -> Odometry[Any]:
    """Return the configured odometry of a log, before its first frame; the log's wheels check its gaps.

    Raises:
        ConfigError: It needs wheels or poses and there are none.
    """
    check = _wheel_measurements(source, config)
    return odometry_for(config.odometry, source, check, config.graph.wheels)


def why_untrackable(source: Log, config: BuildConfig) -> str | None:
    """Return why none of some frames, spread over a log, can be tracked; None if one can."""
    try:
        odometry = session_odometry(source, config)
    except (ConfigError, DataError) as error:
        return str(error)
    first = None
    for entry in source.spread_entries(_LOOKED_AT):
        observation = _observe(odometry, entry).observation
        if not isinstance(observation, Skipped):
            return None
        first = first or observation.reason
    return first


def _wheel_measurements(source: Log, config: BuildConfig) -> WheelMeasurements:
    """Return the log's wheel measurements, for factors; none where wheels are the odometry."""
    wheels = None if config.odometry.kind in BY_POSES else source.wheels
    return WheelMeasurements(wheels, config.graph.wheels)


def noted_log_warnings(source: Log, progress: Progress) -> list[RunWarning]:
    """Return what is implausible about a log's stamps, depth or scans, before it is tracked, and note it.

    Raises:
        DataError: Its depth is none that a camera measures.
    """
    frames = read_spread(source)
    if (why := why_no_depth(source, frames)) is not None:
        raise DataError(f"{source.path}: {why}")
    warnings = [
        RunWarning(kind=kind, sentence=sentence, weight="doubt")
        for kind, sentence in log_warnings(source, frames)
    ]
    for warning in warnings:
        progress.note(warning.sentence)
    return warnings
