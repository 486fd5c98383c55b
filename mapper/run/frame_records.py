"""Frame records: the outcome of every frame of a log, and the time it took; the CSV files of a run."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

import numpy as np

from mapper.core.doubts import Doubt, doubts_of, doubts_text, kinds_text
from mapper.core.rotations import row_of_pose
from mapper.core.timebase import Stamps
from mapper.odometry.base import Diagnostics, FrameResult
from mapper.runtime.csv_file import read_csv, write_csv
from mapper.sources.base import Skipped

Outcome = Literal["tracked", "doubtful", "lost", "skipped"]
_OUTCOMES: Mapping[str, Outcome] = {outcome: outcome for outcome in get_args(Outcome)}

_SIGMAS = (
    "sigma_roll_rad",
    "sigma_pitch_rad",
    "sigma_yaw_rad",
    "sigma_x_m",
    "sigma_y_m",
    "sigma_z_m",
)
_POSE = tuple(f"in_node_{name}" for name in ("x_m", "y_m", "z_m", "qx", "qy", "qz", "qw"))
_COLUMNS = (
    "stamp_ns",
    "outcome",
    "node",
    "is_keyframe",
    "method",
    "features",
    "matches",
    "inliers",
    "residual",
    "residual_unit",
    "unobservable",
    "doubts",
    *_SIGMAS,
    *_POSE,
    "doubt_kinds",
)
_MS_COLUMNS = ("stamp_ns", "ms")
DISCONNECTED = "disconnected"
"""``Diagnostics.method`` of a frame that was placed, but in a part of the path that is left out."""

_NOTHING = Diagnostics()


@dataclass(frozen=True, slots=True)
class FrameRecord:
    """Outcome of one frame.

    Attributes:
        stamp_ns: The frame's stamp.
        outcome: "tracked", "doubtful" (placed, but the pose may be wrong), "lost" (read, but not placed) or
            "skipped" (could not be read).
        node: Graph node that its pose is relative to; None unless placed.
        is_keyframe: The frame is that node.
        diagnostics: Figures on its tracking; all zero for a skipped frame.
        doubts: Why the pose may be wrong.
        sigmas: Standard deviations of the pose relative to its node, or of a keyframe's to the keyframe
            before it: rotation about and translation along the body's x, y, z (rad, m). None if unknown.
        pose_in_node: Pose as tracked of a doubtful frame that is no node, to which neighbours were added: x y
            z (m) and qx qy qz qw. None for all other frames.
    """

    stamp_ns: int
    outcome: Outcome
    node: int | None
    is_keyframe: bool
    diagnostics: Diagnostics
    doubts: tuple[Doubt, ...] = ()
    sigmas: tuple[float, ...] | None = None
    pose_in_node: tuple[float, ...] | None = None


def records_of(tracks: Iterable[FrameResult], skipped: Iterable[Skipped]) -> list[FrameRecord]:
    """Return one record per frame, in time order."""
    records = [
        FrameRecord(
            stamp_ns=track.stamp_ns,
            outcome=_outcome(track),
            node=track.node,
            is_keyframe=track.is_keyframe,
            diagnostics=track.diagnostics,
            doubts=track.doubts,
            sigmas=None if track.covariance is None else tuple(np.sqrt(np.diag(track.covariance)).tolist()),
            pose_in_node=_pose_in_node(track),
        )
        for track in tracks
    ]
    records += [FrameRecord(skip.stamp_ns, "skipped", None, False, _NOTHING) for skip in skipped]
    return sorted(records, key=lambda record: record.stamp_ns)


def stamps_of(records: Iterable[FrameRecord]) -> Stamps:
    """Return (N,) the stamps of frames."""
    return np.array([record.stamp_ns for record in records], dtype=np.int64)


def write_records(path: Path, records: Iterable[FrameRecord]) -> None:
    """Write CSV with a header; numbers keep every digit."""
    write_csv(path, _COLUMNS, map(_row, records))


def read_records(path: Path) -> list[FrameRecord]:
    """Return the records of a CSV file.

    Raises:
        RunError: The file cannot be read.
        DataError: It is not what ``write_records`` writes.
    """
    return read_csv(path, _COLUMNS, lambda rows: [_record(row) for row in rows], of="frames")


def write_frame_ms(path: Path, frame_ms: Mapping[int, float]) -> None:
    """Write how many milliseconds each frame took, by stamp."""
    write_csv(path, _MS_COLUMNS, ((stamp_ns, f"{ms:.3f}") for stamp_ns, ms in frame_ms.items()))


def read_frame_ms(path: Path) -> dict[int, float]:
    """Return what ``write_frame_ms`` wrote.

    Raises:
        RunError: The file cannot be read.
        DataError: It is something else.
    """
    return read_csv(
        path, _MS_COLUMNS, lambda rows: {int(row["stamp_ns"]): float(row["ms"]) for row in rows}, of="times"
    )


def _outcome(track: FrameResult) -> Outcome:
    if track.node is None:
        return "lost"
    return "doubtful" if track.doubts else "tracked"


def _pose_in_node(track: FrameResult) -> tuple[float, ...] | None:
    if _outcome(track) != "doubtful" or track.is_keyframe:
        return None
    return tuple(row_of_pose(track.T_node_body).tolist())


def _cells(values: tuple[float, ...] | None, count: int) -> list[str]:
    return [""] * count if values is None else [repr(value) for value in values]


def _numbers(row: Mapping[str, str], names: Sequence[str]) -> tuple[float, ...] | None:
    """Return the numbers in some columns; None if one is empty, or the run is older than the column."""
    cells = [row.get(name) or "" for name in names]
    return tuple(map(float, cells)) if all(cells) else None


def _row(record: FrameRecord) -> list[object]:
    how = record.diagnostics
    return [
        record.stamp_ns,
        record.outcome,
        "" if record.node is None else record.node,
        int(record.is_keyframe),
        how.method,
        how.features,
        how.matches,
        how.inliers,
        repr(float(how.residual)),
        how.residual_unit,
        how.unobservable,
        doubts_text(record.doubts),
        *_cells(record.sigmas, len(_SIGMAS)),
        *_cells(record.pose_in_node, len(_POSE)),
        kinds_text(record.doubts),
    ]


def _record(row: Mapping[str, str]) -> FrameRecord:
    return FrameRecord(
        stamp_ns=int(row["stamp_ns"]),
        outcome=_OUTCOMES[row["outcome"]],
        node=int(row["node"]) if row["node"] else None,
        is_keyframe=row["is_keyframe"] == "1",
        diagnostics=Diagnostics(
            features=int(row["features"]),
            matches=int(row["matches"]),
            inliers=int(row["inliers"]),
            residual=float(row["residual"]),
            residual_unit=row["residual_unit"],
            method=row["method"],
            # Older runs have this column as "unseen", or not at all.
            unobservable=row.get("unobservable", row.get("unseen", "")),
        ),
        # Older runs have no kinds, or no doubts either.
        doubts=doubts_of(row.get("doubts") or "", row.get("doubt_kinds") or ""),
        sigmas=_numbers(row, _SIGMAS),
        pose_in_node=_numbers(row, _POSE),
    )
