"""Sharpness of a map, without any reference: how well overlapping scans agree.

It separates a good trajectory from a bad one only as far as the sensor is right: scans that are wrong alike
agree.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from mapper.core.errors import DataError
from mapper.core.frames import Sensor
from mapper.core.geometry import Array, Points, apply, stride_for
from mapper.core.trajectory import Trajectory
from mapper.core.voxel_grid import thin
from mapper.evaluators.metrics.metric import Metric
from mapper.mapping.placed_frames import placed_frames
from mapper.runtime.progress import SILENT, Progress
from mapper.sources.base import Log

RADIUS_M: dict[Sensor, float] = {"rgbd": 0.2, "lidar": 0.5, "lidar-2d": 0.2}
"""Radius of the patches: small enough for walls to be flat, large against the errors of poses."""

_FRAMES, _POINTS, _PATCHES = 100, 200_000, 5_000
_MIN_NEIGHBOURS = 15
_BREADTH_RATIO = 0.2
"""A patch's second variance against its largest: below, it is a line, for instance one LiDAR ring."""
_SHEETS_APART, _SHEET_SHARE = 5.0, 0.2
"""Two sheets are this multiple of their spread apart, and hold this share of the points: of one sheet with
normal noise the parts are 2.7 apart, of an evenly filled one 3.5."""
_LEAST_VARIANCE_M2 = 1e-12


@dataclass(frozen=True, slots=True, eq=False)
class Views:
    """Points of several scans in one world, and the directions they were seen from.

    Attributes:
        points_world: (N, 3) metres.
        towards_world: (N, 3) from each point to where the sensor was; of any length.
        frames: (N,) int64: which scan each point is of.
    """

    points_world: Points
    towards_world: Array
    frames: NDArray[np.int64]

    def __post_init__(self) -> None:
        n = len(self.points_world)
        shapes = (self.points_world.shape, self.towards_world.shape, self.frames.shape)
        if n == 0 or shapes != ((n, 3), (n, 3), (n,)):
            raise DataError(f"sharpness: points, directions and frames {shapes}, want (N, 3), (N, 3), (N,)")


def views_of(source: Log, trajectory: Trajectory, *, progress: Progress = SILENT) -> Views:
    """Return evenly chosen points of evenly chosen scans at a trajectory's poses, enough of any log.

    Args:
        source: The log.
        trajectory: T_world_body of its frames.
        progress: Receives stages, counts and notes.

    Raises:
        DataError: No frame of the log has a pose.
        FrameError: A frame cannot be read.
    """
    placed = list(placed_frames(source, trajectory))
    chosen = placed[:: stride_for(len(placed), _FRAMES)]
    points, towards, frames = [np.empty((0, 3))], [np.empty((0, 3))], [np.empty(0, np.int64)]
    with progress.stage("sharp") as report:
        for number, frame in enumerate(chosen):
            scan = frame.scan_of(frame.entry.scan())
            few = scan.points_body[:: max(1, len(scan.points_body) * len(chosen) // _POINTS)]
            points.append(apply(frame.T_world_body, few.astype(np.float64)))
            towards.append((scan.origin_body - few) @ frame.T_world_body[:3, :3].T)
            frames.append(np.full(len(few), number, np.int64))
            report(number + 1, len(chosen))
    return Views(np.concatenate(points), np.concatenate(towards), np.concatenate(frames))


def sharpness_metrics(views: Views, *, radius_m: float) -> list[Metric]:
    """Return wall thickness, double walls, mean map entropy and mean plane variance.

    Patches are the points within a radius of one in each voxel half as wide, seen from the same side, in two
    frames or more. A patch is as thick as the standard deviation across its best plane, unless it is a line.
    Corners and clutter are patches too, so what counts is the median, and maps compare that show the same; to
    leave them out would leave out the walls blurred most. Double walls are the share of patches whose
    points lie in two sheets, steps and edges among them. Entropy is ½ ln |2πe Σ| of a patch's covariance
    (Droeschel, Stückler & Behnke 2014), plane variance its least eigenvalue (Razlaw et al. 2015).

    Args:
        views: The scans at their poses.
        radius_m: Radius of the patches.

    Raises:
        DataError: No patch was seen in two frames, or all are lines.
    """
    order = np.lexsort(np.floor(views.points_world / radius_m).T)  # cell by cell
    views = Views(views.points_world[order], views.towards_world[order], views.frames[order])
    patches = list(_patches(views, radius_m))
    if not patches:
        raise DataError(
            f"sharpness: nowhere {_MIN_NEIGHBOURS} points of two frames within {radius_m:g} m: no overlap"
        )
    variances, axes = np.linalg.eigh([_covariance(patch) for patch in patches])
    variances = np.maximum(variances, _LEAST_VARIANCE_M2)
    broad = variances[:, 1] >= _BREADTH_RATIO * variances[:, 2]
    if not broad.any():
        raise DataError(f"sharpness: all patches of {radius_m:g} m are lines; choose a larger radius")
    thickness_m = np.sqrt(variances[broad, 0])
    double = [_is_double(patches[k], normal=axes[k, :, 0], radius_m=radius_m) for k in np.flatnonzero(broad)]
    entropy = 0.5 * (3.0 * np.log(2.0 * np.pi * np.e) + np.log(variances).sum(axis=1))
    about = f"radius {radius_m:g} m"
    return [
        Metric("patches seen in several frames", len(patches), "patches", about),
        Metric("wall thickness median", float(np.median(thickness_m)), "m", about),
        Metric("wall thickness quartile", float(np.percentile(thickness_m, 25.0)), "m", about),
        Metric("double walls", 100.0 * float(np.mean(double)), "%", about),
        Metric("mean map entropy", float(entropy.mean()), "nats", about),
        Metric("mean plane variance", float(variances[:, 0].mean()), "m²", about),
    ]


def _patches(views: Views, radius_m: float) -> Iterator[Array]:
    """Yield the points about evenly chosen ones, (N, 3) metres from the chosen one.

    They are within the radius and were seen from the same side, so that the two faces of a thin wall are two
    patches. Patches with too few points, or with points of one frame alone, are left out.
    """
    points, towards = views.points_world, views.towards_world
    chosen = thin(points.astype(np.float32), 0.5 * radius_m)
    chosen = chosen[:: stride_for(len(chosen), _PATCHES)].astype(np.int64)
    around = cKDTree(points).query_ball_point(points[chosen], 1.001 * radius_m, return_sorted=True)
    for i, near in zip(chosen, around, strict=True):
        offsets = points[near] - points[i]
        inside = (offsets**2).sum(axis=1) <= radius_m * radius_m
        inside &= (towards[near] * towards[i]).sum(axis=1) > 0.0
        if inside.sum() >= _MIN_NEIGHBOURS and (views.frames[near][inside] != views.frames[i]).any():
            yield offsets[inside]


def _covariance(offsets: Array) -> Array:
    centred = offsets - (offsets / len(offsets)).sum(axis=0)
    covariance: Array = (centred[:, :, None] * centred[:, None, :] / (len(offsets) - 1)).sum(axis=0)
    return covariance


def _is_double(offsets: Array, *, normal: Array, radius_m: float) -> bool:
    """Return whether a patch consists of two sheets.

    The points half as near to the normal through its middle as the radius are parted in two along it so that
    the parts differ most (Otsu 1979). The sheets' distance is that of the parts' means over their spread.
    """
    along = (offsets * normal).sum(axis=1)
    near_normal = (offsets**2).sum(axis=1) - along * along <= 0.25 * radius_m * radius_m
    ordered = np.sort(along[near_normal])
    if len(ordered) < 3:
        return False
    sums, below = np.cumsum(ordered), np.arange(1, len(ordered))
    above, low, high = len(ordered) - below, sums[:-1], sums[-1] - sums[:-1]
    between = below * above * (low / below - high / above) ** 2
    k = int(between.argmax())
    squares = np.cumsum(ordered * ordered)[-1]
    within = squares - low[k] * low[k] / below[k] - high[k] ** 2 / above[k]
    spread = np.sqrt(max(within, 0.0) / len(ordered))
    apart = (high[k] / above[k] - low[k] / below[k]) / max(spread, 1e-9)
    share = min(below[k], above[k]) / len(ordered)
    return bool(apart >= _SHEETS_APART and share >= _SHEET_SHARE)
