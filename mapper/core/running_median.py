"""Running statistics of a log's figures, by which a new one is found to be unusual."""

from collections import deque

import numpy as np

_NORMAL = 1.4826  # standard deviations in a median absolute deviation of normal errors


class RunningMedian:
    """Median and robust standard deviation of a figure's last values.

    Attributes:
        median: Median of the values; 0 while there are too few.
        sigma: 1.4826 times their median absolute deviation; 0 while there are too few.
    """

    def __init__(self, *, memory: int | None, fewest: int = 1) -> None:
        """Start without values.

        Args:
            memory: Number of values that count, the last ones; None counts all.
            fewest: With fewer values nothing is known.
        """
        self._values: deque[float] = deque(maxlen=memory)
        self._fewest = fewest
        self.median = self.sigma = 0.0

    def __len__(self) -> int:
        return len(self._values)

    @property
    def is_known(self) -> bool:
        """Whether there are enough values."""
        return len(self._values) >= self._fewest

    def add(self, value: float) -> None:
        """Add a value."""
        self._values.append(value)
        if self.is_known:
            values = np.array(self._values)
            self.median = float(np.median(values))
            self.sigma = _NORMAL * float(np.median(np.abs(values - self.median)))

    def clear(self) -> None:
        """Forget all values."""
        self._values.clear()
        self.median = self.sigma = 0.0
