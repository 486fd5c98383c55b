"""Planning compared with a simple implementation, in one process; results must agree.

Run: .venv/bin/python benchmarks/planning.py
"""

import heapq
import time
from collections.abc import Callable
from statistics import median
from typing import Any

import numpy as np

from mapper.core.geometry import path_length
from mapper.navigation.distance import DistanceField, signed_distances
from mapper.navigation.path_search import shorten, shortest_path

EDGE_CELLS = 1000
REPEATS = 3


def cpu_s(function: Callable[[], Any], repeats: int = REPEATS) -> tuple[float, Any]:
    """Return the median CPU seconds of a call, and what it returned last."""
    times = []
    for _ in range(repeats):
        began = time.process_time()
        result = function()
        times.append(time.process_time() - began)
    return median(times), result


def maze(edge: int) -> np.ndarray:
    """Return free cells between walls every 100 cells that are open at alternating ends."""
    free = np.ones((1, edge, edge), np.bool_)
    for n, column in enumerate(range(50, edge, 100)):
        free[0, :, column] = False
        free[0, slice(0, 40) if n % 2 else slice(edge - 40, edge), column] = True
    return free


def python_a_star(free: np.ndarray) -> float:
    """Return the length of the shortest path from corner to corner: the same search with heapq and lists."""
    height, width = free.shape
    cells = free.ravel().tolist()
    steps = [(dy, dx, (dy * dy + dx * dx) ** 0.5) for dy in (-1, 0, 1) for dx in (-1, 0, 1) if dy or dx]
    cost = {0: 0.0}
    done = set()
    heap = [(0.0, 0)]
    goal = height * width - 1
    while heap:
        _, cell = heapq.heappop(heap)
        if cell == goal:
            return cost[cell]
        if cell in done:
            continue
        done.add(cell)
        y, x = divmod(cell, width)
        for dy, dx, length in steps:
            v, u = y + dy, x + dx
            if not (0 <= v < height and 0 <= u < width) or not cells[v * width + u]:
                continue
            if dy and dx and not (cells[y * width + u] and cells[v * width + x]):
                continue
            through, other = cost[cell] + length, v * width + u
            if through < cost.get(other, np.inf):
                cost[other] = through
                a, b = abs(height - 1 - v), abs(width - 1 - u)
                heapq.heappush(heap, (through + max(a, b) + (2**0.5 - 1) * min(a, b), other))
    raise SystemExit("the maze has no way through")


def main() -> None:
    """Print one row per job: ours, the peer, the ratio of CPU times."""
    free = maze(EDGE_CELLS)
    goal = (0, EDGE_CELLS - 1, EDGE_CELLS - 1)
    shortest_path(maze(200), (0, 0, 0), (0, 199, 199))  # compiles
    ours_s, found = cpu_s(lambda: shortest_path(free, (0, 0, 0), goal))
    peer_s, length = cpu_s(lambda: python_a_star(free[0]), repeats=1)
    assert abs(path_length(found.cells) - length) < 1e-6 * length
    print(
        f"A*, {EDGE_CELLS}² maze, {length:.0f} cells: {ours_s:.2f} s; "
        f"heapq {peer_s:.1f} s; {peer_s / ours_s:.0f}×"
    )

    field = DistanceField(signed_distances(~free, 1.0), np.zeros(3), 1.0)
    shorten(field, found.cells[:50] + 0.5, radius_m=0.0)
    tight_s, tight = cpu_s(lambda: shorten(field, found.cells + 0.5, radius_m=0.0))
    gain = 1.0 - path_length(tight) / length
    print(f"pulled tight in {tight_s:.2f} s: {100 * gain:.1f} % shorter, {len(tight)} corners")


if __name__ == "__main__":
    main()
