"""Places that several runs share: keyframes of one run recognised and measured in another."""

from collections import Counter, defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Generic, NamedTuple

from mapper.core.errors import RunError
from mapper.core.geometry import Transform
from mapper.loops.base import Place, Proposal, Proposer, verify_proposal
from mapper.loops.closure import LoopClosure, has_moved
from mapper.loops.config import (
    ImageVerificationConfig,
    PlaceLoopsConfig,
    ScanLoopsConfig,
    ScanVerificationConfig,
)
from mapper.loops.factory import build_similarity_proposer, build_verifier
from mapper.loops.map_constraints import KnownPlaces
from mapper.loops.place_file import AnyPlace
from mapper.runtime.executor import IN_PROCESS, Failure, Workers, make_executor, run_jobs
from mapper.runtime.progress import SILENT, Progress

_MOST_SIMILAR = 12
"""Places that are proposed for a keyframe, of all earlier runs."""
_MAX_COMPARED, _MAX_COMPARED_IN_RUN = 300, 60
"""Pairs of places that are compared for each run, with all earlier runs and with any one of them."""


@dataclass(frozen=True, slots=True, eq=False)
class SharedPlace:
    """A keyframe of a run that was measured from a place of an earlier run.

    Attributes:
        first: Number of the earlier run.
        second: Number of the run whose keyframe it is.
        T_first_place: (4, 4) pose of the place in the earlier run's world.
        T_first_body: (4, 4) pose of the keyframe in the earlier run's world, as measured.
        T_second_body: (4, 4) the same in its own run's world.
        loop: The measurement, accepted; i is the place's node in the earlier run, j that of the keyframe in
            its own.
    """

    first: int
    second: int
    T_first_place: Transform
    T_first_body: Transform
    T_second_body: Transform
    loop: LoopClosure


def shared_place(
    first: int,
    second: int,
    loop: LoopClosure,
    T_first_node: Mapping[int, Transform],
    T_second_node: Mapping[int, Transform],
) -> SharedPlace:
    """Return the place of an accepted loop between two runs.

    Args:
        first: Number of the earlier run.
        second: Number of the run whose keyframe was recognised.
        loop: Loop from a node i of the earlier run to a node j of the other.
        T_first_node: (4, 4) poses of the earlier run's nodes in its world.
        T_second_node: (4, 4) poses of the other's.
    """
    assert loop.T_i_j is not None  # it was accepted
    T_first_place = T_first_node[loop.i]
    T_first_body = T_first_place @ loop.T_i_j
    return SharedPlace(first, second, T_first_place, T_first_body, T_second_node[loop.j], loop)


def find_shared_places(
    runs: Sequence[KnownPlaces[Any]],
    config: PlaceLoopsConfig | ScanLoopsConfig,
    *,
    searched: int = 0,
    workers: Workers = IN_PROCESS,
    progress: Progress = SILENT,
) -> list[SharedPlace]:
    """Return the places of runs that were recognised in earlier ones, as measured: some may be false.

    All runs' places are in one index, and for each run a limited number of pairs is verified, as loops are,
    the most similar first. So verification grows with the number of runs, not with its square.

    Args:
        runs: Their places, each in its own world; one run may have none.
        config: Settings by which places are proposed and verified.
        searched: This number of the first runs are not searched in each other: what they share is known.
        workers: Workers that verify pairs, a job for any two runs.
        progress: Receives how many runs are searched, and how many pairs of runs verified.

    Raises:
        ConfigError: The places cannot be recognised by similarity, or the scheduler does not answer.
        RunError: A job failed twice.
    """
    first = next((place for run in runs for place in run.places.values()), None)
    if first is None:
        return []
    search = _Search(config, build_similarity_proposer(config, first, most=_MOST_SIMILAR))
    pairs = list[_Pair]()
    with progress.stage("places") as report:
        for number, run in enumerate(runs):
            pairs += search.add(run, is_searched=number >= searched)
            report(number + 1, len(runs))
    loops = _verified(pairs, runs, config, workers, progress)
    T_map_nodes = [run.T_map_node for run in runs]
    return [
        shared_place(pair.first, pair.second, loop, T_map_nodes[pair.first], T_map_nodes[pair.second])
        for pair, loop in zip(pairs, loops, strict=True)
        if loop.verdict == "accepted"
    ]


class _Pair(NamedTuple):
    """A keyframe of a run, and a place of an earlier one with which it is compared.

    Attributes:
        first: Number of the earlier run.
        second: Number of the run.
        proposal: Proposal of the place.
        node: Node of the keyframe.
    """

    first: int
    second: int
    proposal: Proposal
    node: int


def _verified(
    pairs: Sequence[_Pair],
    runs: Sequence[KnownPlaces[Any]],
    config: PlaceLoopsConfig | ScanLoopsConfig,
    workers: Workers,
    progress: Progress,
) -> list[LoopClosure]:
    """Return the loop closure of every pair, accepted or rejected."""
    by_runs = defaultdict[tuple[int, int], list[int]](list)
    for number, pair in enumerate(pairs):
        by_runs[pair.first, pair.second].append(number)
    numbers, jobs = list(by_runs.values()), list[Callable[[], list[LoopClosure]]]()
    for (first, second), some in by_runs.items():
        compared = [
            (pair.proposal, pair.node, runs[first].places[pair.proposal.node], runs[second].places[pair.node])
            for pair in map(pairs.__getitem__, some)
        ]
        jobs.append(partial(_verify_all, config.verification, compared))
    loops = dict[int, LoopClosure]()
    with make_executor(workers, jobs=len(jobs)) as executor, progress.stage("compare") as report:
        for done, (job, found) in enumerate(run_jobs(jobs, executor), start=1):
            if isinstance(found, Failure):
                raise RunError(f"places could not be compared: {found.reason}")
            loops |= zip(numbers[job], found, strict=True)
            report(done, len(jobs))
    return [loops[number] for number in range(len(pairs))]


def _verify_all(
    config: ImageVerificationConfig | ScanVerificationConfig,
    compared: Sequence[tuple[Proposal, int, AnyPlace, AnyPlace]],
) -> list[LoopClosure]:
    """Return the loop closures of keyframes with places, given as for ``verify_proposal``."""
    verifier = build_verifier(config)
    return [verify_proposal(proposal, node, i, j, verifier) for proposal, node, i, j in compared]


class _Candidate(NamedTuple):
    """A pair of places to be compared, the smallest first.

    Attributes:
        rank: Number of more similar places that the earlier run has for the keyframe. Each keyframe is
            compared with the most similar one before any is with another: pairs lie along the whole path.
        dissimilarity: Similarity with its sign changed.
        node: Node of the keyframe.
        place: Number of the earlier run's place in the index.
        proposal: Proposal of that place.
    """

    rank: int
    dissimilarity: float
    node: int
    place: int
    proposal: Proposal


class _Search(Generic[Place]):
    """The places of the runs so far, in which those of the next are searched."""

    def __init__(self, config: PlaceLoopsConfig | ScanLoopsConfig, proposer: Proposer[Place]) -> None:
        self._config = config
        self._proposer = proposer
        self._runs = 0
        self._known: list[tuple[int, int]] = []

    def add(self, run: KnownPlaces[Place], *, is_searched: bool) -> list[_Pair]:
        """Add a run's places; if it is searched, return the pairs to be compared, the likeliest first."""
        before, number, last = len(self._known), self._runs, None
        self._runs += 1
        candidates = list[_Candidate]()
        for node, place in run.places.items():
            T_map_node = run.T_map_node[node]
            if is_searched and (last is None or has_moved(last, T_map_node, self._config)):
                last = T_map_node
                ranks = Counter[int]()
                for proposal in self._proposer.propose(node, place, before=before, limit=_MOST_SIMILAR):
                    first, _ = self._known[proposal.node]
                    rank = ranks[first], -(proposal.similarity or 0.0), node, proposal.node
                    candidates.append(_Candidate(*rank, proposal))
                    ranks[first] += 1
            self._proposer.add(len(self._known), place)
            self._known.append((number, node))
        compared, chosen = Counter[int](), list[_Pair]()
        for candidate in sorted(candidates):
            first, known = self._known[candidate.proposal.node]
            if compared[first] < _MAX_COMPARED_IN_RUN:
                compared[first] += 1
                chosen.append(_Pair(first, number, replace(candidate.proposal, node=known), candidate.node))
        return chosen[:_MAX_COMPARED]
