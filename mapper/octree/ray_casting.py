"""Ray casting of a scan at its pose: the free and occupied voxels, before a map is updated with them."""

import mmap
from contextlib import suppress
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mapper.core.errors import DataError, MapSizeError
from mapper.core.frames import Points32, Scan
from mapper.core.geometry import Array, Transform, apply
from mapper.core.units import MIB
from mapper.octree import ray_casting_kernels as kernels
from mapper.octree.config import OctreeConfig
from mapper.octree.keys import BLOCK_BITS, BLOCK_VOXELS, KEY_BITS, KEY_COUNT, KEY_ZERO
from mapper.octree.ray_casting_kernels import Window
from mapper.sensing.depth import DepthLimit

_LIMIT_BYTES = 8192 * MIB
"""Limit of a window. Address space, not memory: only pages that a ray crosses are ever backed by memory."""


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


class WindowBuffer:
    """Memory of the window, which is kept from scan to scan and only grows."""

    def __init__(self) -> None:
        self._cells = np.zeros(0, dtype=np.uint8)
        self._touched = np.zeros(0, dtype=np.uint8)

    def window(
        self, lowest: NDArray[np.int64], highest: NDArray[np.int64], *, origin: NDArray[np.int64]
    ) -> Window:
        """Return a window in which no two voxels between two corners share a cell.

        Args:
            lowest: (3,) smallest keys that rays can reach.
            highest: (3,) largest keys that rays can reach.
            origin: (3,) key of the rays' origin.

        Raises:
            MapSizeError: The scan is too large for its resolution; nothing has been allocated then.
        """
        blocks = (highest >> BLOCK_BITS) - (lowest >> BLOCK_BITS) + 1
        lengths = tuple(BLOCK_BITS + (int(n) - 1).bit_length() for n in blocks)
        size = 1 << sum(lengths)
        extent = "×".join(str(n) for n in highest - lowest + 1)
        if size > _LIMIT_BYTES:
            raise MapSizeError(
                f"a scan of {extent} voxels needs {size / 2**30:.0f} GiB of working space, "
                f"the limit is {_LIMIT_BYTES >> 30}; raise resolution_m or lower max_range_m"
            )
        if size > len(self._cells):
            try:
                self._cells = sparse_zeros(size)
            except OSError:
                raise MapSizeError(
                    f"a scan of {extent} voxels needs {size / 2**30:.0f} GiB of address space, which the "
                    "system refuses; raise resolution_m or lower max_range_m"
                ) from None
            self._touched = np.zeros(size // BLOCK_VOXELS, dtype=np.uint8)
        bits, cell_bits, offsets = _layout(lengths)
        base = origin >> BLOCK_BITS << BLOCK_BITS
        wrap = np.array([(1 << n) - 1 for n in lengths], dtype=np.int64)
        return Window(
            self._cells[:size], self._touched[: size // BLOCK_VOXELS], base, wrap, bits, cell_bits, offsets
        )


def sparse_zeros(size: int) -> NDArray[np.uint8]:
    """Return (size,) zeros that take memory only where they are written.

    ``np.zeros`` allocates huge pages: a ray that enters one would pay for clearing and keeping 2 MiB.
    """
    advice = getattr(mmap, "MADV_NOHUGEPAGE", None)
    if advice is None:  # no Linux
        return np.zeros(size, dtype=np.uint8)
    memory = mmap.mmap(-1, size, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
    with suppress(OSError):  # a kernel without huge pages refuses advice about them
        memory.madvise(advice)
    return np.frombuffer(memory, dtype=np.uint8)


@lru_cache(maxsize=64)
def _layout(lengths: tuple[int, ...]) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Return (bits, cell_bits, offsets) of a window with 2^n cells per axis, interleaved from the bottom."""
    bits = np.zeros(3, dtype=np.int64)
    cell_bits = np.zeros((3, 1 << max(lengths)), dtype=np.int64)
    offsets = np.zeros((4, 256), dtype=np.int64)
    position = 0
    for level in range(max(lengths)):
        for axis in range(3):
            if level < lengths[axis]:
                n = np.arange(1 << lengths[axis])
                cell_bits[axis, : len(n)] |= (n >> level & 1) << position
                bits[axis] |= 1 << position
                if level >= BLOCK_BITS:
                    byte, bit = divmod(position - 3 * BLOCK_BITS, 8)
                    offsets[byte] += (np.arange(256) >> bit & 1) << (level - BLOCK_BITS + KEY_BITS * axis)
                position += 1
    return bits, cell_bits, offsets


class Caster:
    """Ray caster: rasterises scans, one at a time, in working memory that it keeps from scan to scan."""

    def __init__(self, config: OctreeConfig) -> None:
        self.config = config
        self._depth_limit = depth_limit_of(config)
        self._buffer = WindowBuffer()

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

    def _ends(self, points_body: Points32, T_world_body: Transform) -> Points32:
        """Return the world points where rays end: one per end voxel, its centre, or one per point."""
        if not self.config.discretize:
            ends_world: Points32 = kernels.to_world(points_body, T_world_body)
            return ends_world
        centres_world: Points32
        centres_world, outside = kernels.end_voxels(points_body, T_world_body, self.config.resolution_m)
        self._refuse(outside, len(points_body))
        return centres_world

    def _rays(self, ends_world: Points32, origin_world: Array, *, free_world: Points32 | None = None) -> Cast:
        """Rasterise rays to obstacles, and rays to points where there is none."""
        obstacles = len(ends_world)
        if free_world is not None:
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
        positions: NDArray[np.int64] = np.flatnonzero(window.touched.view(np.bool_))
        window.touched[positions] = 0
        return Cast(window, positions, kernels.block_codes(window, positions, lowest))

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
