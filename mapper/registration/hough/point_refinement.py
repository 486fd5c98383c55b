"""Refinement of a motion on the points themselves: NDT (Nagy, Gálai & Benedek 2016, §3.4) or GICP."""

from dataclasses import dataclass

import numpy as np

from mapper.core.frames import Scan
from mapper.core.geometry import Points, Transform
from mapper.registration.hough.config import HoughConfig, NdtStagesConfig
from mapper.registration.hough.description import HoughDescription
from mapper.registration.ndt import refine_by_cells
from mapper.registration.refining import refined_motion
from mapper.registration.surfaces import Prepared, prepared


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
    thinned = prepared(scan.points_body, voxel_m=config.voxel_m, neighbours=config.neighbours)
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
            max_iterations=refinement.max_iterations,
        )
    return refined_motion(
        target.thinned,
        source.thinned,
        T_target_source,
        kind="gicp",
        pair_distances_m=refinement.pair_distances_m,
        max_iterations=refinement.max_iterations,
    )
