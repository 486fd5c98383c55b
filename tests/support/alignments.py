"""Errors of registrations."""

import numpy as np

from mapper.core.geometry import Transform, angle_between, inverse
from mapper.registration.base import Alignment


def miss(alignment: Alignment, T_target_source: Transform) -> tuple[float, float]:
    """Return by how many metres and degrees an alignment misses the true motion."""
    gap = inverse(T_target_source) @ alignment.T_target_source
    return float(np.linalg.norm(gap[:3, 3])), float(np.degrees(angle_between(gap[:3, :3], np.eye(3))))
