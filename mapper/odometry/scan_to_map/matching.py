"""The seam of the methods that place a scan in a map of earlier ones."""

from dataclasses import dataclass
from typing import Literal, Protocol

from mapper.core.frames import Scan
from mapper.core.geometry import Transform
from mapper.registration.surfaces import Prepared

Reach = Literal["near", "far"]
"""How far the truth may be from a guess: as far as motion is foreseen, or as far as the method can."""


@dataclass(frozen=True, slots=True, eq=False)
class Sweep:
    """One scan as taken all at once, at its stamp.

    Attributes:
        scan: Thinned points, body frame, without times.
        prepared: The same thinned further, with normals and a search tree.
    """

    scan: Scan
    prepared: Prepared


class Matcher(Protocol):
    """A map and a way to place scans in it."""

    def match(self, sweep: Sweep, T_world_body: Transform, *, reach: Reach) -> Transform | None:
        """Return the T_world_body of a scan from a guess; None if the method cannot say."""
        ...

    def add(self, sweep: Sweep, T_world_body: Transform, *, is_keyframe: bool) -> None:
        """Take a placed scan into the map; the first is placed by definition."""
        ...

    def clear(self) -> None:
        """Forget the map."""
        ...
