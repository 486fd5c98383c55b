"""Settings of fusing: levelling, the cloud, and what the MCAP log shows of each frame."""

from typing import Annotated, Protocol

from pydantic import Field, NonNegativeInt, PositiveFloat, PositiveInt

from mapper.core.config import Config
from mapper.navigation.config import TraversableConfig
from mapper.octree.config import OctreeConfig, SliceConfig


class LevelConfig(Config):
    """How "up" and the floor are found."""

    frames: PositiveInt = 40
    """How many frames, spread over the log, are looked at."""
    points_per_frame: PositiveInt = 4000
    plane_tolerance_m: PositiveFloat = 0.03


class McapConfig(Config):
    """What goes into ``run.mcap``."""

    image_stride: NonNegativeInt = 10
    """Every n-th frame's colour image, or scan, is logged; 0 logs none."""
    image_width_px: PositiveInt = 320
    """Wider images are shrunk."""
    image_quality: Annotated[int, Field(ge=1, le=100)] = 80
    """As libjpeg counts."""
    scan_voxel_m: PositiveFloat = 0.3
    """Scans are thinned to one point per voxel."""
    frame_times: bool = True
    """Log the milliseconds of every frame; without them two builds of a log give the same bytes."""


class CloudConfig(Config):
    """The coloured cloud."""

    voxel_m: PositiveFloat = 0.02
    """The cloud keeps one point, the mean, per cube of this edge."""
    frame_stride: PositiveInt = 10
    """Every n-th tracked frame gives its points."""


class FuseSettings(Protocol):
    """What fusing reads of a build's configuration."""

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
        """Which frames are shown in the MCAP log, and how."""
        ...

    @property
    def workers(self) -> int:
        """Threads that read and cast frames ahead."""
        ...
