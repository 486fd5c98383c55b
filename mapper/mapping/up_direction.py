"""The choice of up: by an accelerometer, by flat patches, by how the sensor is mounted or held."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mapper.core.geometry import Array
from mapper.core.trajectory import Trajectory
from mapper.mapping.body_axes import AXES, BodyAxes, mean_up
from mapper.mapping.config import LevelConfig
from mapper.mapping.up_by_accelerometer import up_by_accelerometer, up_in_stated_axes
from mapper.registration.planes import (
    MAX_TILT_RAD,
    MIN_PATCHES,
    PARALLEL_RAD,
    Patches,
    Vertical,
    vertical_of,
)
from mapper.sources.base import Accelerations

_FELT = "the accelerometer"
_UPSIDE_DOWN = 10
"""Patches that face down for each that faces up, above which a LiDAR hangs: outdoors no patch faces down, and
in rooms, where the ceiling is seen as well, about as many as face up."""


@dataclass(frozen=True, slots=True, eq=False)
class RoughUp:
    """Direction in the world within 60° of which up is.

    Attributes:
        up_world: (3,) the direction.
        conflict: Sentence on what contradicts it; else empty.
        is_decided: A floor below the sensor says that it is right; true without a conflict.
        assumption: Sentence on a direction that nothing in the log states; else empty.
    """

    up_world: Array
    conflict: str = ""
    is_decided: bool = True
    assumption: str = ""


def rough_up(
    patches: Patches,
    trajectory: Trajectory,
    accelerations: Accelerations | None,
    *,
    config: LevelConfig,
    axes: BodyAxes,
) -> RoughUp:
    """Return up as tf mounts the sensor, as its accelerometer feels it, or along its own axis.

    The first of them that the log states is taken. Where they contradict each other, it is the first below
    which a LiDAR sees a floor: drivers turn the clouds of an inverted one, but may leave tf and accelerometer
    as they are. Of a camera, whose images show floors and ceilings alike, it is the accelerometer if the
    path's turns and changes of velocity confirm it.

    Args:
        patches: Flat patches of the scans.
        trajectory: Poses of the body.
        accelerations: Readings, if there are any.
        config: Says which way is up where the log is wrong.
        axes: Rough attitude of the sensor's body.
    """
    if config.up[-1] in "xyz":
        axis = np.eye(3)["xyz".index(config.up[-1])]
        return RoughUp(mean_up(trajectory, -axis if config.up[0] == "-" else axis))
    candidates = _candidates(trajectory, accelerations, axes)
    chosen, is_decided = candidates[0], True
    if any(chosen.contradicts(other) for other in candidates):
        is_decided = accelerations is not None and accelerations.are_checked
        if axes.stands_on_floor:
            chosen, is_decided = _above_floor(candidates, patches, config.plane_tolerance_m)
    if config.up != "auto" and len(candidates) > 1:
        is_wanted = [(one.name == _FELT) == (config.up == "accelerometer") for one in candidates]
        chosen, is_decided = candidates[is_wanted.index(True)] if any(is_wanted) else chosen, True
    against = next((one for one in candidates if one.is_stated and chosen.contradicts(one)), None)
    if against is None:
        if chosen.name == _FELT or config.up != "auto":
            return RoughUp(chosen.up_world)
        assumption = "" if axes.are_stated else f"up is taken to be {chosen.name}, as nothing states it"
        conflict = _hanging(chosen, patches, config.plane_tolerance_m) if axes.stands_on_floor else ""
        return RoughUp(chosen.up_world, conflict, not conflict, assumption)
    angle_deg = np.degrees(chosen.angle_to(against))
    doubt = "" if is_decided else " though nothing decides"
    conflict = (
        f"up by {against.name} is {angle_deg:.0f}° from up by {chosen.name}, which is taken{doubt}; "
        "level.up=sensor or level.up=accelerometer says which is right"
    )
    return RoughUp(chosen.up_world, conflict, is_decided)


def _candidates(
    trajectory: Trajectory, accelerations: Accelerations | None, axes: BodyAxes
) -> list["_Candidate"]:
    """Return what says which way is up, the first of which is taken where nothing contradicts it."""
    is_camera = not axes.stands_on_floor
    own = "the top of the images" if is_camera else "the sensor's z axis"
    mounted = _Candidate("the mounting in tf" if axes.are_stated else own, axes.up_in(trajectory))
    up_felt = up_in_stated_axes(accelerations, trajectory)
    if accelerations is None or up_felt is None:
        felt = []
    else:
        is_reversed = is_camera and not accelerations.are_checked and mounted.is_opposite(up_felt)
        felt = [_Candidate(_FELT, -up_felt if is_reversed else up_felt)]  # some point down at rest
        if is_camera and accelerations.are_checked:
            return [*felt, mounted]
    if not axes.are_stated:
        return [*felt, mounted]
    if is_camera:
        return [mounted, *felt]
    z_axis = _Candidate(own, mean_up(trajectory, AXES["lidar"].up), is_stated=False)
    return [mounted, *felt, z_axis]


def _above_floor(
    candidates: Sequence["_Candidate"], patches: Patches, tolerance_m: float
) -> tuple["_Candidate", bool]:
    """Return the first candidate with a floor below it, and whether none with a floor contradicts it."""
    facing = [_facing(patches, candidate.up_world, tolerance_m) for candidate in candidates]
    with_floor = [
        candidate
        for candidate, (up, down) in zip(candidates, facing, strict=True)
        if up >= MIN_PATCHES and up > down
    ]
    if not with_floor:
        return candidates[0], False
    return with_floor[0], not any(with_floor[0].contradicts(other) for other in with_floor)


def _hanging(chosen: "_Candidate", patches: Patches, tolerance_m: float) -> str:
    """Return that a LiDAR seems to hang upside down; empty if it does not."""
    facing_up, facing_down = _facing(patches, chosen.up_world, tolerance_m)
    if facing_down < MIN_PATCHES or facing_down <= _UPSIDE_DOWN * facing_up:
        return ""
    return (
        f"of the level patches {facing_down} face down and {facing_up} up: is the LiDAR mounted "
        f"upside down? Up is taken by {chosen.name}; level.up=-z turns the map over, "
        "level.up=sensor says that it is right"
    )


def _facing(patches: Patches, up_guess: Array, tolerance_m: float) -> tuple[int, int]:
    """Return how many patches face up, as a floor does, and down, if up is within 60° of a direction."""
    if not len(patches):
        return 0, 0
    vertical = vertical_of(patches, up_guess_world=up_guess, tolerance_m=tolerance_m)
    cosine = patches.normals_world @ vertical.up_world
    return int((cosine > np.cos(PARALLEL_RAD)).sum()), int((cosine < -np.cos(PARALLEL_RAD)).sum())


@dataclass(frozen=True, slots=True, eq=False)
class _Candidate:
    """A direction in the world that may be up, and whether the log or the way a sensor is held says so."""

    name: str
    up_world: Array
    is_stated: bool = True

    def angle_to(self, other: "_Candidate") -> float:
        return float(np.arccos(np.clip(self.up_world @ other.up_world, -1.0, 1.0)))

    def contradicts(self, other: "_Candidate") -> bool:
        return self.angle_to(other) > float(MAX_TILT_RAD)

    def is_opposite(self, up_world: Array) -> bool:
        return bool(self.up_world @ up_world < -np.cos(MAX_TILT_RAD))


def up_of(
    patches: Patches,
    trajectory: Trajectory,
    accelerations: Accelerations | None,
    *,
    up_guess: Array,
    tolerance_m: float,
) -> tuple[Array, str, str]:
    """Return up in the world (3,), its method, and the detail for the manifest, refused methods included.

    Args:
        patches: Flat patches of the scans.
        trajectory: Poses of the body.
        accelerations: Readings, if there are any.
        up_guess: (3,) the rough one, which is taken where the others say nothing.
        tolerance_m: Distance of a plane's points from it.
    """
    details = []
    if accelerations is not None:
        up_world, detail = up_by_accelerometer(accelerations, trajectory, up_guess)
        if up_world is not None:
            return up_world, "accelerometer", detail
        details.append(detail)
    if len(patches) >= MIN_PATCHES:
        vertical = vertical_of(patches, up_guess_world=up_guess, tolerance_m=tolerance_m)
        detail = _planes_text(vertical, len(patches))
        if vertical.is_agreed:
            return vertical.up_world, "planes", "; ".join([*details, detail])
        details.append(f"planes do not agree: {detail}")
    else:
        details.append(f"only {len(patches)} flat patches seen, want {MIN_PATCHES}")
    return up_guess, "camera", "; ".join([*details, "up is the sensor's mean up direction"])


def _planes_text(vertical: Vertical, count: int) -> str:
    text = (
        f"of {count} flat patches {100 * vertical.horizontal_ratio:.0f} % are horizontal, "
        f"{100 * vertical.upright_ratio:.0f} % upright"
    )
    return text if vertical.determined else f"{text}, all facing one way: the tilt along them is the camera's"
