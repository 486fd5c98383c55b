"""Settings of the LiDAR odometries."""

from typing import Literal, Self

from pydantic import PositiveFloat

from mapper.core.config import Config, Ratio, scale_length
from mapper.registration.hough.config import HoughGicpConfig, HoughNdtConfig

_RANGES = frozenset({"min_range_m", "max_range_m"})


class ScanOdometryConfig(Config):
    """Shared settings of the odometries from scans."""

    kind: str
    scale: PositiveFloat | None = None
    """Factor on all lengths except the ranges. None derives it from the log: 1 outdoors, and where walls are
    near the factor that makes the voxel 0.06 of the median distance, or 0.15 m. 1 keeps the lengths as they
    are."""
    min_range_m: PositiveFloat = 1.0
    """Nearer returns are the vehicle's own; ``source.body`` keeps them out of the maps, too."""
    max_range_m: PositiveFloat = 100.0
    """Farther returns are too sparse for registration."""
    voxel_m: PositiveFloat = 0.4
    """Scans are thinned to one point per voxel of this size, the mean of at most eight. Larger is faster;
    smaller keeps thin objects in narrow places."""
    keyframe_distance_m: PositiveFloat = 1.0
    """A scan this far from the last keyframe becomes a keyframe. Lower values find more loops and take
    longer."""
    keyframe_angle_rad: PositiveFloat = 0.2
    """A scan turned this much from the last keyframe becomes a keyframe."""
    usual_ratio: Ratio = 0.8
    """If a scan's overlap with the last keyframe is less than this share of the usual one, and unusual for
    this log, other poses are searched; it is doubtful if there is further evidence against its pose. 0
    accepts every pose."""
    lost_ratio: Ratio = 0.5
    """If the overlap is still less than this share of the usual one, the scan is lost if there is any other
    evidence against its pose, and below half of this share in any case; 0 loses none."""
    rescue: HoughGicpConfig | None = HoughGicpConfig()
    """Registration without a guess to the last keyframe, for scans with too little overlap."""
    max_pair_distance_m: PositiveFloat = 0.5
    """Distance from the last keyframe's points within which a point counts as overlap."""

    def scaled(self, factor: float) -> Self:
        """Return the settings with their own lengths (``…_m``) but for the ranges multiplied."""
        if factor == 1.0:
            return self
        lengths = {
            name: scale_length(value, factor)
            for name, value in self
            if name.endswith("_m") and name not in _RANGES
        }
        return self.model_copy(update={"scale": factor, **lengths})


class GicpOdometryConfig(ScanOdometryConfig):
    """Scan to map by voxelised GICP (Koide et al. 2021)."""

    kind: Literal["gicp"] = "gicp"
    cell_m: PositiveFloat = 0.5
    """Cell size of the map, which has one Gaussian per cell."""
    coarse_cell_m: PositiveFloat = 2.0
    """Cell size of a second map, to which scans are registered first. Larger for fast motion."""


class IcpOdometryConfig(ScanOdometryConfig):
    """Scan to the last keyframes by ICP."""

    kind: Literal["icp"] = "icp"
    distance: Literal["plane", "point"] = "plane"
    """Minimised distance: to the plane through the partner (Chen & Medioni 1992), or to the partner itself
    (Besl & McKay 1992), which a scanner's rings on the road bias towards no motion."""
    pair_distances_m: tuple[PositiveFloat, ...] = (2.0, 1.0, 0.5)
    """Largest distance between the points of a pair, from coarse to fine."""


class KissOdometryConfig(ScanOdometryConfig):
    """KISS-ICP (Vizzo et al. 2023) by its authors' library, with its defaults."""

    kind: Literal["kiss-icp"] = "kiss-icp"
    map_voxel_m: PositiveFloat = 1.0
    """Voxel size of the map; scans are thinned to 0.5 and then 1.5 times this size."""
    initial_threshold_m: PositiveFloat = 2.0
    """A third of the largest pair distance until the motion model's error is known; lower it with the map's
    voxels for a smaller scene."""
    min_motion_m: PositiveFloat = 0.1
    """Smaller deviations from the predicted motion do not change the adaptive threshold."""


class HoughOdometryConfig(ScanOdometryConfig):
    """Each scan against the one before it, without a guess, by Hough and NDT (Nagy et al. 2016)."""

    kind: Literal["hough-ndt"] = "hough-ndt"
    registration: HoughNdtConfig = HoughNdtConfig()
    """Registration of each scan to the one before it."""
    rescue: HoughGicpConfig | None = None


AnyScanOdometryConfig = GicpOdometryConfig | IcpOdometryConfig | KissOdometryConfig | HoughOdometryConfig
