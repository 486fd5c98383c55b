"""NDT: the normal distributions transform (Magnusson 2009) of Open3D, assessed by the surfaces."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from mapper.core.frames import Scan
from mapper.core.geometry import Points, Transform, is_rigid, nearest_rotation, transform
from mapper.registration.acceptance import assess
from mapper.registration.base import Alignment, failed
from mapper.registration.config import NdtConfig
from mapper.registration.icp import COARSE_TO_FINE_VOXELS
from mapper.registration.surfaces import prepared
from mapper.runtime.extras import extra

_MIN_POINTS = 6
"""Cells with fewer points have no Gaussian: twice as many as span a plane."""


class Ndt:
    """NDT: scans are registered by the Gaussians of a target's cells, which Open3D builds in every call."""

    def __init__(self, target: Scan, config: NdtConfig) -> None:
        self._points_target = target.points_body.astype(np.float64)
        self._target = prepared(target.points_body, voxel_m=config.voxel_m, neighbours=config.neighbours)
        self._config = config

    def align(self, source: Scan, T_target_source: Transform) -> Alignment:
        """Return the motion refined from a guess at one cell size after another, assessed."""
        config = self._config
        cloud = prepared(source.points_body, voxel_m=config.voxel_m, neighbours=config.neighbours)
        found = refine_by_cells(
            self._points_target,
            cloud.points,
            T_target_source,
            cells_m=[cell_voxels * config.voxel_m for cell_voxels in COARSE_TO_FINE_VOXELS],
            max_iterations=config.max_iterations,
        )
        if isinstance(found, str):
            return failed(found)
        return assess(self._target, cloud, found, config.acceptance)


def refine_by_cells(
    target: Points,
    source: Points,
    T_target_source: Transform,
    *,
    cells_m: Sequence[float],
    max_iterations: int = 30,
) -> Transform | str:
    """Return the motion refined from a guess, or why there is none.

    When Open3D does not converge it warns, returns its last motion and that motion's fitness; only a fitness
    of zero shows for certain that it found nothing. So the motion has to be assessed by other means.

    Args:
        target: (N, 3) points that make the Gaussians, metres.
        source: (M, 3) points that are placed in them, metres.
        T_target_source: (4, 4) guess.
        cells_m: Edges of the cells, from coarse to fine.
        max_iterations: Largest number of steps at each cell size.
    """
    if len(source) == 0:
        return "no points in the source"
    for cell_m in cells_m:
        found = _by_cells(target, source, T_target_source, cell_m, max_iterations)
        if isinstance(found, str):
            return found
        T_target_source = found
    return T_target_source


def _by_cells(
    target: Points, source: Points, T: Transform, cell_m: float, max_iterations: int
) -> Transform | str:
    with extra("peers", "NDT"):
        import open3d

    registration = open3d.pipelines.registration
    option = registration.NormalDistributionsTransformOption(
        voxel_size=cell_m, min_points_per_voxel=_MIN_POINTS, max_iteration=max_iterations
    )
    with open3d.utility.VerbosityContextManager(open3d.utility.VerbosityLevel.Error):
        try:
            result = registration.registration_ndt(_open3d_cloud(source), _open3d_cloud(target), option, T)
        except RuntimeError:
            return f"no cell of {cell_m:g} m has {_MIN_POINTS} points of the target in it"
    if result.fitness == 0.0:
        return f"no point of the source lies in a cell of {cell_m:g} m that has a Gaussian: no overlap"
    # Open3D sums in the order its threads finish, so the last digits vary from run to run.
    T_refined = np.round(result.transformation, 9)
    if not is_rigid(T_refined):
        return "NDT diverged"
    return transform(nearest_rotation(T_refined[:3, :3]), T_refined[:3, 3])


def _open3d_cloud(points: Points) -> Any:
    import open3d

    return open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
