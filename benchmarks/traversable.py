"""Traversable floor compared with the exact geometry of small worlds: precision, recall, the path, time.

Run: PYTHONPATH=. .venv/bin/python benchmarks/traversable.py [WORLD ...]
"""

import sys
import time

from mapper.navigation.config import TraversableConfig
from mapper.navigation.floor import reachable_floor
from mapper.navigation.traversable import traversable
from tests.support.floor_scenes import WORLDS
from tests.support.floor_worlds import score

CELLS_M = (0.05, 0.1, 0.2)
NOISES = (None, 1)


def main() -> None:
    """Print one row per world, voxel and noise."""
    print("world            cell noise precision  recall blocked unknown  CPU s")
    for name in sys.argv[1:] or WORLDS:
        world = WORLDS[name]()
        for cell_m in CELLS_M:
            config = TraversableConfig(
                max_step_m=0.2, head_room_m=1.8, slope_window_m=max(0.6, 5 * cell_m), max_gap_m=2 * cell_m
            )
            for seed in NOISES:
                octree = world.octree(cell_m, seed=seed)
                began = time.process_time()
                traversable(reachable_floor(octree, config, positions_world=world.positions()), config)
                spent_s = time.process_time() - began
                found = score(world, octree, config)
                print(
                    f"{name:15s} {cell_m:5.2f} {'no' if seed is None else 'yes':>5s} {found.precision:9.4f} "
                    f"{found.recall:7.4f} {found.path_blocked:7.4f} {found.path_unknown:7.4f} {spent_s:6.2f}",
                    flush=True,
                )


if __name__ == "__main__":
    main()
