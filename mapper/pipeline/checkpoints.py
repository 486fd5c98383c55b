"""Checkpoints of a build, so that one that was stopped is resumed and ends in the same bytes.

They lie in a folder of their own in ``OUT.partial``, and come from three steps:

- while a log is tracked, a journal and the state of the odometry (``tracking_checkpoints``). Keyframes'
  features and scans are records of the journal, which all later states refer to (``mapper.runtime.archive``);
- the results of tracking and of solving, whole, each of which replaces what came before it;
- while frames are fused, the file of their updates, with a digest of what of it is on the disk
  (``fuse_checkpoints``).

What is written is copied in the main thread, between two frames; another thread writes it and waits for the
disk. A full disk ends the checkpoints, not the build.
"""

import shutil
import time
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager, nullcontext, suppress
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, Self

from pydantic import ValidationError

from mapper.core.errors import DataError, MapperError, WriteError
from mapper.pipeline.checkpoint_identity import IDENTITY, write_identity
from mapper.run import files
from mapper.run.manifest import Manifest, Resumption, Timing, now_text
from mapper.run.writer import RunWriter
from mapper.runtime.archive import Archive
from mapper.runtime.archived import Archived
from mapper.runtime.atomic import flush_to_disk, write_text
from mapper.runtime.journal import Journal, StateFile, opened_state
from mapper.runtime.progress import Progress, peak_memory_mb
from mapper.runtime.state_file import dump, dumps, load, loads

EVERY_S = 9.0
"""Seconds between two checkpoints, which a build that is stopped loses at most."""
_TIMES = "resumed.json"
_JOURNAL = "tracking.journal"

Step = Literal["tracked", "solved"]
"""Steps of a build whose results are kept whole."""


class Checkpoints:
    """Checkpoints of one build; a context manager."""

    def __init__(
        self,
        writer: RunWriter,
        identity: Mapping[str, Any],
        progress: Progress,
        *,
        every_s: float,
    ) -> None:
        """Begin, or resume from what is in the folder.

        Args:
            writer: Writer of the run.
            identity: All that the result depends on.
            progress: Receives notes.
            every_s: Seconds between two checkpoints, at least; 0 keeps one of every frame, and waits for it.
        """
        self.folder = writer.folder / files.CHECKPOINTS
        self.writer = writer
        self.progress = progress
        self.is_off = False
        self.is_solved = False
        self._every_s = every_s
        self._last_s = time.monotonic()
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="checkpoint")
        self._pending: Future[None] | None = None
        self._written: list[Archived[Any]] = []
        self.journal = Journal(self.folder / _JOURNAL)
        self.archive = Archive(self.journal)
        self._try(partial(self._begin, identity))
        with suppress(OSError, ValidationError):  # the history alone, which changes no result
            known = Timing.model_validate_json((self.folder / _TIMES).read_bytes())
            writer.update(timing=writer.manifest.timing.model_copy(update={"resumed": known.resumed}))

    def _begin(self, identity: Mapping[str, Any]) -> None:
        path = self.folder / IDENTITY
        if path.exists():
            return
        shutil.rmtree(self.folder, ignore_errors=True)
        self.folder.mkdir()
        write_identity(path, identity)
        run = self.writer.folder
        for written in (path, self.folder, run / files.MANIFEST, run, run.parent):
            flush_to_disk(written)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._wait()
        self._thread.shutdown()
        self.journal.close()
        if isinstance(error, MapperError) and not isinstance(error, WriteError):
            shutil.rmtree(self.folder, ignore_errors=True)  # it would fail again

    def load(self, step: Step) -> Any | None:
        """Return the result of a step as an earlier process left it; None if it is to be computed.

        The manifest and the times until then are restored with it.
        """
        versions, damaged = StateFile(self.folder, step).versions()
        for path in versions.values():
            try:
                state = self.read_state(path)
            except DataError:
                damaged += 1
                continue
            self.resume(state)
            self.is_solved = step == "solved"
            if not self.is_solved:
                self.resumed_at("solve", 0)
            return state["result"]
        if damaged:
            self.progress.note(f"what an earlier process has {step} is damaged; it is computed again")
        return None

    def store(self, step: Step, result: object) -> None:
        """Keep the result of a step, with the manifest and the times so far, instead of what led to it."""
        self._wait()
        if not self.is_off:
            self._try(partial(self._replace_by, step, result))

    def _replace_by(self, step: str, result: object) -> None:
        """Write a result, and delete the checkpoints that led to it, but for the journal it refers to."""
        self.snapshot(StateFile(self.folder, step), 0, result)()
        kept = {IDENTITY, _TIMES, self.journal.path.name, f"{step}.0"}
        for path in self.folder.iterdir():
            if path.name not in kept:
                path.unlink()

    def snapshot(
        self, states: StateFile, number: int, result: object, *, fixed: Mapping[str, object] | None = None
    ) -> Callable[[], None]:
        """Copy a result, or a state on the way to it; return the function that writes it and its journal.

        Args:
            states: File of the state.
            number: Number of its version.
            result: The result.
            fixed: Parts of it that are not written, by name.
        """
        packed = dumps(result, fixed=fixed, archive=self.archive.place_of)
        state = {
            "result": packed,
            "journal_end": self.journal.end,
            "manifest": self.writer.manifest.model_dump_json(),
            "seconds": self.writer.clock.so_far(),
            "peak_memory_mb": peak_memory_mb(),
        }
        records, new = self.journal.take(), self.archive.take()

        def write() -> None:
            self.journal.write(records)
            states.write(number, partial(dump, state))
            self._written.extend(new)

        return write

    def read_state(
        self,
        path: Path,
        *,
        fixed: Mapping[str, object] | None = None,
        other: Callable[[bytes], object] = lambda _: None,
    ) -> dict[str, Any]:
        """Return a state with its result, and leave the journal with what belongs to it.

        Args:
            path: Its version.
            fixed: The parts that were not written.
            other: Takes every record of the journal, in order.

        Raises:
            DataError: The state or the journal is damaged.
        """
        self.archive.clear()
        with opened_state(path) as file:
            state: dict[str, Any] = load(file)
        end = int(state["journal_end"])
        for _, record in self.journal.records(end):
            other(record)
        self.journal.truncate(end)
        return {**state, "result": loads(state["result"], fixed=fixed, archived=self.archive.at)}

    def resume(self, state: Mapping[str, Any]) -> None:
        """Go on from a state's manifest and times."""
        writer = self.writer
        manifest = Manifest.model_validate_json(state["manifest"])
        peak_mb = max(state["peak_memory_mb"], manifest.timing.peak_memory_mb)
        timing = manifest.timing.model_copy(
            update={"peak_memory_mb": peak_mb, "resumed": writer.manifest.timing.resumed}
        )
        writer.update(**{**dict(manifest), "timing": timing, "status": "building"})
        writer.clock.seconds.update(state["seconds"])

    def resumed_at(self, step: Literal["track", "solve", "fuse"], frame: int) -> None:
        """Report where the build is resumed, and record it in the manifest."""
        here = Resumption(at=now_text(), step=step, frame=frame)
        timing = self.writer.manifest.timing
        timing = timing.model_copy(update={"resumed": (*timing.resumed, here)})
        self.writer.update(timing=timing)
        self._try(partial(write_text, self.folder / _TIMES, timing.model_dump_json()))
        self.progress.note(f"an earlier process was stopped; resuming with {here.text}")

    def is_due(self) -> bool:
        """Return whether it is time for the next checkpoint, and the last one is on the disk."""
        is_busy = self._pending is not None and not self._pending.done()
        is_early = time.monotonic() - self._last_s < self._every_s
        if self.is_off or (self._every_s > 0.0 and (is_busy or is_early)):
            return False
        self._wait()
        return not self.is_off

    def keep(self, take: Callable[[], Callable[[], None]]) -> None:
        """Take a checkpoint now, and write it in another thread.

        Args:
            take: Function that copies what changes, and returns the function that writes it.
        """
        self._last_s = time.monotonic()
        try:
            write = take()
        except DataError as error:
            self._give_up(str(error))
            return
        self._pending = self._thread.submit(write)

    def _wait(self) -> None:
        pending, self._pending = self._pending, None
        if pending is not None:
            self._try(pending.result)
        written, self._written = self._written, []
        if not self.is_off:
            self.archive.release(written)

    def _try(self, work: Callable[[], None]) -> None:
        """Call a function that writes; if it fails, go on without checkpoints, and free their space."""
        try:
            work()
        except OSError as error:
            self._give_up(error.strerror or str(error))
        except (DataError, WriteError) as error:
            self._give_up(str(error))

    def _give_up(self, reason: str) -> None:
        if not self.is_off:
            self.is_off = True
            self.progress.note(
                f"checkpoints cannot be written ({reason}); the build goes on without, and starts again "
                "if it is stopped"
            )
            shutil.rmtree(self.folder, ignore_errors=True)


def open_checkpoints(
    writer: RunWriter, identity: Mapping[str, Any], progress: Progress, *, every_s: float | None
) -> AbstractContextManager[Checkpoints | None]:
    """Return the checkpoints of a build as a context; None makes none."""
    return nullcontext() if every_s is None else Checkpoints(writer, identity, progress, every_s=every_s)


def remove_checkpoints(run: Path) -> None:
    """Delete the checkpoints of a run that is whole."""
    shutil.rmtree(run / files.CHECKPOINTS, ignore_errors=True)
