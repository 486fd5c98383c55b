"""``mapper eval``: errors of a trajectory, and the quality of a map."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from mapper.cli.answer import Answer, Output
from mapper.cli.completion import run_folders
from mapper.cli.options import refuse_with, refuse_without
from mapper.core.errors import DataError, MapperError, UntrustedError

if TYPE_CHECKING:
    from mapper.core.timebase import Stamps
    from mapper.core.trajectory import Trajectory
    from mapper.evaluators.metrics.evaluate import Assessment
    from mapper.evaluators.metrics.map_quality import MapQuality
    from mapper.evaluators.metrics.metric import Metric
    from mapper.run.folder import Run

_TOLERANCE = 1

Align = Literal["none", "yaw", "se3", "sim3"]
World = Literal["truth", "map"]
Format = Literal["text", "markdown", "csv", "json"]


def evaluate(
    estimate: Annotated[
        Path,
        typer.Argument(
            metavar="RUN|TRAJECTORY",
            autocompletion=run_folders,
            help="Run folder, merged map, or TUM, KITTI or EuRoC trajectory.",
        ),
    ],
    truth: Annotated[
        Path | None, typer.Option(help="TUM, KITTI or EuRoC trajectory of the truth; omit for the run's own.")
    ] = None,
    relations: Annotated[
        Path | None,
        typer.Option(
            help="Known relative poses, as of the Intel lab: lines of time1 time2 x y z roll pitch yaw."
        ),
    ] = None,
    times: Annotated[
        Path | None,
        typer.Option(
            help="Times in seconds, one per line, of poses in KITTI text; otherwise poses are paired by line."
        ),
    ] = None,
    log: Annotated[
        Path | None,
        typer.Option(
            help="Log of a bare trajectory, to see which frames have a pose; with --sharpness, the moved log."
        ),
    ] = None,
    align: Annotated[
        Align, typer.Option(help="How the estimate is aligned with the truth; yaw is for worlds with z up.")
    ] = "se3",
    lengths: Annotated[
        str | None,
        typer.Option(metavar="M,M…", help="Lengths of the relative errors' segments; omit to suit the path."),
    ] = None,
    map_: Annotated[
        Path | None,
        typer.Option(
            "--map",
            metavar="REFERENCE",
            help="Compare the run's map with a cloud, an octree, another run or a synthetic log.",
        ),
    ] = None,
    map_world: Annotated[
        World | None,
        typer.Option(help="World of REFERENCE; omit for truth with synthetic logs, map with others."),
    ] = None,
    register: Annotated[
        bool, typer.Option("--register", help="Register REFERENCE to the run's cloud before it is compared.")
    ] = False,
    tolerance: Annotated[
        int | None,
        typer.Option(
            metavar="VOXELS",
            min=0,
            max=10,
            help="Largest distance between matching surfaces of the two maps.  [default: 1]",
        ),
    ] = None,
    sharpness: Annotated[
        bool, typer.Option("--sharpness", help="Measure how thick walls are where the log's scans overlap.")
    ] = False,
    agreement: Annotated[
        bool,
        typer.Option(
            "--agreement",
            help="Measure how far poses are from what views of one place show; done anyway without a truth.",
        ),
    ] = False,
    against: Annotated[
        Path | None,
        typer.Option(
            metavar="RUN",
            autocompletion=run_folders,
            help="Tell, without a truth, whether the run or this one of the same log is better.",
        ),
    ] = None,
    gate: Annotated[
        list[str] | None,
        typer.Option(
            metavar="METRIC=LIMIT",
            help="Exit with status 1 if a metric exceeds a limit, as in 'ATE RMSE=0.05'; may be repeated.",
        ),
    ] = None,
    plot: Annotated[Path | None, typer.Option(metavar="DIR", help="Folder for plots of the errors.")] = None,
    format_: Annotated[
        Format,
        typer.Option(
            "--format",
            help="csv and json have every digit and each length, angles in radians; json is the list of "
            "metrics in what --json prints.",
        ),
    ] = "text",
    *,
    output: Output,
) -> Answer:
    """Print ATE, RPE, relative errors and coverage of a path, which loops are right, and how good a map is.

    For a merged map: how well its runs agree, and their ATE, each and together, if their truth is known.

    Example: mapper eval runs/xyz --align yaw --plot plots, or: mapper eval 00.txt --truth poses/00.txt, or:
    mapper eval runs/flat --map logs/flat --sharpness
    """
    from mapper.evaluators.metrics.evaluate import estimate_and_truth, run_metrics
    from mapper.evaluators.metrics.relations import read_relations, relation_metrics
    from mapper.run.manifest import is_merged_map

    of_log = {"--sharpness": sharpness, "--agreement": agreement, "--against": against}
    reads_log = any(of_log.values())
    is_merged = is_merged_map(estimate)
    if is_merged:
        only_of_runs = {
            "--truth": truth,
            "--relations": relations,
            "--times": times,
            "--log": log,
            "--lengths": lengths,
            "--map-world": map_world,
            "--register": register,
            **of_log,
            "--plot": plot,
        }
        refuse_with(f"{estimate}, a merged map", only_of_runs, remedy="evaluate its runs one by one")
    if map_ is None:
        of_map = {"--map-world": map_world, "--register": register, "--tolerance": tolerance}
        refuse_without("--map", of_map)
    voxels = _TOLERANCE if tolerance is None else tolerance
    limits = _limits(gate or [])
    if is_merged:
        return _gated(_of_merged_map(estimate, align, map_, voxels, format_), limits)
    run, trajectory, known = estimate_and_truth(estimate, truth, times)
    found = _path_errors(
        trajectory,
        known,
        align,
        lengths,
        frames_ns=_frames_ns(run, log, used=reads_log),
        names=(str(estimate), str(truth) if truth else "its truth"),
    )
    metrics = list(found.metrics)
    if relations is not None:
        metrics += relation_metrics(trajectory, read_relations(relations))
    if run is not None:
        metrics += run_metrics(run, known)
    else:
        refuse_with(f"{estimate}, a trajectory alone", of_log, remedy="give the folder of its run")
    if map_ is None:
        quality = None
    else:
        built = _needed(run, estimate, "--map")
        quality = _map_quality(built, map_, world=map_world, register=register, voxels=voxels)
        metrics += quality.metrics
    notes: list[str] = []
    if run is not None and (reads_log or known is None):
        seen, notes = _of_log(
            run, log, sharpness=sharpness, agreement=agreement, against=against, output=output
        )
        metrics += seen
    if plot is not None:
        _plot(plot, found, quality, align=align, name=estimate.resolve().name, map_=map_)
    return _gated(_answer(run, metrics, found, format_, notes), limits)


def _path_errors(
    trajectory: "Trajectory",
    truth: "Trajectory | None",
    align: Align,
    lengths: str | None,
    *,
    frames_ns: "Stamps | None",
    names: tuple[str, str],
) -> "Assessment":
    from mapper.evaluators.metrics.evaluate import assess

    if lengths is not None and truth is None:
        raise DataError(f"--lengths {lengths}: relative errors need a truth; give one with --truth")
    lengths_m = None if lengths is None else _numbers(lengths)
    found = assess(trajectory, truth, alignment=align, frames_ns=frames_ns, lengths_m=lengths_m, names=names)
    if lengths is not None and not any(map(len, found.lengths)):
        raise DataError(
            f"--lengths {lengths}: the true path, where there are poses, is shorter than that everywhere"
        )
    return found


def _answer(
    run: "Run | None", metrics: "list[Metric]", found: "Assessment", format_: Format, notes: "list[str]"
) -> Answer:
    from mapper.evaluators.metrics.metric import records_of

    text = _text(metrics, found, format_)
    if found.matched is None and format_ in ("text", "markdown"):
        text += "\n\nno ground truth, so no errors: --truth FILE compares with one"
    if format_ in ("text", "markdown"):
        text = "\n\n".join([text, *notes])
    document: dict[str, Any] = {"metrics": records_of(_every_metric(metrics, found))}
    if run is not None:
        from mapper.cli.summary import verdict_text

        document["verdict"] = run.verdict
        if format_ in ("text", "markdown"):
            text += f"\n\n{verdict_text(run)}"
    return Answer(document, text)


def _plot(
    folder: Path,
    found: "Assessment",
    quality: "MapQuality | None",
    *,
    align: Align,
    name: str,
    map_: Path | None,
) -> None:
    from mapper.evaluators.metrics.evaluate import ALIGNED
    from mapper.evaluators.pictures.errors import write_map_errors, write_trajectory_errors

    if quality is None or found.matched is not None:
        write_trajectory_errors(folder, found, title=f"{name}, {ALIGNED[align]}")
    if quality is not None and map_ is not None:
        write_map_errors(folder, quality.check, title=f"{name} against {map_.resolve().name}")


def _of_merged_map(
    folder: Path, align: Align, reference: Path | None, voxels: int, format_: Format
) -> Answer:
    from mapper.evaluators.metrics.evaluate import Assessment
    from mapper.evaluators.metrics.map_reference import read_reference
    from mapper.evaluators.metrics.merged_map import merged_map_metrics, merged_map_quality
    from mapper.evaluators.metrics.metric import records_of
    from mapper.merging.merged_map import open_map
    from mapper.runtime.result_paths import distinct_names

    merged = open_map(folder)
    names = distinct_names([Path(run.path) for run in merged.manifest.runs])
    metrics, notes = merged_map_metrics(merged, names, alignment=align)
    if reference is not None:
        found = read_reference(reference, voxel_m=merged.config.octree.resolution_m)
        metrics += merged_map_quality(merged, found, voxels=voxels)
    text = _text(metrics, Assessment(tuple(metrics)), format_)
    if notes and format_ in ("text", "markdown"):
        text = "\n".join([text, "", *notes])
    return Answer({"metrics": records_of(metrics), "notes": notes}, text)


def _needed(run: "Run | None", path: Path, option: str) -> "Run":
    if run is None:
        raise DataError(f"{path}: a trajectory alone has no map; {option} needs a run folder")
    return run


def _map_quality(run: "Run", path: Path, *, world: World | None, register: bool, voxels: int) -> "MapQuality":
    from mapper.evaluators.metrics.map_quality import map_quality
    from mapper.evaluators.metrics.map_reference import read_reference

    reference = read_reference(path, voxel_m=run.config.octree.resolution_m)
    return map_quality(run, reference, world=world, voxels=voxels, register=register)


def _of_log(
    run: "Run", log: Path | None, *, sharpness: bool, agreement: bool, against: Path | None, output: Output
) -> "tuple[list[Metric], list[str]]":
    """Return what the views of the run's log show without a truth, and sentences on it."""
    from mapper.evaluators.metrics.agreement import (
        CommonViews,
        agreement_metrics,
        comparison_metrics,
        which_is_better,
    )
    from mapper.evaluators.metrics.sharpness import RADIUS_M, sharpness_metrics, views_of
    from mapper.run.folder import moved_log, open_run

    progress, asked = output.progress(), sharpness or agreement or against is not None
    try:
        source = (run if log is None else moved_log(run, log)).open_log()
        metrics: list[Metric] = []
        if sharpness:
            views = views_of(source, run.tracked_trajectory, progress=progress)
            metrics += sharpness_metrics(views, radius_m=RADIUS_M[source.sensor])
        if agreement or against is not None or not sharpness:
            common = CommonViews(source)
            own = common.disagreements(run.tracked_trajectory, progress=progress)
            metrics += agreement_metrics(own)
    except MapperError as error:
        if asked:
            raise
        return [], [f"agreement of views not measured: {error}"]
    if against is None:
        return metrics, []
    other = open_run(against)
    compared = comparison_metrics(own, common.disagreements(other.tracked_trajectory, progress=progress))
    notes = [which_is_better(compared, f"{run.path}", f"{against}")]
    if other.manifest.input.fingerprint != run.manifest.input.fingerprint:
        notes.append(
            f"{against} was built from {other.manifest.input.path}, whose files are not those of "
            f"{run.manifest.input.path}: this holds only if the frames are the same"
        )
    return [*metrics, *compared], notes


def _limits(gates: Sequence[str]) -> dict[str, float]:
    limits = {}
    for gate in gates:
        name, _, limit = gate.rpartition("=")
        try:
            limits[name] = float(limit)
        except ValueError:
            raise DataError(f"--gate {gate}: want METRIC=LIMIT, as in 'ATE RMSE=0.05'") from None
    return limits


def _gated(answer: Answer, limits: Mapping[str, float]) -> Answer:
    """Return the answer with the error that its metrics exceed the limits, if one does."""
    from mapper.evaluators.metrics.metric import exceeded

    too_large = exceeded(answer.document["metrics"], limits)
    return replace(answer, error=UntrustedError("; ".join(too_large))) if too_large else answer


def _frames_ns(run: "Run | None", log: Path | None, *, used: bool) -> "Stamps | None":
    from mapper.config.loading import load_source_config
    from mapper.sources import open_source

    if run is not None:
        if log is not None and not used:
            raise DataError(f"{log}: --log is for bare trajectories; {run.path} has the frames of its log")
        return run.frames_ns
    if log is None:
        return None
    return open_source(log, load_source_config(None, [])).stamps_ns


def _numbers(text: str) -> list[float]:
    try:
        return [float(word) for word in text.split(",")]
    except ValueError:
        raise DataError(f"--lengths {text}: want metres with commas between, as in 1,2,5") from None


def _every_metric(metrics: "list[Metric]", found: "Assessment") -> "list[Metric]":
    from mapper.evaluators.metrics.segments import segment_metrics

    if len(found.lengths) <= 1:
        return metrics
    return metrics + [one for length in found.lengths for one in segment_metrics([length])]


def _text(metrics: "list[Metric]", found: "Assessment", format_: Format) -> str:
    from mapper.evaluators.metrics import metric
    from mapper.evaluators.metrics.segments import LENGTH_COLUMNS, length_records
    from mapper.evaluators.study import table as tables

    if format_ == "json":
        return metric.json_text(_every_metric(metrics, found))
    if format_ == "csv":
        return tables.csv_text(metric.records_of(_every_metric(metrics, found))).rstrip("\n")
    records = length_records(found.lengths)
    if format_ == "markdown":
        shown = [metric.markdown_table(metrics), tables.markdown_table(LENGTH_COLUMNS, records)]
    else:
        lengths = tables.text_table(LENGTH_COLUMNS, records).replace("\n", "\n  ")
        shown = [metric.text_table(metrics), f"  {lengths}"]
    return "\n\n".join(shown if records else shown[:1])
