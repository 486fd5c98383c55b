"""``mapper demo``: the embedded log, made and mapped."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from cli.build import built
from cli.console import progress_for
from cli.environment import prepare_libraries
from cli.options import Overrides, Quiet

if TYPE_CHECKING:
    from mapper.simulation.config import SynthConfig

DEMO_LOG = ("path=loop", "width_px=320", "height_px=240")


def demo(
    out: Annotated[Path, typer.Option(help="Folder for the log and the run.")] = Path("demo"),
    seconds: Annotated[float | None, typer.Option(help="Length of the log; omit for one round.")] = None,
    set_: Overrides = None,
    quiet: Quiet = False,
) -> None:
    """Make a synthetic log of a walk through a flat, build a map from it, and print where its pictures are.

    Example: mapper demo --out /tmp/demo --seconds 20
    """
    from cli.options import assignments
    from cli.summary import summary_text
    from mapper.config.loading import load_config, overridden
    from mapper.run import files
    from mapper.simulation import write_tum_log
    from mapper.simulation.config import SynthConfig

    prepare_libraries()
    load_config(None, set_ or ())  # what is wrong with it is better known before the log is made
    log = out / "log"
    scene = overridden(SynthConfig(), [*DEMO_LOG, *assignments({"duration_s": seconds})])
    if not _is_made(log, scene):
        with progress_for(quiet=quiet).stage("render") as report:
            write_tum_log(log, scene, on_progress=report)
    run, metrics = built(log, None, set_ or (), out / "run", overwrite=True, quiet=quiet)
    if not quiet:
        print(summary_text(run, metrics))
    for picture in (files.SUMMARY, files.CLOUD_VIEWS, f"{files.SLICE}.png"):
        print(run.path / picture)


def _is_made(log: Path, scene: "SynthConfig") -> bool:
    """Tell whether an earlier demo left this very log, which takes longer to make than to map."""
    made_from = log / "scene.json"
    return made_from.is_file() and json.loads(made_from.read_text())["config"] == scene.model_dump(
        mode="json"
    )
