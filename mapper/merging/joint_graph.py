"""One pose graph of many runs: all their keyframes, their own factors, and the loops between them."""

from bisect import bisect_right
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from mapper.core.config import Config
from mapper.core.geometry import Transform
from mapper.graph.components import components
from mapper.graph.config import GraphConfig
from mapper.graph.model import PoseGraph
from mapper.graph.optimize import optimize
from mapper.loops.closure import MIN_WEIGHT, LoopClosure, accepted_loops, apply_solution
from mapper.loops.shared_places import SharedPlace


class Tie(Config):
    """Loops between two runs."""

    first: int
    """Number of the earlier run among those that are in the graph."""
    second: int
    """Number of the later run."""
    measured: int
    """Number of keyframes of the second run that were measured from places of the first."""
    held: int
    """Number of these that are loops of the solved graph."""
    rms_m: float
    """Root mean square distance of a held loop's keyframe from where the loop has it."""
    rms_rad: float
    """The same of its angle."""


@dataclass(frozen=True, slots=True, eq=False)
class JointGraph:
    """All runs' pose graphs as one, at its solution.

    Attributes:
        graph: Pose graph in the map's frame, with the factors that hold.
        first_nodes: Offset of a run's node numbers in the graph, by the run's number; increasing.
        loops: Every place measured between two runs, in the numbers of the joint graph, with its verdict.
        own_rejected: Number of loops within runs that the joint solve rejected.
    """

    graph: PoseGraph
    first_nodes: Mapping[int, int]
    loops: Sequence[LoopClosure]
    own_rejected: int

    def run_of(self, node: int) -> int:
        """Return the number of the run of a joint node."""
        return list(self.first_nodes)[bisect_right(list(self.first_nodes.values()), node) - 1]

    def poses_of(self, number: int) -> dict[int, Transform]:
        """Return the (4, 4) solved poses of a run's nodes, by its own numbers."""
        first = self.first_nodes[number]
        last = min((other for other in self.first_nodes.values() if other > first), default=np.inf)
        nodes = self.graph.T_world_node.items()
        return {node - first: T_map_node for node, T_map_node in nodes if first <= node < last}

    @property
    def ties(self) -> tuple[Tie, ...]:
        """Ties of the pairs of runs that share places."""
        place_of = {number: place for place, number in enumerate(self.first_nodes)}
        by_pair: dict[tuple[int, int], list[LoopClosure]] = {}
        for loop in self.loops:
            pair = place_of[self.run_of(loop.i)], place_of[self.run_of(loop.j)]
            by_pair.setdefault(pair, []).append(loop)
        return tuple(_tie(pair, loops) for pair, loops in sorted(by_pair.items()))


def _tie(pair: tuple[int, int], loops: Sequence[LoopClosure]) -> Tie:
    after = [loop.after for loop in accepted_loops(loops) if loop.after is not None]
    misses = np.array([(miss.translation_m, miss.rotation_rad) for miss in after]).reshape(-1, 2)
    rms_m, rms_rad = np.sqrt((misses**2).mean(axis=0)).tolist() if len(misses) else (0.0, 0.0)
    return Tie(
        first=pair[0],
        second=pair[1],
        measured=len(loops),
        held=len(after),
        rms_m=round(rms_m, 6),
        rms_rad=round(rms_rad, 6),
    )


def solve_jointly(
    graphs: Mapping[int, PoseGraph],
    T_map_worlds: Mapping[int, Transform],
    used: Sequence[SharedPlace],
    others: Sequence[SharedPlace],
    config: GraphConfig,
) -> JointGraph:
    """Return the joint graph at its solution, of the runs that loops which hold connect to the first.

    Every run keeps its factors; loops, its own and those between runs, are weighed together by graduated
    non-convexity. So a run bends where the others show that it drifted, as far as its own factors allow. The
    first node of the first run is held.

    Args:
        graphs: Graph of each run at its own solution, by number; the lowest is the first.
        T_map_worlds: (4, 4) first estimates of their worlds' poses.
        used: Shared places that agree on these poses.
        others: Shared places that do not, which are recorded as rejected.
        config: Settings by which the first run solved its graph.

    Raises:
        GraphError: The graph cannot be solved.
    """
    joint, first_nodes, number_next = PoseGraph(), dict[int, int](), 0
    for number in sorted(graphs):
        graph = graphs[number].moved(T_map_worlds[number])
        first_nodes[number] = number_next
        joint.T_world_node |= {number_next + node: T for node, T in graph.T_world_node.items()}
        joint.stamps_ns |= {number_next + node: stamp_ns for node, stamp_ns in graph.stamps_ns.items()}
        joint.factors += [
            replace(factor, i=number_next + factor.i, j=number_next + factor.j) for factor in graph.factors
        ]
        number_next += 1 + max(graph.T_world_node)
    own = len(joint.factors)
    loops = [_between(place, first_nodes) for place in used]
    joint.add_factors(loop.factor for loop in loops)
    solution = optimize(joint, config.model_copy(update={"solve": "batch", "robust": "gnc"}))
    solved = apply_solution(loops, joint.T_world_node, solution)
    kept = [weight >= MIN_WEIGHT for weight in solution.weights]
    factors = [factor for factor, is_kept in zip(joint.factors, kept, strict=True) if is_kept]
    whole = PoseGraph(solution.T_world_node, joint.stamps_ns, factors)
    refused = [
        loop.rejected("consensus", "disagrees with most places that the two runs share")
        for loop in (
            _between(place, first_nodes) for place in others if {place.first, place.second} <= graphs.keys()
        )
    ]
    found = JointGraph(whole, first_nodes, [*solved, *refused], own - sum(kept[:own]))
    return _connected(found)


def _between(place: SharedPlace, first_nodes: Mapping[int, int]) -> LoopClosure:
    """Return the loop of a shared place in the joint graph's numbers."""
    loop = place.loop
    return replace(loop, i=first_nodes[place.first] + loop.i, j=first_nodes[place.second] + loop.j)


def _connected(joint: JointGraph) -> JointGraph:
    """Return the graph without the runs of which a node is not connected to the first run."""
    first, *others = components(joint.graph)
    if not others:
        return joint
    apart = {joint.run_of(node) for nodes in others for node in nodes}
    apart.discard(joint.run_of(first[0]))  # a run that has fallen apart itself stays as it was
    nodes = {node for node in joint.graph.T_world_node if joint.run_of(node) not in apart}
    first_nodes = {number: first for number, first in joint.first_nodes.items() if number not in apart}
    loops = [loop for loop in joint.loops if loop.i in nodes and loop.j in nodes]
    return replace(joint, graph=joint.graph.part(nodes), first_nodes=first_nodes, loops=loops)
