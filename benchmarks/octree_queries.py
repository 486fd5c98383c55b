"""Octree queries compared with pyoctomap, which takes one call per point or ray, on the same map.

    python benchmarks/octree_queries.py [--data ../shared/data] [--frames 10]

Times are CPU time; the peer for nearest obstacles is SciPy's k-d tree over occupied centres, built each time.
"""

import argparse
import tempfile
from pathlib import Path

import numpy as np
import pyoctomap
from octree_insert import Case, cpu_ms, fr1_xyz_scans, fuse_ours
from scipy.spatial import cKDTree

from mapper.octree.octomap_file import write_ot

FEW, MANY = 5_000, 200_000


def line(name: str, ours_ms: float, ours_count: int, theirs_ms: float, theirs_count: int) -> None:
    """Print microseconds per query and their ratio."""
    ours, theirs = 1e3 * ours_ms / ours_count, 1e3 * theirs_ms / theirs_count
    print(f"{name:28} {ours:9.3f} {theirs:9.3f} {theirs / ours:8.1f}×")


def main() -> None:
    """Fuse, ask, print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, default=Path(__file__).parents[2] / "shared/data")
    parser.add_argument("--frames", type=int, default=10)
    arguments = parser.parse_args()
    scans = fr1_xyz_scans(arguments.data / "tum_fr1_xyz", frames=arguments.frames)
    octree, _ = fuse_ours(Case("fr1_xyz", scans, 0.05, 4.0), discretize=True)
    with tempfile.TemporaryDirectory() as folder:
        write_ot(Path(folder) / "map.ot", octree)
        tree = pyoctomap.OcTree(0.05).read(str(Path(folder) / "map.ot"))
    leaves = octree.leaves()
    centres, rng = leaves.centres_world, np.random.default_rng(0)
    obstacles = centres[leaves.log_odds >= octree.occupied_log_odds]
    points = rng.uniform(centres.min(axis=0), centres.max(axis=0), (MANY, 3))
    directions = rng.normal(size=(MANY, 3))
    settings = {"max_range_m": 4.0, "through_unknown": True}
    for warm_up in (
        lambda: octree.log_odds_at(points[:2]),
        lambda: octree.nearest_obstacles(points[:2], max_range_m=1),
    ):
        warm_up()
    octree.cast_rays(points[:2], directions[:2], **settings)
    print(f"{'µs per query':28} {'ours':>9} {'theirs':>9} {'ratio':>9}")
    few = points[:FEW]
    theirs = cpu_ms(lambda: [tree.search(point) for point in few])
    line("occupancy", cpu_ms(lambda: octree.log_odds_at(points)), MANY, theirs, FEW)
    end = np.zeros(3)
    theirs = cpu_ms(
        lambda: [
            tree.castRay(point, direction, end, True, 4.0)
            for point, direction in zip(few, directions[:FEW], strict=True)
        ]
    )
    line("rays, 4 m", cpu_ms(lambda: octree.cast_rays(points, directions, **settings)), MANY, theirs, FEW)
    for count in (10, FEW):
        some = points[:count]
        theirs = cpu_ms(lambda some=some: cKDTree(obstacles).query(some))
        ours = cpu_ms(lambda some=some: octree.nearest_obstacles(some, max_range_m=10.0))
        line(f"nearest of {count} (k-d tree)", ours, count, theirs, count)


if __name__ == "__main__":
    main()
