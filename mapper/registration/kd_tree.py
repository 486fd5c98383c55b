"""K-d tree (Bentley 1975) over points in space, compiled without the interpreter's lock.

The tree is balanced and implicit: a node halves its range of the points at the median of their widest axis.
It consists of the points in the order of the leaves, and of every inner node's axis and cut.
"""

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from mapper.core.errors import DataError
from mapper.core.frames import Points32
from mapper.core.geometry import Array, Points

_LEAF_POINTS = 8
STACK = 64
"""Deeper than any tree: each of its levels leaves one branch to search later."""


@dataclass(frozen=True, slots=True, eq=False)
class KdTree:
    """K-d tree of points.

    Attributes:
        points: (N, 3) in the order of the leaves; queries return indices into it.
        axes: (M,) axes of the inner nodes' cuts; node i has the children 2i and 2i + 1, the root is 1.
        cuts: (M,) coordinates of the cuts on these axes.
    """

    points: Points
    axes: NDArray[np.int8]
    cuts: Array

    def nearest(self, queries: Points) -> tuple[NDArray[np.int64], Array]:
        """Return the (Q,) indices of the points nearest to (Q, 3) positions, and their distances, metres."""
        indices, squared = neighbours_of(self.points, self.axes, self.cuts, queries, 1)
        return indices[:, 0], np.sqrt(squared[:, 0])

    def nearest_few(self, queries: Points, count: int) -> tuple[NDArray[np.int64], Array]:
        """Return the (Q, count) nearest points, the nearest first, and their distances in metres.

        Raises:
            DataError: The tree has fewer points.
        """
        if count > len(self.points):
            raise DataError(f"k-d tree: {count} nearest of {len(self.points)} points")
        indices, squared = neighbours_of(self.points, self.axes, self.cuts, queries, count)
        return indices, np.sqrt(squared)


def kd_tree(points: Points | Points32) -> KdTree:
    """Return the tree of (N, 3) finite points, metres.

    Raises:
        DataError: There are none.
    """
    if len(points) == 0:
        raise DataError("cloud: no points, so nothing is near it")
    ordered = np.array(points, np.float64)
    levels = max(0, (len(ordered) - 1) // _LEAF_POINTS).bit_length()
    axes, cuts = np.zeros(1 << levels, np.int8), np.zeros(1 << levels)
    _grow(ordered, axes, cuts)
    return KdTree(ordered, axes, cuts)


@njit(cache=True, nogil=True)
def _grow(points, axes, cuts):
    """Order the points, and fill in the inner nodes level by level."""
    inner = len(axes)
    begins, ends = np.zeros(2 * inner, np.int64), np.zeros(2 * inner, np.int64)
    ends[1] = len(points)
    for node in range(1, inner):
        begin, end = begins[node], ends[node]
        middle = (begin + end) // 2
        axis = _widest_axis(points, begin, end)
        _part(points, axis, begin, end, middle)
        axes[node], cuts[node] = axis, points[middle, axis]
        begins[2 * node], ends[2 * node] = begin, middle
        begins[2 * node + 1], ends[2 * node + 1] = middle, end


@njit(cache=True, nogil=True)
def _widest_axis(points, begin, end):
    widest, extent = 0, -1.0
    for axis in range(3):
        low = high = points[begin, axis]
        for i in range(begin + 1, end):
            low, high = min(low, points[i, axis]), max(high, points[i, axis])
        if high - low > extent:
            widest, extent = axis, high - low
    return widest


@njit(cache=True, nogil=True)
def _part(points, axis, begin, end, middle):
    """Move what is smaller than the ``middle``-th along an axis before it, the rest behind (Hoare 1961)."""
    low, high = begin, end - 1
    while low < high:
        first, centre, last = points[low, axis], points[(low + high) // 2, axis], points[high, axis]
        pivot = max(min(first, centre), min(max(first, centre), last))
        i, j = low, high
        while i <= j:
            while points[i, axis] < pivot:
                i += 1
            while points[j, axis] > pivot:
                j -= 1
            if i <= j:
                for k in range(3):
                    points[i, k], points[j, k] = points[j, k], points[i, k]
                i += 1
                j -= 1
        if middle <= j:
            high = j
        elif middle >= i:
            low = i
        else:
            return


@njit(cache=True, nogil=True)
def neighbours_of(points, axes, cuts, queries, count):
    """Return (Q, count) indices and squared distances, ascending, of the points nearest to the queries."""
    indices = np.zeros((len(queries), count), np.int64)
    squared = np.full((len(queries), count), np.inf)
    branches, offsets = np.empty((STACK, 3), np.int64), np.empty((STACK, 4))
    query = np.empty(3)
    for q in range(len(queries)):
        for k in range(3):
            query[k] = queries[q, k]
        search(points, axes, cuts, query, indices[q], squared[q], branches, offsets)
    return indices, squared


@njit(cache=True, nogil=True)
def search(points, axes, cuts, query, indices, squared, branches, offsets):
    """Fill in the points nearest to a query, ascending, of those nearer than the initial ``squared``.

    The distance of a branch is updated from its distances along each axis (Arya & Mount 1993).

    Args:
        points: The tree's.
        axes: The tree's.
        cuts: The tree's.
        query: (3,).
        indices: (K,) is filled in.
        squared: (K,) largest squared distance of interest on entry; is filled in.
        branches: (64, 3) working memory.
        offsets: (64, 4) working memory.
    """
    inner, last, waiting = len(axes), len(squared) - 1, 0
    node, begin, end, bound = 1, 0, len(points), 0.0
    x = y = z = 0.0  # distance of the node's box from the query along each axis
    while True:
        while node < inner:
            axis = axes[node]
            offset = query[axis] - cuts[node]
            before = x if axis == 0 else y if axis == 1 else z
            beyond = bound - before * before + offset * offset
            middle, left = (begin + end) // 2, offset < 0.0
            if beyond < squared[last]:
                branches[waiting, 0] = 2 * node + 1 if left else 2 * node
                branches[waiting, 1] = middle if left else begin
                branches[waiting, 2] = end if left else middle
                offsets[waiting, 0] = offset if axis == 0 else x
                offsets[waiting, 1] = offset if axis == 1 else y
                offsets[waiting, 2] = offset if axis == 2 else z
                offsets[waiting, 3] = beyond
                waiting += 1
            if left:
                node, end = 2 * node, middle
            else:
                node, begin = 2 * node + 1, middle
        for i in range(begin, end):
            dx, dy, dz = points[i, 0] - query[0], points[i, 1] - query[1], points[i, 2] - query[2]
            distance = dx * dx + dy * dy + dz * dz
            if distance < squared[last]:
                slot = last
                while slot > 0 and squared[slot - 1] > distance:
                    squared[slot], indices[slot] = squared[slot - 1], indices[slot - 1]
                    slot -= 1
                squared[slot], indices[slot] = distance, i
        while waiting > 0 and offsets[waiting - 1, 3] >= squared[last]:
            waiting -= 1
        if waiting == 0:
            return
        waiting -= 1
        node, begin, end = branches[waiting, 0], branches[waiting, 1], branches[waiting, 2]
        x, y, z = offsets[waiting, 0], offsets[waiting, 1], offsets[waiting, 2]
        bound = offsets[waiting, 3]
