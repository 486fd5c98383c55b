"""``mapper doctor``: checks of the machine, or of a run's files, and what to do if one fails."""

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mapper.cli.answer import Answer, Output
from mapper.cli.completion import run_folders
from mapper.cli.options import refuse_with
from mapper.core.errors import ConfigError, MapperError
from mapper.runtime.progress import SILENT

if TYPE_CHECKING:
    from collections.abc import Sequence

    from mapper.runtime.doctor import Finding
    from mapper.runtime.progress import Progress

_MARKS = {"well": "ok  ", "warning": "warn", "failed": "FAIL"}


def doctor(
    run: Annotated[
        Path | None,
        typer.Argument(
            metavar="[RUN]",
            autocompletion=run_folders,
            help="Check the files of this run or localised log instead of the machine.",
        ),
    ] = None,
    accept: Annotated[
        list[str] | None,
        typer.Option(
            metavar="FILE",
            help="Accept a map that you edited, such as slice.pgm, as it is now; fusing overwrites it. "
            "Repeatable.",
        ),
    ] = None,
    warm: Annotated[
        bool,
        typer.Option(
            "--warm",
            help="Compile the kernels now, so that the first build does not have to; takes a minute.",
        ),
    ] = False,
    bundle: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE.zip",
            help="Write what a report of a fault needs: these checks, and of RUN its settings, outcomes and "
            "what its log looks like; no images, points or trajectory.",
        ),
    ] = None,
    *,
    output: Output,
) -> Answer:
    """Check the machine, import every library in a separate process, and print what to do.

    With RUN, compare all its files with the sizes and digests in its manifest instead; with --warm, compile
    the kernels. The exit status is 1 if anything failed.

    Example: mapper doctor --json, or: mapper doctor runs/xyz, or after pip install: mapper doctor --warm
    """
    if bundle is not None:
        refuse_with("--bundle", {"--accept": accept, "--warm": warm})
        return _bundled(bundle, run, output)
    if warm:
        refuse_with(
            "--warm", {"RUN": run, "--accept": accept}, remedy="it compiles the kernels of all builds"
        )
    if accept:
        _accept(run, accept)
    progress = output.progress() if warm or sys.stderr.isatty() else SILENT
    if warm:
        findings = _warmed(progress)
    elif run is None:
        from mapper.runtime.doctor import examine

        findings = examine(progress=progress)
    else:
        from mapper.run.file_checks import check_run

        findings = check_run(run, progress=progress)
    failed = [finding.name for finding in findings if finding.verdict == "failed"]
    error = None
    if failed:
        error = MapperError(f"doctor: {len(failed)} of {len(findings)} failed: {', '.join(failed)}")
    return Answer({"findings": findings}, _table(findings), error=error)


def _bundled(path: Path, run: Path | None, output: Output) -> Answer:
    from mapper.run.support_bundle import write_bundle
    from mapper.runtime.doctor import examine

    names = write_bundle(path, examine(progress=output.progress()), run)
    return Answer({"path": path, "files": names}, f"{path}: {', '.join(names)}")


def _warmed(progress: "Progress") -> "list[Finding]":
    from mapper.pipeline.warm_up import compile_kernels
    from mapper.runtime.doctor import check_kernels

    compile_kernels(progress=progress)
    return [check_kernels()]


def _accept(run: Path | None, names: "Sequence[str]") -> None:
    from mapper.octree.grid import read_grid
    from mapper.run import files
    from mapper.run.folder import open_run

    if run is None:
        raise ConfigError(f"--accept {names[0]}: want the run that it is a file of: mapper doctor RUN")
    for name in names:
        if name not in files.EDITABLE:
            known = ", ".join(
                f"{stem}{end}" for stem in (files.SLICE, files.TRAVERSABLE) for end in (".pgm", ".yaml")
            )
            raise ConfigError(f"--accept {name}: is no map that can be edited; want one of {known}")
        read_grid((run / name).with_suffix(".yaml"))
    with open_run(run).changing(names):
        pass


def _table(findings: "Sequence[Finding]") -> str:
    width = max(len(finding.name) for finding in findings)
    lines = []
    for finding in findings:
        lines.append(f"{_MARKS[finding.verdict]}  {finding.name:<{width}}  {finding.detail}")
        if finding.remedy:
            lines.append(f"{'':<{width + 8}}do: {finding.remedy}")
    return "\n".join(lines)
