"""A comparison as one MCAP file: every method's path, and its errors over time."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from mapper.core.geometry import Array
from mapper.core.timebase import Stamps
from mapper.core.trajectory import Trajectory
from mapper.export.mcap_log import McapLog
from mapper.export.palette import TRUTH
from mapper.export.panels import color_of
from mapper.export.ros_messages import Value


@dataclass(frozen=True, slots=True, eq=False)
class PathErrors:
    """How far a path is from the truth over time.

    Attributes:
        stamps_ns: (N,) of the poses that have a true one.
        positions_m: (N,) distances.
        rotations_rad: (N,) angles.
    """

    stamps_ns: Stamps
    positions_m: Array
    rotations_rad: Array


def write_comparison_log(
    path: Path,
    paths: Mapping[str, Trajectory],
    *,
    truth: Trajectory | None,
    errors: Mapping[str, PathErrors],
    trials: Sequence[tuple[int, str, Mapping[str, Value]]],
) -> None:
    """Write /trajectory/NAME for every method and the truth, /errors/NAME, and /trials/NAME.

    Args:
        path: MCAP file to write.
        paths: Name to path; an empty one is left out.
        truth: Where the body really was.
        errors: Name to the errors of its path.
        trials: Stamp, name and record of every registration; all records have the same fields.
    """
    with McapLog(path) as log:
        starts = [int(one.stamps_ns[0]) for one in paths.values() if len(one)]
        if truth is not None and starts:
            log.trajectory(min(starts), truth, name="truth", color=TRUTH)
        for number, (name, trajectory) in enumerate(paths.items()):
            if len(trajectory):
                log.trajectory(min(starts), trajectory, name=name, color=color_of(number))
        for name, series in errors.items():
            rows = zip(
                series.stamps_ns.tolist(),
                series.positions_m.tolist(),
                series.rotations_rad.tolist(),
                strict=True,
            )
            for stamp_ns, position_m, rotation_rad in rows:
                log.record(
                    f"/errors/{name}",
                    "mapper/msg/PathError",
                    stamp_ns,
                    {"position_m": position_m, "rotation_rad": rotation_rad},
                )
        for stamp_ns, name, record in trials:
            log.record(f"/trials/{name}", "mapper/msg/Trial", stamp_ns, record)
