"""What runs and merged maps have in common."""

from collections.abc import Iterable
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, Protocol, Self

from mapper.config.build import BuildConfig

if TYPE_CHECKING:  # compiled code
    from mapper.octree.grid import OccupancyGrid
    from mapper.octree.map import OctreeMap


class MapFolder(Protocol):
    """Interface of runs and merged maps: maps, and the settings of what is made from them."""

    @property
    def path(self) -> Path:
        """Folder of the run or map."""
        ...

    @property
    def config(self) -> BuildConfig:
        """Settings."""
        ...

    @property
    def octree(self) -> "OctreeMap":
        """Occupancy map."""
        ...

    @property
    def slice(self) -> "OccupancyGrid":
        """2D navigation map."""
        ...

    @property
    def traversable(self) -> "OccupancyGrid":
        """Floor that a robot can drive on."""
        ...

    @property
    def keepout(self) -> "OccupancyGrid | None":
        """Keep-out regions in the slice's cells; None if there are none."""
        ...

    def file(self, name: str, /) -> Path:
        """Return the path of one of its files."""
        ...

    def changing(self, names: Iterable[str], /) -> AbstractContextManager[None]:
        """Return a context in which files of the folder may be written."""
        ...

    def with_config(self, config: BuildConfig, /) -> Self:
        """Return the same map with other settings."""
        ...
