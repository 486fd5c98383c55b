"""Interfaces of loop closure: proposers of known places, and verifiers of two places."""

from dataclasses import dataclass
from typing import Protocol, TypeVar

from mapper.core.geometry import Array, Transform
from mapper.features.frame_view import FrameView
from mapper.loops.closure import LoopClosure, ProposedBy


class Stamped(Protocol):
    """Anything with a time stamp."""

    @property
    def stamp_ns(self) -> int:
        """Time, nanoseconds."""
        ...


Place = TypeVar("Place", bound=Stamped)
"""Description of a keyframe, of one sensor's loops."""
Known = TypeVar("Known", bound=Stamped, contravariant=True)
"""The same, where it is only handed over."""


@dataclass(frozen=True, slots=True)
class Proposal:
    """A known place that a view might show.

    Attributes:
        node: The place's node.
        proposed_by: The kind of proposer.
        similarity: Similarity of the two, 0 … 1, if it was computed.
    """

    node: int
    proposed_by: ProposedBy
    similarity: float | None = None


class Proposer(Protocol[Known]):
    """Proposer of known places that a new one might be."""

    def propose(self, node: int, seen: Known, /, *, before: int, limit: int) -> list[Proposal]:
        """Return the most likely known places, the most likely first.

        Args:
            node: Node of the new place, whose pose is known; the place itself is not added.
            seen: Description of the new place.
            before: Number of places, from the first that was added, that are compared.
            limit: Largest number to return.
        """
        ...

    def add(self, node: int, seen: Known) -> None:
        """Add a place; nodes come in time order."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class Verification:
    """Result of comparing two places.

    Attributes:
        matches: Pairs that were compared: of features, or of points.
        reason: Why it is not one place; empty if it is.
        inliers: Pairs that agree with the motion.
        rmse_m: Root mean square distance of the points that agree in space, metres.
        residual_px: Root mean square image residual of the inliers, pixels of the finest octave.
        T_i_j: (4, 4) pose of j's body in i's, None without agreement.
        information: (6, 6) of j's tangent (rotation, translation), None without agreement.
    """

    matches: int
    reason: str
    inliers: int = 0
    rmse_m: float | None = None
    residual_px: float | None = None
    T_i_j: Transform | None = None
    information: Array | None = None


class Verifier(Protocol[Place]):
    """Verifier of loops: tests whether two places are one, and measures the motion between them."""

    def describe(self, seen: FrameView, /) -> Place:
        """Return the description of a keyframe that is kept.

        Raises:
            ConfigError: It is of another sensor than these loops are for.
        """
        ...

    def verify(self, i: Place, j: Place) -> Verification:
        """Return the pose of j in i, or why they are not one place. Pure."""
        ...


def verify_proposal(
    proposal: Proposal, node: int, i: Place, j: Place, verifier: Verifier[Place]
) -> LoopClosure:
    """Return the loop closure of a node with a proposed place, accepted or rejected.

    Args:
        proposal: Proposal of the known place.
        node: The later node.
        i: Description of the known place.
        j: Description of the node's own place.
        verifier: Compares the two.
    """
    return closure_of(proposal, node, i, j, verifier.verify(i, j))


def closure_of(proposal: Proposal, node: int, i: Stamped, j: Stamped, found: Verification) -> LoopClosure:
    """Return the result of comparing two places as a loop closure; arguments as of ``verify_proposal``."""
    return LoopClosure(
        i=proposal.node,
        j=node,
        stamp_i_ns=i.stamp_ns,
        stamp_j_ns=j.stamp_ns,
        proposed_by=proposal.proposed_by,
        verdict="rejected" if found.reason else "accepted",
        reason=found.reason,
        similarity=proposal.similarity,
        matches=found.matches,
        inliers=found.inliers,
        rmse_m=found.rmse_m,
        residual_px=found.residual_px,
        T_i_j=found.T_i_j,
        information=found.information,
    )
