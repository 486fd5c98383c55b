"""Options that tell where the worlds of several runs lie."""

from collections.abc import Sequence
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from mapper.merging.placing import Placed
    from mapper.run.folder import Run


class Place(StrEnum):
    """Source of the runs' poses in the map."""

    BUILT = "built"
    TRUTH = "truth"


PosesFile = Annotated[
    Path | None,
    typer.Option(
        "--poses", help="File of the worlds' poses in the map: a line RUN tx ty tz qx qy qz qw for each."
    ),
]


def placed_runs(runs: "Sequence[Run]", place: Place, poses: Path | None) -> "list[Placed]":
    """Return the runs with the poses of their worlds.

    Raises:
        ConfigError: Two sources of the poses are given.
        MapperError: A pose is missing; see :mod:`mapper.merging.placing`.
    """
    from mapper.core.errors import ConfigError
    from mapper.merging.placing import as_built, by_poses, by_truth

    if poses is None:
        return by_truth(runs) if place is Place.TRUTH else as_built(runs)
    if place is not Place.BUILT:
        raise ConfigError(f"--place {place} and --poses {poses}: both say where the runs lie; give one")
    return by_poses(runs, poses)
