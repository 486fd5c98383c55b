"""Checkpoints while frames are fused: what of the file of their updates is on the disk.

Another process merges these updates again and casts the other frames only, to the same bits; see
``mapper.octree.scan_updates``.
"""

import hashlib
import os
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

from mapper.core.errors import DataError
from mapper.octree.config import OctreeConfig
from mapper.octree.scan_updates import CachedUpdate, ScanUpdateWriter, open_scan_updates
from mapper.pipeline.checkpoints import Checkpoints
from mapper.run import files
from mapper.runtime.atomic import flush_to_disk
from mapper.runtime.journal import StateFile, opened_state
from mapper.runtime.state_file import dump, load

_KNOWN = "updates.bin"
"""The updates that earlier processes have cast; the folder's other names are those of marks."""


def known_updates(checkpoints: Checkpoints, config: OctreeConfig) -> Path | None:
    """Return the file of the updates that earlier processes have cast; None if there are none.

    What was torn is cut off. That the build goes on is reported only if an earlier process had begun to fuse.
    """
    folder = checkpoints.folder
    new, known = checkpoints.writer.folder / files.SCAN_UPDATES, folder / _KNOWN
    marks = [
        (mark, path)
        for name in ("updates", "known")
        for mark in _marks(StateFile(folder, name))
        for path in (new, known)
        if not config.attributes and _holds(path, mark)  # colours are in no update
    ]
    frames, used = 0, None
    if marks:
        mark, path = max(marks, key=lambda found: int(found[0]["frames"]))
        with suppress(OSError):  # as on a disk that is full: all is cast again
            if path == new:
                new.replace(known)
            os.truncate(known, mark["bytes"])
            StateFile(folder, "known").remove()
            StateFile(folder, "known").write(0, partial(dump, mark))
            with open_scan_updates(known) as updates:
                if updates.holds_for(config):
                    frames, used = mark["frames"], known
                    checkpoints.writer.clock.seconds.update(mark["seconds"])
    if checkpoints.is_solved:
        checkpoints.resumed_at("fuse", frames)
    return used


class MarkedUpdates(ScanUpdateWriter):
    """Writer of scan updates that records, every few seconds, how much of the file is on the disk."""

    def __init__(self, path: Path, config: OctreeConfig, checkpoints: Checkpoints) -> None:
        super().__init__(path, config)
        self._checkpoints = checkpoints
        self._marks = StateFile(checkpoints.folder, "updates")
        self._number = self._frames = self._digested = 0
        self._digest = hashlib.sha256()

    def add(self, frame: CachedUpdate) -> None:
        """Append one frame."""
        super().add(frame)
        self._frames += 1
        if self._checkpoints.is_due():
            self._checkpoints.keep(self._snapshot)

    def _snapshot(self) -> Callable[[], None]:
        self.flush()
        frames, end = self._frames, self._path.stat().st_size
        seconds = self._checkpoints.writer.clock.so_far()
        number, self._number = self._number, self._number + 1

        def write() -> None:
            _add(self._digest, self._path, self._digested, end)
            self._digested = end
            flush_to_disk(self._path)
            digest = self._digest.hexdigest()
            mark = {"frames": frames, "bytes": end, "sha256": digest, "seconds": seconds}
            self._marks.write(number, partial(dump, mark))

        return write


def _marks(file: StateFile) -> list[Mapping[str, Any]]:
    marks = []
    for path in file.versions()[0].values():
        with suppress(DataError), opened_state(path) as opened:
            marks.append(load(opened))
    return marks


def _holds(path: Path, mark: Mapping[str, Any]) -> bool:
    """Return whether a file begins with the bytes that a mark describes."""
    digest = hashlib.sha256()
    try:
        if path.stat().st_size < mark["bytes"]:
            return False
        _add(digest, path, 0, mark["bytes"])
    except OSError:
        return False
    return bool(digest.hexdigest() == mark["sha256"])


def _add(digest: "hashlib._Hash", path: Path, begin: int, end: int) -> None:
    with path.open("rb") as file:
        file.seek(begin)
        while begin < end and (piece := file.read(min(end - begin, 1 << 20))):
            digest.update(piece)
            begin += len(piece)
