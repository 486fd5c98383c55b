"""The seam of loop closure: what is remembered of a place, who proposes one, and who compares two."""

from dataclasses import dataclass
from typing import Protocol, TypeVar

from mapper.core.geometry import Array, Transform
from mapper.loops.closure import LoopClosure, ProposedBy
from mapper.odometry.base import Seen


class Stamped(Protocol):
    """Has the time at which it was seen."""

    @property
    def stamp_ns(self) -> int:
        """Time, nanoseconds."""
        ...


Place = TypeVar("Place", bound=Stamped)
"""What one sensor's loops remember of a keyframe."""
Known = TypeVar("Known", bound=Stamped, contravariant=True)
"""The same, where it is only handed over."""


@dataclass(frozen=True, slots=True)
class Proposal:
    """A known place that a view might show.

    Attributes:
        node: The place's node.
        proposed_by: Who thought of it.
        similarity: Of what the two look like, 0 … 1, if that was compared.
    """

    node: int
    proposed_by: ProposedBy
    similarity: float | None = None


class Proposer(Protocol[Known]):
    """Remembers places, and proposes those that a new one might be."""

    def propose(self, node: int, seen: Known, /, *, before: int, limit: int) -> list[Proposal]:
        """Return the likeliest of the first ``before`` places that were remembered, the likeliest first."""
        ...

    def add(self, node: int, seen: Known) -> None:
        """Take a place in; nodes come in time order."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class Verification:
    """What comparing two places came to.

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
    """Tells whether two places are one."""

    def describe(self, seen: Seen, /) -> Place:
        """Return what is to be remembered of a keyframe.

        Raises:
            ConfigError: It was seen by another sensor than these loops are for.
        """
        ...

    def verify(self, i: Place, j: Place) -> Verification:
        """Return how j lies to i, or why they are not one place. Pure."""
        ...


def measured(proposal: Proposal, node: int, i: Place, j: Place, verifier: Verifier[Place]) -> LoopClosure:
    """Return what comparing a node's place j with a proposed place i came to."""
    found = verifier.verify(i, j)
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
