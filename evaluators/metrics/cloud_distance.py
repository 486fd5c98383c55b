"""Distance of one cloud from another (Nagy, Gálai & Benedek 2016, §4.1)."""

from dataclasses import dataclass

import numpy as np

from mapper.core.errors import DataError
from mapper.core.frames import Points32
from mapper.core.geometry import Transform, apply
from mapper.registration.kd_tree import kd_tree


@dataclass(frozen=True, slots=True)
class CloudDistance:
    """Distances of the points p of a cloud P to the nearest of a cloud Q: not the same the other way round.

    Attributes:
        mhd_m: Modified Hausdorff distance, their mean.
        mpd_m: Their median, which objects that moved between the two scans do not disturb.
    """

    mhd_m: float
    mpd_m: float


class DistanceTo:
    """Distances from one cloud, whose search tree is built once."""

    def __init__(self, points_target: Points32) -> None:
        """Index the cloud Q, (N, 3) metres.

        Raises:
            DataError: It is empty.
        """
        self._tree = kd_tree(points_target)

    def of(self, points_source: Points32, T_target_source: Transform) -> CloudDistance:
        """Return the distance of the cloud P, (M, 3) metres in its own frame, from Q under a motion.

        Raises:
            DataError: It is empty.
        """
        if len(points_source) == 0:
            raise DataError("cloud distance: the source has no points")
        _, distances_m = self._tree.nearest(apply(T_target_source, points_source.astype(np.float64)))
        return CloudDistance(float(distances_m.mean()), float(np.median(distances_m)))
