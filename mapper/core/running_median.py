"""Running statistics of a log's figures, by which a new one is found to be unusual."""

from collections import deque
from statistics import median

SIGMAS_PER_MAD = 1.4826
"""Standard deviations in a median absolute deviation of normal errors."""
MEDIAN_LENGTH = 1.538
"""Median length of a vector of three independent normal errors, in their standard deviations."""


class RunningMedian:
    """Median and robust standard deviation of a figure's last values."""

    def __init__(self, *, memory: int, fewest: int = 1) -> None:
        """Start without values.

        Args:
            memory: Number of values that count, the last ones.
            fewest: With fewer values nothing is known.
        """
        self._values: deque[float] = deque(maxlen=memory)
        self._fewest = fewest

    def __len__(self) -> int:
        return len(self._values)

    @property
    def is_known(self) -> bool:
        """Whether there are enough values."""
        return len(self._values) >= self._fewest

    @property
    def median(self) -> float:
        """Median of the values; 0 while there are too few."""
        return median(self._values) if self.is_known else 0.0

    @property
    def sigma(self) -> float:
        """1.4826 times the median absolute deviation of the values; 0 while there are too few."""
        if not self.is_known:
            return 0.0
        middle = self.median
        return SIGMAS_PER_MAD * median(abs(value - middle) for value in self._values)

    def add(self, value: float) -> None:
        """Add a value."""
        self._values.append(value)

    def clear(self) -> None:
        """Forget all values."""
        self._values.clear()
