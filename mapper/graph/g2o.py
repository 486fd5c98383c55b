"""Pose graphs as g2o text (Kümmerle et al. 2011), as GTSAM, g2o and SE-Sync read it."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import get_args

import numpy as np
from numpy.typing import NDArray

from mapper.atomic import write_text
from mapper.errors import GraphError, MapperError
from mapper.geometry import Array, Transform, transform
from mapper.graph.model import BetweenFactor, Origin, PoseGraph
from mapper.rotations import quaternion_from_rotation, rotation_from_euler, rotation_from_quaternion

# g2o orders a pose's tangent (translation, rotation); ours is (rotation, translation).
_SWAPPED = np.ix_([3, 4, 5, 0, 1, 2], [3, 4, 5, 0, 1, 2])
_UPPER_3D = np.triu_indices(6)
_UPPER_2D = np.triu_indices(3)
_PLANAR = np.array([3, 4, 2])
"""Where x, y and yaw stand in our tangent."""


def write_g2o(path: Path, graph: PoseGraph) -> None:
    """Write ``VERTEX_SE3:QUAT``, ``FIX`` of the first node, and ``EDGE_SE3:QUAT`` with every digit.

    What g2o has no words for stands behind a ``#`` at the line's end, where other readers do not look:
    ``# stamp_ns 1305031102175304000`` of a node, ``# origin loop`` of a factor. The information is that of
    the rotation vector (rad⁻²), as GTSAM takes it; the g2o library itself means half-angles.

    Raises:
        GraphError: The graph has no nodes, which no file could say.
    """
    if not graph.T_world_node:
        raise GraphError(f"{path}: a graph without nodes is not written; was any frame tracked?")
    lines = [
        f"VERTEX_SE3:QUAT {node} {_pose_text(T)} # stamp_ns {graph.stamps_ns[node]}"
        for node, T in graph.T_world_node.items()
    ]
    lines.append(f"FIX {next(iter(graph.T_world_node))}")
    for factor in graph.factors:
        information = (0.5 * (factor.information + factor.information.T))[_SWAPPED]
        lines.append(
            f"EDGE_SE3:QUAT {factor.i} {factor.j} {_pose_text(factor.T_i_j)} "
            f"{_numbers_text(information[_UPPER_3D])} # origin {factor.origin}"
        )
    write_text(path, "\n".join(lines) + "\n")


def read_g2o(path: Path) -> PoseGraph:
    """Read a 3D graph, or a 2D one lifted into the plane z = 0.

    A vertex without a stamp gets its id as nanoseconds, which only orders it. A 2D edge holds the
    three motions out of its plane with its own largest information.

    Raises:
        GraphError: The file cannot be read, has no vertices, or a line has an unknown tag, a wrong
            number of columns, a number that is not finite, an id that is unknown or taken, or
            information that is not positive definite; the message names file and line.
    """
    graph = PoseGraph()
    edges: list[tuple[int, BetweenFactor]] = []
    for number, line in enumerate(_text(path).splitlines(), start=1):
        body, _, note = line.partition("#")
        tag, *words = body.split() or [""]
        if tag in ("", "FIX"):
            continue
        try:
            if tag in _VERTICES:
                node, T_world_node = _vertex(words, _VERTICES[tag])
                graph.add_node(node, int(_noted(note, "stamp_ns", str(node))), T_world_node)
            elif tag in _EDGES:
                edges.append((number, _edge(words, _EDGES[tag], _noted(note, "origin", "odometry"))))
            else:
                known = ", ".join((*_VERTICES, *_EDGES, "FIX"))
                raise GraphError(f"unknown tag {tag!r}; want one of {known}")
        except (MapperError, ValueError) as error:
            raise GraphError(f"{path}:{number}: {error}") from None
    if not graph.T_world_node:
        raise GraphError(f"{path}: no vertices; want g2o text with {' or '.join(_VERTICES)} lines")
    for number, factor in edges:
        try:
            graph.add_factors([factor])
        except GraphError as error:
            raise GraphError(f"{path}:{number}: {error}") from None
    return graph


@dataclass(frozen=True, slots=True)
class _Kind:
    """How many numbers a pose and its information take, and what they mean."""

    pose_numbers: int
    information_numbers: int
    pose: Callable[[Array], Transform]
    information: Callable[[Array], Array]


def _vertex(words: list[str], kind: _Kind) -> tuple[int, Transform]:
    _refuse_columns(words, 1 + kind.pose_numbers)
    return int(words[0]), kind.pose(_finite(words[1:]))


def _edge(words: list[str], kind: _Kind, origin: str) -> BetweenFactor:
    _refuse_columns(words, 2 + kind.pose_numbers + kind.information_numbers)
    for known in get_args(Origin):
        if origin == known:
            numbers = _finite(words[2:])
            T_i_j = kind.pose(numbers[: kind.pose_numbers])
            information = kind.information(numbers[kind.pose_numbers :])
            return BetweenFactor(int(words[0]), int(words[1]), T_i_j, information, known)
    raise GraphError(f"origin {origin!r}: want one of {', '.join(get_args(Origin))}")


def _pose_3d(numbers: Array) -> Transform:
    return transform(rotation_from_quaternion(numbers[3:]), numbers[:3])


def _pose_2d(numbers: Array) -> Transform:
    x_m, y_m, yaw_rad = numbers
    return transform(rotation_from_euler(0.0, 0.0, float(yaw_rad)), np.array([x_m, y_m, 0.0]))


def _information_3d(upper: Array) -> Array:
    information: Array = _symmetric(upper, _UPPER_3D)[_SWAPPED]
    return information


def _information_2d(upper: Array) -> Array:
    planar = _symmetric(upper, _UPPER_2D)
    information: Array = np.eye(6) * planar.diagonal().max()
    information[np.ix_(_PLANAR, _PLANAR)] = planar
    return information


def _symmetric(upper: Array, where: tuple[NDArray[np.intp], ...]) -> Array:
    size = int(where[0][-1]) + 1
    matrix = np.zeros((size, size))
    matrix[where] = upper
    matrix.T[where] = upper
    return matrix


_VERTICES = {
    "VERTEX_SE3:QUAT": _Kind(7, 0, _pose_3d, _information_3d),
    "VERTEX_SE2": _Kind(3, 0, _pose_2d, _information_2d),
}
_EDGES = {
    "EDGE_SE3:QUAT": _Kind(7, 21, _pose_3d, _information_3d),
    "EDGE_SE2": _Kind(3, 6, _pose_2d, _information_2d),
}


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="ascii")
    except OSError as error:
        raise GraphError(f"{path}: cannot be read: {error.strerror}") from None
    except UnicodeDecodeError as error:
        raise GraphError(f"{path}: byte {error.start} is not ASCII; is this really a g2o file?") from None


def _refuse_columns(words: list[str], wanted: int) -> None:
    if len(words) != wanted:
        raise GraphError(f"{len(words)} columns after the tag, want {wanted}")


def _finite(words: list[str]) -> Array:
    numbers = np.array([float(word) for word in words])
    if not np.isfinite(numbers).all():
        raise GraphError("a number is not finite")
    return numbers


def _noted(note: str, name: str, missing: str) -> str:
    """Return the word after ``name`` in the note behind ``#``."""
    words = note.split()
    return words[1] if len(words) == 2 and words[0] == name else missing


def _pose_text(T: Transform) -> str:
    return _numbers_text(np.concatenate([T[:3, 3], quaternion_from_rotation(T[:3, :3])]))


def _numbers_text(numbers: Array) -> str:
    return " ".join(repr(float(number)) for number in numbers)
