"""Options for where the worlds of several runs lie."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, assert_never

import typer

from mapper.cli.option_rules import refuse_several

if TYPE_CHECKING:
    from mapper.merging.merged_map import MergedMap
    from mapper.merging.placing import Placing
    from mapper.run.folder import Run
    from mapper.runtime.executor import Workers
    from mapper.runtime.progress import Progress

Place = Literal["built", "truth", "auto"]
"""Source of the poses of the runs' worlds in the map."""

PosesFile = Annotated[
    Path | None,
    typer.Option(
        "--poses", help="File of the worlds' poses in the map, one line per run: RUN tx ty tz qx qy qz qw."
    ),
]


def placing_of(
    runs: "Sequence[Run]",
    place: Place | None,
    poses: Path | None,
    *,
    default: Place,
    jointly: bool,
    known: "MergedMap | None" = None,
    workers: "Workers",
    progress: "Progress",
) -> "Placing":
    """Return the runs with the poses of their worlds.

    Args:
        runs: Runs to be placed.
        place: Source of the poses.
        poses: File of the poses.
        default: Source if neither is given.
        jointly: Whether shared places bend the runs, or place each as a rigid body.
        known: A map of the first of them, to which the others are added.
        workers: Workers that compare places.
        progress: Receives stages and notes.

    Raises:
        ConfigError: Both are given.
        MapperError: A pose is missing; see :mod:`mapper.merging.placing` and
            :mod:`mapper.pipeline.place_runs`.
    """
    from mapper.merging.placing import Placing, as_built, by_poses, by_truth

    refuse_several({"--place": place, "--poses": poses})
    if poses is not None:
        return Placing(by_poses(runs, poses))
    match place or default:
        case "built":
            return Placing(as_built(runs))
        case "truth":
            return Placing(by_truth(runs))
        case "auto":
            from mapper.pipeline.place_runs import place_by_shared_places, place_jointly

            if not jointly:
                return place_by_shared_places(runs, workers=workers, progress=progress)
            known = known if known is not None and known.graph is not None else None
            return place_jointly(runs, known=known, workers=workers, progress=progress)
        case unreachable:
            assert_never(unreachable)
