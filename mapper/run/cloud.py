"""Coloured cloud of a run, read back from its PLY file."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapper.core.errors import FrameError
from mapper.core.frames import Points32
from mapper.sources.cloud_files.ply import read_ply


@dataclass(frozen=True, slots=True, eq=False)
class Cloud:
    """Points with a colour each; ``numpy.asarray(cloud)`` gives the points.

    Attributes:
        points: (N, 3) float32, metres, levelled world: z up, floor at 0.
        colors: (N, 3) uint8 RGB.
    """

    points: Points32
    colors: NDArray[np.uint8]

    def __len__(self) -> int:
        return len(self.points)

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        return np.array(self.points, dtype=dtype, copy=copy)


def read_cloud(path: Path) -> Cloud:
    """Return the cloud of a PLY file with colours.

    Raises:
        FrameError: The file cannot be read.
    """
    try:
        columns = read_ply(path)
    except OSError as error:
        raise FrameError(f"{path}: cannot be read: {error.strerror}") from None
    return Cloud(
        np.column_stack([columns[axis] for axis in ("x", "y", "z")]),
        np.column_stack([columns[channel] for channel in ("red", "green", "blue")]),
    )
