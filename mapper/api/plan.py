"""Paths for a robot through finished maps."""

from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from mapper.config.loading import Settings, overridden
from mapper.core.errors import DataError
from mapper.export.plan import draw_plan, write_plan
from mapper.merging import open_map_folder
from mapper.merging.slicing import keep_out_of, traversable_of
from mapper.navigation.config import PlanConfig
from mapper.navigation.planner import Plan, plan_2d, plan_3d, plan_storeys
from mapper.octree.grid import with_obstacles
from mapper.octree.map import read_octree
from mapper.run import files
from mapper.run.folder import Run
from mapper.run.map_folder import has_grid
from mapper.runtime.regular_files import AnyPath


def plan(
    run: Run | AnyPath,
    start: ArrayLike,
    goal: ArrayLike,
    *,
    in_3d: bool = False,
    settings: Settings | None = None,
) -> Plan:
    """Plan the shortest collision-free path, and draw it into the run, as ``mapper plan`` does.

    Args:
        run: A run or its folder, or that of a merged map.
        start: x and y in metres; with ``in_3d`` also z; a third number on several storeys is a height.
        goal: The same.
        in_3d: Plan for a ball in the octree.
        settings: ``radius_m``, ``unknown`` ("blocked" or "free") and ``layer`` ("slice" or "traversable").

    Raises:
        PlanError: There is no such path.
        DataError: A point has another number of coordinates.
        ConfigError: A setting is unknown or has no such value.
        RunError: The folder is no map.
    """
    config = overridden(PlanConfig(), settings=settings)
    built = run if isinstance(run, Run) else open_map_folder(Path(run))
    on_floor = config.layer == "traversable"
    has_storeys = on_floor and not in_3d and has_grid(built, files.storey(0))
    ends = [np.asarray(end, np.float64) for end in (start, goal)]
    sizes = (3,) if in_3d else (2, 3) if has_storeys else (2,)
    if any(end.ndim != 1 or len(end) not in sizes for end in ends):
        want = " or ".join(f"({size},)" for size in sizes)
        raise DataError(f"plan: start {ends[0].shape} and goal {ends[1].shape}, want {want} metres")
    grid = built.traversable if on_floor else with_obstacles(built.slice, built.keepout)
    if in_3d:
        octree = read_octree(built.file(files.OCTREE_OT))
        found = plan_3d(octree, *ends, config=config, keep_out=keep_out_of(built))
    elif has_storeys:
        found = plan_storeys(traversable_of(built), *ends, config=config)
    else:
        found = plan_2d(grid, *ends, config=config)
    if isinstance(built, Run):
        write_plan(built, found, grid=grid)
    else:
        draw_plan(built.path, found, grid=grid)
    return found
