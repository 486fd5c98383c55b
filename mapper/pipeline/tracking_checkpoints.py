"""Checkpoints while a log is tracked: a journal of frames, and the state of the odometry every few seconds.

The journal gets the result of every frame, the place and the comparisons of every search for loops, and each
keyframe's observation, once. The state of the odometry refers to it for its observations. The loop detector
and the graph have no state of their own there: they are made again from the journal, at the price of what is
cheap in them (``mapper.loops.verification_log``), as the solver of the current estimates cannot be written.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from isal import isal_zlib

from mapper.core.errors import DataError
from mapper.core.trajectory import Trajectory
from mapper.features.base import Detector
from mapper.graph.wheel_factors import WheelMeasurements
from mapper.loops.verification_log import LoopSearch
from mapper.odometry.base import FrameResult, Odometry
from mapper.pipeline.checkpoints import Checkpoints
from mapper.places.vocabulary import Vocabulary
from mapper.runtime.journal import Journal, StateFile, opened_state
from mapper.runtime.state_pickle import Archivable, dump, dumps, fixed_parts, load, loads
from mapper.sensing.wheel_kinematics import Odometer
from mapper.sources.base import Skipped
from mapper.sources.reading_checks import ReadingChecks

_FIXED_PARTS = (Detector, Vocabulary, WheelMeasurements, Trajectory, Odometer)
"""Parts of an odometry that exist before the first frame and never change."""
_FRAME = b"frame "
"""Beginning of a frame's record; others are observations, whose packed bytes begin otherwise."""


@dataclass(frozen=True, slots=True, eq=False)
class FrameCheckpoint:
    """A frame that was tracked.

    Attributes:
        result: Its result, or why there is none.
        search: The search for loops from it.
        frame_ms: Milliseconds that it took.
        reading: What ``ReadingChecks`` keep of it.
    """

    result: FrameResult | Skipped
    search: LoopSearch
    frame_ms: float
    reading: Any


@dataclass(frozen=True, slots=True, eq=False)
class TrackingState:
    """State of tracking between two frames.

    Attributes:
        odometry: After the last frame.
        frames: All frames so far.
    """

    odometry: Odometry[Any]
    frames: Sequence[FrameCheckpoint]


class TrackingCheckpoints:
    """Checkpoints of the first pass over a log."""

    def __init__(self, checkpoints: Checkpoints) -> None:
        self._checkpoints = checkpoints
        self._journal = Journal(checkpoints.folder / "tracking.journal")
        self._states = StateFile(checkpoints.folder, "odometry")
        self._number = 0
        self._archived: dict[int, tuple[Archivable, int | None]] = {}
        self._fixed: Mapping[str, object] = {}

    def restore(self, odometry: Odometry[Any], checks: ReadingChecks) -> TrackingState:
        """Return the newest state that is whole, or that before the first frame.

        Args:
            odometry: Before its first frame.
            checks: Of the log's frames; takes over what is known of those that are not read again.
        """
        self._fixed = fixed_parts(odometry, _FIXED_PARTS)
        versions, damaged = self._states.versions()
        for number, path in versions.items():
            try:
                state = self._read_state(path)
            except DataError:
                damaged += 1
                continue
            self._number = number + 1
            self._checkpoints.resume(state)
            for index, frame in enumerate(state["frames"]):
                checks.restore(index, frame.reading)
            if damaged:
                self._checkpoints.progress.note(
                    "the newest checkpoint is damaged or torn; the one before it is used"
                )
            self._checkpoints.resumed_at("track", len(state["frames"]))
            return TrackingState(state["result"], state["frames"])
        if damaged:
            self._checkpoints.progress.note(
                "the checkpoints of an earlier process are damaged; tracking begins anew"
            )
        self._states.remove()
        self._journal.path.unlink(missing_ok=True)
        return TrackingState(odometry, ())

    def _read_state(self, path: Path) -> dict[str, Any]:
        """Return a state with the odometry and the frames; cut the journal off behind what belongs to it."""
        with opened_state(path) as file:
            state: dict[str, Any] = load(file)
        records: dict[int, bytes] = {}
        frames: list[FrameCheckpoint] = []
        for place, record in self._journal.records(state["journal_end"]):
            if record.startswith(_FRAME):
                frames.append(_unpacked(record[len(_FRAME) :]))
            else:
                records[place] = record
        known: dict[int, Any] = {}

        def archived(place: int) -> object:
            if place not in known:
                if place not in records:
                    raise DataError(f"{self._journal.path}: nothing at byte {place}")
                known[place] = _unpacked(records[place])
            return known[place]

        odometry = loads(state["result"], fixed=self._fixed, archived=archived)
        self._journal.truncate(state["journal_end"])
        self._archived = {id(data): (data, place) for place, data in known.items()}
        return {**state, "result": odometry, "frames": frames}

    def add(self, frame: FrameCheckpoint, odometry: Odometry[Any]) -> None:
        """Keep a frame that was tracked, and the state after it if it is time to."""
        if self._checkpoints.is_off:
            return
        self._journal.append(_FRAME + _packed(frame))
        if self._checkpoints.is_due():
            self._checkpoints.keep(partial(self._taken, odometry))

    def _taken(self, odometry: Odometry[Any]) -> Callable[[], None]:
        """Copy the state of the odometry; return what writes it."""
        before, self._archived = self._archived, {}

        def archive(data: Archivable) -> int | None:
            known = self._archived.get(id(data)) or before.get(id(data)) or (data, None)
            if id(data) in before and known[1] is None:  # what was there last time is a keyframe's
                known = data, self._journal.append(_packed(data))
            self._archived[id(data)] = known
            return known[1]

        state = self._checkpoints.state(dumps(odometry, fixed=self._fixed, archive=archive))
        state["journal_end"] = self._journal.end
        number, self._number = self._number, self._number + 1
        records = self._journal.take()

        def write() -> None:
            self._journal.write(records)
            self._states.write(number, partial(dump, state))

        return write


def _packed(data: object) -> bytes:
    return bytes(isal_zlib.compress(dumps(data), 1))


def _unpacked(record: bytes) -> Any:
    """Return what was packed; its digest was compared."""
    return loads(isal_zlib.decompress(record))
