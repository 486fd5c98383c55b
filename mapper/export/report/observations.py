"""Observations of occupied voxels: the first hit and the number of hits, from a run's stored scan updates."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapper.octree.keys import BLOCK_BITS, BLOCK_VOXELS
from mapper.octree.scan_updates import open_scan_updates
from mapper.run.folder import Run

NEVER_NS = np.iinfo(np.int64).max


@dataclass(frozen=True, slots=True, eq=False)
class Observations:
    """Hits of voxels.

    Attributes:
        codes: (N,) int64 Morton codes of the voxels, increasing.
        first_ns: (N,) int64 stamp of the first hit, nanoseconds; the largest integer where there is none.
        hits: (N,) uint32 scans that hit the voxel.
    """

    codes: NDArray[np.int64]
    first_ns: NDArray[np.int64]
    hits: NDArray[np.uint32]

    def coarser(self, levels: int) -> "Observations":
        """Return those of the nodes above the voxels: the earliest stamp, and the most hits of a voxel."""
        parents, starts = np.unique(self.codes >> (3 * levels), return_index=True)
        if not len(parents):
            return self
        return Observations(
            parents,
            np.minimum.reduceat(self.first_ns, starts),
            np.maximum.reduceat(self.hits, starts),
        )

    def of(self, codes: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.uint32]]:
        """Return the stamp of the first hit and the number of hits of some voxels, in any order."""
        if not len(self.codes):
            return np.full(len(codes), NEVER_NS), np.zeros(len(codes), np.uint32)
        place = np.minimum(np.searchsorted(self.codes, codes), len(self.codes) - 1)
        is_known = self.codes[place] == codes
        return np.where(is_known, self.first_ns[place], NEVER_NS), np.where(is_known, self.hits[place], 0)


def observations_of(run: Run, codes: NDArray[np.int64]) -> Observations | None:
    """Return the hits of some voxels; None if the run keeps no scan updates.

    Args:
        run: A finished run.
        codes: (N,) int64 Morton codes of the voxels, increasing.

    Raises:
        MapperError: The file of scan updates cannot be read.
    """
    path = run.scan_updates()
    if path is None:
        return None
    blocks, inside = np.unique(codes >> (3 * BLOCK_BITS)), codes & (BLOCK_VOXELS - 1)
    hits = np.zeros((len(blocks), BLOCK_VOXELS), np.uint32)
    first_ns = np.full(hits.shape, NEVER_NS)
    with open_scan_updates(path) as updates:
        for entry in updates.entries():
            update = entry.update()
            _, ours, theirs = np.intersect1d(blocks, update.codes, assume_unique=True, return_indices=True)
            is_hit = np.unpackbits(update.occupied[theirs], axis=1, bitorder="little").astype(np.bool_)
            hits[ours] += is_hit
            first_ns[ours] = np.minimum(first_ns[ours], np.where(is_hit, entry.stamp_ns, NEVER_NS))
    place = np.searchsorted(blocks, codes >> (3 * BLOCK_BITS)), inside
    return Observations(codes, first_ns[place], hits[place])
