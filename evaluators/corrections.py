"""One log's loops as constraints of the graph and as the thesis's proportional correction, side by side."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from evaluators.trajectory import align, associate, ate
from mapper.config import BuildConfig
from mapper.errors import DataError
from mapper.graph.model import PoseGraph
from mapper.loops.closure import LoopClosure
from mapper.odometry.base import Odometry, Track
from mapper.solving import solve
from mapper.sources.base import FrameSource
from mapper.tracking import Tracking


@dataclass(frozen=True, slots=True)
class Correction:
    """What one way to use the loops comes to.

    Attributes:
        solve: ``graph.solve``, or "no loops".
        ate_m: ATE RMSE in metres, SE(3)-aligned.
        loops: How many loops hold.
        lost: Frames that were not placed.
    """

    solve: str
    ate_m: float
    loops: int
    lost: int


def corrections(source: FrameSource, config: BuildConfig) -> Iterator[Correction]:
    """Yield the log's error without loops, with proportional correction, and with GTSAM constraints.

    The log is tracked once. Each correction looks for its own loops, for where it believes to be decides what
    it compares.

    Args:
        source: A log with ground truth.
        config: Odometry and loops are used as configured; ``graph.solve`` is what varies.

    Raises:
        DataError: The log has no truth.
    """
    truth = source.truth
    if truth is None:
        raise DataError(f"{source.path}: no ground truth, so there is no error to compare")
    odometry: Odometry[Any] = config.odometry.build()
    observations = [odometry.observe(entry.load(colour=False)) for entry in source.entries()]
    tracks = [odometry.track(observation) for observation in observations]
    graph = PoseGraph()
    for track in tracks:
        if track.is_keyframe and track.node is not None:
            graph.add_node(track.node, track.stamp_ns, track.T_world_body)
    graph.add_factors(factor for track in tracks for factor in track.factors)
    graph.add_factors(odometry.finish())
    tracked = Tracking(tuple(tracks), (), graph, (), {})
    views = [partial(odometry.view, observation) for observation in observations]

    def judged(name: str, loops: Sequence[LoopClosure], config: BuildConfig) -> Correction:
        held = [loop.factor for loop in loops if loop.verdict == "accepted"]
        tied = PoseGraph(graph.T_world_node, graph.stamps_ns, [*graph.factors, *held])
        solved = solve(tied, loops, config.graph)
        estimate = replace(tracked, graph=solved.graph).trajectory()
        matched = associate(estimate, truth)
        holding = sum(loop.verdict == "accepted" for loop in solved.loops)
        return Correction(
            name, ate(align(matched, "se3").moved(matched)).rmse, holding, len(tracks) - len(estimate)
        )

    yield judged("no loops", (), _with_solve(config, "none"))
    for how in ("proportional", "batch"):
        varied = _with_solve(config, how)
        yield judged(how, _closures(tracks, views, varied), varied)


def _with_solve(config: BuildConfig, how: str) -> BuildConfig:
    return config.model_copy(update={"graph": config.graph.model_copy(update={"solve": how})})


def _closures(tracks: Sequence[Track], views: Sequence[Any], config: BuildConfig) -> Sequence[LoopClosure]:
    closer = config.loops.build(config.graph.solve)
    for track, view in zip(tracks, views, strict=True):
        if track.is_keyframe and track.node is not None:
            closer.add(track.node, track, view)
    return closer.closures()
