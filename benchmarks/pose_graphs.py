"""Published pose graphs: final cost, and time compared with GTSAM's own Levenberg–Marquardt.

    python benchmarks/pose_graphs.py [--data ../shared/data/posegraph] [--only sphere2500 …]

Both start from the file's estimates and stop when an iteration gains less than 1e-8 of the error. Times are
CPU seconds of solving without reading the file; ours includes everything from a ``PoseGraph`` to its
``Solution``, also the initial poses and every factor's error. ``GraphConfig(robust="none")``, otherwise
defaults.
"""

import argparse
import json
from pathlib import Path
from time import process_time

import gtsam

from mapper.graph.config import GraphConfig
from mapper.graph.g2o import read_g2o
from mapper.graph.optimize import optimize

CONFIG = GraphConfig(robust="none")
ANCHOR_SIGMA = 1e-3


def gtsam_plain(path: Path, *, planar: bool) -> tuple[float, int, float]:
    """Return cost, iterations and CPU seconds of a plain LevenbergMarquardtOptimizer."""
    graph, values = gtsam.readG2o(str(path), not planar)
    problem = gtsam.NonlinearFactorGraph(graph)
    first = min(values.keys())
    noise = gtsam.noiseModel.Isotropic.Sigma(3 if planar else 6, ANCHOR_SIGMA)
    if planar:
        problem.add(gtsam.PriorFactorPose2(first, values.atPose2(first), noise))
    else:
        problem.add(gtsam.PriorFactorPose3(first, values.atPose3(first), noise))
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setMaxIterations(200)
    parameters.setRelativeErrorTol(CONFIG.relative_error)
    began = process_time()
    optimizer = gtsam.LevenbergMarquardtOptimizer(problem, values, parameters)
    optimizer.optimize()
    return optimizer.error(), optimizer.iterations(), process_time() - began


def main() -> None:
    """Print one line per graph."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, default=Path("../shared/data/posegraph"))
    parser.add_argument("--published", type=Path, default=Path("../shared/reference/published.json"))
    parser.add_argument("--only", nargs="*")
    arguments = parser.parse_args()
    published = json.loads(arguments.published.read_text())["pose_graphs"]
    best_of = {
        name: dict(zip(published["columns"], row, strict=True)) for name, row in published["rows"].items()
    }

    print("graph            best known        ours   off by  its   CPU s |  plain LM   its   CPU s |  ratio")
    for name, row in best_of.items():
        if arguments.only and name not in arguments.only:
            continue
        path, best = arguments.data / f"{name}.g2o", row["gtsam_best"]
        planar = "VERTEX_SE2" in path.read_text()
        graph = read_g2o(path)
        began = process_time()
        solution = optimize(graph, CONFIG)
        ours_s = process_time() - began
        cost, iterations, theirs_s = gtsam_plain(path, planar=planar)
        print(
            f"{name:15} {best:11.7g} {solution.error_after:11.7g} {solution.error_after / best - 1:8.1e}"
            f" {solution.iterations:4d} {ours_s:7.2f} | {cost:9.7g} {iterations:5d} {theirs_s:7.2f} |"
            f" {theirs_s / ours_s:6.1f}×",
            flush=True,
        )


if __name__ == "__main__":
    main()
