"""Errors of a path by known relations between its poses (Kümmerle et al. 2009), as of the Intel lab."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mapper.core.errors import DataError
from mapper.core.geometry import Array, inverse, length_and_angle, transform
from mapper.core.rotations import rotation_from_euler
from mapper.core.timebase import NS_PER_S, Stamps
from mapper.core.trajectory import Trajectory
from mapper.evaluators.metrics.metric import Metric
from mapper.evaluators.metrics.trajectory_errors import statistics
from mapper.sensing.wheel_kinematics import pose_at
from mapper.sources.text import parse_stamp, table

_COLUMNS = ("time1", "time2", "x", "y", "z", "roll", "pitch", "yaw")
_MAX_GAP_NS = NS_PER_S


@dataclass(frozen=True, slots=True, eq=False)
class Relations:
    """Known relative poses of one body.

    Attributes:
        begins_ns: (N,) times of the first poses.
        ends_ns: (N,) times of the second.
        T_begin_end: (N, 4, 4) true poses of the second in the first.
    """

    begins_ns: Stamps
    ends_ns: Stamps
    T_begin_end: Array

    def __len__(self) -> int:
        return len(self.begins_ns)


def read_relations(path: Path) -> Relations:
    """Read lines of two times in seconds, x y z in metres, and roll, pitch and yaw in radians.

    Raises:
        SourceError: The file cannot be read, or a line has other columns or a malformed time.
        DataError: A number is malformed or not finite, or there is no line.
    """
    stamps_ns: list[list[int]] = []
    T_begin_end: list[Array] = []
    for place, words in table(path, *_COLUMNS):
        stamps_ns.append([parse_stamp(word, where=place) for word in words[:2]])
        try:
            numbers = np.array(words[2:], np.float64)
        except ValueError as error:
            raise DataError(f"{place}: {error}") from None
        if not np.isfinite(numbers).all():
            raise DataError(f"{place}: a number is not finite; remove the line")
        T_begin_end.append(transform(rotation_from_euler(*numbers[3:]), numbers[:3]))
    if not stamps_ns:
        raise DataError(f"{path}: no relations; want lines of {' '.join(_COLUMNS)}")
    begins_ns, ends_ns = np.array(stamps_ns, np.int64).T
    return Relations(begins_ns, ends_ns, np.array(T_begin_end))


def relation_metrics(estimate: Trajectory, relations: Relations) -> list[Metric]:
    """Return how far the path's relative poses are from known ones: mean, standard deviation and RMSE.

    The published tables' "squared" errors are squares of the RMSE. Poses are interpolated; relations with a
    time at which the path has none within a second are counted apart.

    Raises:
        DataError: The path has no relation's both poses.
    """
    errors = []
    times_ns = zip(relations.begins_ns.tolist(), relations.ends_ns.tolist(), strict=True)
    for (begin_ns, end_ns), T_begin_end in zip(times_ns, relations.T_begin_end, strict=True):
        T_world_begin, T_world_end = (
            pose_at(estimate, time_ns, max_gap_ns=_MAX_GAP_NS) for time_ns in (begin_ns, end_ns)
        )
        if T_world_begin is not None and T_world_end is not None:
            errors.append(length_and_angle(inverse(T_begin_end) @ inverse(T_world_begin) @ T_world_end))
    if not errors:
        raise DataError(
            f"none of {len(relations)} relations has both its times within the path; are they of this "
            "log, and is its clock theirs?"
        )
    metrics = [
        Metric("relations", len(errors), "pairs"),
        Metric("relations outside the path", len(relations) - len(errors), "pairs"),
    ]
    for what, unit, values in zip(("translation", "rotation"), ("m", "rad"), np.array(errors).T, strict=True):
        found = statistics(values)
        metrics += [
            Metric(f"relations' {what} {name}", value, unit)
            for name, value in (("mean", found.mean), ("std", found.std), ("RMSE", found.rmse))
        ]
    return metrics
