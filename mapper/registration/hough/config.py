"""Settings of the Hough registration (Nagy, Gálai & Benedek 2016).

Every length in metres is a setting, also those rarely changed: for depth cameras all are scaled alike.
"""

from typing import Annotated, Literal

from pydantic import Field, NonNegativeInt, PositiveFloat, PositiveInt

from mapper.core.config import Config, Ratio


class LevellingConfig(Config):
    """Level frame of one scan: the plane with most points on it and few below, by random samples."""

    max_tilt_rad: Annotated[float, Field(gt=0.0, lt=1.4)] = 0.7
    """Steeper planes are walls. Raise it for a sensor that is tilted further, such as a hand-held camera."""
    inlier_m: PositiveFloat = 0.12
    """Largest distance of a ground point from the plane."""
    min_height_m: float = 0.3
    """Least height of the sensor above the plane."""
    max_height_m: float = 4.0
    """Largest height of the sensor above the plane. Raise it for a sensor on a mast."""
    cell_m: PositiveFloat = 1.0
    """One point per cubic cell is used, so that near ground does not outvote the rest."""
    reach_m: PositiveFloat = 40.0
    """Points farther away along an axis are not used."""
    seed: NonNegativeInt = 0
    """Seed of the random samples."""


class GroundConfig(Config):
    """Ground removal on a grid (§3.1), and which of the remaining points are obstacles."""

    cell_m: PositiveFloat = 0.5
    """Edge of a cell of the grid."""
    max_thickness_m: PositiveFloat = 0.25
    """Largest height between the lowest and the highest point of a ground cell, as published."""
    window_m: PositiveFloat = 8.0
    """Edge of the neighbourhood of a cell, in which the lowest flat cell is searched."""
    max_rise_m: PositiveFloat = 0.5
    """Largest mean height of a ground cell above the lowest flat cell of its neighbourhood. Raise it on
    slopes."""
    radius_m: PositiveFloat = 60.0
    """Half the edge of the grid: points farther away along an axis are dropped."""
    min_obstacle_m: float = 0.5
    """Least height of an obstacle above the ground."""
    max_obstacle_m: float = 8.0
    """Higher points are dropped. The paper has 4 m; a tilted sensor sees mostly walls, and more of them up to
    8 m."""
    voxel_m: PositiveFloat = 0.4
    """Obstacles are thinned to one point per voxel, so that sparse and dense clouds have equal weight. Those
    of one scan overlap within a voxel of the other's; this is maximised in steps of a voxel, halved twice."""


class CellsConfig(Config):
    """Centroids of occupied cells in place of objects: more of them, and steadier."""

    kind: Literal["cells"] = "cells"
    cell_m: PositiveFloat = 2.0
    """Edge of a cell."""


class ObjectsConfig(Config):
    """Centres of objects, by two levels of grid cells (§3.2)."""

    kind: Literal["objects"] = "objects"
    coarse_m: PositiveFloat = 1.0
    """Cells of this edge that touch make a group of objects."""
    fine_m: PositiveFloat = 0.4
    """Inside a group, cells of this edge that touch make one object."""


class ConstellationConfig(Config):
    """Constellation: the centres of a scan that vote."""

    levelling: LevellingConfig = LevellingConfig()
    """Level frame of a scan."""
    ground: GroundConfig = GroundConfig()
    """Ground removal, and which points are obstacles."""
    centres: Annotated[CellsConfig | ObjectsConfig, Field(discriminator="kind")] = CellsConfig()
    """Centres that vote: of occupied cells or of objects."""


class VotingConfig(Config):
    """Accumulator A[dx, dy, α] (§3.3)."""

    max_offset_m: PositiveFloat = 10.0
    """Largest offset searched along each axis."""
    bin_m: PositiveFloat = 1.0
    """Edge of a bin of dx and dy; one bin is centred on zero."""
    angles: PositiveInt = 180
    """Steps of a full turn. The paper has 360; half of them find the same peaks, and verification refines
    them."""
    peaks: PositiveInt = 20
    """Distinct peaks that are verified."""

    @property
    def width_m(self) -> float:
        """Width of a peak: nearer ones are the same, and one at the end of the range would be cut off."""
        return 2.0 * self.bin_m


class OverlapConfig(Config):
    """Verification of the peaks: planar refinement by overlap, then the free-space check."""

    distinct_m: PositiveFloat = 1.0
    """Motions nearer to each other than this, and than 0.05 rad, are the same."""
    margin_m: PositiveFloat = 0.2
    """Margin of the free-space check along a ray."""


class HoughAcceptanceConfig(Config):
    """Acceptance of the answer; otherwise there is none."""

    min_agreeing_ratio: Ratio = 0.1
    """Share of each scan's obstacles that the other measured, too. Right results had 0.12 or more."""
    pair_m: PositiveFloat = 0.5
    """A point of the refined clouds is an inlier if it is this near to one of the other cloud."""


class GicpStagesConfig(Config):
    """GICP on the whole clouds (Segal, Haehnel & Thrun 2009)."""

    kind: Literal["gicp"] = "gicp"
    pair_distances_m: Annotated[tuple[PositiveFloat, ...], Field(min_length=1)] = (1.0,)
    """Largest distance between the points of a pair, from coarse to fine."""


class NdtStagesConfig(Config):
    """NDT on the points above the ground (§3.4)."""

    kind: Literal["ndt"] = "ndt"
    cells_m: Annotated[tuple[PositiveFloat, ...], Field(min_length=1)] = (2.0, 1.0)
    """Edges of the cells, from coarse to fine."""


class HoughConfig(Config):
    """Settings common to the Hough registrations."""

    constellation: ConstellationConfig
    """From a scan to the centres that vote."""
    voting: VotingConfig
    """Search of the motions that most pairs of centres agree on."""
    overlap: OverlapConfig = OverlapConfig()
    acceptance: HoughAcceptanceConfig = HoughAcceptanceConfig()
    voxel_m: PositiveFloat = 0.4
    """The clouds that are refined have one point per voxel."""
    refinement: Annotated[GicpStagesConfig | NdtStagesConfig, Field(discriminator="kind")]
    """Registration that refines the motion found by voting."""


class HoughGicpConfig(HoughConfig):
    """Occupied cells, Hough voting, GICP: our default."""

    kind: Literal["hough-gicp"] = "hough-gicp"
    constellation: ConstellationConfig = ConstellationConfig()
    voting: VotingConfig = VotingConfig()
    refinement: Annotated[GicpStagesConfig | NdtStagesConfig, Field(discriminator="kind")] = (
        GicpStagesConfig()
    )


class HoughNdtConfig(HoughConfig):
    """Objects, Hough voting, NDT, as published, with our levelling of tilted scans and our verification."""

    kind: Literal["hough-ndt"] = "hough-ndt"
    constellation: ConstellationConfig = ConstellationConfig(
        ground=GroundConfig(max_obstacle_m=4.0), centres=ObjectsConfig()
    )
    voting: VotingConfig = VotingConfig(angles=360)
    refinement: Annotated[GicpStagesConfig | NdtStagesConfig, Field(discriminator="kind")] = NdtStagesConfig()
