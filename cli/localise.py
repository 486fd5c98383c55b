"""``mapper localise``: where a new log lies in a finished map."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from mapper.cli.answer import Answer, Output, rows_text, untrusted
from mapper.cli.completion import run_folders
from mapper.cli.options import First, Last, Overrides, Overwrite, Stride, selection, settings_of
from mapper.runtime.result_paths import RUNS, name_of, place_of

if TYPE_CHECKING:
    from mapper.run.manifest import LocalisedManifest


def localise(
    log: Annotated[
        Path, typer.Argument(metavar="LOG", help="Recorded log, from the same kind of sensor as the map.")
    ],
    in_: Annotated[
        Path,
        typer.Option(
            "--in",
            metavar="RUN",
            autocompletion=run_folders,
            help="Finished run, or merged map; it is not changed.",
        ),
    ],
    out: Annotated[
        Path | None, typer.Option(help="Folder to create.  [default: runs/LOG-in-RUN, or with a number]")
    ] = None,
    set_: Overrides = None,
    first: First = None,
    last: Last = None,
    stride: Stride = None,
    overwrite: Overwrite = False,
    strict: Annotated[
        bool,
        typer.Option(
            "--strict", help="Exit with status 1 if the result is not trusted; it is written in any case."
        ),
    ] = False,
    *,
    output: Output,
) -> Answer:
    """Place a new log in a finished map: its trajectory in the map's frame, and which parts are trusted.

    A log of another place is refused, with exit status 1.

    Example: mapper localise logs/tuesday --in runs/flat --out runs/tuesday
    """
    from mapper.api.localise import localise as localise_log

    out = place_of(out, RUNS / f"{name_of(log)}-in-{name_of(in_)}", overwrite=overwrite)
    settings = settings_of(selection(first, last, stride, None), set_)
    manifest = localise_log(
        log, in_, out=out, settings=settings, progress=output.progress(), overwrite=overwrite
    )
    error = untrusted(out, manifest.verdict) if strict and manifest.verdict is not None else None
    return Answer(_document(manifest, out), _text(manifest, out), error=error)


def _document(manifest: "LocalisedManifest", out: Path) -> dict[str, Any]:
    from mapper.cli.summary import frame_counts

    counts = manifest.counts
    return {
        "path": out,
        "map": manifest.map,
        "frames": frame_counts(counts),
        "localised_ratio": manifest.localised_share,
        "constraints": {"accepted": counts.loops, "candidates": counts.loop_candidates},
        "stretches": manifest.stretches,
        "total_s": manifest.timing.total_s,
        "verdict": manifest.verdict,
    }


def _text(manifest: "LocalisedManifest", out: Path) -> str:
    from mapper.run.timeline import counted, span_text

    counts, verdict = manifest.counts, manifest.verdict
    rows = [
        ("frames", counts.frames_text),
        ("localised", f"{manifest.localised_share:.1%} of the frames, in {manifest.map}"),
        ("constraints", f"{counts.loops} of {counts.loop_candidates} comparisons with the map's places hold"),
    ]
    for stretch in manifest.stretches:
        known = f", known to {stretch.sigma_m:.2g} m (1 σ)" if stretch.sigma_m is not None else ""
        held = f"{counted(stretch.frames, 'frame')}, {stretch.constraints} constraints"
        rows.append((span_text(stretch.begin_s, stretch.end_s), f"{stretch.state}, {held}{known}"))
    rows.append(("seconds", f"{manifest.timing.total_s:.1f}"))
    rows.append(("in", str(out)))
    if verdict is not None:
        rows += [("verdict", verdict.state), *(("", sentence) for sentence in verdict.sentences)]
    return rows_text(rows)
