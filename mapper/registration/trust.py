"""Whether a motion found between two scans is believed."""

from dataclasses import replace

from mapper.config.registration import TrustConfig
from mapper.geometry import Transform
from mapper.registration.base import Alignment
from mapper.registration.degeneracy import degeneracy_of
from mapper.registration.gicp import Prepared, measured


def judged(target: Prepared, source: Prepared, T_target_source: Transform, config: TrustConfig) -> Alignment:
    """Return what a motion is worth; not converged when too little of the source lies on the target.

    A motion along which no surface resists is not converged either: the answer there is only the guess.

    Args:
        target: Cloud that stays.
        source: Cloud that moves.
        T_target_source: (4, 4) motion in question.
        config: What is asked of it, in voxels of the source.
    """
    alignment = measured(
        target,
        source,
        T_target_source,
        max_pair_distance_m=config.near_voxels * source.voxel_m,
        max_surface_distance_m=config.surface_voxels * source.voxel_m,
    )
    if not alignment.converged:
        return alignment
    if alignment.inlier_ratio < config.min_inlier_ratio:
        reason = (
            f"{alignment.inlier_ratio:.0%} of the source's points lie on the target's surfaces, "
            f"less than {config.min_inlier_ratio:.0%}"
        )
        return replace(alignment, converged=False, reason=reason)
    assert alignment.information is not None  # measured and converged
    degeneracy = degeneracy_of(alignment.information, points=source.points)
    if degeneracy.is_degenerate:
        return replace(alignment, converged=False, reason=f"degenerate: no surface shows {degeneracy.text}")
    return alignment
