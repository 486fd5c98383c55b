"""Part of a run, as exports take it: what lies in a box, in the frame that was asked for."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapper.config.loading import checked_config
from mapper.core.errors import ConfigError
from mapper.core.frames import Cloud, Points32
from mapper.core.geometry import Transform, apply, inverse
from mapper.core.trajectory import Trajectory
from mapper.graph.model import PoseGraph
from mapper.mapping.config import Edits, Region
from mapper.mapping.edits import MapEditor
from mapper.octree.grid import OccupancyGrid
from mapper.octree.map import OctreeMap
from mapper.run.folder import Run
from mapper.run.map_folder import MapFolder
from mapper.run.stored_tracking import poses_of


@dataclass(frozen=True, repr=False)
class PartOfRun(Run):
    """A run whose maps are cropped, and whose poses and points are in another frame.

    Attributes:
        T_frame_map: (4, 4) pose of the levelled world in the frame; octree and grids stay in the world.
        region: What the maps are cropped to, in the levelled world; None leaves them whole.
        poses_map: Poses of another frame on the robot than the body, in the levelled world.
    """

    T_frame_map: Transform = field(default_factory=lambda: np.eye(4))
    region: Region | None = None
    poses_map: Trajectory | None = None

    @cached_property
    def trajectory(self) -> Trajectory:
        """Poses of all placed frames."""
        poses = super().trajectory if self.poses_map is None else self.poses_map
        return poses.moved(self.T_frame_map)

    @cached_property
    def octree(self) -> OctreeMap:
        """Occupancy map."""
        octree = super().octree
        if self.region is not None:
            self.editor.crop(octree)
            octree.drop_unknown()
        return octree

    @cached_property
    def cloud(self) -> Cloud:
        """Coloured cloud."""
        whole = super().cloud
        cloud = part_of_cloud(self, whole)
        if not len(cloud):
            raise ConfigError(f"crop: no point of the cloud is in it; {_reach(whole.points)}")
        return cloud

    @cached_property
    def graph(self) -> PoseGraph:
        """Pose graph with its nodes at the solution."""
        return super().graph.moved(self.T_frame_map)

    @cached_property
    def slice(self) -> OccupancyGrid:
        """2D navigation map."""
        return self._cropped(super().slice)

    @cached_property
    def traversable(self) -> OccupancyGrid:
        """Floor that a robot can drive on."""
        return self._cropped(super().traversable)

    @cached_property
    def keepout(self) -> OccupancyGrid | None:
        """Keep-out regions."""
        grid = super().keepout
        return None if grid is None else self._cropped(grid)

    @property
    def editor(self) -> MapEditor:
        """Editor that leaves what lies in the region."""
        keep = () if self.region is None else (self.region,)
        return MapEditor(Edits(keep=keep), np.empty((0, 3)), room_m=0.0)

    def _cropped(self, grid: OccupancyGrid) -> OccupancyGrid:
        """Return the cells whose centres are in the box, seen from above."""
        if self.region is None or self.region.box_m is None:
            return grid
        low, high = np.array(self.region.box_m)[:, :2]
        begin, end = np.rint(((low, high) - grid.origin_world_m) / grid.resolution_m).astype(int)
        begin, end = (np.clip(cells, 0, grid.shape[::-1]) for cells in (begin, end))
        if not (begin < end).all():
            corners = grid.origin_world_m + np.array([[0, 0], grid.shape[::-1]]) * grid.resolution_m
            raise ConfigError(f"crop: no cell of the 2D map is in it; {_reach(corners)}")
        cells = grid.cells[begin[1] : end[1], begin[0] : end[0]]
        return replace(grid, cells=cells, origin_world_m=grid.origin_world_m + begin * grid.resolution_m)


def part_of(run: MapFolder, frame: str, box_m: Sequence[float] | None, poses: str | None = None) -> MapFolder:
    """Return a run as an export takes it; the run itself if it is to be whole and in the levelled world.

    Args:
        run: The run.
        frame: Frame of poses and points: "map", or "start" or "base", the body or the base at its first pose.
        box_m: Lowest and highest corner, x y z x y z, in the levelled world; None crops nothing.
        poses: Whose poses the trajectory has, as of ``poses_of``; None is the body.

    Raises:
        ConfigError: It is a merged map, no such frame, a run whose log has no base, or no box.
    """
    if frame == "map" and box_m is None and poses is None:
        return run
    if not isinstance(run, Run):
        raise ConfigError(f"{run.path}: a merged map is exported whole; crop or move its runs")
    if frame not in ("map", "start", "base"):
        raise ConfigError(f"frame {frame!r}: want map, start or base")
    T_frame_map, manifest = np.eye(4), run.manifest
    if frame != "map":
        T_frame_map = inverse(poses_of(run, "base" if frame == "base" else "body")[0])
        manifest = manifest.model_copy(update={"georeference": None})  # which is that of the levelled world
    region = None if box_m is None else checked_config({"box_m": (box_m[:3], box_m[3:])}, Region, "crop")
    poses_map = None if poses is None else poses_of(run, poses)
    return PartOfRun(run.path, run.config, manifest, T_frame_map, region, poses_map)


def in_map(run: Run) -> Run:
    """Return the same part of a run in the levelled world."""
    return replace(run, T_frame_map=np.eye(4)) if isinstance(run, PartOfRun) else run


def part_of_cloud(run: Run, cloud: Cloud) -> Cloud:
    """Return the points of a cloud in the levelled world that a run has, in its frame."""
    if not isinstance(run, PartOfRun):
        return cloud
    if run.region is not None:
        cloud = cloud.select(run.editor.leave(cloud.points))
    return replace(cloud, points=placed(run, cloud.points))


def placed(run: Run, points_map: Points32) -> Points32:
    """Return (N, 3) points of the levelled world in the frame of a run."""
    if not isinstance(run, PartOfRun):
        return points_map
    return apply(run.T_frame_map, points_map.astype(np.float64)).astype(np.float32)


def _reach(points: NDArray[Any]) -> str:
    low, high = (
        " ".join(f"{value:.2f}" for value in ends) for ends in (points.min(axis=0), points.max(axis=0))
    )
    return f"the map reaches from {low} to {high} m"
