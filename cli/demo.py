"""``mapper demo``: a synthetic log, made and mapped."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mapper.cli.answer import Answer, Output
from mapper.cli.build import built
from mapper.cli.options import Overrides

if TYPE_CHECKING:
    from mapper.simulation.config import SynthConfig

DEMO_LOG = ("path=loop", "width_px=320", "height_px=240")


def demo(
    out: Annotated[Path, typer.Option(help="Folder for the log and the run.")] = Path("demo"),
    seconds: Annotated[float | None, typer.Option(help="Length of the log; omit for one round.")] = None,
    set_: Overrides = None,
    *,
    output: Output,
) -> Answer:
    """Make a synthetic log of a walk through a flat, build a map from it, and print where its pictures are.

    Example: mapper demo --out /tmp/demo --seconds 20
    """
    from mapper.cli.options import assignments
    from mapper.cli.summary import summary_of
    from mapper.config.loading import load_config, overridden
    from mapper.run import files
    from mapper.simulation import write_tum_log
    from mapper.simulation.config import SynthConfig

    load_config(None, set_ or ())  # what is wrong with it is better known before the log is made
    log = out / "log"
    scene = overridden(SynthConfig(), [*DEMO_LOG, *assignments({"duration_s": seconds})])
    if not _is_made(log, scene):
        with output.progress().stage("render") as report:
            write_tum_log(log, scene, on_progress=report)
    run, metrics = built(log, None, set_ or (), out / "run", overwrite=True, output=output)
    pictures = [run.path / name for name in (files.SUMMARY, files.CLOUD_VIEWS, f"{files.SLICE}.png")]
    summary, below = summary_of(run, metrics), "\n".join(map(str, pictures))
    return Answer(
        {**summary.document, "pictures": pictures},
        f"{summary.text}\n{below}",
        f"{summary.details}\n{below}",
    )


def _is_made(log: Path, scene: "SynthConfig") -> bool:
    """Return whether an earlier demo left this very log, which takes longer to make than to map."""
    made_from = log / "scene.json"
    return made_from.is_file() and json.loads(made_from.read_text())["config"] == scene.model_dump(
        mode="json"
    )
