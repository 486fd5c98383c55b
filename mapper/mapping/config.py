"""Settings of mapping: levelling, the coloured cloud, and the frames in the MCAP log."""

from typing import Annotated, Literal, Protocol

from pydantic import Field, NonNegativeInt, PositiveFloat, PositiveInt

from mapper.core.config import Config
from mapper.navigation.config import TraversableConfig
from mapper.octree.config import OctreeConfig, SliceConfig


class LevelConfig(Config):
    """Settings of levelling: the search for "up" and the floor."""

    frames: PositiveInt = 40
    """Number of frames, spread over the log, in which planes are searched."""
    plane_tolerance_m: PositiveFloat = 0.03
    """Largest standard deviation of a plane's points from it: the noise of the sensor."""
    heading: Literal["walls", "start"] = "walls"
    """What x and y lie along: most walls, where these agree, so that a slice shows them straight; or the
    first pose's heading."""


class McapConfig(Config):
    """Content of ``run.mcap``."""

    image_stride: NonNegativeInt = 10
    """Every n-th frame's colour image, or scan, is logged; 0 logs none."""
    image_width_px: PositiveInt = 320
    """Wider images are shrunk."""
    image_quality: Annotated[int, Field(ge=1, le=100)] = 80
    """Quality of the JPEG images, on the scale of libjpeg."""
    scan_voxel_m: PositiveFloat = 0.3
    """Scans are thinned to one point per voxel."""
    frame_times: bool = True
    """Log the milliseconds of every frame; without them two builds of a log give the same bytes."""


class CloudConfig(Config):
    """Settings of the coloured cloud."""

    voxel_m: PositiveFloat = 0.02
    """The cloud has one point, the mean, per cube of this edge."""
    frame_stride: PositiveInt = 10
    """Every n-th tracked frame adds its points."""


class FuseSettings(Protocol):
    """The part of a build's configuration that fusing reads."""

    @property
    def octree(self) -> OctreeConfig:
        """The octree's geometry and sensor model."""
        ...

    @property
    def slice(self) -> SliceConfig:
        """The 2D slice cut from it."""
        ...

    @property
    def traversable(self) -> TraversableConfig:
        """The floor that a robot can drive on."""
        ...

    @property
    def cloud(self) -> CloudConfig:
        """The coloured cloud."""
        ...

    @property
    def mcap(self) -> McapConfig:
        """Frames in the MCAP log, and their form."""
        ...

    @property
    def workers(self) -> int:
        """Threads that read and cast frames ahead."""
        ...
