"""ICP, point-to-plane ICP and GICP: from coarse pairs to fine ones, then assessed."""

from mapper.core.frames import Scan
from mapper.core.geometry import Transform
from mapper.registration.acceptance import assess
from mapper.registration.base import Alignment
from mapper.registration.config import GicpConfig, IcpConfig, PlaneIcpConfig, RefinedConfig
from mapper.registration.pair_refinement import Refiner, refine
from mapper.registration.surfaces import Prepared, prepared

AnyIcp = IcpConfig | PlaneIcpConfig | GicpConfig

COARSE_TO_FINE_VOXELS = (7.0, 3.5)
"""Largest distance between the points of a pair: 2 m of a street from poor guesses, then 1 m."""


class Icp:
    """ICP and its variants: scans are registered to a target by their nearest pairs."""

    def __init__(self, target: Scan, config: AnyIcp) -> None:
        self._target = cloud_of(target, config)
        self._config = config

    def align(self, source: Scan, T_target_source: Transform) -> Alignment:
        """Return the motion refined from a guess, assessed."""
        cloud = cloud_of(source, self._config)
        return refined(self._target, cloud, T_target_source, self._config, kind=self._config.kind)


def cloud_of(scan: Scan, config: RefinedConfig) -> Prepared:
    """Return a scan's cloud, prepared by the settings."""
    return prepared(scan.points_body, voxel_m=config.voxel_m, neighbours=config.neighbours)


def refined(
    target: Prepared, source: Prepared, T_target_source: Transform, config: RefinedConfig, *, kind: Refiner
) -> Alignment:
    """Return the motion refined at one pair distance after another, assessed.

    Args:
        target: Cloud that stays.
        source: Cloud that moves.
        T_target_source: (4, 4) guess.
        config: Voxel, iterations and acceptance.
        kind: Error that is minimised.
    """
    alignment = refine(
        target,
        source,
        T_target_source,
        kind=kind,
        pair_distances_m=[voxels * config.voxel_m for voxels in COARSE_TO_FINE_VOXELS],
        max_iterations=config.max_iterations,
    )
    if not alignment.converged:
        return alignment
    return assess(target, source, alignment.T_target_source, config.acceptance)
