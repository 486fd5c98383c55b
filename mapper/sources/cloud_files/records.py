"""Width of the records in a file of bare numbers: how many float32 a point has."""

import numpy as np
from numpy.typing import NDArray

from mapper.sources.cloud_files.parsing import MAX_RANGE_M, SAMPLES

KITTIS = 4
"""x y z intensity."""
_WIDTHS = (3, 5, 6, 7, 8)  # x y z; with intensity and ring (nuScenes); with a time; with padding (PCL)
_BLOCKS, _BLOCK_NUMBERS = 8, 3360  # in parts of whole records of every width up to 8
_LEAST_STEP = 0.01
_BETTER, _BETTER_OF_EIGHT = 0.2, 1.2
"""Difference of logarithms of steps that shows other records: those of the right width were smaller by 0.3 in
shuffled clouds and by 1.5 to 4 in sweeps; where upper and lower rings take turns, those of eight
by 0.6, of padded ones by 2.5."""
_ALIKE_RATIO = 2.0
_LEAST_INTENSITY, _MAX_NEGATIVE_RATIO = -1.0, 0.01
"""Coordinates are below it; times before the end of the sweep, in seconds, are not."""


def other_width(numbers: NDArray[np.float32]) -> tuple[int, bool] | None:
    """Return the width that a file's numbers have if it is not KITTI's, and whether they leave no doubt.

    From record to record each column advances little beside the steps from one column to another, or in
    shuffled clouds at least has a spread of its own. Where no width shows, columns that should be intensities
    but have coordinates' signs are in doubt.

    Args:
        numbers: (N,) all of the file.
    """
    fitting = [width for width in _WIDTHS if len(numbers) % width == 0 and len(numbers) >= 2 * width]
    if not fitting:
        return None
    step = _usual_step(numbers, KITTIS)
    gains = {
        width: step - _usual_step(numbers, width) - (_BETTER_OF_EIGHT if width == 8 else _BETTER)
        for width in fitting
    }
    best = max(fitting, key=lambda width: (gains[width], -width))
    if best == 6 and _are_halves_alike(numbers.reshape(-1, 6)):
        best = 3
    if gains[best] > 0.0:
        return best, True
    if len(numbers) % KITTIS or gains[best] < -2.0 * _BETTER:
        return None
    negative = (numbers[KITTIS - 1 :: KITTIS] < _LEAST_INTENSITY).mean()
    return (best, False) if negative > _MAX_NEGATIVE_RATIO else None


def _are_halves_alike(records: NDArray[np.float32]) -> bool:
    """Return whether records of six are two of x y z: their columns spread as far as those three later."""
    sample = _within_range(records[:: 1 + len(records) // SAMPLES])
    spreads = _LEAST_STEP + sample.std(axis=0)
    return bool(np.abs(np.log(spreads[:3] / spreads[3:])).max() < np.log(_ALIKE_RATIO))


def _within_range(numbers: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return numbers that are no ranges, or none, as the largest range: constant columns take no steps."""
    return np.nan_to_num(numbers, nan=MAX_RANGE_M).clip(-MAX_RANGE_M, MAX_RANGE_M)


def _usual_step(numbers: NDArray[np.float32], width: int) -> float:
    """Return the mean over the columns of the logarithm of their mean step from record to record."""
    starts = np.linspace(0, max(len(numbers) - _BLOCK_NUMBERS, 0), _BLOCKS) // _BLOCK_NUMBERS * _BLOCK_NUMBERS
    total, count = np.zeros(width), 0
    for start in np.unique(starts.astype(int)):
        block = _within_range(numbers[start : start + _BLOCK_NUMBERS])
        rows = block[: len(block) // width * width].reshape(-1, width).astype(np.float64)
        total += np.abs(np.diff(rows, axis=0)).sum(axis=0)
        count += len(rows) - 1
    return float(np.log(_LEAST_STEP + total / max(count, 1)).mean())
