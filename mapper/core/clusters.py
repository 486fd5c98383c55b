"""Clusters of points: a step of limited length leads from any member to another."""

import numpy as np
from numpy.typing import NDArray


def cluster_numbers(points: NDArray[np.generic], max_step: float, *, norm: float = 2.0) -> NDArray[np.intp]:
    """Return the (N,) number of each point's cluster, from 0, in the order of their first members.

    Args:
        points: (N, D).
        max_step: Largest distance of neighbours in a cluster, in the points' unit.
        norm: p of the distance (Σ|Δ|ᵖ)^(1/p): 2 is Euclid's, infinity the largest |Δ|.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree  # these take half a second

    if not len(points):
        return np.zeros(0, np.intp)
    pairs = cKDTree(points).query_pairs(max_step, p=norm, output_type="ndarray")
    neighbours = coo_array((np.ones(len(pairs), np.bool_), pairs.T), shape=(len(points), len(points)))
    _, numbers = connected_components(neighbours, directed=False)
    return np.asarray(numbers, dtype=np.intp)
