"""Loop closures: every candidate with its measurement and its verdict, and the file of them."""

import json
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from mapper.core.errors import DataError, RunError
from mapper.core.geometry import Array, Transform, inverse, length_and_angle, transform
from mapper.core.rotations import quaternion_from_rotation, rotation_from_quaternion
from mapper.graph.model import BetweenFactor, Solution
from mapper.loops.config import KeyframeLoopsConfig
from mapper.runtime.atomic import write_text
from mapper.runtime.regular_files import read_text

ProposedBy = Literal["places", "scans", "nearby", "hand"]
Verdict = Literal["accepted", "rejected"]

SOLVER = "solver"
"""``LoopClosure.rejected_by`` of a loop that the rest of the graph contradicts."""

MIN_CONFLICTS = 4
"""Rejected loops that have to agree before they count against odometry or wheels."""
LEAST_AGREEING = 3
"""Loops that have to agree for two paths, or a path and a map, to be tied by them alone."""
MIN_WEIGHT = 0.5
"""A loop with less weight in the solution is rejected, and is no factor of the solved graph."""


@dataclass(frozen=True, slots=True)
class Discrepancy:
    """Distance of two poses from the relative pose that a loop closure measured."""

    translation_m: float
    rotation_rad: float


@dataclass(frozen=True, slots=True, eq=False)
class LoopClosure:
    """One candidate and its verdict.

    Attributes:
        i: Earlier node.
        j: Later node, from which the loop was found.
        stamp_i_ns: Stamp of i's frame.
        stamp_j_ns: Stamp of j's frame.
        proposed_by: The kind of proposer.
        similarity: Similarity of two images' words (Zhao et al. 2020, eq. 10) or of two scans' heights; None
            if they were not compared.
        matches: Features paired by descriptor, or upright points compared.
        inliers: Pairs that agree with the motion, in the image or in space.
        rmse_m: Root mean square distance of the agreeing points; None if none agreed.
        residual_px: Root mean square image residual of the inliers; None if none agreed.
        T_i_j: (4, 4) measured pose of j in i; None if there is no measurement.
        information: (6, 6) of j's tangent (rotation, translation); None if there is no measurement.
        verdict: Whether it is a constraint of the graph.
        reason: Why it was rejected: the step that did it, a colon, and what it found; empty when accepted.
        before: Discrepancy before the solve; None unless it was accepted until then.
        after: Discrepancy after the solve.
        weight: Weight that the solver gave it, 0 … 1.
    """

    i: int
    j: int
    stamp_i_ns: int
    stamp_j_ns: int
    proposed_by: ProposedBy
    verdict: Verdict
    reason: str = ""
    similarity: float | None = None
    matches: int = 0
    inliers: int = 0
    rmse_m: float | None = None
    residual_px: float | None = None
    T_i_j: Transform | None = None
    information: Array | None = field(default=None, repr=False)
    before: Discrepancy | None = None
    after: Discrepancy | None = None
    weight: float | None = None

    def __post_init__(self) -> None:
        if (self.verdict == "accepted") == bool(self.reason):
            raise DataError(
                f"loop {self.i} → {self.j}: verdict {self.verdict!r} with reason {self.reason!r}; "
                "a rejected loop says why, an accepted one has nothing to say"
            )
        if self.verdict == "accepted" and (self.T_i_j is None or self.information is None):
            raise DataError(f"loop {self.i} → {self.j}: accepted without a measurement")

    def rejected(self, step: str, why: str) -> "LoopClosure":
        """Return it as a loop that a step has rejected, and what that found."""
        return replace(self, verdict="rejected", reason=f"{step}: {why}")

    @property
    def rejected_by(self) -> str:
        """Step that rejected it, e.g. "isvd", "gate" or ``SOLVER``; empty when accepted."""
        return self.reason.partition(":")[0]

    @property
    def factor(self) -> BetweenFactor:
        """Constraint of the graph.

        Raises:
            DataError: Nothing was measured.
        """
        if self.T_i_j is None or self.information is None:
            raise DataError(f"loop {self.i} → {self.j}: nothing was measured, so it is no constraint")
        return BetweenFactor(self.i, self.j, self.T_i_j, self.information, "loop")


def discrepancy(T_i_j: Transform, T_world_i: Transform, T_world_j: Transform) -> Discrepancy:
    """Return the distance of node j from the pose that a measurement from node i gives it."""
    return Discrepancy(*length_and_angle(inverse(T_i_j) @ inverse(T_world_i) @ T_world_j))


def pose_difference(T_a: Transform, T_b: Transform) -> Discrepancy:
    """Return how far two poses are apart."""
    return Discrepancy(*length_and_angle(inverse(T_a) @ T_b))


def exceeds(miss: Discrepancy, limit: Discrepancy) -> bool:
    """Return whether a discrepancy is larger than a limit in either part."""
    return miss.translation_m > limit.translation_m or miss.rotation_rad > limit.rotation_rad


def has_moved(T_world_last: Transform, T_world_now: Transform, config: KeyframeLoopsConfig) -> bool:
    """Return whether loops are searched at a pose, given that of the last search."""
    moved = pose_difference(T_world_last, T_world_now)
    return exceeds(moved, Discrepancy(config.min_motion_m, config.min_motion_rad))


def accepted_loops(loops: Iterable[LoopClosure]) -> list[LoopClosure]:
    """Return the loops that are constraints of the graph."""
    return [loop for loop in loops if loop.verdict == "accepted"]


def rejections(loops: Iterable[LoopClosure]) -> dict[str, int]:
    """Return how many candidates each step rejected, the most first."""
    return dict(Counter(loop.rejected_by for loop in loops if loop.verdict == "rejected").most_common())


def why_none_accepted(loops: Sequence[LoopClosure]) -> str:
    """Return why no loop of some candidates is accepted: none looked alike, or which steps rejected them."""
    if not loops:
        return "nothing in it looks like a known place (min_similarity of loops.places or loops.context)"
    counts = ", ".join(f"{step} {count}" for step, count in rejections(loops).items())
    return f"{len(loops)} candidates compared, none held: {counts}"


def apply_solution(
    loops: Sequence[LoopClosure],
    T_world_before: Mapping[int, Transform],
    solution: Solution,
) -> tuple[LoopClosure, ...]:
    """Return the loops with their discrepancies and weights; below ``MIN_WEIGHT`` they are rejected.

    Args:
        loops: Every candidate; the accepted ones are the solved graph's last factors, in this order.
        T_world_before: Poses before the solve.
        solution: Solution of that graph.
    """
    weights = iter(solution.weights[len(solution.weights) - len(accepted_loops(loops)) :])
    return tuple(
        _apply_solution(loop, next(weights), T_world_before, solution.T_world_node)
        if loop.verdict == "accepted" and loop.T_i_j is not None
        else loop
        for loop in loops
    )


def _apply_solution(
    loop: LoopClosure,
    weight: float,
    T_world_before: Mapping[int, Transform],
    T_world_after: Mapping[int, Transform],
) -> LoopClosure:
    assert loop.T_i_j is not None
    solved = replace(
        loop,
        before=discrepancy(loop.T_i_j, T_world_before[loop.i], T_world_before[loop.j]),
        after=discrepancy(loop.T_i_j, T_world_after[loop.i], T_world_after[loop.j]),
        weight=weight,
    )
    if weight >= MIN_WEIGHT:
        return solved
    return solved.rejected(SOLVER, f"contradicts the rest of the graph, weight {weight:.2f}")


def write_closures(path: Path, closures: Iterable[LoopClosure]) -> None:
    """Write one JSON object per line; numbers keep every digit."""
    write_text(path, "".join(json.dumps(_fields(closure)) + "\n" for closure in closures))


def read_closures(path: Path) -> list[LoopClosure]:
    """Return what ``write_closures`` wrote.

    Raises:
        RunError: The file cannot be read.
        DataError: A line is not a loop closure; the message names it.
    """
    lines = read_text(path, error=RunError).splitlines()
    closures = []
    for number, line in enumerate(lines, start=1):
        try:
            closures.append(_closure(json.loads(line)))
        except (KeyError, TypeError, ValueError, RecursionError, DataError) as error:
            raise DataError(f"{path}:{number}: not a loop closure: {error!r}") from None
    return closures


def _fields(closure: LoopClosure) -> dict[str, Any]:
    values: dict[str, Any] = {}
    for one in fields(closure):
        value = getattr(closure, one.name)
        if one.name == "T_i_j":
            values["translation_m"] = None if value is None else value[:3, 3].tolist()
            values["rotation_xyzw"] = (
                None if value is None else quaternion_from_rotation(value[:3, :3]).tolist()
            )
        elif isinstance(value, Discrepancy):
            values[one.name] = asdict(value)
        else:
            values[one.name] = value.tolist() if isinstance(value, np.ndarray) else value
    return values


def _closure(values: dict[str, Any]) -> LoopClosure:
    rest = dict(values)
    translation_m, rotation_xyzw = rest.pop("translation_m"), rest.pop("rotation_xyzw")
    information = rest.pop("information")
    before, after = rest.pop("before"), rest.pop("after")
    T_i_j = None
    if translation_m is not None:
        T_i_j = transform(rotation_from_quaternion(np.array(rotation_xyzw)), np.array(translation_m))
    return LoopClosure(
        **rest,
        T_i_j=T_i_j,
        information=None if information is None else np.array(information),
        before=None if before is None else Discrepancy(**before),
        after=None if after is None else Discrepancy(**after),
    )
