"""Settings of the occupancy octree and of the 2D slice."""

import math
from typing import Annotated, Literal, Self

from pydantic import Field, PositiveFloat, PositiveInt, model_validator

from mapper.core.config import Config
from mapper.sensing.config import DepthNoiseConfig

Probability = Annotated[float, Field(gt=0.0, lt=1.0)]

Parent = Literal["max", "mean"]
"""Log-odds of a node from its known children: the highest, as in OctoMap (Hornung et al. 2013, eq. 7:
nothing occupied is overlooked), or their mean (Zhao et al. 2020, eq. 14)."""


class OctreeConfig(Config):
    """OctoMap's sensor model and geometry (Hornung et al. 2013); its defaults."""

    resolution_m: PositiveFloat = 0.05
    """Edge of a voxel. Half of it takes 6 to 8 times the memory and time; smaller than the sensor's noise it
    shows no more."""
    hit_probability: Annotated[float, Field(ge=0.5, lt=1.0)] = 0.7
    """Probability that a voxel in which one ray ends is occupied. Raise it where few frames see each
    surface."""
    miss_probability: Annotated[float, Field(gt=0.0, le=0.5)] = 0.4
    """Probability that a voxel through which one ray passes is occupied. Lower values free voxels sooner
    after an object has left, but thin surfaces that rays graze."""
    clamp_min_probability: Annotated[float, Field(gt=0.0, lt=0.5)] = 0.1192
    """Lowest probability of a voxel, which no further ray reduces. Nearer to 0.5, an object that arrives is
    mapped sooner."""
    clamp_max_probability: Annotated[float, Field(gt=0.5, lt=1.0)] = 0.971
    """Highest probability of a voxel, which no further ray increases. Nearer to 0.5, voxels are freed sooner
    after an object has left."""
    occupied_probability: Probability = 0.5
    """A voxel counts as occupied above this probability. Higher values leave out what few rays have hit."""
    max_range_m: Annotated[float, Field(gt=0.0, allow_inf_nan=True)] | None = None
    """Returns beyond this range only free space, up to it. None is as far as ``depth_noise`` allows."""
    depth_noise: DepthNoiseConfig | None = None
    """Noise of a depth camera; returns count while their standard deviation is at most a voxel. None uses
    ``odometry.depth_noise``, or else the noise measured on the planes in the log. No effect if
    ``max_range_m`` is set."""
    discretize: bool = True
    """Cast one ray per end voxel (fast), not one per point; both are OctoMap's own modes."""
    attributes: bool = False
    """Keep mean colour, hit count and time of the last hit of the voxels where rays end."""
    max_memory_mb: PositiveFloat | None = None
    """Size of the voxels beyond which a build keeps them in a file in the run's folder, of which the system
    caches what fits; the map is the same. For maps larger than memory; tables of their blocks and the 2D maps
    still have to fit. None keeps all in memory."""
    moving: Literal["removed", "kept"] = "removed"
    """Whether fusing frees the voxels in which something moved, and keeps surfaces that rays only grazed; see
    ``mapper.octree.moving_objects``. "kept" gives OctoMap's map."""

    @property
    def max_memory_bytes(self) -> float:
        """Size of the voxels beyond which they are in a file."""
        return math.inf if self.max_memory_mb is None else 1e6 * self.max_memory_mb

    @property
    def range_limit_m(self) -> float:
        """Length of the longest ray with an occupied end."""
        return math.inf if self.max_range_m is None else self.max_range_m


class SliceConfig(Config):
    """The 2D navigation map cut from the octree."""

    min_height_m: float = 0.1
    """Lower edge of the band above the floor."""
    max_height_m: float = 1.2
    """Upper edge of the band above the floor: the robot's height."""
    above: Literal["floor", "ground"] = "floor"
    """"floor": the band is level; "ground": it follows streets that rise and fall."""
    min_cluster_cells: PositiveInt = 1
    """Smaller 8-connected groups of occupied cells count as noise; 1 keeps all."""

    @model_validator(mode="after")
    def _refuse_an_empty_band(self) -> Self:
        """Refuse an empty band before a log is fused, not after."""
        if self.max_height_m <= self.min_height_m:
            raise ValueError(
                f"max_height_m {self.max_height_m} must be above min_height_m {self.min_height_m}"
            )
        return self
