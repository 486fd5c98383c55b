"""Options that tell where the worlds of several runs lie."""

from collections.abc import Sequence
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, assert_never

import typer

from mapper.core.errors import ConfigError

if TYPE_CHECKING:
    from mapper.merging.merged_map import MergedMap
    from mapper.merging.placing import Placing
    from mapper.run.folder import Run
    from mapper.runtime.executor import Workers
    from mapper.runtime.progress import Progress


class Place(StrEnum):
    """Source of the runs' poses in the map."""

    BUILT = "built"
    TRUTH = "truth"
    AUTO = "auto"


PosesFile = Annotated[
    Path | None,
    typer.Option(
        "--poses", help="File of the worlds' poses in the map, one line per run: RUN tx ty tz qx qy qz qw."
    ),
]


def placing_of(
    runs: "Sequence[Run]",
    place: Place,
    poses: Path | None,
    *,
    jointly: bool,
    known: "MergedMap | None" = None,
    workers: "Workers",
    progress: "Progress",
) -> "Placing":
    """Return the runs with the poses of their worlds.

    Args:
        runs: To be placed.
        place: Source of the poses.
        poses: File of them.
        jointly: Whether shared places bend the runs, or place each as a rigid body.
        known: A map of the first of them, to which the others are added.
        workers: Where places are compared.
        progress: Receives stages and notes.

    Raises:
        ConfigError: Two sources of the poses are given.
        MapperError: A pose is missing; see :mod:`mapper.merging.placing` and
            :mod:`mapper.pipeline.place_runs`.
    """
    from mapper.merging.placing import Placing, as_built, by_poses, by_truth

    if poses is not None:
        if place is not Place.BUILT:
            raise ConfigError(f"--place {place} and --poses {poses}: both say where the runs lie; give one")
        return Placing(by_poses(runs, poses))
    match place:
        case Place.BUILT:
            return Placing(as_built(runs))
        case Place.TRUTH:
            return Placing(by_truth(runs))
        case Place.AUTO:
            from mapper.pipeline.place_runs import place_by_shared_places, place_jointly

            if not jointly:
                return place_by_shared_places(runs, workers=workers, progress=progress)
            known = known if known is not None and known.graph is not None else None
            return place_jointly(runs, known=known, workers=workers, progress=progress)
        case _:
            assert_never(place)
