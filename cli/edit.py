"""``mapper edit``: a finished run mended by hand, by options, by an edits file, or on its page."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mapper.cli.answer import Answer, Output
from mapper.cli.console import print_text
from mapper.cli.options import MovedLogs, RunFolder, refuse_several, refuse_without
from mapper.core.errors import ConfigError

if TYPE_CHECKING:
    from mapper.mapping.config import EditKind
    from mapper.run.folder import Run

_Corners = tuple[float, float, float, float, float, float]


def edit(
    run: RunFolder,
    erase: Annotated[
        bool, typer.Option("--erase", help="Free what is occupied in a region; its points leave the cloud.")
    ] = False,
    keep: Annotated[
        bool, typer.Option("--keep", help="Leave out what lies outside this and other kept regions.")
    ] = False,
    keepout: Annotated[
        bool, typer.Option("--keepout", help="Keep robots out of a region: floor, plans and nav2.")
    ] = False,
    box: Annotated[
        _Corners | None,
        typer.Option(metavar="X0 Y0 Z0 X1 Y1 Z1", help="Region: lowest and highest corner, metres."),
    ] = None,
    height: Annotated[
        tuple[float, float] | None, typer.Option(metavar="LOW HIGH", help="Region: between two heights.")
    ] = None,
    radius: Annotated[
        float | None, typer.Option(help="Region: within this distance of the sensor's path, seen from above.")
    ] = None,
    polygon: Annotated[
        str | None,
        typer.Option(metavar='"X,Y X,Y X,Y…"', help="Region: inside the polygon of these corners."),
    ] = None,
    undo: Annotated[bool, typer.Option("--undo", help="Undo the last edit of a region.")] = False,
    from_: Annotated[
        Path | None,
        typer.Option("--from", metavar="FILE", help="Edits file, as the page saves it: loops and regions."),
    ] = None,
    page: Annotated[
        bool,
        typer.Option("--page", help="Serve the run's page, to edit on, until it is closed."),
    ] = False,
    list_: Annotated[  # noqa: ARG001 - says what is done anyway
        bool, typer.Option("--list", help="Print the edits; the default without other options.")
    ] = False,
    log: MovedLogs = None,
    *,
    output: Output,
) -> Answer:
    """Erase, keep or block the region of a map where all given conditions hold, and make the maps again.

    On the page, and by the file that it saves, loops are accepted, rejected and added as well.

    Edits are kept in RUN/edits.toml, which can be changed by hand, and apply to every later fuse. Coordinates
    are those of slice.yaml and cloud.ply.

    Example: mapper edit runs/xyz --erase --box 2.1 0.3 0.1 2.9 1.05 1.5
    """
    from mapper.config.loading import read_config
    from mapper.pipeline.edit import apply_edits
    from mapper.run.edits_file import EditsFile
    from mapper.run.folder import moved_log, open_run

    given: dict[EditKind, bool] = {"erase": erase, "keep": keep, "keepout": keepout}
    kinds = [kind for kind, is_given in given.items() if is_given]
    conditions = {
        "box_m": None if box is None else (box[:3], box[3:]),
        "height_m": height,
        "path_radius_m": radius,
        "polygon_m": None if polygon is None else [corner.split(",") for corner in polygon.split()],
    }
    region = {name: value for name, value in conditions.items() if value is not None}
    other = {"--undo": undo, "--from": from_, "--page": page}
    refuse_several({"--erase": erase, "--keep": keep, "--keepout": keepout, **other})
    changes = bool(kinds or undo or from_ or page)
    if not changes:
        refuse_without("--erase, --keep, --keepout, --undo, --from or --page", {"--log": log})
    if kinds and not region:
        raise ConfigError(f"--{kinds[0]}: want a region: --box, --height, --radius or --polygon")
    if region and not kinds:
        raise ConfigError("a region alone changes nothing: want --erase, --keep or --keepout with it")
    built = open_run(run)
    if changes:
        edits = None if from_ is None else read_config(from_, EditsFile)
        if log:
            built = moved_log(built, *log)
        progress = output.progress()
        if page:
            from mapper.api.edit_page import serve_edit_page

            on_ready = progress.note if output.json else print_text
            built = serve_edit_page(built.open_log(), built, on_ready=on_ready, progress=progress)
        elif edits is not None:
            built = apply_edits(built.open_log(), built, edits, progress=progress)
        else:
            built = built.edit(kinds[0] if kinds else "undo", progress=progress, **region)
    return Answer({"run": built.path, "edits": built.manifest.edits}, edits_table(built))


def edits_table(run: "Run") -> str:
    """Return a line for each region of ``edits.toml``, with what it did; a new one was not fused yet."""
    from mapper.run.edits_file import edits_text, parse_edits

    edits = parse_edits(edits_text(run.path), run.path)
    done = list(run.manifest.edits)
    lines = []
    for kind, regions in edits:
        for region in regions:
            applied = next((edit for edit in done if (edit.kind, edit.region) == (kind, region)), None)
            if applied is not None:
                done.remove(applied)
            what = f"{kind} {', '.join(region.lines)}: not in the maps yet; mapper fuse {run.path}"
            lines.append(applied.text if applied else what)
    lines += [f"{edit.text}; no longer in edits.toml: mapper fuse {run.path}" for edit in done]
    return "\n".join(lines or ["no edits"])
