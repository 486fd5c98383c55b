"""Removal of moving points on synthetic streets and flats: mapper compared with DUFOMap and others.

    python benchmarks/moving_objects.py [--quick] [--peers VENV/bin/python]

Peers run in a separate environment, and are left out if it or a package is missing:

    python -m venv peers && peers/bin/pip install dufomap==1.1.1 dynamic-object-removal==0.6.0

Metrics are those of the DynamicMap benchmark (Zhang et al. 2023) by point: SA is the share of static points
that are kept, DA that of moving points that are removed, AA = sqrt(SA · DA). Poses are the true ones with
Gaussian errors. "returns" counts points that are kept out of the cloud, "removed" those in removed voxels,
"map" those in voxels that are not occupied in the finished octree. All methods get the same points; times are
CPU seconds per scan of one thread, for mapper including casting and fusing.
"""

import argparse
import subprocess
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mapper.core.deskew import deskewed, twist_at
from mapper.core.frames import Scan
from mapper.core.geometry import exp
from mapper.mapping.depth_noise_estimation import measure_noise
from mapper.octree.config import OctreeConfig
from mapper.octree.map import OctreeMap
from mapper.octree.moving_objects import remove_moving_objects
from mapper.octree.ray_casting import Caster
from mapper.octree.scan_updates import pack
from mapper.sensing.depth import DepthLimit
from mapper.simulation.config import COURTYARD, STREET, LidarSynthConfig, SynthConfig
from mapper.simulation.lidar import LidarSimulator
from mapper.simulation.source import CameraSimulator

_SMALL = {"width_px": 320, "height_px": 240, "frame_rate_hz": 10.0, "duration_s": 20.0}
_THIN = {"pole", "sign"}
_LIMIT_S = 1800.0
_PEERS = ("dufomap", "dynamic-object-removal")
_PEER = """
import sys, time
import numpy as np
method, path, voxel_m, out = sys.argv[1], sys.argv[2], float(sys.argv[3]), sys.argv[4]
data = np.load(path)
scans = np.split(data["points"], np.cumsum(data["counts"])[:-1])
origins = data["origins"]
begin = time.process_time()
if method == "dufomap":
    from dufomap import dufomap
    poses = [[float(x) for x in (*origin, 1, 0, 0, 0)] for origin in origins]
    tool = dufomap(voxel_m, 2 * voxel_m, 1, num_threads=1)
    for scan, pose in zip(scans, poses):
        tool.run(scan, pose, cloud_transform=False)
    tool.oncePropagateCluster(False, False)
    moving = np.concatenate([tool.segment(s, p, cloud_transform=False) for s, p in zip(scans, poses)]) > 0
else:
    from dynamic_object_removal import clean_map_by_fusion
    moving = ~clean_map_by_fusion(data["points"], list(zip(scans, origins)))[1]
np.savez(out, moving=moving, seconds=time.process_time() - begin)
"""


@dataclass(frozen=True, slots=True, eq=False)
class Labelled:
    """A log whose points are labelled.

    Attributes:
        name: Name.
        octree: Its octree's settings.
        scans: (N, 3) float32 points of each scan, body frame.
        T_world_body: (S, 4, 4) poses with errors.
        moving: (P,) whether each point of all scans lies on what moves.
        thin: (P,) whether it lies on a thin static thing.
    """

    name: str
    octree: OctreeConfig
    scans: list[np.ndarray]
    T_world_body: np.ndarray
    moving: np.ndarray
    thin: np.ndarray

    def points_world(self) -> np.ndarray:
        """Return (P, 3) float32 points of all scans."""
        moved = (p @ T[:3, :3].T + T[:3, 3] for p, T in zip(self.scans, self.T_world_body, strict=True))
        return np.concatenate(list(moved)).astype(np.float32)


def _with_errors(T_world_body: np.ndarray, *, sigma_m: float, sigma_rad: float) -> np.ndarray:
    rng = np.random.default_rng(0)
    errors = [exp(rng.normal(0.0, sigma_rad, 3), rng.normal(0.0, sigma_m, 3)) for _ in T_world_body]
    return T_world_body @ np.array(errors)


def outdoors(name: str, config: LidarSynthConfig) -> Labelled:
    """Return a labelled LiDAR log; its poses err by 1.5 cm and 0.05° along and about each axis."""
    simulator = LidarSimulator(config)
    truth, scans, moving, thin = simulator.truth, [], [], []
    hulls = simulator.scene.solids.hulls
    posts = np.array([name in _THIN for name in hulls.names], np.bool_)
    for index in range(len(truth)):
        scan, labels = simulator.observe_labelled(index)
        points = deskewed(scan, twist_at(truth, index)).points_body
        T = truth.T_world_body[index]
        exact = points @ T[:3, :3].T + T[:3, 3]
        on_post = np.zeros(len(points), np.bool_)
        for center, half in zip(hulls.centers_world[posts], hulls.half_sizes_m[posts], strict=True):
            reach = max(half[0], half[1]) + 0.08
            inside = np.linalg.norm(exact[:, :2] - center[:2], axis=1) < reach
            base_m = center[2] - half[2] + 0.5  # what is near the ground may be ground
            on_post |= inside & (exact[:, 2] > base_m) & (exact[:, 2] < center[2] + half[2] + 0.05)
        scans.append(points)
        moving.append(labels)
        thin.append(on_post & ~labels)
    octree = OctreeConfig(resolution_m=0.2, max_range_m=80.0)
    T_world_body = _with_errors(truth.T_world_body, sigma_m=0.015, sigma_rad=0.0009)
    return Labelled(name, octree, scans, T_world_body, np.concatenate(moving), np.concatenate(thin))


def indoors(name: str, config: SynthConfig) -> Labelled:
    """Return a labelled RGB-D log; its poses err by 5 mm and 0.11° along and about each axis."""
    simulator, octree = CameraSimulator(config), OctreeConfig()
    noise = measure_noise(simulator.log(), workers=1).noise
    octree = octree.model_copy(update={"depth_noise": noise})
    limit_m = DepthLimit(noise, max_sigma_m=octree.resolution_m).depth_m
    scans, moving = [], []
    for index in range(len(simulator.truth)):
        frame = simulator.observe(index)
        points = frame.scan().points_body
        near = points[:, 2] <= limit_m  # farther points are in no octree
        labels = simulator.moving_pixels(index, frame.depth_m)[frame.depth_m > 0.0]
        scans.append(points[near])
        moving.append(labels[near])
    T_world_body = _with_errors(simulator.truth.T_world_body, sigma_m=0.005, sigma_rad=0.002)
    labels = np.concatenate(moving)
    return Labelled(name, octree, scans, T_world_body, labels, np.zeros_like(labels))


def logs(*, quick: bool):  # type: ignore[no-untyped-def]
    """Yield labelled logs of several seeds and densities."""
    for seed in range(1 if quick else 3):
        for cars, cyclists, people in ((4, 2, 8), (10, 6, 20)):
            traffic = {"cars": cars, "cyclists": cyclists, "pedestrians": people}
            length = {"seed": seed, "duration_s": 5.0 if quick else 12.0}
            yield outdoors(f"street {seed}, {cars} cars", STREET.model_copy(update=traffic | length))
        yard = COURTYARD.model_copy(update={"seed": seed, "duration_s": 30.0, "pedestrians": 5})
        yield outdoors(f"courtyard {seed}", yard)
        for people in (3, 6):
            flat = SynthConfig(seed=seed, people=people, **_SMALL)
            yield indoors(f"flat {seed}, {people} people", flat)


def scores(moving: np.ndarray, labels: np.ndarray) -> tuple[float, float, float]:
    """Return SA, DA and AA, per cent."""
    sa, da = 1.0 - moving[~labels].mean(), moving[labels].mean()
    return 100.0 * sa, 100.0 * da, 100.0 * float(np.sqrt(sa * da))


def ours(log: Labelled) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Return which points are in no cloud, in removed voxels, in no occupied one, and CPU seconds a scan."""
    points_world, begin = log.points_world(), time.process_time()
    octree, caster, updates = OctreeMap(log.octree), Caster(log.octree), []
    for points, T_world_body in zip(log.scans, log.T_world_body, strict=True):
        updates.append(pack(caster.cast(Scan(0, points), T_world_body)))
        octree.merge(updates[-1])
    is_camera = log.octree.depth_noise is not None
    poses = log.T_world_body if is_camera else None
    objects = remove_moving_objects(octree, lambda: updates, T_world_camera=poses)
    scans = np.split(points_world, np.cumsum([len(scan) for scan in log.scans])[:-1])
    returns = np.concatenate([objects.returns_of(scan) for scan in scans])
    seconds = (time.process_time() - begin) / len(log.scans)
    return returns, objects.contain(points_world), ~octree.are_occupied(points_world), seconds


def peer(log: Labelled, method: str, python: Path, scratch: Path) -> tuple[np.ndarray, float] | str:
    """Return which points a peer removes and its CPU seconds a scan, or why it did not run."""
    data, found = scratch / "log.npz", scratch / "found.npz"
    counts = [len(points) for points in log.scans]
    np.savez(data, points=log.points_world(), counts=counts, origins=log.T_world_body[:, :3, 3])
    voxel_m = 0.1 if log.octree.resolution_m > 0.1 else log.octree.resolution_m  # DUFOMap's own outdoors
    command = [str(python), "-c", _PEER, method, str(data), str(voxel_m), str(found)]
    try:
        subprocess.run(command, check=True, capture_output=True, text=True, timeout=_LIMIT_S)
    except subprocess.TimeoutExpired:
        return f"left out: not done in {_LIMIT_S:g} s"
    except (OSError, subprocess.SubprocessError) as error:
        return f"left out: {str(getattr(error, 'stderr', '') or error).strip().splitlines()[-1]}"
    with np.load(found) as result:
        return result["moving"], float(result["seconds"]) / len(log.scans)


def main() -> None:
    """Print one row a method and log."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="one seed, short streets")
    parser.add_argument("--peers", type=Path, help="python of the environment with the peers")
    parser.add_argument("--only", choices=_PEERS, help="this peer alone")
    options = parser.parse_args()
    print(f"{'log':24}{'method':26}{'SA %':>8}{'DA %':>8}{'AA %':>8}{'s/scan':>9}{'thin kept %':>13}")
    for log in logs(quick=options.quick):
        returns, removed, empty, seconds = ours(log)
        _row(log, "mapper, returns", returns, seconds)
        _row(log, "mapper, removed", removed, seconds)
        _row(log, "mapper, map", empty, seconds)
        if options.peers is None:
            continue
        for method in _PEERS if options.only is None else (options.only,):
            with tempfile.TemporaryDirectory() as scratch:
                answer = peer(log, method, options.peers, Path(scratch))
            if isinstance(answer, str):
                print(f"{log.name:24}{method:26}{answer}", flush=True)
            else:
                _row(log, method, *answer)


def _row(log: Labelled, method: str, moving: np.ndarray, seconds: float) -> None:
    sa, da, aa = scores(moving, log.moving)
    thin = f"{100.0 * (1.0 - moving[log.thin].mean()):13.2f}" if log.thin.any() else ""
    print(f"{log.name:24}{method:26}{sa:8.2f}{da:8.2f}{aa:8.2f}{seconds:9.4f}{thin}", flush=True)


if __name__ == "__main__":
    main()
