"""``mapper eval``: how far a trajectory is from the truth."""

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from evaluators.metric import Metric
    from mapper.trajectory import Trajectory


class Align(StrEnum):
    """How the estimate is laid over the truth first."""

    NONE = "none"
    SE3 = "se3"
    SIM3 = "sim3"


def evaluate(
    estimate: Annotated[Path, typer.Argument(metavar="RUN|TRAJECTORY", help="Run folder or TUM trajectory.")],
    truth: Annotated[
        Path | None, typer.Option(help="TUM trajectory of the truth; omit for the run's own.")
    ] = None,
    align: Annotated[Align, typer.Option(help="How the estimate is laid over the truth.")] = Align.SE3,
    json: Annotated[bool, typer.Option("--json", help="Print JSON, every digit, angles in radians.")] = False,
) -> None:
    """Print ATE and RPE as the TUM benchmark defines them, which loops are right, and the end's offset.

    Example: mapper eval runs/xyz --align sim3, or: mapper eval estimate.tum --truth groundtruth.txt
    """
    from evaluators.evaluate import evaluate as evaluate_trajectory
    from evaluators.metric import json_text, text_table

    trajectory, known = _trajectories(estimate, truth)
    names = (str(estimate), str(truth) if truth else "its truth")
    metrics = evaluate_trajectory(trajectory, known, alignment=align.value, names=names)
    if estimate.is_dir() and known is not None:
        metrics += _loops_of(estimate, known)
    print(json_text(metrics) if json else text_table(metrics))


def _loops_of(path: Path, truth: "Trajectory") -> "list[Metric]":
    from evaluators.loops import loop_metrics
    from mapper.run import KEYFRAMES, load_run
    from mapper.trajectory import read_tum

    run = load_run(path)
    loops = run.config.loops
    looked_every_m = loops.min_motion_m if loops.kind == "scans" else 0.0
    keyframes_ns = read_tum(path / KEYFRAMES).stamps_ns
    return loop_metrics(run.loops(), keyframes_ns, truth, looked_every_m=looked_every_m)


def _trajectories(estimate: Path, truth: Path | None) -> "tuple[Trajectory, Trajectory | None]":
    from mapper.run import load_run
    from mapper.trajectory import read_tum

    if estimate.is_file():
        return read_tum(estimate), read_tum(truth) if truth else None
    run = load_run(estimate)
    return run.trajectory(), read_tum(truth) if truth else run.truth()
