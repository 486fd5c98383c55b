"""Comparison of methods on one log: a job for each, as odometry over all frames and on pairs of them."""

import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from mapper.core.errors import DataError, FrameError
from mapper.core.frames import Sensor
from mapper.core.geometry import inverse
from mapper.core.timebase import MAX_TRUTH_GAP_NS, Stamps
from mapper.core.trajectory import Trajectory, trajectory_from, with_rotations
from mapper.evaluators.compare.catalogue import methods_for
from mapper.evaluators.compare.config import CompareConfig, TrialsConfig
from mapper.evaluators.compare.methods import FrameReader, Method, PreparedFrame, Tracker, reason_of
from mapper.evaluators.compare.pairwise import guesses_for, pairs_of, trials_of
from mapper.evaluators.metrics.agreement import CommonViews
from mapper.evaluators.metrics.odometry import OdometryRun, Step, assess_run, step_for
from mapper.evaluators.study.engine import digest, run_study, versions
from mapper.run.input_logs import fingerprint
from mapper.runtime.progress import SILENT, Progress
from mapper.runtime.resumable_jobs import Job, Record
from mapper.sources.base import FrameRef, Log, Skipped

_WARM_UP_FRAMES = 2


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Comparison:
    """The results of all methods on one log.

    Attributes:
        path: Path of the log.
        log: Its name.
        sensor: Sensor that took it.
        config: Settings of the comparison.
        truth: True poses of the body while the log was taken, if it has them.
        runs: Each method over the whole log.
        step: Step of the runs' relative errors.
        trials: A record of every registration of every pair, as ``trials_of`` returns them.
        read_ms: CPU time of reading a frame, for all methods alike and not counted as theirs.
        scan_ms: CPU time of making its scan, likewise.
        skipped: Frames that could not be read.
        notes: Sentences on what was left out.
    """

    path: Path
    log: str
    sensor: Sensor
    config: CompareConfig
    truth: Trajectory | None
    runs: tuple[OdometryRun, ...]
    step: Step
    trials: tuple[Record, ...]
    read_ms: float
    scan_ms: float
    skipped: tuple[Skipped, ...]
    notes: tuple[str, ...]

    def __repr__(self) -> str:
        methods = ", ".join(run.method for run in self.runs)
        return f"Comparison of {methods} on {self.log}, with {len(self.trials)} trials"

    @property
    def trials_config(self) -> TrialsConfig:
        """Settings of the trials: registrations that were tried, and what counts as right."""
        return self.config.trials(self.sensor)


def compare(source: Log, config: CompareConfig, folder: Path, *, progress: Progress = SILENT) -> Comparison:
    """Run every chosen method over the whole log, and on pairs of its frames.

    Every method gets the same frames, one at a time, so memory does not grow with the log. Times are of the
    CPU: they are what one core would take, whatever else the machine does. A method that breaks down is
    listed with its reason, and the others go on.

    Args:
        source: The log.
        config: Methods, and how they are compared.
        folder: Folder of the results of finished methods, which are not run again.
        progress: Receives each method's counts, and notes of frames that cannot be read.

    Raises:
        ConfigError: No method of such a name, or none of them can use the log.
        DataError: No frame can be read.
    """
    methods, notes = methods_for(source, config)
    settings = config.model_dump(mode="json", exclude={"methods"})
    decides = digest(versions(), fingerprint(source.path), settings, digits=12)
    jobs = {
        method.name: Job(
            f"{method.name}.{decides}", method.name, MethodJob(source, config, method.name, progress)
        )
        for method in methods
    }
    found: dict[str, Any] = {}
    for name, result in run_study(jobs, folder, attempts=1).items():
        if result.failure:
            raise DataError(result.failure)
        (found[name],) = result.records
    one, *_ = found.values()
    skipped = tuple(Skipped(**skip) for skip in one["skipped"])
    for skip in skipped:
        progress.note(f"skipped: {skip.reason}")
    frames_ns = np.array(one["frames_ns"], np.int64)
    truth, step = _truth_during(source, frames_ns), step_for(frames_ns)
    runs = [assess_run(_run_of(name, record), truth, step) for name, record in found.items()]
    if truth is None:
        runs = list(_judged_by_views(source, runs, progress))
        notes = [*notes, "the log has no truth for these frames: no errors, and no registration of pairs"]
    frames = len(found) * len(frames_ns)
    return Comparison(
        path=source.path,
        log=source.name,
        sensor=source.sensor,
        config=config,
        truth=truth,
        runs=tuple(runs),
        step=step,
        trials=_by_pair([trial for record in found.values() for trial in record["trials"]]),
        read_ms=1e3 * sum(record["read_s"] for record in found.values()) / frames,
        scan_ms=1e3 * sum(record["scan_s"] for record in found.values()) / frames,
        skipped=skipped,
        notes=tuple(notes),
    )


def _judged_by_views(source: Log, runs: Iterable[OdometryRun], progress: Progress) -> Iterator[OdometryRun]:
    """Yield the runs with how far they are from what views of one place show, where that is known."""
    common = CommonViews(source)
    for run in runs:
        disagreement_m = None
        with suppress(DataError, FrameError):
            disagreement_m = common.disagreements(run.trajectory, progress=progress).rms_m
        yield replace(run, disagreement_m=disagreement_m)


def _run_of(method: str, record: Any) -> OdometryRun:
    stamps_ns = np.array(record["stamps_ns"], np.int64)
    return OdometryRun(
        method=method,
        frames=record["frames"],
        failures=record["failures"],
        seconds=record["seconds"],
        trajectory=Trajectory(stamps_ns, np.array(record["T_world_body"]).reshape(-1, 4, 4)),
        broke=record["broke"],
    )


def _by_pair(trials: Sequence[Record]) -> tuple[Record, ...]:
    pairs = dict.fromkeys((trial["target_ns"], trial["source_ns"]) for trial in trials)
    number = {pair: index for index, pair in enumerate(pairs)}
    return tuple(sorted(trials, key=lambda trial: number[trial["target_ns"], trial["source_ns"]]))


@dataclass(frozen=True, slots=True, eq=False)
class MethodJob:
    """One method on one log.

    Attributes:
        source: The log.
        config: Settings of the comparison.
        method: Its name.
        progress: Receives stages, counts and notes.
    """

    source: Log
    config: CompareConfig
    method: str
    progress: Progress = SILENT

    def __call__(self) -> list[Record]:
        """Return one record: the run over the whole log, every trial, and what reading took.

        Raises:
            DataError: No frame can be read.
        """
        method = next(one for one in methods_for(self.source, self.config)[0] if one.name == self.method)
        self._warm_up(method)
        run, reader = MethodRun(method), FrameReader(self.config.rgbd)
        frames_ns, skipped = self._follow(run, reader)
        truth = _truth_during(self.source, frames_ns)
        return [
            {
                **run.record(),
                "trials": [] if truth is None else self._register(method, truth),
                "frames_ns": frames_ns.tolist(),
                "skipped": [asdict(skip) for skip in skipped],
                "read_s": reader.read_s,
                "scan_s": reader.scan_s,
            }
        ]

    def _warm_up(self, method: Method) -> None:
        reader = FrameReader(self.config.rgbd)
        frames = []
        for entry in islice(self.source.entries(), _WARM_UP_FRAMES):
            with suppress(FrameError):
                frames.append(reader.read(entry))
        with suppress(Exception):  # what breaks down will do so again, and be recorded
            tracker = method.tracker()
            for frame in frames:
                tracker.add(method.view(frame))

    def _follow(self, run: "MethodRun", reader: FrameReader) -> tuple[Stamps, list[Skipped]]:
        """Give the method every frame; return the stamps of those that can be read, and the others."""
        frames_ns: list[int] = []
        skipped: list[Skipped] = []
        with self.progress.stage(self.method) as report:
            for done, entry in enumerate(self.source.entries(), start=1):
                try:
                    frame = reader.read(entry)
                except FrameError as error:
                    skipped.append(Skipped(entry.stamp_ns, str(error)))
                    continue
                run.add(frame)
                frames_ns.append(entry.stamp_ns)
                report(done, len(self.source))
        if not frames_ns:
            raise DataError(
                f"{self.source.path}: none of {len(self.source)} frames can be read; "
                f"the first: {skipped[0].reason}"
            )
        return np.array(frames_ns, np.int64), skipped

    def _register(self, method: Method, truth: Trajectory) -> list[Record]:
        if not self.config.pairs:
            return []
        entries: list[FrameRef] = list(self.source.entries())
        stamps_ns = np.array([entry.stamp_ns for entry in entries], np.int64)
        settings, reader = self.config.trials(self.source.sensor), FrameReader(self.config.rgbd)
        pairs = pairs_of(stamps_ns, truth, count=self.config.pairs, frames_apart=settings.frames_apart)
        level = self.source.sensor != "rgbd"
        trials: list[Record] = []
        with self.progress.stage(f"{self.method} on pairs") as report:
            for done, pair in enumerate(pairs, start=1):
                with suppress(FrameError):  # the frame is among the skipped ones
                    frames = reader.read(entries[pair.target]), reader.read(entries[pair.source])
                    guesses = guesses_for(pair, settings.guesses, level=level, seed=self.config.seed)
                    trials += trials_of(method, pair, frames, guesses, settings)
                report(done, len(pairs))
        return trials


class MethodRun:
    """One method over a whole log, frame by frame."""

    def __init__(self, method: Method) -> None:
        self._method = method
        self._tracker: Tracker | None = None
        self._T_body_seen = np.eye(4)
        self._frames = self._failures = 0
        self._seconds = 0.0
        self._broke = ""

    def add(self, frame: PreparedFrame) -> None:
        """Give the method the next frame, unless it has failed."""
        if self._broke:
            return
        self._T_body_seen = np.eye(4) if self._method.sees_images else frame.T_body_scan
        began = time.process_time()
        try:
            self._tracker = self._tracker or self._method.tracker()
            self._failures += not self._tracker.add(self._method.view(frame))
        except Exception as error:  # a library's breakdown is a result, and the other methods go on
            self._broke = f"broke down at frame {self._frames}: {reason_of(error)}"
        self._seconds += time.process_time() - began
        self._frames += 1

    def record(self) -> dict[str, Any]:
        """Return counts, CPU seconds, the poses of the body, and why the method failed if it did."""
        began = time.process_time()
        trajectory = trajectory_from(())
        if self._tracker is not None and not self._broke:
            try:
                trajectory = self._tracker.trajectory()
                if not np.isfinite(trajectory.T_world_body).all():
                    raise DataError("a pose is not finite")
            except Exception as error:  # as above
                trajectory = trajectory_from(())
                self._broke = f"broke down at the end: {reason_of(error)}"
        self._seconds += time.process_time() - began
        return {
            "frames": self._frames,
            "failures": self._failures,
            "seconds": self._seconds,
            "stamps_ns": trajectory.stamps_ns.tolist(),
            "T_world_body": (trajectory.T_world_body @ inverse(self._T_body_seen)).tolist(),
            "broke": self._broke,
        }


def _truth_during(source: Log, frames_ns: Stamps) -> Trajectory | None:
    """Return the true poses from the first frame to the last; None if there are none."""
    posed = with_rotations(source.truth)
    if posed is None:
        return None
    truth = posed.during(frames_ns[0] - MAX_TRUTH_GAP_NS, frames_ns[-1] + MAX_TRUTH_GAP_NS)
    return truth if len(truth) else None
