"""Pose graphs as g2o text (Kümmerle et al. 2011), as GTSAM, g2o and SE-Sync read it, and TORO's in 2D."""

from collections import Counter
from collections.abc import Callable, Container, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import chain, pairwise
from pathlib import Path
from typing import get_args

import numpy as np
from numpy.typing import NDArray

from mapper.core.errors import GraphError, MapperError, listed
from mapper.core.geometry import Array
from mapper.core.rotations import pose_of_row, row_of_pose
from mapper.graph.components import by_odometry
from mapper.graph.model import BetweenFactor, Origin, PoseGraph
from mapper.runtime.atomic import write_text
from mapper.runtime.progress import SILENT, Progress
from mapper.runtime.regular_files import read_text

# g2o orders a pose's tangent (translation, rotation); ours is (rotation, translation).
_SWAPPED = np.array([3, 4, 5, 0, 1, 2])
_PLANAR = np.array([3, 4, 2])
"""Indices of x, y and yaw in the tangent."""


def _swap(information: Array) -> Array:
    """Return (N, 6, 6) matrices from g2o's order of the tangent in ours, or back."""
    return information[:, _SWAPPED][:, :, _SWAPPED]


def _symmetric(upper: Array, rows: int) -> Array:
    """Return (N, rows, rows) symmetric matrices of their upper triangles, row by row."""
    where = np.triu_indices(rows)
    matrices = np.zeros((len(upper), rows, rows))
    matrices[:, *where] = upper
    matrices[:, *where[::-1]] = upper
    return matrices


def _lift(planar: Array) -> Array:
    """Return (N, 6, 6) of (N, 3, 3) over (x, y, yaw): the other motions get an edge's largest information."""
    largest = planar.diagonal(axis1=1, axis2=2).max(axis=1)
    information: Array = largest[:, np.newaxis, np.newaxis] * np.eye(6)
    information[:, _PLANAR[:, np.newaxis], _PLANAR] = planar
    return information


def _as_gtsam_takes(information: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Return positive definite matrices in place of indefinite ones, and which were.

    GTSAM weighs residuals with the Cholesky factor R of the information, information = RᵀR. Eigen's LLT
    stops at the first pivot that is not positive and leaves the rest of R as the matrix had it;
    costs published for such graphs rest on that R.

    Args:
        information: (N, k, k) symmetric, with positive diagonals, in GTSAM's order.
    """
    factor = np.tril(information)
    positive = np.ones(len(factor), dtype=np.bool_)
    for k in range(factor.shape[1]):
        done = factor[:, k, :k]
        pivot = factor[:, k, k] - (done * done).sum(axis=1)
        positive &= pivot > 0.0
        root = np.sqrt(pivot[positive])
        below = factor[positive, k + 1 :, k] - np.einsum(
            "nij,nj->ni", factor[positive, k + 1 :, :k], done[positive]
        )
        factor[positive, k, k] = root
        factor[positive, k + 1 :, k] = below / root[:, np.newaxis]
    taken = information.copy()
    taken[~positive] = factor[~positive] @ np.swapaxes(factor[~positive], 1, 2)
    return taken, ~positive


_Row = tuple[int, list[int], str, Array]
"""Line, ids, note and pose of a vertex or an edge."""
_ORIGINS: tuple[Origin, ...] = get_args(Origin)
_PARAMETERS = "PARAMS_"
"""Begins tags of sensors' mountings, which the g2o library writes; no edge that is read here uses one."""
_LARGEST_ID = np.iinfo(np.int64).max
_SHORTEST = 1e-9
"""A quaternion shorter than this has no direction."""


def write_g2o(path: Path, graph: PoseGraph, *, rejected: Container[int] = ()) -> None:
    """Write ``VERTEX_SE3:QUAT``, ``FIX`` (the first node unless others are fixed), ``EDGE_SE3:QUAT``.

    Data without a g2o tag stand behind a ``#`` at the line's end, which other readers ignore:
    ``# stamp_ns 1305031102175304000`` of a node, ``# origin loop`` of a factor. The information is that of
    the rotation vector (rad⁻²), as GTSAM takes it; the g2o library itself means half-angles.

    Args:
        path: File to write.
        graph: Nodes and factors.
        rejected: Indices of factors that do not hold; their lines are comments.

    Raises:
        GraphError: The graph has no nodes.
    """
    if not graph.T_world_node:
        raise GraphError(f"{path}: a graph without nodes is not written; was any frame tracked?")
    poses = _pose_texts(np.array(list(graph.T_world_node.values())))
    lines = [
        f"VERTEX_SE3:QUAT {node} {pose} # stamp_ns {graph.stamps_ns[node]}"
        for node, pose in zip(graph.T_world_node, poses, strict=True)
    ]
    lines += [f"FIX {node}" for node in graph.fixed or list(graph.T_world_node)[:1]]
    if graph.factors:
        information = np.array([factor.information for factor in graph.factors])
        information = 0.5 * (information + np.swapaxes(information, 1, 2))
        upper = _swap(information)[:, *np.triu_indices(6)]
        motions = _pose_texts(np.array([factor.T_i_j for factor in graph.factors]))
        lines += [
            f"{'# rejected ' if k in rejected else ''}EDGE_SE3:QUAT {factor.i} {factor.j} {motion} "
            f"{_numbers_text(row)} # origin {factor.origin}"
            for k, (factor, motion, row) in enumerate(zip(graph.factors, motions, upper, strict=True))
        ]
    write_text(path, "\n".join(lines) + "\n")


def read_g2o(path: Path, *, guess_loops: bool = False, progress: Progress = SILENT) -> PoseGraph:
    """Read a 3D graph, or a 2D one lifted into the plane z = 0.

    A vertex without a stamp gets its id as nanoseconds, which only orders it. A 2D edge holds the
    three motions out of its plane with its own largest information. Information with a negative
    eigenvalue, as in the published cubicle graph, is what GTSAM's Cholesky factor makes of it. Of edges
    alone the poses are chained, each to an earlier id by the edge between the nearest.

    Args:
        path: The file.
        guess_loops: An edge without an origin is a loop unless it joins a vertex to the next one, by the ids
            or in the file, whichever has more edges between neighbours; otherwise it counts as odometry.
        progress: Receives a note of how many edges have such information or none, of poses that are chained,
            and of priors and landmarks, which are left out.

    Raises:
        GraphError: The file cannot be read, has no poses, or a line has an unknown tag, a wrong number of
            columns, a number that is not finite, an id that is unknown or taken, or
            information whose diagonal is not positive; the message names file and line. Or loops are to
            be guessed, and edges join fewer than half of the neighbours in either order.
    """
    tables = _tables(path, progress)
    graph = PoseGraph()
    edges = _in_order(path, tables, _EDGES)
    vertices = _in_order(path, tables, _VERTICES)
    are_chained = not vertices
    if are_chained:
        line_of = {node: line for line, ids, _, _ in edges for node in ids}
        vertices = [(line_of[node], [node], "", np.eye(4)) for node in sorted(line_of)]
    for line, (node,), note, T_world_node in vertices:
        try:
            graph.add_node(node, int(_noted(note, "stamp_ns", str(node))), T_world_node)
        except (MapperError, ValueError) as error:
            raise GraphError(f"{path}:{line}: {error}") from None
    if not graph.T_world_node:
        raise GraphError(f"{path}: no poses; want g2o text with {' or '.join(_FORMS)} lines")
    graph.fixed = _fixed(path, tables.get(_FIX, _Table()), graph)
    informations = _informations(path, tables, progress)
    rank = {}
    if guess_loops and not all(note.split()[:1] == ["origin"] for _, _, note, _ in edges):
        rank = _order_of_travel(path, list(graph.T_world_node), [ids for _, ids, _, _ in edges])
    for line, (i, j), note, T_i_j in edges:
        try:
            are_neighbours = abs(rank.get(i, 0) - rank.get(j, 0)) == 1
            unnamed: Origin = "loop" if guess_loops and not are_neighbours else "odometry"
            graph.add_factors([BetweenFactor(i, j, T_i_j, informations[line], _origin(note, unnamed))])
        except MapperError as error:
            raise GraphError(f"{path}:{line}: {error}") from None
    if are_chained:
        progress.note(f"{path}: no vertices; {len(vertices)} initial poses are chained along its edges")
        nearest_first = sorted(graph.factors, key=lambda factor: abs(factor.j - factor.i))
        graph = graph.with_poses(by_odometry(graph.with_factors(nearest_first)))
    return graph


def _order_of_travel(path: Path, nodes: Sequence[int], edges: Sequence[Sequence[int]]) -> dict[int, int]:
    """Return the position of each node on the way, by the order whose neighbours have more edges."""
    pairs = {frozenset(ids) for ids in edges}

    def joined(order: Sequence[int]) -> int:
        return sum(frozenset(pair) in pairs for pair in pairwise(order))

    order = max(sorted(nodes), nodes, key=joined)
    if 2 * joined(order) < len(nodes) - 1:
        raise GraphError(
            f"{path}: edges join {joined(order)} of {len(nodes) - 1} pairs of neighbouring vertices, by their"
            " ids or in the file, so nothing tells odometry from loops; write the vertices in the order of "
            "the way, or --robust none keeps every edge"
        )
    return {node: k for k, node in enumerate(order)}


@dataclass(frozen=True, slots=True)
class _Form:
    """Meaning of the numbers of a line.

    Attributes:
        ids: Number of node ids.
        pose_numbers: Number of columns of a pose.
        poses: Function that makes (N, 4, 4) poses of (N, pose_numbers).
        information_rows: Rows of the information matrix whose upper triangle follows; 0 for none.
    """

    ids: int
    pose_numbers: int
    poses: Callable[[Array], Array]
    information_rows: int = 0

    @property
    def columns(self) -> int:
        return self.ids + self.pose_numbers + self.information_rows * (self.information_rows + 1) // 2


@dataclass(slots=True)
class _Table:
    """All lines of one tag: where they stand, their ids, numbers and notes."""

    lines: list[int] = field(default_factory=list)
    ids: list[list[int]] = field(default_factory=list)
    numbers: list[list[float]] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def refuse(self, path: Path, bad: NDArray[np.bool_], why: str) -> None:
        """Raise an error that names the first line with a bad value, if there is one."""
        lines = bad.reshape(len(self.lines), -1).any(axis=1)
        if lines.any():
            raise GraphError(f"{path}:{self.lines[int(np.argmax(lines))]}: {why}")


def _no_poses(numbers: Array) -> Array:
    return np.empty((len(numbers), 0))


def _poses_2d(numbers: Array) -> Array:
    poses = np.tile(np.eye(4), (len(numbers), 1, 1))
    cosine, sine = np.cos(numbers[:, 2]), np.sin(numbers[:, 2])
    poses[:, 0, 0], poses[:, 0, 1], poses[:, 1, 0], poses[:, 1, 1] = cosine, -sine, sine, cosine
    poses[:, :2, 3] = numbers[:, :2]
    return poses


_VERTICES = {"VERTEX_SE3:QUAT": _Form(1, 7, pose_of_row), "VERTEX_SE2": _Form(1, 3, _poses_2d)}
_EDGES = {"EDGE_SE3:QUAT": _Form(2, 7, pose_of_row, 6), "EDGE_SE2": _Form(2, 3, _poses_2d, 3)}
_FORMS = _VERTICES | _EDGES
_TORO = {"VERTEX2": "VERTEX_SE2", "EDGE2": "EDGE_SE2"}
"""Tags of TORO (Grisetti et al. 2007), and those of g2o with the same numbers, but for their order."""
_TORO_EDGE = [0, 1, 2, 3, 4, 5, 6, 9, 7, 10, 8]
"""Of ids, motion and I₁₁ I₁₂ I₂₂ I₃₃ I₁₃ I₂₃ the order that g2o has."""
_FIX = "FIX"
_LANDMARKS = frozenset({"VERTEX_XY", "VERTEX_TRACKXYZ"})
_LEFT_OUT = {
    **dict.fromkeys(
        ("EDGE_SE3_PRIOR", "EDGE_PRIOR_SE2", "EDGE_PRIOR_SE2_XY", "EDGE_SE2_PRIOR"), "priors on single poses"
    ),
    **dict.fromkeys(_LANDMARKS, "landmarks"),
    **dict.fromkeys(
        ("EDGE_SE2_XY", "EDGE_BEARING_SE2_XY", "EDGE_SE3_TRACKXYZ", "EDGE_PROJECT_DEPTH"),
        "sightings of landmarks",
    ),
}
"""What lines are that are not solved, by their tags, of which g2o's library has these."""
_FORTRAN = str.maketrans("Dd", "ee")
"""Fortran writes exponents as 1.0D+00."""
_IDENTITY_INFORMATION = {n: ["1" if i == j else "0" for i in range(n) for j in range(i, n)] for n in (3, 6)}
"""Words of the upper triangle of an identity matrix, by its rows."""


def _tables(path: Path, progress: Progress) -> dict[str, _Table]:
    """Sort the lines by their tags; numbers are checked in bulk afterwards."""
    tables: dict[str, _Table] = {}
    left_out = Counter[str]()
    landmarks = set[str]()
    uninformed = 0
    lines = read_text(path, error=GraphError).splitlines()
    for line, text in enumerate(lines, start=1):
        body, _, note = text.partition("#")
        tag, *words = body.split() or [""]
        if tag == "" or tag.startswith(_PARAMETERS):
            continue
        if tag in _LEFT_OUT:
            left_out[_LEFT_OUT[tag]] += 1
            landmarks.update(words[:1] if tag in _LANDMARKS else [])
            continue
        if tag in _TORO:
            words = [words[k] for k in _TORO_EDGE] if len(words) == len(_TORO_EDGE) else words
            tag = _TORO[tag]
        form = _Form(len(words), 0, _no_poses) if tag == _FIX else _FORMS.get(tag)
        if form is None:
            known = ", ".join((*_FORMS, *_TORO, _FIX))
            raise GraphError(f"{path}:{line}: unknown tag {tag!r}; want one of {known}")
        if len(words) == form.ids + form.pose_numbers and form.information_rows:
            words += _IDENTITY_INFORMATION[form.information_rows]
            uninformed += 1
        if len(words) != form.columns:
            raise GraphError(f"{path}:{line}: {len(words)} columns after the tag, want {form.columns}")
        table = tables.setdefault(tag, _Table())
        try:
            if not all(word.lstrip("-").isdecimal() for word in words[: form.ids]):
                raise ValueError(f"{' and '.join(words[: form.ids])}, want whole numbers as ids")
            table.ids.append([int(word) for word in words[: form.ids]])
            table.numbers.append(_floats(words[form.ids :]))
        except ValueError as error:
            remedy = "; numbers need a decimal point, not a comma" if "," in body else ""
            raise GraphError(f"{path}:{line}: {error}{remedy}") from None
        table.lines.append(line)
        table.notes.append(note)
    if (fixed := tables.get(_FIX)) is not None:
        fixed.ids = [[one for one in ids if f"{one}" not in landmarks] for ids in fixed.ids]
    if left_out:
        counts = listed([f"{number} {what}" for what, number in left_out.items()])
        progress.note(f"{path}: {counts} are left out; edges between poses alone are solved")
    if uninformed:
        progress.note(f"{path}: {uninformed} edges have no information; it is taken as identity")
    for table in tables.values():
        table.refuse(path, np.array([min(ids, default=0) < 0 for ids in table.ids]), "an id is negative")
        too_large = np.array([max(ids, default=0) > _LARGEST_ID for ids in table.ids])
        table.refuse(path, too_large, f"an id is more than {_LARGEST_ID}")
    if (planar := tables.get("EDGE_SE2")) is not None:
        turns = np.array([abs(numbers[2]) > 2.0 * np.pi for numbers in planar.numbers])
        planar.refuse(path, turns, "it turns by more than 2π; is the angle in degrees? want radians")
    return tables


def _floats(words: Sequence[str]) -> list[float]:
    try:
        return [float(word) for word in words]
    except ValueError:
        with suppress(ValueError):
            return [float(word.translate(_FORTRAN)) for word in words]
        raise


def _in_order(path: Path, tables: dict[str, _Table], forms: dict[str, _Form]) -> list[_Row]:
    """Return some tags' lines in the file's order."""
    rows: list[_Row] = []
    for tag, table in tables.items():
        if tag not in forms:
            continue
        form = forms[tag]
        numbers = np.array(table.numbers)
        table.refuse(path, ~np.isfinite(numbers), "a number is not finite")
        pose = numbers[:, : form.pose_numbers]
        if form.poses is pose_of_row:
            lengths = np.linalg.norm(pose[:, 3:], axis=1)
            table.refuse(path, lengths < _SHORTEST, "its quaternion is zero and has no direction")
        rows += zip(table.lines, table.ids, table.notes, form.poses(pose), strict=True)
    return sorted(rows, key=lambda row: row[0])


def _fixed(path: Path, table: _Table, graph: PoseGraph) -> tuple[int, ...]:
    """Return the nodes that the file says to keep."""
    for line, ids in zip(table.lines, table.ids, strict=True):
        for node in ids:
            if node not in graph.T_world_node:
                raise GraphError(f"{path}:{line}: FIX of node {node}, which is not in the graph")
    return tuple(dict.fromkeys(chain.from_iterable(table.ids)))


def _informations(path: Path, tables: dict[str, _Table], progress: Progress) -> dict[int, Array]:
    """Return the (6, 6) information of every edge, in our tangent, by its line."""
    informations: dict[int, Array] = {}
    indefinite = 0
    for tag, table in tables.items():
        if tag not in _EDGES:
            continue
        form = _EDGES[tag]
        given = _symmetric(np.array(table.numbers)[:, form.pose_numbers :], form.information_rows)
        is_planar = form.information_rows == 3
        if not is_planar:
            given = _swap(given)
        table.refuse(path, ~np.isfinite(given), "a number is not finite")
        diagonal = given.diagonal(axis1=1, axis2=2)
        table.refuse(
            path,
            diagonal <= 0.0,
            "its information is not positive definite: a diagonal value is not positive",
        )
        taken, mended = _as_gtsam_takes(given)
        indefinite += int(mended.sum())
        informations |= zip(table.lines, _lift(taken) if is_planar else taken, strict=True)
    if indefinite:
        progress.note(
            f"{path}: {indefinite} of {len(informations)} edges have indefinite information, "
            "taken as GTSAM takes it: by its Cholesky factor as far as that goes"
        )
    return informations


def _noted(note: str, name: str, missing: str) -> str:
    """Return the word after ``name`` in the note behind ``#``."""
    words = note.split()
    return words[1] if len(words) == 2 and words[0] == name else missing


def _origin(note: str, missing: Origin) -> Origin:
    named = _noted(note, "origin", missing)
    for origin in _ORIGINS:
        if named == origin:
            return origin
    raise GraphError(f"origin {named!r}: want one of {', '.join(_ORIGINS)}")


def _pose_texts(poses: Array) -> list[str]:
    """Return (N, 4, 4) poses as ``x y z qx qy qz qw``."""
    return [_numbers_text(row) for row in row_of_pose(poses)]


def _numbers_text(numbers: Array) -> str:
    return " ".join(map(repr, numbers.tolist()))
