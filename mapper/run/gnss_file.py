"""GNSS fixes that are factors of a run's graph: ``gnss.csv``."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np

from mapper.core.geometry import Array
from mapper.graph.model import PositionFactor
from mapper.runtime.csv_file import read_csv, write_csv

_UPPER = np.triu_indices(3)
_AXES = ("x", "y", "z")
_POSITION = tuple(f"{axis}_m" for axis in _AXES)
_ANTENNA = tuple(f"in_node_{axis}_m" for axis in _AXES)
_INFORMATION = tuple(f"info_{_AXES[i]}_{_AXES[j]}" for i, j in zip(*_UPPER, strict=True))
_COLUMNS = ("stamp_ns", "node", *_POSITION, *_ANTENNA, *_INFORMATION, "weight")


def write_fixes(path: Path, fixes: Sequence[PositionFactor]) -> None:
    """Write the fixes, in the run's world."""
    write_csv(
        path,
        _COLUMNS,
        (
            (
                fix.stamp_ns,
                fix.node,
                *fix.position_world.tolist(),
                *fix.point_node.tolist(),
                *fix.information[_UPPER].tolist(),
                fix.weight,
            )
            for fix in fixes
        ),
    )


def read_fixes(path: Path) -> tuple[PositionFactor, ...]:
    """Return the fixes of a run's file.

    Raises:
        RunError: The file cannot be read.
        DataError: It lists something else.
    """
    return read_csv(path, _COLUMNS, _fixes, of="GNSS fixes")


def _fixes(rows: Iterable[Mapping[str, str]]) -> tuple[PositionFactor, ...]:
    return tuple(
        PositionFactor(
            int(row["node"]),
            _numbers(row, _ANTENNA),
            _numbers(row, _POSITION),
            _symmetric(_numbers(row, _INFORMATION)),
            float(row["weight"]),
            int(row["stamp_ns"]),
        )
        for row in rows
    )


def _numbers(row: Mapping[str, str], names: Sequence[str]) -> Array:
    return np.array([float(row[name]) for name in names])


def _symmetric(upper: Array) -> Array:
    matrix = np.empty((3, 3))
    matrix[_UPPER] = matrix[_UPPER[::-1]] = upper
    return matrix
