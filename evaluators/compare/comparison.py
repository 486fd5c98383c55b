"""Every method on one log: the same frames, prepared in the same way, as odometry and pair by pair."""

import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np

from evaluators.compare.catalogue import methods_for
from evaluators.compare.config import CompareConfig, TrialsConfig
from evaluators.compare.frames import Moment, Reader
from evaluators.compare.methods import Method, Tracker, reason_of
from evaluators.compare.pairwise import Trial, guesses_for, pairs_of, trials_of
from evaluators.metrics.odometry import OdometryRun, Step, judged_run, step_for
from mapper.core.errors import DataError, FrameError
from mapper.core.frames import Sensor
from mapper.core.geometry import inverse
from mapper.core.timebase import MAX_TRUTH_GAP_NS, Stamps
from mapper.core.trajectory import Trajectory, trajectory_from
from mapper.runtime.progress import SILENT, Progress
from mapper.sources.base import Log, Skipped

_WARM_UP_FRAMES = 2


@dataclass(frozen=True, slots=True, eq=False)
class Comparison:
    """What the methods come to on one log.

    Attributes:
        path: Where it lies.
        log: What it calls itself.
        sensor: What took it.
        config: How the methods were compared.
        truth: Where the body really was while the log was taken, if it tells.
        runs: Each method over the whole log.
        step: Of the runs' relative errors.
        trials: Every registration of every pair.
        read_ms: What reading a frame takes of the CPU, for all methods alike and not counted as theirs.
        scan_ms: What making its scan takes, likewise.
        skipped: Frames that could not be read.
        notes: What had to be left out, a sentence each.
    """

    path: Path
    log: str
    sensor: Sensor
    config: CompareConfig
    truth: Trajectory | None
    runs: tuple[OdometryRun, ...]
    step: Step
    trials: tuple[Trial, ...]
    read_ms: float
    scan_ms: float
    skipped: tuple[Skipped, ...]
    notes: tuple[str, ...]

    @property
    def trials_config(self) -> TrialsConfig:
        """Which registrations were tried, and what counts as right."""
        return trials_config(self.config, self.sensor)


def trials_config(config: CompareConfig, sensor: Sensor) -> TrialsConfig:
    """Return which registrations are tried on logs of a sensor."""
    return config.rgbd if sensor == "rgbd" else config.lidar


def compare(source: Log, config: CompareConfig, *, progress: Progress = SILENT) -> Comparison:
    """Run every chosen method over the whole log, and on pairs of its frames.

    Frames are read one at a time and shown to one method after the other, so memory does not grow with the
    log. Times are of the CPU: they are what one core would take, whatever else the machine does. A method
    that breaks down is told with its reason, and the others go on.

    Raises:
        ConfigError: No method of such a name, or none of them can use the log.
        DataError: No frame can be read.
    """
    methods, notes = methods_for(source, config)
    reader = Reader(config.rgbd)
    _warm_up(source, methods, config)
    racers, stamps_ns, skipped = _race(source, methods, reader, progress=progress)
    step = step_for(stamps_ns)
    truth = None if source.truth is None else _while(source.truth, stamps_ns)
    runs = tuple(racer.run(truth, step) for racer in racers)
    trials: list[Trial] = []
    if truth is None:
        notes = [*notes, "the log has no truth for these frames: no errors, and no registration of pairs"]
    elif config.pairs:
        trials = _register(source, methods, truth, config, progress=progress)
    return Comparison(
        path=source.path,
        log=source.name,
        sensor=source.sensor,
        config=config,
        truth=truth,
        runs=runs,
        step=step,
        trials=tuple(trials),
        read_ms=1e3 * reader.read_s / max(reader.frames, 1),
        scan_ms=1e3 * reader.scan_s / max(reader.frames, 1),
        skipped=tuple(skipped),
        notes=tuple(notes),
    )


class _Racer:
    """One method on its way through the log."""

    def __init__(self, method: Method) -> None:
        self._method = method
        self._tracker: Tracker | None = None
        self._T_body_seen = np.eye(4)
        self._frames = self._failures = 0
        self._seconds = 0.0
        self._broke = ""

    def add(self, moment: Moment) -> None:
        """Show the method the next frame, unless it has broken down."""
        if self._broke:
            return
        self._T_body_seen = np.eye(4) if self._method.sees_images else moment.T_body_scan
        began = time.process_time()
        try:
            self._tracker = self._tracker or self._method.tracker()
            self._failures += not self._tracker.add(self._method.view(moment))
        except Exception as error:  # a library's breakdown is a result, and the other methods go on
            self._broke = f"broke down at frame {self._frames}: {reason_of(error)}"
        self._seconds += time.process_time() - began
        self._frames += 1

    def run(self, truth: Trajectory | None, step: Step) -> OdometryRun:
        """Return what became of the method."""
        began = time.process_time()
        trajectory = trajectory_from(())
        if self._tracker is not None and not self._broke:
            try:
                trajectory = self._tracker.trajectory()
            except Exception as error:  # as above
                self._broke = f"broke down at the end: {reason_of(error)}"
        self._seconds += time.process_time() - began
        run = OdometryRun(
            method=self._method.name,
            frames=self._frames,
            failures=self._failures,
            seconds=self._seconds,
            trajectory=Trajectory(trajectory.stamps_ns, trajectory.T_world_body @ inverse(self._T_body_seen)),
            broke=self._broke,
        )
        return judged_run(run, truth, step)


def _race(
    source: Log, methods: Sequence[Method], reader: Reader, *, progress: Progress
) -> tuple[list[_Racer], Stamps, list[Skipped]]:
    """Show every frame to every method."""
    racers = [_Racer(method) for method in methods]
    stamps_ns: list[int] = []
    skipped: list[Skipped] = []
    with progress.stage("follow") as report:
        for done, entry in enumerate(source.entries(), start=1):
            try:
                moment = reader.read(entry)
            except FrameError as error:
                skipped.append(Skipped(entry.stamp_ns, str(error)))
                progress.note(f"skipped: {error}")
                continue
            for racer in racers:
                racer.add(moment)
            stamps_ns.append(entry.stamp_ns)
            report(done, len(source))
    if not stamps_ns:
        raise DataError(
            f"{source.path}: none of {len(source)} frames can be read; the first: {skipped[0].reason}"
        )
    return racers, np.array(stamps_ns, np.int64), skipped


def _while(truth: Trajectory, stamps_ns: Stamps) -> Trajectory | None:
    """Return the true poses from the first frame to the last; None if there are none."""
    first_ns, last_ns = stamps_ns[0] - MAX_TRUTH_GAP_NS, stamps_ns[-1] + MAX_TRUTH_GAP_NS
    near = (truth.stamps_ns >= first_ns) & (truth.stamps_ns <= last_ns)
    return Trajectory(truth.stamps_ns[near], truth.T_world_body[near]) if near.any() else None


def _register(
    source: Log,
    methods: Sequence[Method],
    truth: Trajectory,
    config: CompareConfig,
    *,
    progress: Progress,
) -> list[Trial]:
    """Register pairs of frames by every method from every guess."""
    settings, reader = trials_config(config, source.sensor), Reader(config.rgbd)
    entries = list(source.entries())
    pairs = pairs_of(source.stamps_ns, truth, count=config.pairs, frames_apart=settings.frames_apart)
    trials: list[Trial] = []
    with progress.stage("register") as report:
        for done, pair in enumerate(pairs, start=1):
            try:
                target, source_moment = reader.read(entries[pair.target]), reader.read(entries[pair.source])
            except FrameError:
                continue  # it was told when the log was followed
            level = source.sensor == "lidar"
            guesses = guesses_for(pair, settings.guesses, level=level, seed=config.seed)
            for method in methods:
                trials += trials_of(method, pair, (target, source_moment), guesses, settings)
            report(done, len(pairs))
    return trials


def _warm_up(source: Log, methods: Sequence[Method], config: CompareConfig) -> None:
    """Let every method load its libraries and compiled code before anything is timed."""
    reader = Reader(config.rgbd)
    moments = []
    for entry in islice(source.entries(), _WARM_UP_FRAMES):
        with suppress(FrameError):
            moments.append(reader.read(entry))
    for method in methods:
        with suppress(Exception):  # what breaks down will do so again, and be told
            tracker = method.tracker()
            for moment in moments:
                tracker.add(method.view(moment))
