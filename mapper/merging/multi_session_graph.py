"""Poses of runs in one map by the places that they share: as rigid bodies, then in one pose graph of all.

The joint graph has all runs' keyframes, their own factors, and the loops between them.
"""

from bisect import bisect_right
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, pairwise

import numpy as np
from numpy.typing import NDArray

from mapper.core.config import Config
from mapper.core.geometry import Array, Transform, adjoint, inverse, length_and_angle
from mapper.graph.components import components
from mapper.graph.config import GraphConfig
from mapper.graph.model import BetweenFactor, PoseGraph, PoseSigmas
from mapper.graph.optimize import optimize
from mapper.loops.closure import (
    LEAST_AGREEING,
    MIN_WEIGHT,
    Discrepancy,
    LoopClosure,
    accepted_loops,
    apply_solution,
    discrepancy,
    exceeds,
    pose_difference,
)
from mapper.loops.config import SLACK_RAD, GateConfig
from mapper.loops.inter_session_loops import SharedPlace
from mapper.loops.odometry_drift import NodePath, allowed

_LEAST_LEAD = 2.0
"""Least ratio of the places that agree with the best pose to those that agree with any other: where rooms
look alike, a run may fit in several."""
_TIED_APART = "shares places only with runs that nothing ties to the first"


@dataclass(frozen=True, slots=True, eq=False)
class WorldByPlaces:
    """Pose of a run's world in the first run's, by shared places.

    Attributes:
        T_map_world: (4, 4).
        places: Number of shared places by which it lies there.
        rms_m: Root mean square distance of the two poses of their keyframes.
    """

    T_map_world: Transform
    places: int
    rms_m: float


@dataclass(frozen=True, slots=True, eq=False)
class SolvedWorlds:
    """Runs placed by the places that they share; runs are known by their numbers.

    Attributes:
        worlds: Poses of run 0 and of the runs tied to it, by number.
        refused: A reason for every run that shares places and is not tied to another by them.
        contradicting: Pairs of runs whose shared places were not used, as stronger ones contradict them.
        used: The shared places by which they lie there, those of a pair together.
    """

    worlds: Mapping[int, WorldByPlaces]
    refused: Mapping[int, str]
    contradicting: Sequence[tuple[int, int]]
    used: Sequence[SharedPlace]


def solve_worlds(shared: Sequence[SharedPlace], gate: GateConfig) -> SolvedWorlds:
    """Return the poses of the runs that shared places tie to run 0.

    Two runs are tied by the largest set of shared places that agree with one of them. The strongest ties make
    a spanning tree of the runs; every other tie closes a cycle of the tree, and has to agree with it. Then
    all runs are solved together, each as a rigid body, by least squares over their places. Run 0 is held.

    Args:
        shared: Shared places as measured; some may be false.
        gate: Largest disagreement of two places, by the distance between them: the drift within a run.
    """
    pairs = defaultdict[tuple[int, int], list[SharedPlace]](list)
    for place in shared:
        pairs[place.first, place.second].append(place)
    ties, refused = dict[tuple[int, int], list[SharedPlace]](), dict[int, str]()
    for pair, places in sorted(pairs.items()):
        agreeing, reason = _find_consensus(places, gate)
        if not reason:
            ties[pair] = agreeing
        for number in pair:
            refused[number] = refused.get(number, reason) if reason else _TIED_APART
    tree = _spanning_tree(ties)
    tied = {pair: places for pair, places in ties.items() if pair[0] in tree.T_map_worlds}
    contradicting = [pair for pair in tied if pair not in tree.pairs and not tree.agrees(pair, ties, gate)]
    used = [place for pair, places in tied.items() if pair not in contradicting for place in places]
    T_map_worlds = _solve(tree.T_map_worlds, used, gate) if used else tree.T_map_worlds
    worlds = {number: _measure_residuals(number, T_map_worlds, used) for number in sorted(T_map_worlds)}
    return SolvedWorlds(worlds, refused, contradicting, used)


def _find_consensus(places: Sequence[SharedPlace], gate: GateConfig) -> tuple[list[SharedPlace], str]:
    """Return the places that agree on the pose of one run in the other, or why they do not tie the two."""
    agree = _agreement(places, gate)
    best = int(agree.sum(axis=1).argmax())
    inside = agree[best]
    agreeing = [place for place, is_inside in zip(places, inside, strict=True) if is_inside]
    if len(agreeing) < LEAST_AGREEING:
        return [], f"{len(agreeing)} of {len(places)} places agree, want {LEAST_AGREEING}"
    rival = int(agree[~inside][:, ~inside].sum(axis=1).max(initial=0))
    if len(agreeing) < _LEAST_LEAD * rival:
        return [], f"{len(agreeing)} places agree on one pose and {rival} on another: places look alike"
    in_first, in_second = zip(
        *((place.T_first_place, place.T_second_body) for place in agreeing), strict=True
    )
    if not (_are_several(in_first, gate) and _are_several(in_second, gate)):
        return [], f"the {len(agreeing)} places that agree are one place"
    return agreeing, ""


def _agreement(places: Sequence[SharedPlace], gate: GateConfig) -> NDArray[np.bool_]:
    """Return (N, N) whether two places have the same relative pose in both runs, within the drift between."""
    agree = np.eye(len(places), dtype=bool)
    for (a, one), (b, other) in combinations(enumerate(places), 2):
        in_second = inverse(one.T_second_body) @ other.T_second_body
        limits = allowed(gate, NodePath(*length_and_angle(in_second)))
        miss = discrepancy(in_second, one.T_first_body, other.T_first_body)
        agree[a, b] = agree[b, a] = not exceeds(miss, limits)
    return agree


def _are_several(T_world_bodies: Sequence[Transform], gate: GateConfig) -> bool:
    same = Discrepancy(gate.slack_m, SLACK_RAD)
    first = T_world_bodies[0]
    return any(exceeds(pose_difference(first, other), same) for other in T_world_bodies[1:])


@dataclass(frozen=True, slots=True, eq=False)
class _SpanningTree:
    """Spanning tree of the runs by their strongest ties, with run 0 as its root.

    Attributes:
        T_map_worlds: (4, 4) poses of the runs' worlds in that of run 0.
        parents: Parent of every run but run 0.
    """

    T_map_worlds: Mapping[int, Transform]
    parents: Mapping[int, int]

    @property
    def pairs(self) -> set[tuple[int, int]]:
        """Ties of the tree."""
        return {(min(pair), max(pair)) for pair in self.parents.items()}

    def agrees(
        self,
        pair: tuple[int, int],
        ties: Mapping[tuple[int, int], Sequence[SharedPlace]],
        gate: GateConfig,
    ) -> bool:
        """Return whether most places of a pair lie where the tree has them, within the drift of its cycle.

        That is the drift along a path that leads from place to place through the runs of the cycle.
        """
        cycle = [self._bodies_map(ties[step])[:, :3, 3] for step in self._path(*pair)]
        agreeing = 0
        for place in ties[pair]:
            T_map_first, T_map_second = (self.T_map_worlds[number] for number in pair)
            T_map_body = T_map_second @ place.T_second_body
            begin_m = at_m = T_map_body[:3, 3]
            path_m = 0.0
            for places_m in cycle:
                next_m = places_m[np.linalg.norm(places_m - at_m, axis=1).argmin()]
                path_m, at_m = path_m + float(np.linalg.norm(next_m - at_m)), next_m
            path = NodePath(path_m + float(np.linalg.norm(begin_m - at_m)), 0.0)
            miss = pose_difference(T_map_first @ place.T_first_body, T_map_body)
            agreeing += not exceeds(miss, allowed(gate, path))
        return 2 * agreeing > len(ties[pair])

    def _bodies_map(self, places: Sequence[SharedPlace]) -> Array:
        return np.array([self.T_map_worlds[place.second] @ place.T_second_body for place in places])

    def _path(self, first: int, second: int) -> list[tuple[int, int]]:
        """Return the tree's ties on the path from the second run to the first."""
        up, down = (self._to_root(number) for number in (second, first))
        steps = [step for step in up if step not in down]
        steps += reversed([step for step in down if step not in up])
        return [(min(step), max(step)) for step in steps]

    def _to_root(self, number: int) -> list[tuple[int, int]]:
        runs = [number]
        while runs[-1] in self.parents:
            runs.append(self.parents[runs[-1]])
        return list(pairwise(runs))


def _spanning_tree(ties: Mapping[tuple[int, int], Sequence[SharedPlace]]) -> _SpanningTree:
    """Return the maximum spanning tree from run 0 (Prim 1957): a tie is as strong as it has places."""
    T_map_worlds, parents = {0: np.eye(4)}, dict[int, int]()
    by_strength = sorted(ties, key=lambda pair: (-len(ties[pair]), pair))
    while pair := next((p for p in by_strength if (p[0] in T_map_worlds) != (p[1] in T_map_worlds)), None):
        first, second = pair
        middle = ties[pair][len(ties[pair]) // 2]
        T_first_second = middle.T_first_body @ inverse(middle.T_second_body)
        if first in T_map_worlds:
            T_map_worlds[second], parents[second] = T_map_worlds[first] @ T_first_second, first
        else:
            T_map_worlds[first], parents[first] = T_map_worlds[second] @ inverse(T_first_second), second
    return _SpanningTree(T_map_worlds, parents)


def _solve(
    T_map_worlds: Mapping[int, Transform], places: Sequence[SharedPlace], gate: GateConfig
) -> dict[int, Transform]:
    at_body = PoseSigmas(SLACK_RAD, gate.slack_m).information
    factors = []
    for place in places:
        to_body = adjoint(inverse(place.T_second_body))
        T_first_second = place.T_first_body @ inverse(place.T_second_body)
        information = to_body.T @ at_body @ to_body
        factors.append(BetweenFactor(place.first, place.second, T_first_second, information))
    graph = PoseGraph(dict(sorted(T_map_worlds.items())), dict.fromkeys(T_map_worlds, 0), factors)
    solution = optimize(graph, GraphConfig(robust="none"))
    return solution.T_world_node | {0: np.eye(4)}  # held but for rounding


def _measure_residuals(
    number: int, T_map_worlds: Mapping[int, Transform], places: Sequence[SharedPlace]
) -> WorldByPlaces:
    """Return the pose of a run's world with the residuals of the places that it shares with any other."""
    misses_m = [
        pose_difference(
            T_map_worlds[place.first] @ place.T_first_body,
            T_map_worlds[place.second] @ place.T_second_body,
        ).translation_m
        for place in places
        if number in (place.first, place.second)
    ]
    rms_m = float(np.sqrt(np.mean(np.square(misses_m)))) if misses_m else 0.0
    return WorldByPlaces(T_map_worlds[number], len(misses_m), rms_m)


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
    return _drop_unconnected(found)


def _between(place: SharedPlace, first_nodes: Mapping[int, int]) -> LoopClosure:
    loop = place.loop
    return replace(loop, i=first_nodes[place.first] + loop.i, j=first_nodes[place.second] + loop.j)


def _drop_unconnected(joint: JointGraph) -> JointGraph:
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
