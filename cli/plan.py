"""``mapper plan``: a path for a robot through a finished map."""

import json
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from mapper.cli.answer import Answer, Output
from mapper.cli.completion import run_folders
from mapper.cli.groups import Verb
from mapper.cli.options import assignments, refuse_with
from mapper.core.errors import ConfigError

if TYPE_CHECKING:
    from mapper.core.geometry import Array

_POINT_OPTIONS = ("--from", "--to")


class WithPoints(Verb):
    """Lets ``--from`` and ``--to`` take two numbers or three, negative ones too."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Join the numbers that follow each point option to one word."""
        joined: list[str] = []
        takes_numbers = False
        for word in args:
            if takes_numbers and _is_number(word):
                joined[-1] = f"{joined[-1]} {word}" if "=" in joined[-1] else f"{joined[-1]}={word}"
            else:
                joined.append(word)
                takes_numbers = word in _POINT_OPTIONS
        return list(super().parse_args(ctx, joined))


def plan(
    run: Annotated[
        Path,
        typer.Argument(metavar="RUN", autocompletion=run_folders, help="Run folder, or a merged map."),
    ],
    from_: Annotated[str, typer.Option("--from", metavar="X Y [Z]", help="Start, metres.")],
    to: Annotated[str, typer.Option("--to", metavar="X Y [Z]", help="Goal, metres.")],
    in_3d: Annotated[
        bool, typer.Option("--3d", help="Plan for a ball in the octree; points then have a height.")
    ] = False,
    radius: Annotated[float | None, typer.Option(help="Radius of the robot, metres.  [default: 0.2]")] = None,
    unknown: Annotated[
        Literal["blocked", "free"] | None,
        typer.Option(help="How to treat unknown space.  [default: blocked]"),
    ] = None,
    layer: Annotated[
        Literal["slice", "traversable"] | None, typer.Option(help="Grid for a path in 2D.  [default: slice]")
    ] = None,
    *,
    output: Output,  # noqa: ARG001
) -> Answer:
    """Plan the shortest collision-free path, and draw it into the run: plan.json, plan.png, run.mcap.

    Where floors lie above each other (--layer traversable), a third number gives the storey of a point. A
    merged map has no run.mcap to draw it into.

    Example: mapper plan runs/xyz --from 2.1 -0.3 --to 1.9 1.4 --radius 0.15
    """
    from mapper.config.loading import overridden
    from mapper.export.plan import draw_plan, plan_json, write_plan
    from mapper.merging import open_map_folder
    from mapper.merging.slicing import keep_out_of, traversable_of
    from mapper.navigation.config import PlanConfig
    from mapper.navigation.planner import plan_2d, plan_3d, plan_storeys
    from mapper.octree.grid import with_obstacles
    from mapper.octree.map import read_octree
    from mapper.run import files
    from mapper.run.folder import Run

    if in_3d:
        refuse_with("--3d", {"--layer": layer})
    has_storeys = not in_3d and layer == "traversable" and (run / f"{files.storey(0)}.yaml").exists()
    counts = (3,) if in_3d else (2, 3) if has_storeys else (2,)
    start, goal = (_point(text, name, counts) for text, name in zip((from_, to), _POINT_OPTIONS, strict=True))
    config = overridden(PlanConfig(), assignments({"radius_m": radius, "unknown": unknown, "layer": layer}))
    built = open_map_folder(run)
    on_floor = config.layer == "traversable"
    grid = built.traversable if on_floor else with_obstacles(built.slice, built.keepout)
    if in_3d:
        octree = read_octree(built.file(files.OCTREE_OT))
        found = plan_3d(octree, start, goal, config=config, keep_out=keep_out_of(built))
    elif has_storeys:
        found = plan_storeys(traversable_of(built), start, goal, config=config)
    else:
        found = plan_2d(grid, start, goal, config=config)
    if isinstance(built, Run):
        write_plan(built, found, grid=grid)
    else:
        draw_plan(run, found, grid=grid)
    points = ["  ".join(f"{value:7.3f}" for value in waypoint) for waypoint in found.waypoints_world]
    return Answer(
        {"picture": run / files.PLAN_VIEW, **json.loads(plan_json(found))},
        "\n".join([found.summary, *points, str(run / files.PLAN_VIEW)]),
    )


def _point(text: str, name: str, counts: tuple[int, ...]) -> "Array":
    import numpy as np

    words = text.replace(",", " ").split()
    if len(words) not in counts or not all(_is_number(word) and isfinite(float(word)) for word in words):
        wanted = " or ".join("x y z"[: 2 * count - 1] for count in counts)
        hint = "; a height needs --3d" if len(words) == 3 and 3 not in counts else ""
        raise ConfigError(f"{name} {text}: want {wanted} in metres{hint}")
    return np.array([float(word) for word in words])


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True
