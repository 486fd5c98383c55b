"""Results of localising a log in a finished map: the manifest, and which stretches are to be trusted."""

from collections.abc import Iterator, Mapping, Sequence
from itertools import groupby
from typing import Literal

import numpy as np

from mapper.core.config import Config
from mapper.core.timebase import NS_PER_S
from mapper.run.frame_outcomes import FrameRecord
from mapper.run.manifest import Manifest
from mapper.run.pose_covariances import UncertainPoses

StretchState = Literal["localised", "doubtful", "not localised"]
_STATES: Mapping[str, StretchState] = {"tracked": "localised", "doubtful": "doubtful"}


class Stretch(Config):
    """Consecutive frames of a log with the same outcome."""

    state: StretchState
    begin_s: float
    """Time of its first frame, in seconds since the log's first."""
    end_s: float
    frames: int
    constraints: int
    """Keyframes in it that were recognised in the map."""
    sigma_m: float | None = None
    """Median standard deviation of the position in its least certain direction; None if unknown."""


class LocalisedManifest(Manifest):
    """``manifest.json`` of a localised log; ``counts.loops`` are the constraints to the map that hold."""

    kind: Literal["localised log"] = "localised log"
    map: str
    """Folder of the run or merged map, absolute."""
    stretches: tuple[Stretch, ...] = ()

    @property
    def localised_share(self) -> float:
        """Share of all frames of the log that are localised without a doubt."""
        return self.counts.tracked / max(self.counts.listed, 1)


def find_stretches(
    records: Sequence[FrameRecord], poses: UncertainPoses, constrained_ns: Sequence[int]
) -> list[Stretch]:
    """Return a log's stretches in time order.

    Args:
        records: Outcome of every frame, in time order.
        poses: Poses of the frames that were placed.
        constrained_ns: Stamps of the keyframes that were recognised in the map.
    """
    return list(_stretches(records, poses, np.array(sorted(constrained_ns), np.int64)))


def _stretches(
    records: Sequence[FrameRecord], poses: UncertainPoses, constrained_ns: np.ndarray
) -> Iterator[Stretch]:
    stamps_ns = poses.trajectory.stamps_ns
    for state, group in groupby(records, key=lambda record: _STATES.get(record.outcome, "not localised")):
        frames = list(group)
        first_ns, last_ns = frames[0].stamp_ns, frames[-1].stamp_ns
        sigmas_m = poses.position_sigmas_m[(stamps_ns >= first_ns) & (stamps_ns <= last_ns)]
        known = sigmas_m[np.isfinite(sigmas_m)]
        yield Stretch(
            state=state,
            begin_s=(first_ns - records[0].stamp_ns) / NS_PER_S,
            end_s=(last_ns - records[0].stamp_ns) / NS_PER_S,
            frames=len(frames),
            constraints=int(((constrained_ns >= first_ns) & (constrained_ns <= last_ns)).sum()),
            sigma_m=float(np.median(known)) if state != "not localised" and len(known) else None,
        )
