"""Configuration of the Hough-space registration (Nagy, Gálai & Benedek 2016)."""

from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import Field, NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt

from mapper.core.config import Config, Ratio

if TYPE_CHECKING:
    from mapper.registration.base import Registration


class LevellingConfig(Config):
    """Which way is up in one scan: the plane most points lie on and few below, by random samples."""

    max_tilt_rad: Annotated[float, Field(gt=0.0, lt=1.4)] = 0.7
    """Steeper planes are walls."""
    level_above_rad: NonNegativeFloat = 0.09
    """A smaller tilt stays: on a sloping street the plane would tilt what gravity has levelled."""
    inlier_m: PositiveFloat = 0.12
    """Largest distance of a ground point from the plane."""
    min_height_m: float = 0.3
    max_height_m: float = 4.0
    """The sensor stands between these heights above the plane."""
    below_weight: NonNegativeFloat = 1.0
    """What a point below the plane costs, in inliers."""
    cell_m: PositiveFloat = 1.0
    """One point per cubic cell is looked at, so that near ground does not outvote the rest."""
    reach_m: PositiveFloat = 40.0
    """Points farther away along an axis are not looked at."""
    samples: PositiveInt = 400
    """Planes tried."""
    min_inlier_ratio: Ratio = 0.03
    """With a smaller share of inliers there is no ground, and the scan is taken as level."""
    seed: NonNegativeInt = 0
    """Of the random samples."""


class GroundConfig(Config):
    """What is ground: C1's grid, and what of the rest is looked at."""

    cell_m: PositiveFloat = 0.5
    """Edge of a cell of the grid."""
    min_points: PositiveInt = 3
    """Cells with fewer points are noise."""
    max_thickness_m: PositiveFloat = 0.25
    """Between the lowest and the highest point of a ground cell (C1)."""
    window_m: PositiveFloat = 8.0
    """Neighbourhood of a cell."""
    max_rise_m: PositiveFloat = 0.5
    """A ground cell's mean height above the lowest flat cell of its neighbourhood."""
    radius_m: PositiveFloat = 60.0
    """Half the edge of the grid: points farther away along an axis are dropped."""
    min_obstacle_m: float = 0.5
    """Lowest height above the ground of what is no ground."""
    max_obstacle_m: float = 8.0
    """What is higher is cut off. C1 has 4 m; a tilted sensor sees little but walls, and more up to 8."""
    voxel_m: PositiveFloat = 0.4
    """Obstacles are thinned to one point per voxel, so that sparse and dense clouds weigh alike."""


class CellsConfig(Config):
    """A constellation of the centroids of occupied cells: more and steadier points than objects."""

    kind: Literal["cells"] = "cells"
    cell_m: PositiveFloat = 2.0
    """Edge of a cell."""
    min_voxels_ratio: NonNegativeFloat = 0.5
    """An occupied cell has so many times the voxels of the cloud's median cell."""


class ObjectsConfig(Config):
    """C2: a constellation of objects, by two levels of grid cells."""

    kind: Literal["objects"] = "objects"
    coarse_m: PositiveFloat = 1.0
    """Cells of this edge that touch make a group of objects."""
    fine_m: PositiveFloat = 0.4
    """Inside a group, cells of this edge that touch make one object."""
    min_voxels_ratio: NonNegativeFloat = 0.5
    """An object has so many times the voxels of the cloud's median coarse cell."""


class ConstellationConfig(Config):
    """From one scan to the centres that vote."""

    levelling: LevellingConfig = LevellingConfig()
    ground: GroundConfig = GroundConfig()
    centres: Annotated[CellsConfig | ObjectsConfig, Field(discriminator="kind")] = CellsConfig()


class VotingConfig(Config):
    """C3: the accumulator A[dx, dy, α]."""

    max_offset_m: PositiveFloat = 10.0
    """Largest offset looked for along each axis."""
    margin_m: NonNegativeFloat = 2.0
    """The accumulator reaches so much farther: a peak at its edge would be cut."""
    bin_m: PositiveFloat = 1.0
    """Edge of a bin of dx and dy; one bin is centred on zero."""
    angles: PositiveInt = 180
    """Steps of a full turn. C3 has 360; half of them find the same peaks, and verification refines them."""
    peaks: PositiveInt = 20
    """Distinct peaks that are verified."""
    distinct_m: PositiveFloat = 2.0
    distinct_rad: PositiveFloat = 0.09
    """Peaks nearer to a higher one than both are the same peak."""


class OverlapConfig(Config):
    """How peaks are verified: by what the two scans saw of each other's obstacles."""

    voxel_m: PositiveFloat = 0.4
    """Obstacles of one scan within a voxel of those of the other overlap."""
    obstacles: PositiveInt = 1000
    """Voxels, and columns of ground, that are looked at, evenly chosen."""
    step_m: PositiveFloat = 0.4
    step_rad: PositiveFloat = 0.0175
    halvings: NonNegativeInt = 2
    """From each peak the overlap is climbed in these steps, halved so often."""
    candidates: PositiveInt = 6
    """Peaks with the most overlap that are held against both scans' lines of sight."""
    distinct_m: PositiveFloat = 1.0
    distinct_rad: PositiveFloat = 0.05
    """Motions nearer than both are the same."""
    direction_rad: PositiveFloat = 0.0175
    """Resolution of the lines of sight."""
    rays: PositiveInt = 40_000
    """Points, evenly chosen, whose lines of sight are looked along."""
    margin_m: PositiveFloat = 0.2
    margin_ratio: NonNegativeFloat = 0.01
    """An obstacle agrees with a surface at its range, give or take this and so much of the range. One nearer
    than all that the other scan saw in its direction contradicts it."""
    min_returns: PositiveInt = 3
    """And it contradicts only where so many of the directions around it have a return."""
    contradiction_weight: NonNegativeFloat = 5.0
    """A motion's score is the share of obstacles that agree, less so many times that which contradicts."""


class HoughTrustConfig(Config):
    """When the answer is believed; otherwise there is none."""

    min_centres: PositiveInt = 5
    """A scan with fewer centres shows no objects."""
    min_score: float = 0.0
    """A best candidate with a lower score is refused without being refined. Right ones had 0.3 and more,
    those of different streets −0.4 and less."""
    min_agreeing_ratio: Ratio = 0.1
    """Share of each scan's obstacles that the other saw, too. Right answers had 0.12 and more."""
    min_ground_ratio: Ratio = 0.15
    """Share of a scan's ground that the other saw, too. Where two views have but a wall in common, any wall
    will do: wrong answers that nothing contradicted had 0.07 and less, right ones 0.31 and more."""
    max_contradicting_ratio: Ratio = 0.015
    """Share of the obstacles that the other scan looked through, the mean of both. Right answers had 0.008
    and less, or 0.014 where a cloud's origin was not where it was seen from; answers in other, similar
    courtyards 0.016 and more."""
    many_centres: PositiveInt = 150
    max_contradicting_many_ratio: Ratio = 0.03
    """The same where both scans have many centres, whose agreement is no chance: traffic may contradict more.
    Right answers had 0.023 and less, wrong ones 0.1 and more."""
    min_lead: NonNegativeFloat = 0.1
    """By how much the score leads that of any other motion."""
    pair_m: PositiveFloat = 0.5
    """A point of the refined clouds counts as an inlier that lies so near to one of the other."""
    min_share: Ratio = 0.004
    """Each motion's displacements go along the surfaces' normals by this share, or the answer is loose."""
    refined: PositiveInt = 3
    """Candidates that are refined, where their scores are near."""
    near_score: NonNegativeFloat = 0.3
    """How near."""


class GicpStagesConfig(Config):
    """GICP on the whole clouds (Segal, Haehnel & Thrun 2009)."""

    kind: Literal["gicp"] = "gicp"
    pair_distances_m: Annotated[tuple[PositiveFloat, ...], Field(min_length=1)] = (1.0,)
    """Largest distance between the points of a pair, from coarse to fine."""
    max_iterations: PositiveInt = 30
    """At each of these distances."""


class NdtStagesConfig(Config):
    """NDT on what is not ground (C4)."""

    kind: Literal["ndt"] = "ndt"
    cells_m: Annotated[tuple[PositiveFloat, ...], Field(min_length=1)] = (2.0, 1.0)
    """Edges of the cells, from coarse to fine."""
    min_points: Annotated[int, Field(ge=4)] = 6
    """Cells with fewer points have no Gaussian."""
    max_iterations: PositiveInt = 30
    """At each of these cells."""
    with_ground: bool = False


class HoughConfig(Config):
    """What the Hough-space registrations share."""

    constellation: ConstellationConfig
    voting: VotingConfig
    overlap: OverlapConfig = OverlapConfig()
    trust: HoughTrustConfig = HoughTrustConfig()
    voxel_m: PositiveFloat = 0.4
    """The clouds that are refined have one point per voxel."""
    neighbours: Annotated[int, Field(ge=5)] = 10
    """Nearest points that give each of these its normal."""
    refinement: Annotated[GicpStagesConfig | NdtStagesConfig, Field(discriminator="kind")]

    def build(self) -> "Registration":
        """Return the method this configures."""
        from mapper.registration.hough.aligner import Hough

        return Hough(self)


class HoughGicpConfig(HoughConfig):
    """Occupied cells, Hough, GICP: our default."""

    kind: Literal["hough-gicp"] = "hough-gicp"
    constellation: ConstellationConfig = ConstellationConfig()
    voting: VotingConfig = VotingConfig()
    refinement: Annotated[GicpStagesConfig | NdtStagesConfig, Field(discriminator="kind")] = (
        GicpStagesConfig()
    )


class HoughNdtConfig(HoughConfig):
    """Objects, Hough, NDT, as published; peaks are verified, and tilted scans levelled, all the same."""

    kind: Literal["hough-ndt"] = "hough-ndt"
    constellation: ConstellationConfig = ConstellationConfig(
        ground=GroundConfig(max_obstacle_m=4.0), centres=ObjectsConfig()
    )
    voting: VotingConfig = VotingConfig(angles=360)
    refinement: Annotated[GicpStagesConfig | NdtStagesConfig, Field(discriminator="kind")] = NdtStagesConfig()
