"""Observers of a build: viewers and prompts that receive every tracked frame and the results."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:  # a command line that only helps loads none of it
    from mapper.core.geometry import Transform
    from mapper.features.frame_view import FrameView
    from mapper.loops.detector import LoopDetector
    from mapper.mapping.map_building import Maps
    from mapper.odometry.base import FeatureMatches, FrameResult
    from mapper.run.folder import Run
    from mapper.run.results import RunResults
    from mapper.sources.base import FrameRef


@dataclass(frozen=True, slots=True, eq=False)
class Step:
    """One frame has been tracked.

    Attributes:
        entry: The frame; loading it again gives its image.
        track: Its result.
        view: Returns the features that it was tracked by; computed at each call.
        matches: Returns the matches behind its pose; computed at each call.
        detector: The loops so far, and the current estimates of node poses.
    """

    entry: "FrameRef"
    track: "FrameResult"
    view: "Callable[[], FrameView]"
    matches: "Callable[[], FeatureMatches | None]"
    detector: "LoopDetector"


class Observer(Protocol):
    """Observer of a build; its arguments are read-only."""

    def on_frame(self, step: Step, /) -> None:
        """Receive a frame that was read, in time order, in the thread that tracks."""
        ...

    def on_levelled(self, T_level_world: "Transform", /) -> None:
        """Receive the pose of the odometry's world in the levelled one, once the graph is solved."""
        ...

    def on_mapped(self, run: "Run", results: "RunResults", maps: "Maps", /) -> None:
        """Receive the results; the run's folder still has the name of one that is being built."""
        ...


class Observers:
    """Observer that passes everything on to several, in their order; without any it ignores everything."""

    _observers: tuple[Observer, ...] = ()

    def __init__(self, *observers: Observer) -> None:
        self._observers = observers

    def on_frame(self, step: Step, /) -> None:
        """Pass the frame on."""
        for observer in self._observers:
            observer.on_frame(step)

    def on_levelled(self, T_level_world: "Transform", /) -> None:
        """Pass the world on."""
        for observer in self._observers:
            observer.on_levelled(T_level_world)

    def on_mapped(self, run: "Run", results: "RunResults", maps: "Maps", /) -> None:
        """Pass the results on."""
        for observer in self._observers:
            observer.on_mapped(run, results, maps)


NULL_OBSERVER = Observers()
