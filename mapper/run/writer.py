"""Run folder being written, whole or not at all."""

from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from mapper.config.build import BuildConfig
from mapper.core.errors import MapperError, WriteError
from mapper.odometry.gyroscope_calibration import GyroscopeCalibration
from mapper.run import files
from mapper.run.digests import digests_of
from mapper.run.input_logs import fingerprint
from mapper.run.manifest import Manifest, RunWarning, Timing, library_versions, now_text
from mapper.run.manifest_logs import AppendedLog, GyroscopeFit, Input, RobotFrames
from mapper.runtime.atomic import FolderKind, atomic_folder, flush_to_disk, write_text
from mapper.runtime.progress import Stopwatch, peak_memory_mb
from mapper.sources.base import Log, Session
from mapper.sources.config import SourceConfig


class RunWriter:
    """A run folder being filled; its manifest says "building" until the end is known.

    Attributes:
        folder: Folder of the files.
        clock: Times the stages.
        manifest: Manifest that is written at the end; ``update`` replaces parts of it.
    """

    def __init__(self, folder: Path, manifest: Manifest) -> None:
        self.folder = folder
        self.clock = Stopwatch()
        self.manifest = manifest.model_copy(update={"files": {}})
        self.save()

    def update(self, **parts: Any) -> None:
        """Replace fields of the manifest."""
        self.manifest = self.manifest.model_copy(update=parts)

    def warn(self, warnings: Sequence[RunWarning]) -> None:
        """Add what reading a log found; its sentences are notes on the log that was read last, too."""
        self.update(warnings=(*self.manifest.warnings, *warnings))
        notes = [warning.sentence for warning in warnings]
        known = self.manifest.input
        if known.appended:
            self._update_last(notes=(*known.appended[-1].notes, *notes))
        else:
            self.update(input=known.model_copy(update={"notes": (*known.notes, *notes)}))

    def record_gyroscope(self, calibration: GyroscopeCalibration) -> None:
        """Keep the calibration of the gyroscope of the log that was read last."""
        fit = GyroscopeFit.of(calibration)
        if self.manifest.input.appended:
            self._update_last(gyroscope=fit)
        else:
            self.update(gyroscope=fit)

    def _update_last(self, **parts: Any) -> None:
        known = self.manifest.input
        *others, last = known.appended
        appended = (*others, last.model_copy(update=parts))
        self.update(input=known.model_copy(update={"appended": appended}))

    def record_timing(self, *, log_s: float, frames: int) -> None:
        """Put the seconds of the stages so far into the manifest, and what follows from them.

        Args:
            log_s: Duration of the log that was worked on.
            frames: Number of its frames that were read.
        """
        seconds = {stage: round(value, 3) for stage, value in self.clock.seconds.items()}
        total_s = max(sum(seconds.values()), 1e-9)
        timing = self.manifest.timing
        self.update(
            timing=timing.model_copy(
                update={
                    "stage_s": seconds,
                    "total_s": round(total_s, 3),
                    "log_s": log_s,
                    "frames_per_s": round(frames / total_s, 2),
                    "real_time_factor": round(log_s / total_s, 3),
                    "peak_memory_mb": round(max(peak_memory_mb(), timing.peak_memory_mb), 1),
                }
            )
        )

    def save(self) -> None:
        """Write the manifest as it stands."""
        self.manifest.save(self.folder / files.MANIFEST)


@contextmanager
def write_run(
    out: Path,
    manifest: Manifest,
    config: BuildConfig,
    *,
    overwrite: bool,
    takes_over: bool = False,
    kind: FolderKind = files.RUN,
    keeps: Callable[[Path], Collection[str]] = lambda _: (),
) -> Iterator[RunWriter]:
    """Yield the writer of a run that becomes OUT on success and stays behind as ``OUT.partial`` otherwise.

    A failure or an interruption is written into the manifest; a killed process leaves it at "building".

    Args:
        out: Run folder to create.
        manifest: Manifest to begin with.
        config: Every setting.
        overwrite: Replace a run that is there; one that holds a user's own files only with ``takes_over``.
        takes_over: The caller copies a user's own files from the run that is replaced.
        kind: Kind of the folder; only one of the same kind is replaced.
        keeps: Returns the names of what an earlier process left in ``OUT.partial`` that stays.

    Raises:
        RunError: OUT exists and may not be replaced, or is being built by another process.
        WriteError: A file cannot be written, as when the disk is full.
    """
    with atomic_folder(out, kind, overwrite=overwrite, takes_over=takes_over, keeps=keeps) as folder:
        writer = RunWriter(folder, manifest)
        try:
            write_text(folder / files.CONFIG, config.model_dump_json(indent=2) + "\n")
            yield writer
        except BaseException as error:
            status = "interrupted" if isinstance(error, KeyboardInterrupt) else "failed"
            reason = str(error) if isinstance(error, MapperError) else f"{type(error).__name__}: {error}"
            writer.update(status=status, reason=reason)
            with suppress(WriteError):  # the disk is full; the manifest still says "building"
                writer.save()
            error.add_note(f"what there is so far stays in {folder}")
            raise
        writer.update(status="complete", files=digests_of(folder))
        writer.save()
        flush_to_disk(folder / files.MANIFEST)
        flush_to_disk(folder)


def first_manifest(source: Log) -> Manifest:
    """Return the manifest of a run that has just begun."""
    return Manifest(
        status="building",
        libraries=library_versions(),
        input=Input(**_facts(source)),
        timing=Timing(started=now_text()),
    )


def appended_log(session: Session, config: SourceConfig) -> AppendedLog:
    """Return the manifest's entry of an appended log."""
    return AppendedLog(
        **_facts(session.log),
        source=config,
        shift_ns=session.shift_ns,
        begins_ns=int(session.log.stamps_ns[0]),
    )


def _facts(source: Log) -> dict[str, Any]:
    return {
        "path": str(source.path.resolve()),
        "kind": source.kind,
        "fingerprint": fingerprint(source.path),
        "choices": tuple(source.choices),
        "notes": tuple(source.notes),
        "images": tuple(images.name for images in source.images),
        "robot": RobotFrames.of(source),
    }
