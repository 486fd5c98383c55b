"""Refinement of the accumulator's peaks: most overlap of the obstacles, ground on ground, then the points.

On the points it is NDT (Nagy, Gálai & Benedek 2016, §3.4) or GICP.
"""

from dataclasses import dataclass

import numpy as np

from mapper.core.frames import Scan
from mapper.core.geometry import Points, Transform, apply, planar_motion, rotation_exp, transform
from mapper.registration.free_space import DIRECTION_RAD
from mapper.registration.hough.config import HoughConfig, NdtStagesConfig
from mapper.registration.hough.description import HoughDescription
from mapper.registration.hough.ground import FITS, Ground
from mapper.registration.hough.voting_kernels import FULL_OVERLAP, hill_climb
from mapper.registration.ndt import refine_by_cells
from mapper.registration.pair_refinement import refined_motion
from mapper.registration.surfaces import Prepared, prepared

_HALVINGS = 2
_MOST_STEPS = 30  # of GICP at each pair distance
"""Number of times that the steps are halved: to a quarter of a voxel; the points are then refined."""
_FIT_WIDTH_M = 0.5
_MIN_FIT_CELLS = 30


@dataclass(frozen=True, slots=True)
class PlanarFit:
    """A planar motion between level frames, and the overlap of the obstacles under it.

    Attributes:
        dx_m: Offset along the target's level x.
        dy_m: Offset along its y.
        alpha_rad: Turn about up.
        overlap: 0 … 1, how many of the source's obstacles lie on the target's.
    """

    dx_m: float
    dy_m: float
    alpha_rad: float
    overlap: float


def refine_planar(
    target: HoughDescription,
    source: HoughDescription,
    motion: tuple[float, float, float],
    config: HoughConfig,
) -> PlanarFit:
    """Return the planar motion near (dx, dy, α) under which the obstacles overlap most."""
    ground = config.constellation.ground
    (dx_m, dy_m, alpha_rad), total = hill_climb(
        target.volume,
        source.checked_obstacles.points_level,
        source.heights_m,
        np.array(motion),
        ground.voxel_m,
        ground.min_obstacle_m,
        DIRECTION_RAD,
        _HALVINGS,
    )
    share = total / (FULL_OVERLAP * max(len(source.heights_m), 1))
    return PlanarFit(float(dx_m), float(dy_m), float(alpha_rad), float(share))


def align_grounds(target: Ground, source: Ground, fit: PlanarFit) -> Transform:
    """Return T_target_source between the level frames: the planar motion, with ground on ground.

    The difference of the two grounds, a step and a slope, is fitted by least squares under Tukey's biweight
    (Beaton & Tukey 1974). Where both scans show too little common ground, the planar motion is returned.
    """
    T = planar_motion(fit.dx_m, fit.dy_m, fit.alpha_rad)
    x, y, z = apply(T, source.points_level).T
    seen, heights = target.at(x, y)
    if seen.sum() < _MIN_FIT_CELLS:
        return T
    rows = np.column_stack([np.ones(len(x)), x, y])[seen]
    gaps_m = heights[seen] - z[seen]
    plane = np.array([np.median(gaps_m), 0.0, 0.0])
    for _ in range(FITS):
        weights = np.clip(1.0 - ((gaps_m - rows @ plane) / _FIT_WIDTH_M) ** 2, 0.0, None) ** 2
        weighted = rows * weights[:, np.newaxis]
        # A plane without step or slope counts as much as one cell.
        plane = np.linalg.solve(weighted.T @ rows + np.eye(3), weighted.T @ gaps_m)
    step, slope_x, slope_y = plane
    tilt = transform(rotation_exp(np.array([slope_y, -slope_x, 0.0])), np.array([0.0, 0.0, step]))
    return tilt @ T


@dataclass(frozen=True, slots=True, eq=False)
class RefinementCloud:
    """A scan's points, ready for the refinement and for the assessment of its result.

    Attributes:
        thinned: One point per voxel, with normals.
        dense: (N, 3) metres, body frame: the points that make NDT's cells; empty for GICP.
        sparse: (M, 3) metres, body frame: the points that are placed in NDT's cells; empty for GICP.
    """

    thinned: Prepared
    dense: Points
    sparse: Points


def refinement_cloud(scan: Scan, description: HoughDescription, config: HoughConfig) -> RefinementCloud:
    """Return a scan's points as the configured refinement takes them."""
    thinned = prepared(scan.points_body, voxel_m=config.voxel_m)
    dense = sparse = np.empty((0, 3))
    if isinstance(config.refinement, NdtStagesConfig):
        min_height_m = config.constellation.ground.max_thickness_m
        dense = description.above_ground(scan.points_body.astype(np.float64), min_height_m)
        sparse = description.above_ground(thinned.points, min_height_m)
    return RefinementCloud(thinned, dense, sparse)


def refine_on_points(
    target: RefinementCloud, source: RefinementCloud, T_target_source: Transform, config: HoughConfig
) -> Transform | str:
    """Return the motion refined from a first guess, or why there is none."""
    refinement = config.refinement
    if isinstance(refinement, NdtStagesConfig):
        return refine_by_cells(
            target.dense,
            source.sparse,
            T_target_source,
            cells_m=refinement.cells_m,
        )
    return refined_motion(
        target.thinned,
        source.thinned,
        T_target_source,
        kind="gicp",
        pair_distances_m=refinement.pair_distances_m,
        max_iterations=_MOST_STEPS,
    )
