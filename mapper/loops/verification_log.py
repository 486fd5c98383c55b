"""Record of a loop detector's searches, from which its state is restored without repeating them."""

from dataclasses import dataclass, field
from typing import Any

from mapper.core.errors import FrameError
from mapper.features.frame_view import FrameView
from mapper.loops.base import Verification, Verifier
from mapper.runtime.archived import Archived, archived


@dataclass(slots=True, eq=False)
class LoopSearch:
    """Record of a search for loops from one node: the parts that take long to repeat.

    Attributes:
        place: Reference to the node's description; None if no loops were searched from it.
        found: Result of comparing two places, by their stamps (i, j).
    """

    place: Archived[Any] | None = None
    found: dict[tuple[int, int], Verification] = field(default_factory=dict)


class VerificationLog:
    """Verifier that records the results of another one, and returns them when a search is repeated.

    All else in a loop detector follows from the nodes and from this, and is cheap: given the same nodes and
    the same searches, a new detector comes to the same state, to the bit.
    """

    def __init__(self, verifier: Verifier[Any] | None) -> None:
        """Start before the first node; None is for a detector that compares nothing."""
        self._verifier = verifier
        self._repeated: LoopSearch | None = None
        self._new = LoopSearch()

    def describe(self, seen: FrameView, /) -> Any:
        """Return the description of a keyframe that is kept; see ``Verifier``."""
        if self._repeated is not None:
            assert self._repeated.place is not None
            return self._repeated.place.data
        assert self._verifier is not None
        place = self._verifier.describe(seen)
        self._new.place = archived(place)
        return place

    def verify(self, i: Any, j: Any) -> Verification:
        """Return the pose of j in i, or why they are not one place."""
        key = i.stamp_ns, j.stamp_ns
        if self._repeated is not None:
            return self._repeated.found[key]
        assert self._verifier is not None
        found = self._new.found[key] = self._verifier.verify(i, j)
        return found

    def take(self) -> LoopSearch:
        """Return the search since the last call."""
        new, self._new = self._new, LoopSearch()
        return new

    def repeat(self, search: LoopSearch | None) -> None:
        """Return a search's results from now on; None returns to verifying."""
        self._repeated = search
        self._new = LoopSearch()

    def view(self) -> FrameView:
        """Return what stands for the view of the node whose search is repeated.

        Raises:
            FrameError: It could not be read then, or was not requested.
        """
        if self._repeated is None or self._repeated.place is None:
            raise FrameError("a frame from which no loop was searched")
        view: FrameView = self._repeated.place.data
        return view
