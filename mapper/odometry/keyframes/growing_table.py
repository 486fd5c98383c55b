"""Table of arrays that grows by appending rows."""

from typing import Any

import numpy as np
from numpy.typing import NDArray


class GrowingTable:
    """Columns of equal length that grow by doubling; compiled code reads them as plain arrays."""

    def __init__(self, **columns: tuple[tuple[int, ...], type]) -> None:
        self.size = 0
        self._columns: dict[str, NDArray[Any]] = {
            name: np.zeros((1024, *shape), kind) for name, (shape, kind) in columns.items()
        }

    def __getitem__(self, name: str) -> NDArray[Any]:
        column: NDArray[Any] = self._columns[name]
        return column

    def __getstate__(self) -> dict[str, Any]:
        """Return the rows in use."""
        return {
            "size": self.size,
            "_columns": {name: column[: self.size] for name, column in self._columns.items()},
        }

    def append(self, count: int, **values: object) -> NDArray[np.int32]:
        """Append rows and return their ids."""
        first, self.size = self.size, self.size + count
        for name, column in self._columns.items():
            if self.size > len(column):
                grown = np.zeros((max(2 * len(column), self.size), *column.shape[1:]), column.dtype)
                grown[:first] = column[:first]
                self._columns[name] = column = grown
            column[first : self.size] = values[name]
        return np.arange(first, self.size, dtype=np.int32)
