"""What runs and merged maps have in common."""

from collections.abc import Iterable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Self

from mapper.config.build import BuildConfig
from mapper.run import files

if TYPE_CHECKING:  # compiled code, which takes longer to load than most files of a run
    from mapper.octree.grid import OccupancyGrid
    from mapper.octree.map import OctreeMap


@dataclass(frozen=True, repr=False)
class MapFolder:
    """A run or a merged map: maps, and the settings of what is made from them.

    Attributes:
        path: Its folder.
        config: Settings.
    """

    path: Path
    config: BuildConfig
    _octree: ClassVar[str] = files.OCTREE_MAP

    def file(self, name: str) -> Path:
        """Return the path of one of its files."""
        return self.path / name

    def changing(self, _names: Iterable[str]) -> AbstractContextManager[None]:
        """Return a context in which files of the folder may be written."""
        return nullcontext()

    def with_config(self, config: BuildConfig) -> Self:
        """Return the same map with other settings, for what is made from its files."""
        return replace(self, config=config)

    @cached_property
    def octree(self) -> "OctreeMap":
        """Occupancy map, with colours and times if a run was built with ``octree.attributes``."""
        from mapper.octree.map import read_octree

        return read_octree(self.file(self._octree))

    @cached_property
    def slice(self) -> "OccupancyGrid":
        """2D navigation map: the band of heights above the floor of ``config.slice``."""
        return stored_grid(self, files.SLICE)

    @cached_property
    def traversable(self) -> "OccupancyGrid":
        """Floor that a robot can drive on, of the storey on which the first log begins."""
        return stored_grid(self, files.TRAVERSABLE)

    @cached_property
    def keepout(self) -> "OccupancyGrid | None":
        """Keep-out regions in the slice's cells; None if there are none."""
        return stored_grid(self, files.KEEPOUT) if has_grid(self, files.KEEPOUT) else None


def has_grid(folder: MapFolder, stem: str) -> bool:
    """Return whether a run or a merged map has a grid of a name, such as "slice"."""
    return (folder.path / f"{stem}.yaml").exists()


def stored_grid(folder: MapFolder, stem: str) -> "OccupancyGrid":
    """Return a grid of a run or of a merged map.

    Raises:
        RunError: A file is not as it was written.
        MapFileError: It is missing, or cannot be read.
    """
    from mapper.octree.grid import read_grid

    folder.file(f"{stem}.pgm")
    return read_grid(folder.file(f"{stem}.yaml"))
