"""Configuration of the Hough-space registration (Nagy, Gálai & Benedek 2016)."""

from typing import Annotated, Literal

from pydantic import Field, NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt

from mapper.config.base import Config

Ratio = Annotated[float, Field(ge=0.0, le=1.0)]


class LevellingConfig(Config):
    """Which way is up in one scan: the plane most points lie on and few below, by random samples."""

    max_tilt_deg: Annotated[float, Field(gt=0.0, lt=80.0)] = 40.0
    """Steeper planes are walls."""
    level_above_deg: NonNegativeFloat = 5.0
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
    max_obstacle_m: float = 4.0
    """What is higher is cut off: the sparse sensor does not see it (C1)."""
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
    distinct_deg: PositiveFloat = 5.0
    """Peaks nearer to a higher one than both are the same peak."""
