"""Runs of small maps, and merges of them."""

import numpy as np

from mapper.config.build import BuildConfig
from mapper.core.geometry import exp
from mapper.core.trajectory import Trajectory
from mapper.merging.merge import merge
from mapper.merging.world_poses import Placing
from mapper.navigation.config import TraversableConfig
from mapper.octree.config import SliceConfig
from mapper.octree.map_file import write_map
from mapper.run.folder import open_run
from mapper.run.frame_records import write_records
from mapper.run.manifest import Manifest
from mapper.run.manifest_logs import Input
from mapper.run.writer import write_run
from mapper.sources.trajectory_files import write_tum

ROBOT = TraversableConfig()
BAND = SliceConfig(min_height_m=-0.5, max_height_m=0.8)


def merged_map_of(placed, out, *, tile_m=3.2, **settings):
    return merge(Placing(placed), out, tile_m=tile_m, **settings)


def make_run(
    path, octree, *, band=BAND, log="sha256:0", T_truth_world=None, positions=None, traversable=ROBOT
):
    """A run folder with what a merge reads."""
    config = BuildConfig(octree=octree.config, slice=band, traversable=traversable)
    manifest = Manifest(status="building", input=Input(path="/log", kind="tum", fingerprint=log))
    rng = np.random.default_rng(len(path.name))
    poses = np.array([exp(rng.normal(0, 0.3, 3), rng.normal(0, 1.0, 3)) for _ in range(9)])
    if positions is not None:
        poses = np.tile(np.eye(4), (len(positions), 1, 1))
        poses[:, :3, 3] = positions
    trajectory = Trajectory(np.arange(len(poses)) * 100_000_000 + 1, poses)
    with write_run(path, manifest, config, overwrite=True) as writer:
        write_map(writer.folder / "map.octree", octree)
        write_tum(writer.folder / "trajectory.tum", trajectory)
        write_records(writer.folder / "frames.csv", [])
        if T_truth_world is not None:
            write_tum(writer.folder / "truth.tum", trajectory.moved(T_truth_world))
    return open_run(path)
