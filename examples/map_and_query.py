"""Map a log, then ask the map: where is it free, what is near, what does a robot see as walls?

python examples/map_and_query.py                      # a room that the toolkit simulates
python examples/map_and_query.py LOG [OUT]            # your own: TUM, KITTI, MCAP, bag, clouds
"""

import sys
from pathlib import Path

import numpy as np
from synthetic_logs import room_log, scratch

import mapper

FREE, OCCUPIED = 0, 100


def main(log: Path, out: Path) -> None:
    """Build a run of the log, and print what its parts tell."""
    run = mapper.build(log, out=out, progress=print)
    print(f"verdict: {run.verdict.state}")
    print(f"path: {run.trajectory.path_length_m:.2f} m in {len(run.trajectory)} poses")

    octree = run.octree
    occupied = octree.occupied()
    print(f"octree: {len(occupied)} occupied voxels of {octree.resolution_m:g} m")
    states = octree.query(run.trajectory.positions)
    print(f"the sensor was in free voxels {np.mean(states == FREE):.0%} of the time")

    here = run.trajectory.positions[-1]
    nearest = octree.nearest_obstacles(here[np.newaxis], max_range_m=5.0)
    print(f"nearest obstacle to the last pose: {nearest.distances_m[0]:.2f} m")

    walls = octree.slice(z_min=0.3, z_max=1.5)
    print(f"slice: {np.sum(walls.grid == OCCUPIED)} occupied cells of {walls.resolution:g} m")

    picture = out.with_suffix(".png")
    run.plot().figure.savefig(picture, dpi=150)
    print(f"picture: {picture}")


if __name__ == "__main__":
    folder = scratch()
    log = Path(sys.argv[1]) if len(sys.argv) > 1 else room_log(folder)
    main(log, Path(sys.argv[2]) if len(sys.argv) > 2 else folder / "run")
