"""Ray casting of a scan at its pose: the free and occupied voxels, before a map is updated with them."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from mapper.core.errors import DataError
from mapper.core.frames import Points32, Scan
from mapper.core.geometry import Array, Transform, apply
from mapper.octree import kernels
from mapper.octree.config import OctreeConfig
from mapper.octree.keys import KEY_COUNT, KEY_ZERO
from mapper.octree.window import Window, WindowBuffer, block_codes, take_touched
from mapper.sensing.depth_limit import DepthLimit

_NO_POINTS: Points32 = np.empty((0, 3), np.float32)


class Cast(NamedTuple):
    """A scan rasterised into a window; reading the cells must reset them to UNTOUCHED.

    Attributes:
        window: The window around the scan.
        positions: (B,) int64 positions of the touched blocks in the window.
        codes: (B,) int64 Morton codes of the same blocks.
    """

    window: Window
    positions: NDArray[np.int64]
    codes: NDArray[np.int64]


class Caster:
    """Ray caster: rasterises scans, one at a time, in working memory that it keeps from scan to scan."""

    def __init__(self, config: OctreeConfig) -> None:
        self.config = config
        self._depth_limit = depth_limit_of(config)
        self._buffer = WindowBuffer()

    @property
    def memory_bytes(self) -> int:
        """Bytes of address space held."""
        return self._buffer.memory_bytes

    def reset(self) -> None:
        """Drop the working memory, together with a cast in it that is not going to be read."""
        self._buffer = WindowBuffer()

    def cast(self, scan: Scan, T_world_body: Transform) -> Cast:
        """Rasterise a scan: free along every ray, occupied at its end; occupied wins.

        Returns of a depth camera that are noisier than a voxel is large only free space.

        Raises:
            DataError: A point or the origin has no key.
            MapSizeError: The scan is too large for its resolution.
        """
        origin_world = apply(T_world_body, scan.origin_body[np.newaxis])[0]
        T = np.ascontiguousarray(T_world_body)
        if self._depth_limit is None:
            return self._rays(self._ends(np.ascontiguousarray(scan.points_body), T), origin_world)
        counting, free_body = self._depth_limit.split(scan)
        ends_world = self._ends(np.ascontiguousarray(counting.points_body), T)
        return self._rays(ends_world, origin_world, free_world=self._ends(free_body, T))

    def cast_points(self, points_world: Points32, origin_world: Array) -> Cast:
        """Rasterise rays from a (3,) origin to (N, 3) world points, metres.

        Raises:
            DataError: The points are not (N, 3), or one of them or the origin has no key.
            MapSizeError: The scan is too large for its resolution.
        """
        if points_world.ndim != 2 or points_world.shape[1] != 3:
            raise DataError(f"octree: points {points_world.shape}, want (N, 3)")
        points_world = np.ascontiguousarray(points_world, dtype=np.float32)
        return self._rays(self._ends(points_world, np.eye(4)), origin_world)

    def _ends(self, points_body: Points32, T_world_body: Transform) -> Points32:
        """Return the world points where rays end: one per end voxel, its centre, or one per point."""
        if not self.config.discretize:
            ends_world: Points32 = kernels.to_world(points_body, T_world_body)
            return ends_world
        centres_world: Points32
        centres_world, outside = kernels.end_voxels(points_body, T_world_body, self.config.resolution_m)
        self._refuse(outside, len(points_body))
        return centres_world

    def _rays(self, ends_world: Points32, origin_world: Array, *, free_world: Points32 = _NO_POINTS) -> Cast:
        """Rasterise rays to obstacles, and rays to points where there is none."""
        obstacles = len(ends_world)
        if len(free_world):
            ends_world = np.concatenate([ends_world, free_world])
        resolution_m = self.config.resolution_m
        origin = np.asarray(origin_world, dtype=np.float32)
        base = origin_key(origin, resolution_m)
        stops, hits, lowest, highest, outside = kernels.clip_rays(
            ends_world, origin, resolution_m, self.config.range_limit_m
        )
        self._refuse(outside, len(ends_world))
        hits[obstacles:] = False
        window = self._buffer.window(lowest, highest, origin=base)
        kernels.cast_rays(stops, hits, origin, resolution_m, window)
        positions = take_touched(window)
        return Cast(window, positions, block_codes(window, positions, lowest))

    def _refuse(self, outside: int, total: int) -> None:
        if outside:
            resolution_m = self.config.resolution_m
            raise DataError(
                f"octree: {outside} of {total} points are not finite or not within "
                f"±{reach_m(resolution_m):g} m, the reach of {resolution_m:g} m voxels; "
                "drop them or raise resolution_m"
            )


def depth_limit_of(config: OctreeConfig) -> DepthLimit | None:
    """Return which returns of a depth camera count; None where its noise does not limit them."""
    if config.depth_noise is None or config.max_range_m is not None:
        return None
    return DepthLimit(config.depth_noise, max_sigma_m=config.resolution_m)


def octree_config(config: OctreeConfig | float) -> OctreeConfig:
    """Return a configuration, or that of OctoMap's sensor model with voxels of an edge, metres.

    Raises:
        DataError: The edge is no positive number.
    """
    if isinstance(config, OctreeConfig):
        return config
    try:
        return OctreeConfig(resolution_m=config)
    except ValidationError:
        raise DataError(f"octree: voxels of {config!r} m; want metres > 0, or an OctreeConfig") from None


def origin_key(origin: NDArray[np.float32], resolution_m: float) -> NDArray[np.int64]:
    """Return the (3,) key of the origin of rays, (3,) metres.

    Raises:
        DataError: The origin has no key.
    """
    keys = np.floor((1.0 / resolution_m) * origin.astype(np.float64)) + KEY_ZERO
    if not ((keys >= 0) & (keys < KEY_COUNT)).all():
        raise DataError(
            f"octree: sensor origin {origin.tolist()} is not within ±{reach_m(resolution_m):g} m, "
            f"the reach of {resolution_m:g} m voxels; raise resolution_m or shift the map"
        )
    return keys.astype(np.int64)


def reach_m(resolution_m: float) -> float:
    """Return how far from the map's origin, along each axis, voxels have keys."""
    return KEY_ZERO * resolution_m
