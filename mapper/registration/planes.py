"""Plane patches of scans, and the vertical direction that fits most of them."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapper.core.frames import Scan
from mapper.core.geometry import Array, Points, Transform, apply, stride_for

_ENOUGH = 4000
"""Evenly chosen points of a scan, or patches: more hardly change the planes and take longer."""
_CELL_RANGE_RATIO = 0.1
_CELL_LIMITS_M = (0.15, 1.0)
_MIN_PATCH_POINTS = 8
_FLATNESS_RATIO = 0.1
"""A patch's least variance against its second: above, it is a clump, not a plane."""
_BREADTH_RATIO = 0.05
"""A patch's second variance against its largest: below, it is a line, for instance one LiDAR ring."""

MAX_TILT_RAD = np.radians(60.0)
"""Largest angle between up and the sensor's own up: a camera is held roughly upright."""
_GRID_STEP_RAD = np.radians(2.5)
_BLOCK = 32
"""Directions scored at a time: what they need of 4000 patches then fits into a processor's cache."""
PARALLEL_RAD = np.radians(8.0)
"""Directions that differ by less are the same."""
_REFINED_TOLERANCE_RAD = np.radians(5.0)
_NORMAL_NOISE_RAD = np.radians(3.0)
_WIDENINGS = (4.0, 3.0, 2.0, 1.5, 1.0, 1.0, 1.0)
"""Factors of the tolerance of a level surface's heights, by iteration, while its tilt is refined."""
MIN_PATCHES = 30
"""Fewer show no direction."""
MIN_AGREEING_RATIO = 0.4
"""Least share of patches along or across a direction: of random ones it is one in six."""
_MIN_LEVEL_PATCHES = 5
_MIN_SUPPORT_RATIO = 0.03
"""Least share of the patches that make a surface, or that constrain a tilt."""

# Weights of patches: a random normal lies within 8° of an axis in 0.5 % of all cases, and within 8° of the
# plane across it in 14 %; the ratio of the logarithms is about 2.5. Surfaces that face down are measured less
# reliably: ceilings are rarely in view, and the backs of steep objects resemble them.
_FACING_UP, _FACING_DOWN = 2.5, 1.25  # of upright patches, 1


@dataclass(frozen=True, slots=True, eq=False)
class Patches:
    """Small flat pieces of surface, each about as large as the others.

    Attributes:
        centres_world: (N, 3) metres, world frame.
        normals_world: (N, 3) unit vectors, world frame, on the sensor's side.
    """

    centres_world: Points
    normals_world: Array

    def __len__(self) -> int:
        return len(self.centres_world)


@dataclass(frozen=True, slots=True, eq=False)
class Vertical:
    """The vertical: the normal of horizontal surfaces, across the normals of upright ones.

    Attributes:
        up_world: (3,) unit vector, world frame.
        horizontal_ratio: Share of the patches with normals along it, up or down.
        upright_ratio: Share of the patches with normals across it.
        determined: False if the normals of all fitting patches are parallel and across it, as with a single
            wall: then the tilt along that wall is the guess's.
    """

    up_world: Array
    horizontal_ratio: float
    upright_ratio: float
    determined: bool

    @property
    def is_agreed(self) -> bool:
        """Whether enough patches are horizontal or upright."""
        return self.horizontal_ratio + self.upright_ratio >= MIN_AGREEING_RATIO


def patches_of(scans: Sequence[tuple[Scan, Transform]], *, tolerance_m: float) -> Patches:
    """Return the flat patches of every scan, by principal components in voxel cells.

    Cells grow with the scan's median range, so that they have enough points of a LiDAR and of a camera.
    Patches of different scans stay apart: drift between the scans does not bend a patch.

    Args:
        scans: Scans with their T_world_body.
        tolerance_m: Largest standard deviation of a patch's points from its plane.
    """
    centres, normals = [np.empty((0, 3))], [np.empty((0, 3))]
    for scan, T_world_body in scans:
        points_body = subsampled(scan) - scan.origin_body
        if len(points_body) < _MIN_PATCH_POINTS:
            continue
        centres_sensor, normals_sensor = flat_cells(points_body, tolerance_m)
        centres.append(apply(T_world_body, centres_sensor + scan.origin_body))
        normals.append(normals_sensor @ T_world_body[:3, :3].T)
    return Patches(np.concatenate(centres), np.concatenate(normals))


def subsampled(scan: Scan) -> Points:
    """Return (M, 3) float64 points of a scan, evenly chosen, body frame; M ≤ 4000."""
    stride = stride_for(len(scan.points_body), _ENOUGH)
    return scan.points_body[::stride].astype(np.float64)


def vertical_of(patches: Patches, *, up_guess_world: Array, tolerance_m: float) -> Vertical:
    """Return the axis, at most 60° from the guess, with most patches along it and across it.

    Every direction of a 2.5° grid is scored, weighted by its closeness to the guess. The best is refined by
    least squares on the normals that fit, under Tukey's biweight (Beaton & Tukey 1974), and on the heights of
    level patches: those of one floor or table lie at one height, which over metres of floor determines the
    tilt far better than normals do.

    Args:
        patches: At least one.
        up_guess_world: (3,) unit vector, roughly up.
        tolerance_m: Standard deviation of a level surface's height.
    """
    normals = patches.normals_world
    up = _best_on_grid(normals, up_guess_world)
    for widening in _WIDENINGS:
        by_normals = _normals_cost(normals, up)
        heights = _heights_cost(patches, up, widening * tolerance_m)
        cost = by_normals + heights * (_NORMAL_NOISE_RAD / tolerance_m) ** 2
        axes = np.linalg.eigh(cost)[1]
        determined = bool(np.linalg.eigvalsh(by_normals)[1] > _MIN_SUPPORT_RATIO * len(normals))
        free = axes[:, :1] if determined else axes[:, :2]
        up = free @ (free.T @ up_guess_world)
        up /= np.linalg.norm(up)

    cosine = normals @ up
    return Vertical(
        up_world=up,
        horizontal_ratio=float((np.abs(cosine) > np.cos(_REFINED_TOLERANCE_RAD)).mean()),
        upright_ratio=float((np.abs(cosine) < np.sin(_REFINED_TOLERANCE_RAD)).mean()),
        determined=determined,
    )


def levels_of(heights_m: Array, *, tolerance_m: float, least: int) -> list[NDArray[np.intp]]:
    """Return the indices of the heights of every level surface, the best supported first.

    Args:
        heights_m: (N,) heights, metres.
        tolerance_m: Half the window of one surface's heights.
        least: Fewest heights of a surface.
    """
    levels = []
    left = np.argsort(heights_m, kind="stable")
    while len(left) >= least:
        heights = heights_m[left]
        ends = np.searchsorted(heights, heights + 2.0 * tolerance_m, side="right")
        begin = int(np.argmax(ends - np.arange(len(heights))))
        end = int(ends[begin])
        if end - begin < least:
            break
        levels.append(left[begin:end])
        left = np.delete(left, np.s_[begin:end])
    return levels


def _best_on_grid(normals: Array, up_guess_world: Array) -> Array:
    candidates = _cone(up_guess_world)
    few = normals[:: stride_for(len(normals), _ENOUGH)]
    blocks = np.array_split(candidates, -(-len(candidates) // _BLOCK))
    agreement = np.concatenate([_consistency(few @ block.T).sum(axis=0) for block in blocks])
    score = agreement * (candidates @ up_guess_world) ** 2
    best: Array = candidates[int(np.argmax(score))]
    return best


def _normals_cost(normals: Array, up: Array) -> Array:
    """Return (3, 3) C with uᵀCu = Σ across·(n·u)² + Σ along·|n × u|² for unit vectors u."""
    cosine = normals @ up
    limit = np.sin(_REFINED_TOLERANCE_RAD)
    along = np.clip(1.0 - (1.0 - cosine**2) / limit**2, 0.0, None) ** 2
    across = np.clip(1.0 - (cosine / limit) ** 2, 0.0, None) ** 2
    cost: Array = normals.T @ (normals * (across - along)[:, None]) + along.sum() * np.eye(3)
    return cost


def _heights_cost(patches: Patches, up: Array, tolerance_m: float) -> Array:
    """Return (3, 3) C with uᵀCu = Σ (u·(c − mean of its level))² over the patches of level surfaces."""
    level = patches.centres_world[np.abs(patches.normals_world @ up) > np.cos(PARALLEL_RAD)]
    cost = np.zeros((3, 3))
    for members in levels_of(level @ up, tolerance_m=tolerance_m, least=least_support(len(level))):
        offsets = level[members] - level[members].mean(axis=0)
        cost += offsets.T @ offsets
    return cost


def least_support(patches: int) -> int:
    """Return the fewest level patches, of all patches, that make a surface rather than a coincidence."""
    return max(_MIN_LEVEL_PATCHES, int(_MIN_SUPPORT_RATIO * patches))


def flat_cells(points: Points, tolerance_m: float) -> tuple[Points, Array]:
    """Return centres and normals, facing the origin, of the cells whose points lie in a plane."""
    cell_m = float(np.clip(_CELL_RANGE_RATIO * np.median(np.linalg.norm(points, axis=1)), *_CELL_LIMITS_M))
    cells = np.floor(points / cell_m).astype(np.int64)
    # Scans reach less than 2²⁰ cells from the sensor, so that three coordinates fit into one integer.
    keys = ((cells[:, 0] << 42) + (cells[:, 1] << 21)) + cells[:, 2]
    _, cell_of, counts = np.unique(keys, return_inverse=True, return_counts=True)

    def means(values: Array) -> Array:
        return np.bincount(cell_of, weights=values, minlength=len(counts)) / counts

    centres = np.column_stack([means(points[:, axis]) for axis in range(3)])
    offsets = points - centres[cell_of]
    covariances = np.empty((len(counts), 3, 3))
    for row in range(3):
        for column in range(row + 1):
            covariances[:, row, column] = means(offsets[:, row] * offsets[:, column])
    variances, axes = np.linalg.eigh(covariances)  # reads the lower triangle only
    flat = (
        (counts >= _MIN_PATCH_POINTS)
        & (variances[:, 0] <= tolerance_m**2)
        & (variances[:, 0] <= _FLATNESS_RATIO * variances[:, 1])
        & (variances[:, 1] >= _BREADTH_RATIO * variances[:, 2])
    )
    centres, normals = centres[flat], axes[flat, :, 0]
    away = np.einsum("ij,ij->i", normals, centres) > 0.0
    normals[away] *= -1.0
    return centres, normals


def _cone(axis: Array) -> Array:
    """Return (N, 3) unit vectors, evenly spread by a Fibonacci spiral (González 2010), within the cone."""
    cap = 1.0 - np.cos(MAX_TILT_RAD)
    count = int(2.0 * np.pi * cap / _GRID_STEP_RAD**2)
    k = np.arange(count)
    cosine = 1.0 - cap * (k + 0.5) / count
    sine = np.sqrt(1.0 - cosine**2)
    longitude = k * np.pi * (3.0 - np.sqrt(5.0))
    side = np.cross(axis, np.eye(3)[int(np.argmin(np.abs(axis)))])
    side /= np.linalg.norm(side)
    return (
        np.outer(cosine, axis)
        + np.outer(sine * np.cos(longitude), side)
        + np.outer(sine * np.sin(longitude), np.cross(axis, side))
    )


def _consistency(cosines: Array) -> Array:
    """Return each patch's score for each candidate axis, from the cosine between normal and candidate."""
    along = np.clip(1.0 - (1.0 - np.abs(cosines)) / (1.0 - np.cos(PARALLEL_RAD)), 0.0, None)
    across = np.clip(1.0 - (cosines / np.sin(PARALLEL_RAD)) ** 2, 0.0, None)
    agreement: Array = along * np.where(cosines > 0.0, _FACING_UP, _FACING_DOWN) + across
    return agreement
