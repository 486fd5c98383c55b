"""``mapper plan``: a path for a robot through a finished map."""

import json
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from mapper.cli.answer import Answer, Output
from mapper.cli.completion import run_folders
from mapper.cli.groups import Verb
from mapper.cli.options import refuse_with
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
        return super().parse_args(ctx, joined)


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
    from mapper.api.plan import plan as plan_path
    from mapper.export.plan import plan_json
    from mapper.run import files

    if in_3d:
        refuse_with("--3d", {"--layer": layer})
    has_storeys = not in_3d and layer == "traversable" and (run / f"{files.storey(0)}.yaml").exists()
    counts = (3,) if in_3d else (2, 3) if has_storeys else (2,)
    start, goal = (_point(text, name, counts) for text, name in zip((from_, to), _POINT_OPTIONS, strict=True))
    given = {"radius_m": radius, "unknown": unknown, "layer": layer}
    settings = {name: value for name, value in given.items() if value is not None}
    found = plan_path(run, start, goal, in_3d=in_3d, settings=settings)
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
