"""A planned path in its map's folder: as JSON, as a picture, and as channels of a run's MCAP log."""

import json
from math import isfinite
from pathlib import Path

import numpy as np

from mapper.core.errors import RunError
from mapper.core.geometry import Points
from mapper.export.mcap_log import PLAN_TOPICS, McapLog
from mapper.export.picture import write_path
from mapper.export.transforms import root_of
from mapper.navigation.planner import Plan, point_text
from mapper.octree.grid import OccupancyGrid
from mapper.run import files
from mapper.run.folder import Run
from mapper.runtime.atomic import write_text


def write_plan(run: Run, plan: Plan, *, grid: OccupancyGrid) -> None:
    """Write ``plan.json`` and ``plan.png``, and put the path into ``run.mcap``; an earlier plan is replaced.

    Args:
        run: A finished run.
        plan: The path.
        grid: Background of the drawing.

    Raises:
        RunError: The run has no MCAP log.
        DataError: The log cannot be read; it stays as it is.
    """
    log_path = run.file(files.MCAP)
    if not log_path.is_file():
        raise RunError(f"{log_path}: is missing from the run; make it again with mapper fuse {run.path}")
    stamp_ns = int(run.trajectory.stamps_ns[0])
    with run.changing({files.PLAN, files.PLAN_VIEW, files.MCAP}):
        with McapLog(log_path) as log:
            log.copy(log_path, without=PLAN_TOPICS)
            log.plan(stamp_ns, _in_space(plan), frame=root_of(log_path)[0])
        draw_plan(run.path, plan, grid=grid)


def draw_plan(folder: Path, plan: Plan, *, grid: OccupancyGrid) -> None:
    """Write ``plan.json`` and ``plan.png`` into a map's folder; an earlier plan is replaced.

    Args:
        folder: Folder of a run, or of a merged map.
        plan: The path.
        grid: Background of the drawing.
    """
    write_text(folder / files.PLAN, plan_json(plan))
    write_path(
        folder / files.PLAN_VIEW,
        grid=grid,
        waypoints_world=plan.waypoints_world,
        radius_m=plan.config.radius_m,
        title=f"{point_text(plan.waypoints_world[0])} to {point_text(plan.waypoints_world[-1])} m",
        lines=[plan.summary],
    )


def plan_json(plan: Plan) -> str:
    """Return what ``plan.json`` holds."""
    record = {
        "map": plan.map_name,
        "radius_m": plan.config.radius_m,
        "unknown": plan.config.unknown,
        "length_m": plan.length_m,
        "min_clearance_m": plan.min_clearance_m if isfinite(plan.min_clearance_m) else None,
        "storeys": list(plan.storeys),
        "waypoints_world_m": plan.waypoints_world.tolist(),
    }
    return json.dumps(record, indent=1) + "\n"


def _in_space(plan: Plan) -> Points:
    """Return the waypoints as (N, 3); a path on a grid lies on the floor."""
    if plan.dimensions == 3:
        return plan.waypoints_world
    return np.column_stack([plan.waypoints_world, np.zeros(len(plan.waypoints_world))])
