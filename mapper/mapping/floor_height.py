"""The floor that levelling puts at z = 0: a surface that patches show, or what lies below the sensor."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from mapper.core.frames import Scan
from mapper.core.geometry import Array, Transform, apply
from mapper.registration.planes import PARALLEL_RAD, Patches, least_support, levels_of, subsampled

_NEAR_FLOOR_M = 0.15
_LOWEST_PERCENT = 0.5
_NEAR_SENSOR_M = 12.0
_MIN_FLOOR_POINTS = 100


def heights_of(scans: Sequence[tuple[Scan, Transform]], up_world: Array) -> Array:
    """Return (N,) heights along up of the points, metres."""
    heights = [apply(T_world_body, subsampled(scan)) @ up_world for scan, T_world_body in scans]
    return np.concatenate([np.empty(0), *heights])


@dataclass(frozen=True, slots=True)
class Floor:
    """The floor.

    Attributes:
        height_m: Height along up; None is that of the first pose.
        detail: Source of the height; part of a sentence.
        is_seen: Whether a surface shows it, or tf states it; else it is a guess.
        conflict: Sentence on what tf states otherwise; empty without a contradiction.
    """

    height_m: float | None
    detail: str
    is_seen: bool
    conflict: str = ""


def floor_of(patches: Patches, heights_m: Array, *, up_world: Array, tolerance_m: float) -> Floor:
    """Return the floor that patches show.

    The floor is the lowest surface that faces up with enough patches. If many points lie deeper, that surface
    is a table, and the lowest points give the floor.
    """
    if not len(heights_m):
        return Floor(None, "no points seen: the floor is put at the first pose", is_seen=False)
    faces_up = patches.normals_world @ up_world > np.cos(PARALLEL_RAD)
    heights_up_m = patches.centres_world[faces_up] @ up_world
    surfaces = levels_of(heights_up_m, tolerance_m=tolerance_m, least=least_support(len(heights_up_m)))
    if surfaces:
        medians_m = np.array([np.median(heights_up_m[members]) for members in surfaces])
        # A surface has fringes just above and below it; the best supported of the lowest ones comes first.
        chosen = int(np.flatnonzero(medians_m <= medians_m.min() + _NEAR_FLOOR_M)[0])
        floor_m = float(medians_m[chosen])
        if (heights_m < floor_m - _NEAR_FLOOR_M).mean() <= 0.01 * _LOWEST_PERCENT:
            detail = f"floor seen in {len(surfaces[chosen])} of {len(patches)} patches"
            return Floor(floor_m, detail, is_seen=True)
    lowest_m = float(np.percentile(heights_m, _LOWEST_PERCENT))
    detail = f"no floor seen: z = 0 is where the lowest {_LOWEST_PERCENT:g} % of the points end"
    return Floor(lowest_m, detail, is_seen=False)


def floor_below(scans: Sequence[tuple[Scan, Transform]], up_world: Array, *, tolerance_m: float) -> Floor:
    """Return the floor below the first scan that shows one.

    It is the best supported height below the sensor among the points around it.
    """
    for scan, T_world_body in scans:
        sensor_world = apply(T_world_body, scan.origin_body[np.newaxis])[0]
        points_world = apply(T_world_body, scan.points_body.astype(np.float64)) - sensor_world
        heights_m = points_world @ up_world
        across_m = np.linalg.norm(points_world - heights_m[:, np.newaxis] * up_world, axis=1)
        below_m = heights_m[(across_m <= _NEAR_SENSOR_M) & (heights_m < -_NEAR_FLOOR_M)]
        least = max(_MIN_FLOOR_POINTS, len(below_m) // 4)
        levels = levels_of(below_m, tolerance_m=tolerance_m, least=least)
        if levels:
            floor_m = float(np.median(below_m[levels[0]]))
            height_m = floor_m + float(sensor_world @ up_world)
            return Floor(height_m, f"floor {-floor_m:.2f} m below the sensor", is_seen=True)
    detail = "no floor seen below the sensor: the floor is put at the first pose"
    return Floor(None, detail, is_seen=False)


def weighed(floor: Floor, stated_m: Array) -> Floor:
    """Return the floor that scans show; where they show none, the one that the log states below the robot.

    Args:
        floor: What the scans show.
        stated_m: (N,) heights along up of the floor below the robot, along the path; at least one.
    """
    if floor.height_m is None or not floor.is_seen:
        return Floor(float(stated_m[0]), "no floor seen: it is the robot's footprint by tf", is_seen=True)
    above_m = floor.height_m - float(np.clip(floor.height_m, stated_m.min(), stated_m.max()))
    if abs(above_m) <= _NEAR_FLOOR_M:
        return floor
    side = "above" if above_m > 0.0 else "below"
    conflict = (
        f"the floor seen is {abs(above_m):.2f} m {side} the robot's footprint by tf, and is taken; is "
        "base_footprint right?"
    )
    return replace(floor, conflict=conflict)
