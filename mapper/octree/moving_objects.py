"""Removal of what moved: voxels that held something in some scans and were seen empty in others.

In OctoMap the majority of scans counts, and every ray frees whatever voxels it crosses. So what stood
for long stays, and ground that is seen at a slant is erased by the rays that pass low above it. Here
the evidence of a ray is weighed by what the same scan saw around it:

- A miss is *void* if all 26 voxels around were observed in the same scan (Duberg et al. 2024, DUFOMap).
  Nothing is observed below the ground or behind a wall, so rays that graze a surface do not erase it. The
  margin of a voxel covers errors of the pose (their d_p = 1).
- A miss *passes* if none of these 26 voxels was hit in the same scan: noise of the range and errors of the
  pose move a hit by no more (their d_s). The depth of a camera errs by more, so that one wall has two places:
  there no voxel within the error of depth may be hit, and what lies so near the limit of depth that a hit
  may be beyond it is not passed. A voxel is *seen through* by a miss that is void and passes.

What moves is away for a time without a break, while rays that miss a thin thing, such as a pole or a chair's
leg, lie between rays that hit it. So misses are counted in the longest stretch of scans that do not hit the
voxel; what precedes the first hit and what follows the last are one stretch.

A voxel with h hits held something that moved if no surface is next to it and it was seen through at least
twice and in more than h/2 scans. A sparse sensor seldom observes all voxels around in one scan; for it, 8
passes and more than 2h are enough. A surface is a voxel that was hit and has a voxel next to it that no
scan observed: the ground, a wall. Feet and wheels touch the ground: a voxel that was hit next to a voxel of
a moving object that was hit too, in 9 of 10 of its hits, belongs to the object; this is repeated once. As
rings may lie more than a voxel apart, two voxels from it are near enough for one with at least 3 and more
than 2h passes; without that, poles next to traffic would go. Where a log begins or ends, much of an object
was never seen through: what was within 0.4 m of the object in all of its own hits belongs to it, too.

Where the foot of an object shares a voxel with the ground, that voxel stays. Its returns are separated from
the ground's scan by scan: those on the ground, at most two voxels below a removed voxel that the same scan
hit and at most one aside, belong to the object. The cloud is made without them.

What remains of the voxels that were ever hit is occupied, unless its void misses alone outweigh its hits.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import zip_longest
from math import ceil

import numpy as np
from numba import njit
from numpy import float32, int64, uint64
from numpy.typing import NDArray

from mapper.core.frames import Points32
from mapper.core.geometry import Points, Transform
from mapper.core.voxel_index import row_of, voxel_index
from mapper.octree.bit_planes import (
    ALL_SET,
    NONE_SET,
    WORD_BITS,
    WORDS,
    Words,
    dilate,
    neighbours_of,
    words_of,
)
from mapper.octree.config import OctreeConfig
from mapper.octree.keys import (
    BLOCK_BITS,
    BLOCK_EDGE,
    KEY_COUNT,
    KEY_ZERO,
    block_keys,
    codes_of,
    codes_of_keys,
    keys_of,
)
from mapper.octree.map import OctreeMap
from mapper.octree.ray_casting import depth_limit_of
from mapper.octree.scan_updates import ScanUpdate
from mapper.octree.sparse_grid import BlockStore, find_slots
from mapper.sensing.config import DepthNoiseConfig
from mapper.sensing.depth import depth_sigma_m

_LEAST_SEEN_THROUGH, _SEEN_THROUGH_RATIO = 2, 0.5
_LEAST_PASSES, _PASSES_RATIO = 8, 2.0
_LEAST_PASSES_NEARBY = 3
_ATTACHED_RATIO, _ATTACHED_ROUNDS = 0.9, 2
_ATTACHED_M = 0.4
_LONGEST, _FIRST, _NOW = range(3)  # stretches of scans without a hit
_DEPTH_ERROR_SIGMAS = 12.0
"""Error of depth by the noise of depth. It is that of a pixel of disparity, whose noise is 0.07 to 0.08 px in
cameras of structured light; both grow with the square of depth (Khoshelham & Oude Elberink 2012)."""
_AROUND = np.array([(x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1)])
_BELOW = np.array([(x, y, -z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (1, 2)])


@dataclass(frozen=True, slots=True, eq=False)
class MovingObjects:
    """Voxels that held something that moved.

    Attributes:
        blocks: The blocks of the map.
        removed: The plane of these voxels, by the blocks' slots.
        surfaces: The plane of the voxels that were hit and have a voxel next to them that no scan observed.
        resolution_m: Edge of a voxel.
    """

    blocks: BlockStore
    removed: Words
    surfaces: Words
    resolution_m: float

    def contain(self, points_world: Points | Points32) -> NDArray[np.bool_]:
        """Return for each of (N, 3) points, metres, whether it lies in such a voxel."""
        return self._lie_in(self.removed, self._codes_of(points_world))

    def returns_of(self, points_world: Points | Points32) -> NDArray[np.bool_]:
        """Return for each of one scan's (N, 3) returns, metres, whether it belongs to a moving object.

        It does if it lies in such a voxel, or on the ground below one that the same scan hit: feet share
        voxels with the ground, which stays.
        """
        codes = self._codes_of(points_world)
        moving = self._lie_in(self.removed, codes)
        if not moving.any():
            return moving
        below = _codes_below(codes[moving])
        is_below = _are_among(codes, voxel_index(len(below), below))
        candidates = np.flatnonzero(is_below & ~moving)
        lowered = points_world[candidates].astype(np.float64) - [0.0, 0.0, self.resolution_m]
        is_ground = self._lie_in(self.surfaces, codes[candidates])
        is_ground |= self._lie_in(self.surfaces, self._codes_of(lowered))
        moving[candidates[is_ground]] = True
        return moving

    def _codes_of(self, points_world: Points | Points32) -> NDArray[np.int64]:
        codes: NDArray[np.int64] = codes_of(np.ascontiguousarray(points_world, np.float64), self.resolution_m)
        return codes

    def _lie_in(self, plane: Words, codes: NDArray[np.int64]) -> NDArray[np.bool_]:
        slots = np.empty(len(codes), np.int64)
        find_slots(self.blocks.table, codes >> (3 * BLOCK_BITS), slots)
        inside: NDArray[np.bool_] = _set_at(plane, slots, codes) & (codes >= 0)
        return inside

    def __len__(self) -> int:
        """Return the number of voxels."""
        return int(np.unpackbits(self.removed.view(np.uint8)).sum())


def remove_moving_objects(
    octree: OctreeMap,
    scans: Callable[[], Iterable[ScanUpdate]],
    *,
    T_world_camera: Sequence[Transform | None] = (),
) -> MovingObjects:
    """Free the voxels of an octree in which something moved, and keep those of grazed surfaces.

    A voxel that was never passed becomes unknown. Memory: about 40 bytes a voxel that was ever hit, and a few
    bits for every other.

    Args:
        octree: The map of all scans; changed in place.
        scans: Returns the map's scans, in the order of time; it is called more than once.
        T_world_camera: (4, 4) pose of the depth camera that made each, z forward; None of a LiDAR's. Empty
            if all are of a LiDAR.
    """
    blocks = octree.blocks
    ever = np.zeros((len(blocks), WORDS), np.uint64)
    for scan in scans():
        _mark(words_of(scan.occupied), _slots_of(blocks, scan), ever)
    starts, count = _number(ever)
    hits, voids, passes, seen_through = _count_scans(octree, scans(), T_world_camera, ever, starts, count)
    often = (seen_through >= _LEAST_SEEN_THROUGH) & (seen_through > _SEEN_THROUGH_RATIO * hits)
    often |= (passes >= _LEAST_PASSES) & (passes > _PASSES_RATIO * hits)
    inside = _inside(octree)
    surfaces = ever & ~inside
    near_surfaces = dilate(surfaces, neighbours_of(blocks.codes), absent=NONE_SET)
    moved = often & _gather_at(inside & ~near_surfaces, ever, count)
    passed = (passes >= _LEAST_PASSES_NEARBY) & (passes > _PASSES_RATIO * hits)
    adjacent, nearby = np.zeros((2, count), np.int32)
    counted = np.zeros_like(ever)
    for done in range(max(_ATTACHED_ROUNDS, ceil(_ATTACHED_M / octree.resolution_m))):
        removed = _scatter(moved, ever)
        for scan in scans():
            hit, slots = words_of(scan.occupied), _slots_of(blocks, scan)
            near, before = hit & removed[slots], hit & counted[slots]
            if np.array_equal(near, before):
                continue
            rows = _rows_around(scan.codes, near.any(axis=1))
            hit, slots, near, before = hit[rows], slots[rows], near[rows], before[rows]
            neighbours = neighbours_of(scan.codes[rows])
            for counts in (adjacent, nearby):
                near, before = (dilate(plane, neighbours, absent=NONE_SET) for plane in (near, before))
                _count_one(hit & near & ~before, slots, ever, starts, counts)
        counted = removed
        least = hits * (_ATTACHED_RATIO if done < _ATTACHED_ROUNDS else 1.0)
        attached = (adjacent >= least) | (passed & (nearby >= least))
        if not (attached & ~moved).any():
            break
        moved |= attached
    _write_log_odds(
        blocks.table.values, ever, moved, hits, voids, passes, octree.sensor, octree.occupied_log_odds
    )
    return MovingObjects(blocks, _scatter(moved, ever), surfaces, octree.resolution_m)


def _depth_margins(
    codes: NDArray[np.int64], T_world_camera: Transform, noise: DepthNoiseConfig, config: OctreeConfig
) -> NDArray[np.int64]:
    """Return by how many voxels the hits of a depth camera may be off in (B,) blocks; −1 is unknown."""
    limit = depth_limit_of(config)
    centres_world = (block_keys(codes) - KEY_ZERO + BLOCK_EDGE / 2) * config.resolution_m
    z_m = np.maximum((centres_world - T_world_camera[:3, 3]) @ T_world_camera[:3, 2], 0.0)
    error_m = _DEPTH_ERROR_SIGMAS * depth_sigma_m(noise, z_m)
    margins = np.ceil(error_m / config.resolution_m).clip(min=1).astype(np.int64)
    return np.where(z_m + error_m > (config.range_limit_m if limit is None else limit.depth_m), -1, margins)


def _evidence(scan: ScanUpdate, margins: NDArray[np.int64] | None) -> tuple[Words, Words, Words]:
    """Return where a scan hit, where it is void, and where it passes; margins of None are one voxel."""
    free, hit = words_of(scan.free), words_of(scan.occupied)
    neighbours = neighbours_of(scan.codes)
    void = free & ~dilate(~(free | hit), neighbours, absent=ALL_SET)
    near = grown = dilate(hit, neighbours, absent=NONE_SET)
    if margins is not None:
        for voxels in range(2, int(margins.max(initial=1)) + 1):
            grown = dilate(grown, neighbours, absent=NONE_SET)
            near = np.where((margins >= voxels)[:, np.newaxis], grown, near)
        near = np.where((margins < 0)[:, np.newaxis], ALL_SET, near)
    return hit, void, free & ~near


def _count_scans(
    octree: OctreeMap,
    scans: Iterable[ScanUpdate],
    T_world_camera: Sequence[Transform | None],
    ever: Words,
    starts: NDArray[np.int64],
    count: int,
) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.int32], NDArray[np.int32]]:
    """Return (count,) hits and voids, and passes and those seen through in the longest stretch."""
    counts, misses = np.zeros((count, 2), np.int32), np.zeros((count, 3, 2), np.int32)
    noise = octree.config.depth_noise
    for scan, T in zip_longest(scans, T_world_camera):
        margins = None
        if T is not None and noise is not None:
            margins = _depth_margins(scan.codes, T, noise, octree.config)
        _count(*_evidence(scan, margins), _slots_of(octree.blocks, scan), ever, starts, counts, misses)
    around = misses[:, _FIRST] + misses[:, _NOW]
    return *counts.T, *np.maximum(misses[:, _LONGEST], around, out=around).T


def _slots_of(blocks: BlockStore, scan: ScanUpdate) -> NDArray[np.int64]:
    slots = np.empty(len(scan), np.int64)
    find_slots(blocks.table, scan.codes, slots)
    return slots


def _inside(octree: OctreeMap) -> Words:
    """Return the voxels with nothing unknown among the voxels around."""
    known: Words = _known(octree.blocks.table.values, len(octree.blocks))
    return known & ~dilate(~known, neighbours_of(octree.blocks.codes), absent=ALL_SET)


def _codes_below(codes: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the codes of the voxels up to two below some, and up to one aside of these."""
    around = (keys_of(np.unique(codes))[:, np.newaxis] + _BELOW).reshape(-1, 3)
    return np.unique(codes_of_keys(around[((around >= 0) & (around < KEY_COUNT)).all(axis=1)]))


def _rows_around(codes: NDArray[np.int64], chosen: NDArray[np.bool_]) -> NDArray[np.intp]:
    """Return the rows of the chosen ones of (B,) blocks, and of those that touch one of them."""
    keys = keys_of(codes[chosen])[:, np.newaxis] + _AROUND
    around = np.unique(codes_of_keys(keys[((keys >= 0) & (keys < KEY_COUNT // BLOCK_EDGE)).all(axis=-1)]))
    return np.flatnonzero(_are_among(codes, voxel_index(len(around), around)))


@njit(cache=True, nogil=True)
def _are_among(codes, index):
    among = np.empty(len(codes), np.bool_)
    for i in range(len(codes)):
        among[i] = row_of(index, codes[i]) >= 0
    return among


@njit(cache=True, nogil=True)
def _known(values, blocks):
    words = np.zeros((blocks, WORDS), uint64)
    for i in range(blocks):
        for j in range(WORDS * WORD_BITS):
            if values[i, j] == values[i, j]:
                words[i, j // WORD_BITS] |= uint64(1) << uint64(j % WORD_BITS)
    return words


@njit(cache=True, nogil=True)
def _mark(words, slots, plane):
    for i in range(len(slots)):
        for k in range(WORDS):
            plane[slots[i], k] |= words[i, k]


@njit(cache=True, nogil=True)
def _number(ever):
    """Number the set bits of a plane; return the first number in each word, and how many there are."""
    starts, count = np.empty(ever.shape, int64), int64(0)
    for i in range(len(ever)):
        for k in range(WORDS):
            starts[i, k] = count
            word = ever[i, k]
            while word:
                word &= word - uint64(1)
                count += 1
    return starts, count


@njit(cache=True, nogil=True)
def _count(hit, void, passed, slots, ever, starts, counts, misses):
    """Add one scan to the counts, and to the stretches of misses, of the voxels that were ever hit."""
    for i in range(len(slots)):
        for k in range(WORDS):
            own = ever[slots[i], k]
            if not own & (hit[i, k] | void[i, k] | passed[i, k]):
                continue
            row = starts[slots[i], k]
            for bit in range(WORD_BITS):
                if not (own >> uint64(bit)) & uint64(1):
                    continue
                is_void = int64((void[i, k] >> uint64(bit)) & uint64(1))
                is_passed = int64((passed[i, k] >> uint64(bit)) & uint64(1))
                if (hit[i, k] >> uint64(bit)) & uint64(1):
                    for kind in range(2):
                        ended = misses[row, _NOW, kind]
                        if counts[row, 0] == 0:
                            misses[row, _FIRST, kind] = ended
                        misses[row, _LONGEST, kind] = max(misses[row, _LONGEST, kind], ended)
                        misses[row, _NOW, kind] = 0
                    counts[row, 0] += 1
                counts[row, 1] += is_void
                misses[row, _NOW, 0] += is_passed
                misses[row, _NOW, 1] += is_void & is_passed
                row += 1


@njit(cache=True, nogil=True)
def _count_one(words, slots, ever, starts, counts):
    """Add one plane of a scan to the counts of the voxels that were ever hit."""
    for i in range(len(slots)):
        for k in range(WORDS):
            if not words[i, k]:
                continue
            row = starts[slots[i], k]
            for bit in range(WORD_BITS):
                if (ever[slots[i], k] >> uint64(bit)) & uint64(1):
                    counts[row] += int64((words[i, k] >> uint64(bit)) & uint64(1))
                    row += 1


@njit(cache=True, nogil=True)
def _gather_at(plane, ever, count):
    """Return (count,) bool: a plane at the voxels that were ever hit."""
    flags, row = np.empty(count, np.bool_), 0
    for i in range(len(ever)):
        for k in range(WORDS):
            for bit in range(WORD_BITS):
                if (ever[i, k] >> uint64(bit)) & uint64(1):
                    flags[row] = (plane[i, k] >> uint64(bit)) & uint64(1) != uint64(0)
                    row += 1
    return flags


@njit(cache=True, nogil=True)
def _scatter(flags, ever):
    """Return the plane of flagged voxels: the inverse of ``_gather_at``."""
    plane, row = np.zeros_like(ever), 0
    for i in range(len(ever)):
        for k in range(WORDS):
            for bit in range(WORD_BITS):
                if (ever[i, k] >> uint64(bit)) & uint64(1):
                    plane[i, k] |= uint64(flags[row]) << uint64(bit)
                    row += 1
    return plane


@njit(cache=True, nogil=True)
def _write_log_odds(values, ever, moved, hits, voids, passes, sensor, occupied_log_odds):
    """Write the log-odds of all voxels that were ever hit."""
    row = 0
    for i in range(len(ever)):
        for k in range(WORDS):
            for bit in range(WORD_BITS):
                if not (ever[i, k] >> uint64(bit)) & uint64(1):
                    continue
                voxel = k * WORD_BITS + bit
                if moved[row] and passes[row] > 0:
                    values[i, voxel] = sensor.lowest
                elif moved[row]:
                    values[i, voxel] = np.nan
                elif values[i, voxel] < occupied_log_odds:
                    weighed = float32(hits[row]) * sensor.hit + float32(voids[row]) * sensor.miss
                    if weighed >= occupied_log_odds:
                        values[i, voxel] = min(weighed, sensor.highest)
                row += 1


@njit(cache=True, nogil=True)
def _set_at(plane, slots, codes):
    """Return (N,) bool: a plane's bits at the voxels of codes whose blocks have these slots."""
    flags = np.zeros(len(codes), np.bool_)
    for i in range(len(codes)):
        if slots[i] >= 0:
            voxel = codes[i] & (WORDS * WORD_BITS - 1)
            flags[i] = (plane[slots[i], voxel // WORD_BITS] >> uint64(voxel % WORD_BITS)) & uint64(
                1
            ) != uint64(0)
    return flags
