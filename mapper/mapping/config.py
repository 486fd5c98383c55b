"""Settings of mapping: levelling, the coloured cloud, the frames in the MCAP log, and edits by hand."""

import json
import math
from typing import Literal, Protocol, Self

from pydantic import NonNegativeInt, PositiveFloat, PositiveInt, model_validator

from mapper.core.config import Config
from mapper.navigation.config import TraversableConfig
from mapper.octree.config import OctreeConfig, SliceConfig


class LevelConfig(Config):
    """Settings of levelling: the search for "up" and the floor."""

    frames: PositiveInt = 40
    """Number of frames, spread over the log, in which planes are searched."""
    plane_tolerance_m: PositiveFloat = 0.03
    """Largest standard deviation of a plane's points from it: the noise of the sensor."""
    up: Literal["auto", "accelerometer", "sensor", "x", "-x", "y", "-y", "z", "-z"] = "auto"
    """What says which way is up where the accelerometer contradicts the sensor's mounting by more than 60°:
    auto asks the floor of a LiDAR, and of a camera the accelerometer if the path confirms it. Or the axis of
    the sensor that points up: of a camera y points down in its images and x to their right."""
    heading: Literal["walls", "start"] = "walls"
    """Direction of x and y: along most walls if these agree, so that they are straight in a slice; or the
    first pose's heading."""


class McapConfig(Config):
    """Content of ``run.mcap``."""

    image_stride: NonNegativeInt = 10
    """Every n-th frame's colour image, or scan, is logged; 0 logs none."""
    image_width_px: PositiveInt = 320
    """Wider images are shrunk."""
    frame_times: bool = True
    """Log the milliseconds of every frame; without them two builds of a log give the same bytes."""


class CloudConfig(Config):
    """Settings of the coloured cloud."""

    voxel_m: PositiveFloat = 0.02
    """The cloud has one mean point per cube of this edge."""
    frame_stride: PositiveInt = 10
    """Every n-th tracked frame adds its points."""


_Point2 = tuple[float, float]
_Point3 = tuple[float, float, float]


class Region(Config):
    """Part of a map: where all of the conditions hold that are given. Metres in the run's levelled world."""

    box_m: tuple[_Point3, _Point3] | None = None
    """Lowest and highest corner of a box along the axes."""
    height_m: tuple[float, float] | None = None
    """Lowest and highest z."""
    path_radius_m: PositiveFloat | None = None
    """Largest distance, seen from above, from where the sensor was in any frame of the maps."""
    polygon_m: tuple[_Point2, ...] | None = None
    """Corners, seen from above, in order around it; the last is joined to the first."""

    @model_validator(mode="after")
    def _holds_space(self) -> Self:
        if not self.model_fields_set:
            raise ValueError(f"no condition; want one or more of {', '.join(Region.model_fields)}")
        if self.box_m is not None and not all(low < high for low, high in zip(*self.box_m, strict=True)):
            raise ValueError(f"box_m = {json.dumps(self.box_m)}: want the lowest corner, then the highest")
        if self.height_m is not None and not self.height_m[0] < self.height_m[1]:
            raise ValueError(f"height_m = {json.dumps(self.height_m)}: want the lowest z, then the highest")
        low_m, high_m = self.z_range_m
        if not low_m < high_m:
            raise ValueError("box_m and height_m have no height in common")
        if self.polygon_m is not None:
            _refuse_crossed(self.polygon_m)
        return self

    @property
    def z_range_m(self) -> tuple[float, float]:
        """Lowest and highest z that the conditions allow."""
        low_m, high_m = self.height_m or (-math.inf, math.inf)
        if self.box_m is None:
            return low_m, high_m
        return max(low_m, self.box_m[0][2]), min(high_m, self.box_m[1][2])

    @property
    def lines(self) -> list[str]:
        """The conditions as lines of TOML."""
        return [f"{name} = {json.dumps(value)}" for name, value in self if value is not None]


def _refuse_crossed(corners: tuple[_Point2, ...]) -> None:
    """Refuse a polygon without an area, or with two sides that cross: its corners are in another order."""
    if len(set(corners)) < len(corners) or len(corners) < 3:
        raise ValueError(f"polygon_m has corners {json.dumps(corners)}: want 3 or more, each once")
    sides = list(zip(corners, corners[1:] + corners[:1], strict=True))
    for number, (a, b) in enumerate(sides):
        for c, d in sides[:number]:
            apart = _cross(a, b, c) * _cross(a, b, d), _cross(c, d, a) * _cross(c, d, b)
            if max(apart) < 0.0:
                raise ValueError(
                    f"polygon_m: its sides {json.dumps([c, d])} and {json.dumps([a, b])} cross; "
                    "want the corners in order around it"
                )
    if math.isclose(sum(_cross((0.0, 0.0), *side) for side in sides), 0.0, abs_tol=1e-9):
        raise ValueError(f"polygon_m has corners {json.dumps(corners)}, without an area between them")


def _cross(a: _Point2, b: _Point2, c: _Point2) -> float:
    """Return twice the area of a triangle, < 0 if its corners are in clockwise order."""
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])


EditKind = Literal["erase", "keep", "keepout"]


class Edits(Config):
    """``edits.toml``: what a user changes in the maps by hand; each fuse does it again."""

    erase: tuple[Region, ...] = ()
    """Occupied voxels in these regions become free, and points of the cloud there are left out."""
    keep: tuple[Region, ...] = ()
    """If there are any, everything outside these regions is left out of octree, cloud and grids."""
    keepout: tuple[Region, ...] = ()
    """Floor in these regions is blocked in the traversable floor; the other maps do not change."""

    def __len__(self) -> int:
        """Return the number of regions."""
        return len(self.erase) + len(self.keep) + len(self.keepout)


class AppliedEdit(Config):
    """A region of ``edits.toml`` and what it did when the maps were made."""

    kind: EditKind
    region: Region
    count: int
    """Occupied voxels that were erased, known voxels that are kept, or cells that were not blocked before."""

    @property
    def text(self) -> str:
        """Both in one line."""
        did = {"erase": "voxels erased", "keep": "voxels kept", "keepout": "cells blocked"}[self.kind]
        return f"{self.kind} {', '.join(self.region.lines)}: {self.count} {did}"


def edits_of(applied: tuple[AppliedEdit, ...]) -> Edits:
    """Return the regions of edits that were made."""
    kinds: tuple[EditKind, ...] = ("erase", "keep", "keepout")
    return Edits(**{kind: tuple(edit.region for edit in applied if edit.kind == kind) for kind in kinds})


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
