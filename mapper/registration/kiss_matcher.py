"""KISS-Matcher (Lim et al. 2025): a motion from matched features without a first guess, refined by GICP."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any

import numpy as np

from mapper.core.frames import Scan
from mapper.core.geometry import Transform, is_rigid, transform
from mapper.registration.base import Alignment, failed
from mapper.registration.config import KissMatcherConfig
from mapper.registration.icp import cloud_of, refined
from mapper.registration.pair_refinement import MIN_PAIRS
from mapper.registration.surfaces import Prepared, prepared
from mapper.runtime.extras import extra

_CROWD = 5  # points this near together, in feature voxels, are certain to have a normal and a feature
_CROWD_VOXELS = 1.5
_MAX_MATCHES = 5000  # of more the library draws this number at random, unseeded
_GROWTH = 1.25
_MAX_NOISE_M = 1.0  # the library accepts no more, and prints that


class KissMatcher:
    """KISS-Matcher: scans are registered by their features; those of the target are found in every call."""

    def __init__(self, target: Scan, config: KissMatcherConfig) -> None:
        self._target = cloud_of(target, config)
        self._config = config

    def align(self, source: Scan, T_target_source: Transform) -> Alignment:  # noqa: ARG002
        """Return the motion that most matches agree on, refined and assessed."""
        config = self._config
        cloud = cloud_of(source, config)
        thinned = _thinned(self._target, cloud, config.feature_voxels * config.voxel_m)
        for name, side in zip(("target", "source"), thinned, strict=True):
            if _crowded(side) < MIN_PAIRS:
                return failed(f"too few points of the {name} lie close enough together to have features")
        found = _matched(*thinned)
        if found is None:
            return failed("the features of the two clouds agree on no motion")
        return refined(self._target, cloud, found, config, kind="gicp")


def _thinned(target: Prepared, source: Prepared, voxel_m: float) -> tuple[Prepared, Prepared]:
    """Return both with one point in each voxel, which grows until one of them has few enough."""
    while True:
        thinned = (prepared(target.points, voxel_m=voxel_m), prepared(source.points, voxel_m=voxel_m))
        if min(len(side.points) for side in thinned) <= _MAX_MATCHES:
            return thinned
        voxel_m *= _GROWTH


def _crowded(cloud: Prepared) -> int:
    """Return the number of points with enough neighbours. The library crashes on clouds where none has."""
    if cloud.tree is None or len(cloud.points) < _CROWD:
        return 0
    _, distances_m = cloud.tree.nearest_few(cloud.points, _CROWD)
    return int((distances_m[:, -1] <= _CROWD_VOXELS * cloud.voxel_m).sum())


def _matched(target: Prepared, source: Prepared) -> Transform | None:
    """Return the motion that the matches agree on, or None."""
    kiss_matcher = _library()
    noise_gain = min(1.0, _MAX_NOISE_M / target.voxel_m)
    config = kiss_matcher.KISSMatcherConfig(
        target.voxel_m,
        False,
        num_max_corr=_MAX_MATCHES,
        robin_noise_bound_gain=noise_gain,
        solver_noise_bound_gain=0.75 * noise_gain,
    )
    solution = kiss_matcher.KISSMatcher(config).estimate(
        source.points.astype(np.float32), target.points.astype(np.float32)
    )
    T_target_source = transform(np.array(solution.rotation), np.array(solution.translation))
    return T_target_source if solution.valid and is_rigid(T_target_source) else None


@cache
def _library() -> Any:
    """Return the library, limited to one thread: with more, the order of its points and so its answer vary.

    Its thread pools are sized as it is loaded (OpenMP) and at its first use (TBB), by the cores that the
    thread may run on then.
    """
    few = np.random.default_rng(0).uniform(size=(300, 3)).astype(np.float32)
    with extra("peers", "KISS-Matcher (Python 3.11 or 3.12)"), _on_one_core():
        import kiss_matcher

        kiss_matcher.KISSMatcher(0.2).estimate(few, few)
    return kiss_matcher


@contextmanager
def _on_one_core() -> Iterator[None]:
    """Run on one core meanwhile, where the system can say so: on Linux."""
    if not hasattr(os, "sched_setaffinity"):
        yield
        return
    cores = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(cores)})
    try:
        yield
    finally:
        os.sched_setaffinity(0, cores)
