"""Odometry methods for scans."""

from typing import Literal

from pydantic import NonNegativeInt, PositiveFloat, PositiveInt

from mapper.core.config import Config, Ratio
from mapper.registration.hough.config import HoughGicpConfig, HoughNdtConfig


class ScanOdometryConfig(Config):
    """What the odometries share that place each scan by its points alone."""

    kind: str
    min_range_m: PositiveFloat = 1.0
    """Nearer returns are the vehicle's own."""
    max_range_m: PositiveFloat = 100.0
    """Farther returns are too sparse to say anything."""
    voxel_m: PositiveFloat = 0.4
    """Scans are reduced to one point, the mean of at most eight, in each such voxel."""
    keyframe_distance_m: PositiveFloat = 1.0
    keyframe_angle_rad: PositiveFloat = 0.2
    """A scan this far, or turned this much, from the last keyframe is one itself."""
    usual_ratio: Ratio = 0.8
    """A scan that overlaps with the last keyframe by a smaller share of what is usual is looked at again."""
    lost_ratio: Ratio = 0.5
    """One that still overlaps by less than this share of what is usual is lost."""
    max_lost_scans: NonNegativeInt = 10
    """After so many lost scans in a row a new sub-map begins; 0 never begins one."""
    rescue: HoughGicpConfig | None = HoughGicpConfig()
    """How a scan that the map does not explain is compared with the last keyframe: without a guess."""
    max_pair_distance_m: PositiveFloat = 0.5
    """A point this near to one of the last keyframe's overlaps with it."""


class GicpOdometryConfig(ScanOdometryConfig):
    """Scan to map by voxelised GICP (Koide et al. 2021)."""

    kind: Literal["gicp"] = "gicp"
    cell_m: PositiveFloat = 0.5
    """The map keeps one Gaussian in each such cell."""
    coarse_cell_m: PositiveFloat = 2.0
    """The same in a second map, in which scans are placed first."""
    max_iterations: PositiveInt = 30


class IcpOdometryConfig(ScanOdometryConfig):
    """Scan to the last keyframes by ICP."""

    kind: Literal["icp"] = "icp"
    distance: Literal["plane", "point"] = "plane"
    """What is made small: from a point to the plane through its partner (Chen & Medioni 1992), or to the
    partner itself (Besl & McKay 1992), which the rings on the road hold back."""
    pair_distances_m: tuple[PositiveFloat, ...] = (2.0, 1.0, 0.5)
    """Largest distance between the points of a pair, from coarse to fine."""
    max_iterations: PositiveInt = 40


class KissOdometryConfig(ScanOdometryConfig):
    """KISS-ICP (Vizzo et al. 2023) by its authors' library; its defaults."""

    kind: Literal["kiss-icp"] = "kiss-icp"
    map_voxel_m: PositiveFloat = 1.0
    """Voxel size of the map; scans are thinned to 0.5 and then 1.5 of it."""
    initial_threshold_m: PositiveFloat = 2.0
    """A third of the largest pair distance until the motion model's error is known; lower it with the map's
    voxels for a smaller scene."""
    min_motion_m: PositiveFloat = 0.1
    """Smaller deviations from the predicted motion teach the threshold nothing."""
    max_iterations: PositiveInt = 500


class HoughOdometryConfig(ScanOdometryConfig):
    """Each scan against the one before it, without a guess, by Hough and NDT (C6)."""

    kind: Literal["hough-ndt"] = "hough-ndt"
    registration: HoughNdtConfig = HoughNdtConfig()
    rescue: HoughGicpConfig | None = None


ScanToMapConfig = GicpOdometryConfig | IcpOdometryConfig | KissOdometryConfig | HoughOdometryConfig
