"""Interface of the scan matchers: methods that register a scan to a map of earlier ones."""

from dataclasses import dataclass
from typing import Literal, Protocol

from mapper.core.frames import Scan
from mapper.core.geometry import Transform
from mapper.registration.surfaces import Prepared

Reach = Literal["near", "far"]
"""Search range around a guess: the error of the predicted motion, or the largest that the method has."""


@dataclass(frozen=True, slots=True, eq=False)
class DeskewedScan:
    """A scan as taken all at once.

    Attributes:
        scan: Thinned points, body frame, without times.
        prepared: The same thinned further, with normals and a search tree.
    """

    scan: Scan
    prepared: Prepared


class ScanMatcher(Protocol):
    """Map of earlier scans, and a method that registers a scan to it.

    Poses are those in the middle of a sweep. Planar scans of a 2D laser (``scan.is_planar``) come, too.
    What a matcher keeps are arrays, numbers and objects of this package, or it has ``__getstate__`` as
    KissMatcher has: otherwise builds run without checkpoints.

    Attributes:
        uses_guess: Whether another guess can give another pose.
    """

    uses_guess: bool

    def match(self, deskewed: DeskewedScan, T_world_body: Transform, *, reach: Reach) -> Transform | None:
        """Return the refined T_world_body of a scan from a guess; None if the method finds none.

        "far" is asked for once "near" found nothing that fits; None if the method has no wider search.
        """
        ...

    def add(self, deskewed: DeskewedScan, T_world_body: Transform, *, is_keyframe: bool) -> None:
        """Add a tracked scan, or the first one, to the map."""
        ...

    def clear(self) -> None:
        """Empty the map."""
        ...
