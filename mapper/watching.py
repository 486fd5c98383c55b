"""Who looks on while a map is built, without the builder knowing what they do with what they see."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

from mapper.geometry import Transform
from mapper.loops.closer import Closer
from mapper.odometry.base import Matches, Seen, Track
from mapper.sources.base import Entry

if TYPE_CHECKING:
    from mapper.fusion import Maps
    from mapper.run import Run
    from mapper.story import Story


@dataclass(frozen=True, slots=True, eq=False)
class Step:
    """One frame has been tracked.

    Attributes:
        entry: The frame; who wants its image loads it again.
        track: What tracking made of it.
        view: Gives the features that it was tracked by; costs something, so not to be asked without need.
        matches: Gives those that hold its pose, and where they were before; the same.
        closer: The loops so far, and where nodes are believed to be with them.
    """

    entry: Entry
    track: Track
    view: Callable[[], Seen]
    matches: Callable[[], Matches | None]
    closer: Closer


class Watcher(Protocol):
    """Whoever looks on. What they are told is not theirs to change."""

    def stepped(self, step: Step, /) -> None:
        """See a frame that was read, in time order, in the thread that tracks."""
        ...

    def levelled(self, T_level_world: Transform, /) -> None:
        """See where the odometry's world lies in the levelled one, once the graph is solved."""
        ...

    def mapped(self, run: "Run", story: "Story", maps: "Maps", /) -> None:
        """See the results; the run's folder still has the name of one that is being built."""
        ...


class Nobody:
    """Nobody looks on."""

    def stepped(self, step: Step, /) -> None:
        """Ignore the frame."""

    def levelled(self, T_level_world: Transform, /) -> None:
        """Ignore the world."""

    def mapped(self, run: "Run", story: "Story", maps: "Maps", /) -> None:
        """Ignore the results."""


NOBODY = Nobody()
