"""Octree insertion, writing and queries compared with pyoctomap, in one process on the same scans.

    python benchmarks/octree_insert.py [--data ../shared/data] [--frames 20] [--repeats 3]

Times are CPU time per scan. ``lazy_eval=True`` is OctoMap's faster mode. "no binding" subtracts pyoctomap's
time for a cloud of the same size whose points all lie in the sensor's own voxel, which is that of the wrapper
and one key per point: a lower bound for the ratio to the bare C++ library. Both maps' leaves are compared bit
by bit.
"""

import argparse
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np
import pyoctomap

from mapper.core.frames import Scan
from mapper.core.geometry import Transform, apply, inverse
from mapper.core.timebase import nearest
from mapper.octree import ray_casting_kernels as kernels
from mapper.octree.config import OctreeConfig
from mapper.octree.map import OctreeMap, read_octree
from mapper.octree.octomap_file import write_bt, write_ot
from mapper.sources import open_source
from mapper.sources.config import SourceConfig
from mapper.sources.trajectory_files import read_kitti

Scans = list[tuple[Scan, Transform]]
MAX_QUERIES = 1_000_000


@dataclass(frozen=True)
class Case:
    """One data set at one resolution."""

    name: str
    scans: Scans
    resolution_m: float
    max_range_m: float


def fr1_xyz_scans(folder: Path, *, frames: int) -> Scans:
    """Return scans of depth frames spread over the log with the nearest true pose each."""
    stride = max(1, len(open_source(folder)) // frames)
    source = open_source(folder, SourceConfig(stride=stride))
    loaded = [entry.load(colour=False).scan() for entry in source.entries()][:frames]
    truth = source.truth
    if truth is None:
        raise SystemExit(f"{folder}: has no ground truth")
    indices, _ = nearest(truth.stamps_ns, np.array([scan.stamp_ns for scan in loaded]))
    return list(zip(loaded, truth.T_world_body[indices], strict=True))


def kitti_scans(folder: Path, *, frames: int) -> Scans:
    """Return the first LiDAR scans with their poses in the first scan's frame."""
    T_camera_lidar = np.eye(4)
    for line in (folder / "calib.txt").read_text().splitlines():
        if line.startswith("Tr:"):
            T_camera_lidar[:3] = np.array(line.split()[1:], dtype=float).reshape(3, 4)
    scans = []
    for i, T_world_camera in enumerate(read_kitti(folder / "poses.txt").T_world_body[:frames]):
        points = np.fromfile(folder / f"velodyne/{i:06d}.bin", dtype=np.float32).reshape(-1, 4)[:, :3]
        scans.append((Scan(i, points.copy()), inverse(T_camera_lidar) @ T_world_camera @ T_camera_lidar))
    return scans


def cpu_ms(work: Callable[[], object]) -> float:
    """Return the CPU milliseconds that a call takes."""
    start = process_time()
    work()
    return 1e3 * (process_time() - start)


def fuse_ours(case: Case, *, discretize: bool) -> tuple[OctreeMap, list[float]]:
    """Return our map and the time of each scan, the transform to the world included."""
    config = OctreeConfig(resolution_m=case.resolution_m, max_range_m=case.max_range_m, discretize=discretize)
    octree = OctreeMap(config)
    return octree, [cpu_ms(lambda s=scan, T=T: octree.insert(s, T)) for scan, T in case.scans]


def fuse_theirs(case: Case, *, discretize: bool) -> tuple[Any, list[float], list[float]]:
    """Return OctoMap's tree, the time of each scan (already in the world), and the binding's share of it."""
    tree, idle = pyoctomap.OcTree(case.resolution_m), pyoctomap.OcTree(case.resolution_m)
    settings = {"max_range": case.max_range_m, "lazy_eval": True, "discretize": discretize}
    times, binding = [], []
    for scan, T_world_body in case.scans:
        points = kernels.to_world(scan.points_body, T_world_body).astype(np.float64)
        origin = apply(T_world_body, scan.origin_body[np.newaxis])[0]
        here = np.repeat(origin[np.newaxis], len(points), axis=0)
        times.append(cpu_ms(lambda p=points, o=origin: tree.insertPointCloud(p, o, **settings)))
        binding.append(cpu_ms(lambda p=here, o=origin: idle.insertPointCloud(p, o, **settings)))
    tree.updateInnerOccupancy()
    return tree, times, binding


def same_leaves(octree: OctreeMap, tree: Any, folder: Path) -> bool:
    """Tell whether keys and float32 log-odds agree, by way of the C++ library's own file."""
    tree.write(str(folder / "theirs.ot"))
    ours, theirs = octree.leaves(), read_octree(folder / "theirs.ot").leaves()
    return np.array_equal(ours.keys, theirs.keys) and np.array_equal(ours.log_odds, theirs.log_odds)


def compare_insertion(case: Case, *, discretize: bool, repeats: int, folder: Path) -> OctreeMap:
    """Print one line of the table and return our map."""
    ours_ms, theirs_ms, binding_ms = [], [], []
    for _ in range(repeats):
        octree, times = fuse_ours(case, discretize=discretize)
        tree, tree_times, tree_binding = fuse_theirs(case, discretize=discretize)
        ours_ms.append(np.median(times))
        theirs_ms.append(np.median(tree_times))
        binding_ms.append(np.median(tree_binding))
    ours, theirs, binding = (float(np.median(values)) for values in (ours_ms, theirs_ms, binding_ms))
    mode = "discretize" if discretize else "every point"
    equal = "equal" if same_leaves(octree, tree, folder) else "DIFFERENT"
    leaf_bytes = octree.memory_bytes / len(octree), tree.memoryUsage() / tree.getNumLeafNodes()
    print(
        f"{case.name:22} {mode:12} {ours:8.2f} {theirs:9.1f} {theirs / ours:7.1f}× "
        f"{(theirs - binding) / ours:9.1f}× {leaf_bytes[0]:8.1f} {leaf_bytes[1]:8.1f}  "
        f"{len(octree):9d} {equal}",
        flush=True,
    )
    return octree


def compare_products(case: Case, octree: OctreeMap, *, repeats: int, folder: Path) -> None:
    """Print memory when pruned, writing times and query rates of one map."""
    ours, theirs = {"bt": [], "ot": []}, {"bt": [], "ot": []}
    ot, bt, other = folder / "map.ot", folder / "map.bt", folder / "other"
    for _ in range(max(repeats, 3)):
        ours["ot"].append(cpu_ms(lambda: write_ot(ot, octree)))
        ours["bt"].append(cpu_ms(lambda: write_bt(bt, octree)))
        tree = pyoctomap.OcTree(case.resolution_m).read(str(ot))  # pruned, as non-lazy insertion leaves it
        pruned_bytes = tree.memoryUsage()
        theirs["ot"].append(cpu_ms(lambda t=tree: t.write(str(other))))
        same = other.read_bytes() == ot.read_bytes()
        theirs["bt"].append(cpu_ms(lambda t=tree: t.writeBinary(str(other))))
        same = same and other.read_bytes() == bt.read_bytes()
    centres = octree.leaves().centres_world
    points = np.random.default_rng(0).uniform(centres.min(axis=0), centres.max(axis=0), (MAX_QUERIES, 3))
    octree.log_odds_at(points[:10])
    rate = len(points) / cpu_ms(lambda: octree.log_odds_at(points)) / 1e3
    their_rate = 20_000 / cpu_ms(lambda: [tree.search(point) for point in points[:20_000]]) / 1e3
    times = {kind: (np.median(ours[kind]), np.median(theirs[kind])) for kind in ours}
    print(
        f"{case.name}: memory {octree.memory_bytes / 1e6:.1f} MB, OctoMap's pruned {pruned_bytes / 1e6:.1f}; "
        + "; ".join(f".{kind} {t[0]:.1f} ms, {t[1] / t[0]:.1f}×" for kind, t in times.items())
        + f", {'byte-identical' if same else 'DIFFERENT'}; "
        f"queries {rate:.0f} M/s, {rate / their_rate:.0f}× one by one through the binding"
    )


def main() -> None:
    """Run every case and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, default=Path(__file__).parents[2] / "shared/data")
    parser.add_argument("--frames", type=int, default=20)
    parser.add_argument("--repeats", type=int, default=3)
    arguments = parser.parse_args()
    fr1_xyz = fr1_xyz_scans(arguments.data / "tum_fr1_xyz", frames=arguments.frames)
    kitti = kitti_scans(arguments.data / "kitti_00", frames=min(arguments.frames, 8))
    cases = (
        Case("fr1_xyz 5 cm 4 m", fr1_xyz, 0.05, 4.0),
        Case("kitti_00 20 cm 80 m", kitti, 0.2, 80.0),
        Case("kitti_00 10 cm 80 m", kitti, 0.1, 80.0),
    )
    for discretize in (True, False):  # compile, or load what was compiled, before anything is timed
        fuse_ours(Case("warm-up", fr1_xyz[:1], 0.1, 4.0), discretize=discretize)
    print(
        f"{'map':22} {'mode':12} {'ours ms':>8} {'theirs ms':>9} {'ratio':>8} {'no binding':>10} "
        f"{'B/leaf':>8} {'theirs':>8}  {'leaves':>9}"
    )
    maps = []
    with tempfile.TemporaryDirectory() as folder:
        for case in cases:
            for discretize in (True, False):
                octree = compare_insertion(
                    case, discretize=discretize, repeats=arguments.repeats, folder=Path(folder)
                )
                if discretize:
                    maps.append((case, octree))
        for case, octree in maps:
            compare_products(case, octree, repeats=arguments.repeats, folder=Path(folder))


if __name__ == "__main__":
    main()
