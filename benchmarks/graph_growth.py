"""How the back end bears long graphs, and false loops.

    python -m benchmarks.graph_growth growth [--most 10000]
    python -m benchmarks.graph_growth false-loops [--seeds 20]

"growth": one update of the incremental solver per keyframe with a loop, and one batch solve, against the
number of keyframes; CPU time. A walk of 1000 keyframes a lap around a building, loops to earlier laps.
"false-loops": the change of ATE by loops that are wrong, alone or in clusters that agree with each other,
against the same graph without any; also where all information is five times too confident.
"""

import argparse
from dataclasses import dataclass
from time import process_time

import numpy as np

from mapper.core.geometry import Transform, apply, exp, fit_rigid, rotation_exp, transform
from mapper.graph.config import GraphConfig
from mapper.graph.incremental import IncrementalSolver
from mapper.graph.model import BetweenFactor, PoseGraph, PoseSigmas
from mapper.graph.optimize import optimize
from tests.support.noisy_graphs import noisy_measure, odometry_chain, wrong_alignment

STEP_M = 0.15
ODOMETRY = PoseSigmas(rotation_rad=0.002, translation_m=0.005)
LOOP = PoseSigmas(rotation_rad=0.005, translation_m=0.01)
LEAST_GAP = 50


@dataclass(frozen=True)
class Walk:
    """A graph as odometry and a loop detector would leave it.

    Attributes:
        truth: (N, 4, 4) true poses.
        graph: Nodes at the odometry's estimates; loops come last, the true ones first.
        true_loops: How many of the loops are true.
    """

    truth: Transform
    graph: PoseGraph
    true_loops: int


def true_poses(nodes: int, lap: int) -> Transform:
    """Return a walk around a building with four wings, so many nodes a lap."""
    turns = 2.0 * np.pi * np.arange(nodes) / lap
    radius_m = lap * STEP_M / (2.0 * np.pi) * (1.0 + 0.3 * np.sin(4.0 * turns))
    return np.array(
        [
            transform(
                rotation_exp(np.array([0.0, 0.0, turn + np.pi / 2])),
                np.array([r * np.cos(turn), r * np.sin(turn), 0.2 * np.sin(3.0 * turn)]),
            )
            for turn, r in zip(turns, radius_m, strict=True)
        ]
    )


def walk(
    nodes: int,
    *,
    lap: int,
    seed: int = 0,
    loop_every: int = 10,
    false_share: float = 0.0,
    cluster: int = 1,
    too_confident: float = 1.0,
) -> Walk:
    """Return a noisy walk; what is measured is ``too_confident`` times worse than its information says."""
    rng = np.random.default_rng(seed)
    truth = true_poses(nodes, lap)

    measured = noisy_measure(truth, rng, too_confident=too_confident)
    graph = odometry_chain(truth, measured, ODOMETRY)
    true_loops = 0
    for j in range(lap, nodes, loop_every):
        near = np.flatnonzero(np.linalg.norm(truth[: j - LEAST_GAP, :3, 3] - truth[j, :3, 3], axis=1) < 0.5)
        if len(near):
            i = int(rng.choice(near))
            graph.add_factors([BetweenFactor(i, j, measured(i, j, LOOP), LOOP.information, "loop")])
            true_loops += 1
    wanted = round(false_share * true_loops)
    while wanted > 0:
        size = min(cluster, wanted)
        i, j = np.sort(rng.choice(nodes - size, 2, replace=False)).tolist()
        if j - i < LEAST_GAP:
            continue
        T_i_j = exp(rng.normal(0.0, 0.3, 3), rng.normal(0.0, 1.0, 3))
        for ik, jk, T_ik_jk in wrong_alignment(truth, i, j, T_i_j, size):
            graph.add_factors([BetweenFactor(ik, jk, T_ik_jk, LOOP.information, "loop")])
        wanted -= size
    return Walk(truth, graph, true_loops)


def ate_m(T_world_node: dict[int, Transform], truth: Transform) -> float:
    """Return the RMS distance after the best rigid alignment."""
    target = truth[:, :3, 3]
    source = np.array([T_world_node[k][:3, 3] for k in range(len(truth))])
    T_target_source, _ = fit_rigid(target, source)
    return float(np.sqrt(((target - apply(T_target_source, source)) ** 2).sum(axis=1).mean()))


def growth(most: int) -> None:
    """Print solving times against the number of keyframes."""
    sizes = [size for size in (1000, 2000, 5000, 10_000, 20_000) if size <= most]
    whole = walk(max(sizes), lap=1000)
    waiting = {k: [] for k in whole.graph.T_world_node}
    for factor in whole.graph.factors:
        waiting[factor.j].append(factor)
    solver, times_ms, T_world_last = IncrementalSolver(), [], whole.truth[0]
    print(
        "keyframes   loops   update ms: median, 95 %, worst   all poses ms   batch s   ATE m: growing, batch"
    )
    for k, factors in waiting.items():
        if factors:
            T_world_last = T_world_last @ factors[0].T_i_j
        solver.add_node(k, T_world_last)
        solver.add_factors(factors)
        if len(factors) > 1:
            began = process_time()
            solver.update()
            T_world_last = solver.pose_of(k)
            times_ms.append(1e3 * (process_time() - began))
        if k + 1 in sizes:
            show_growth(k + 1, whole, solver, times_ms)


def show_growth(nodes: int, whole: Walk, solver: IncrementalSolver, times_ms: list[float]) -> None:
    """Print one line; update times are those of the last hundred loops."""
    solver.update()
    began = process_time()
    growing = solver.poses()
    read_ms = 1e3 * (process_time() - began)
    graph = PoseGraph()
    for k in range(nodes):
        graph.add_node(k, k, whole.graph.T_world_node[k])
    graph.add_factors(factor for factor in whole.graph.factors if factor.j < nodes)
    began = process_time()
    batch = optimize(graph, GraphConfig()).T_world_node
    batch_s = process_time() - began
    loops = len(graph.factors) - nodes + 1
    recent = np.array(times_ms[-100:]) if times_ms else np.zeros(1)
    truth = whole.truth[:nodes]
    median, most = np.percentile(recent, [50.0, 95.0])
    print(
        f"{nodes:9d} {loops:7d} {median:18.1f} {most:6.1f} {recent.max():7.1f}"
        f" {read_ms:14.1f} {batch_s:9.2f} {ate_m(growing, truth):17.3f} {ate_m(batch, truth):7.3f}",
        flush=True,
    )


def false_loops(seeds: int) -> None:
    """Print what false loops do to the ATE, over all seeds."""
    print("nodes  laps  too confident  cluster  false  ATE m  change: median, worst  true, false kept  CPU s")
    for nodes, lap in ((200, 100), (600, 200), (600, 520)):
        for too_confident in (1.0, 5.0):
            honest = []
            for share, cluster in ((0.0, 1), *((s, c) for c in (1, 5) for s in (0.05, 0.2, 0.5))):
                show_false_loops(
                    nodes, lap, share, cluster=cluster, factor=too_confident, honest=honest, seeds=seeds
                )


def show_false_loops(
    nodes: int, lap: int, share: float, *, cluster: int, factor: float, honest: list[float], seeds: int
) -> None:
    """Print one line; without false loops, note the ATE of every seed instead of comparing."""
    errors, kept, seconds = [], np.zeros(4, int), 0.0
    for seed in range(seeds):
        case = walk(nodes, lap=lap, seed=seed, false_share=share, cluster=cluster, too_confident=factor)
        began = process_time()
        solution = optimize(case.graph, GraphConfig())
        seconds += process_time() - began
        errors.append(ate_m(solution.T_world_node, case.truth))
        believed = np.array(solution.weights[nodes - 1 :]) > 0.5
        true, false = believed[: case.true_loops], believed[case.true_loops :]
        kept += [true.sum(), len(true), false.sum(), len(false)]
    if share == 0.0:
        honest[:] = errors
    change = 100.0 * (np.array(errors) / honest - 1.0)
    print(
        f"{nodes:5d} {nodes / lap:5.2f} {factor:14g} {cluster:8d} {share:6.0%} {np.median(errors):6.3f}"
        f" {np.median(change):14.1f} % {change.max():5.1f} % {kept[0]:5d}/{kept[1]:<5d}"
        f" {kept[2]:4d}/{kept[3]:<5d} {seconds / seeds:6.2f}",
        flush=True,
    )


def main() -> None:
    """Run one of the two."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", choices=["growth", "false-loops"])
    parser.add_argument("--most", type=int, default=10_000, help="keyframes of the longest graph")
    parser.add_argument("--seeds", type=int, default=20)
    arguments = parser.parse_args()
    growth(arguments.most) if arguments.what == "growth" else false_loops(arguments.seeds)


if __name__ == "__main__":
    main()
