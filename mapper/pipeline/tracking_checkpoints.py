"""Checkpoints while a log is tracked: a journal of frames, and the state of the odometry every few seconds.

The journal gets the result of every frame and the comparisons of every search for loops. It is the archive,
too: each keyframe's features or points are in it once, and the states refer to them. The loop detector
and the graph have no state of their own there: they are made again from the journal, at the price of what is
cheap in them (``mapper.loops.verification_log``), as the solver of the current estimates cannot be written.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

from mapper.core.errors import DataError
from mapper.core.trajectory import Trajectory
from mapper.features.base import Detector
from mapper.graph.wheel_factors import WheelMeasurements
from mapper.loops.verification_log import LoopSearch
from mapper.odometry.base import FrameResult, Odometry
from mapper.pipeline.checkpoints import Checkpoints
from mapper.places.vocabulary import Vocabulary
from mapper.runtime.archive import pack, unpack
from mapper.runtime.journal import StateFile
from mapper.runtime.state_file import dumps, fixed_parts, loads
from mapper.sensing.gyroscope import Gyroscope
from mapper.sensing.wheel_kinematics import Odometer
from mapper.sources.base import Skipped
from mapper.sources.reading_checks import ReadingChecks

_FIXED_PARTS = (Detector, Vocabulary, WheelMeasurements, Trajectory, Odometer, Gyroscope)
"""Parts of an odometry that exist before the first frame and never change."""
_FRAME = b"frame "
"""Beginning of a frame's record; others are data of the archive, whose packed bytes begin otherwise."""


@dataclass(frozen=True, slots=True, eq=False)
class FrameCheckpoint:
    """A frame that was tracked.

    Attributes:
        result: Its result, or why there is none.
        search: The search for loops from it.
        frame_ms: Milliseconds that it took.
        reading: Its part in ``ReadingChecks``.
    """

    result: FrameResult | Skipped
    search: LoopSearch
    frame_ms: float
    reading: Any


@dataclass(frozen=True, slots=True, eq=False)
class TrackingState:
    """State of tracking between two frames.

    Attributes:
        odometry: Odometry after the last frame.
        frames: All frames so far.
    """

    odometry: Odometry[Any]
    frames: Sequence[FrameCheckpoint]


class TrackingCheckpoints:
    """Checkpoints of the first pass over a log."""

    def __init__(self, checkpoints: Checkpoints) -> None:
        self._checkpoints = checkpoints
        self._states = StateFile(checkpoints.folder, "odometry")
        self._number = 0
        self._fixed: Mapping[str, object] = {}

    def restore(self, odometry: Odometry[Any], checks: ReadingChecks) -> TrackingState:
        """Return the newest state that is whole, or that before the first frame.

        Args:
            odometry: Before its first frame.
            checks: Checks of the log's frames; they take over what is known of those that are not read again.
        """
        checkpoints = self._checkpoints
        self._fixed = fixed_parts(odometry, _FIXED_PARTS)
        versions, damaged = self._states.versions()
        for number, path in versions.items():
            packed: list[bytes] = []

            def keep(record: bytes, packed: list[bytes] = packed) -> None:
                if record.startswith(_FRAME):
                    packed.append(record[len(_FRAME) :])

            try:
                state = checkpoints.read_state(path, fixed=self._fixed, other=keep)
                frames = [loads(unpack(record), archived=checkpoints.archive.at) for record in packed]
            except DataError:
                damaged += 1
                continue
            self._number = number + 1
            checkpoints.resume(state)
            for index, frame in enumerate(frames):
                checks.restore(index, frame.reading)
            if damaged:
                checkpoints.progress.note(
                    "the newest checkpoint is damaged or torn; the one before it is used"
                )
            checkpoints.resumed_at("track", len(frames))
            return TrackingState(state["result"], frames)
        if damaged:
            checkpoints.progress.note(
                "the checkpoints of an earlier process are damaged; tracking begins anew"
            )
        self._states.remove()
        checkpoints.journal.remove()
        checkpoints.archive.clear()
        return TrackingState(odometry, ())

    def add(self, frame: FrameCheckpoint, odometry: Odometry[Any]) -> None:
        """Keep a frame that was tracked, and the state after it if it is time to."""
        checkpoints = self._checkpoints
        if checkpoints.is_off:
            return
        checkpoints.journal.append(_FRAME + pack(dumps(frame, archive=checkpoints.archive.place_of)))
        if checkpoints.is_due():
            checkpoints.keep(partial(self._snapshot, odometry))

    def _snapshot(self, odometry: Odometry[Any]) -> Callable[[], None]:
        number, self._number = self._number, self._number + 1
        return self._checkpoints.snapshot(self._states, number, odometry, fixed=self._fixed)
