"""Release of voxels that an object has left: an update policy for dynamic environments.

OctoMap weighs all scans alike, so an object that stood for long takes as many scans to be cleared. Here a run
of scans in which an occupied voxel is free ends the object's time there: evidence from before the run no
longer counts, and the voxel's log-odds become those of the run alone. A hit ends the run, so a surface that
is missed now and then stays. All other voxels are OctoMap's to the last bit.
"""

import numpy as np
from numba import njit
from numpy import float32, int32
from numpy.typing import NDArray

from mapper.octree.kernels import SensorModel
from mapper.octree.keys import BLOCK_VOXELS
from mapper.octree.window import OCCUPIED, UNTOUCHED


class SeenThrough:
    """Map update that counts, for every voxel, the consecutive scans in which it was free.

    Args:
        scans: Length of a run that releases an occupied voxel.
        occupied_log_odds: Least log-odds of an occupied voxel.
    """

    def __init__(self, scans: int, *, occupied_log_odds: np.float32) -> None:
        self._scans = scans
        self._occupied_log_odds = occupied_log_odds
        self._runs = np.zeros((0, BLOCK_VOXELS), np.uint8)

    @property
    def memory_bytes(self) -> int:
        """Bytes held."""
        return self._runs.nbytes

    def merge(
        self,
        cells: NDArray[np.uint8],
        positions: NDArray[np.int64],
        slots: NDArray[np.int64],
        values: NDArray[np.float32],
        sensor: SensorModel,
    ) -> int:
        """Update the map as ``kernels.merge`` does, and release voxels after runs of free scans."""
        missing = len(values) - len(self._runs)
        if missing > 0:
            self._runs = np.concatenate([self._runs, np.zeros((missing, BLOCK_VOXELS), np.uint8)])
        added: int = _merge(
            cells, positions, slots, values, sensor, self._runs, self._scans, self._occupied_log_odds
        )
        return added


@njit(cache=True, nogil=True)
def _merge(cells, positions, slots, values, sensor, runs, scans, occupied_log_odds):
    hit, miss, lowest, highest = sensor.hit, sensor.miss, sensor.lowest, sensor.highest
    released = max(lowest, float32(scans) * miss)
    added = 0
    for i in range(len(positions)):
        start = positions[i] * BLOCK_VOXELS
        seen_block = cells[start : start + BLOCK_VOXELS]
        block, runs_block = values[slots[i]], runs[slots[i]]
        block_added = int32(0)
        for j in range(BLOCK_VOXELS):
            seen = int32(seen_block[j])
            if seen == UNTOUCHED:
                continue
            old = block[j]
            unknown = old != old
            block_added += int32(unknown)
            value = float32(0.0) if unknown else old
            if seen == OCCUPIED:
                runs_block[j] = 0
                block[j] = value if value >= highest else min(value + hit, highest)
                continue
            runs_block[j] = min(int32(runs_block[j]) + 1, 255)
            new = value if value <= lowest else max(value + miss, lowest)
            if runs_block[j] >= scans and new >= occupied_log_odds:
                new = released
            block[j] = new
        added += block_added
        seen_block[:] = UNTOUCHED
    return added
