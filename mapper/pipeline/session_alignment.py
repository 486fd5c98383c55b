"""Placing runs by the places that they share: no common truth or world is needed."""

from bisect import bisect_right
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from mapper.core.errors import RunError
from mapper.core.geometry import inverse
from mapper.loops.closure import read_closures
from mapper.loops.inter_session_loops import SharedPlace, find_shared_places, shared_place
from mapper.loops.map_constraints import KnownPlaces
from mapper.merging.merged_map import MergedMap
from mapper.merging.multi_session_graph import JointGraph, SolvedWorlds, solve_jointly, solve_worlds
from mapper.merging.world_poses import Placed, Placing, fit_poses
from mapper.pipeline.known_map import WITHOUT_PLACES, detector_of, loops_between_days, run_places, sensor_of
from mapper.run import files
from mapper.run.folder import Run
from mapper.run.stored_tracking import load_tracking
from mapper.runtime.executor import IN_PROCESS, Workers
from mapper.runtime.progress import SILENT, Progress

_FIRST = "first"
_UNKNOWN = "no place of it was recognised in the others"
_REJECTED = "the joint graph contradicts all places that it shares with the others"


def place_by_shared_places(
    runs: Sequence[Run], *, workers: Workers = IN_PROCESS, progress: Progress = SILENT
) -> Placing:
    """Place runs in the world of the first by the places that they share, over other runs where need be.

    The runs' keyframes are recognised in each other as a log's are in a finished map; their own maps stay as
    they are, and each run is placed as a rigid body. Places of all runs are held in memory.

    Args:
        runs: Runs, at least one; the first must have places. A run whose stored places were deleted
            has them observed again from its log.
        workers: Workers that compare places.
        progress: Receives stages and notes.

    Returns:
        The first run and those that are tied to it, and why the others are not.

    Raises:
        RunError: Nothing ties any other run to the first, or the first has no places.
        ConfigError: The first run's places cannot be recognised by similarity.
    """
    found = _recognised(runs, workers, progress)
    placed = [
        Placed(
            runs[number],
            world.T_map_world,
            f"by {world.places} places, RMS {world.rms_m:.2g} m" if number else _FIRST,
        )
        for number, world in found.solved.worlds.items()
    ]
    return Placing(placed, found.left_out(runs), found.warnings(runs))


def place_jointly(
    runs: Sequence[Run],
    *,
    known: MergedMap | None = None,
    workers: Workers = IN_PROCESS,
    progress: Progress = SILENT,
) -> Placing:
    """Place runs by one pose graph over all their keyframes, so that each bends where it had drifted.

    The poses of ``place_by_shared_places`` are the first estimate. The loops between runs are those places
    that agree with it; graduated non-convexity rejects outliers among them and the runs' own loops. The world
    of the first run is the map's, and its first node is held. Every other world lies where the run's solved
    keyframes are nearest to where they were in it; what is left is the bend.

    Args:
        runs: Runs, at least one; the first must have places.
        known: A map of the first of these runs by a joint graph: they are not searched in each other again.
        workers: Workers that compare places.
        progress: Receives stages and notes.

    Returns:
        The first run and those that loops which hold tie to it, and why the others are not.

    Raises:
        RunError: Nothing ties any other run to the first, or the first has no places.
        ConfigError: The first run's places cannot be recognised by similarity.
        GraphError: The joint graph cannot be solved.
    """
    found = _recognised(runs, workers, progress, () if known is None else _measured_in(known, runs), known)
    worlds = found.solved.worlds
    used = set(map(id, found.solved.used))
    joint = solve_jointly(
        {number: runs[number].graph for number in worlds},
        {number: world.T_map_world for number, world in worlds.items()},
        found.solved.used,
        [place for place in found.shared if id(place) not in used],
        runs[0].config.graph,
    )
    left_out = found.left_out(runs) | {
        str(runs[number].path): _REJECTED for number in worlds if number not in joint.first_nodes
    }
    warnings = found.warnings(runs)
    if joint.own_rejected:
        warnings.append(f"the joint graph rejected {joint.own_rejected} loops that single runs had accepted")
    held = Counter[int]()
    for tie in joint.ties:
        held.update(dict.fromkeys((tie.first, tie.second), tie.held))
    placed = [
        _placed(runs[number], number, joint, held[place]) for place, number in enumerate(joint.first_nodes)
    ]
    _refuse_alone(runs, len(placed), left_out)
    return Placing(placed, left_out, warnings, joint)


def _placed(run: Run, number: int, joint: JointGraph, held: int) -> Placed:
    """Return a run with its world where its solved keyframes lie nearest to where they were in it."""
    T_map_node, graph = joint.poses_of(number), run.graph
    T_map_world = np.eye(4)
    if number:
        T_map_world = fit_poses(np.array(list(T_map_node.values())), graph.poses)
    T_world_map = inverse(T_map_world)
    moved = {node: T_world_map @ T for node, T in T_map_node.items()}
    solved = load_tracking(run).solved(graph.with_poses(moved), run.loops)
    return Placed(run, T_map_world, f"by {held} loops" if number else _FIRST, solved.trajectory)


@dataclass(frozen=True, slots=True, eq=False)
class _Recognised:
    """Places that runs share, and the poses of their worlds by these.

    Attributes:
        shared: All that were measured.
        solved: The poses.
        unfit: Why some runs cannot be compared with the first, by number.
    """

    shared: Sequence[SharedPlace]
    solved: SolvedWorlds
    unfit: Mapping[int, str]

    def left_out(self, runs: Sequence[Run]) -> dict[str, str]:
        """Return why each run that is not placed is not, by its path."""
        reasons = dict.fromkeys(range(len(runs)), _UNKNOWN) | dict(self.solved.refused) | dict(self.unfit)
        return {
            str(run.path): reasons[number]
            for number, run in enumerate(runs)
            if number not in self.solved.worlds
        }

    def warnings(self, runs: Sequence[Run]) -> list[str]:
        """Return what is suspicious about the shared places, a line each."""
        return [
            f"{runs[first].path} and {runs[second].path}: the places that they share contradict those that "
            "they share with other runs, and were not used"
            for first, second in self.solved.contradicting
        ]


def _measured_in(known: MergedMap, runs: Sequence[Run]) -> list[SharedPlace]:
    first_nodes = [member.first_node or 0 for member in known.manifest.runs]
    places = []
    for loop in read_closures(known.path / files.LOOPS):
        first, second = (bisect_right(first_nodes, node) - 1 for node in (loop.i, loop.j))
        measured = replace(
            loop,
            i=loop.i - first_nodes[first],
            j=loop.j - first_nodes[second],
            verdict="accepted",
            reason="",
            before=None,
            after=None,
            weight=None,
        )
        T_worlds = runs[first].graph.T_world_node, runs[second].graph.T_world_node
        places.append(shared_place(first, second, measured, *T_worlds))
    return places


def _recognised(
    runs: Sequence[Run],
    workers: Workers,
    progress: Progress,
    measured: Sequence[SharedPlace] = (),
    known_map: MergedMap | None = None,
) -> _Recognised:
    """Recognise and measure the runs' keyframes in each other, but for those of a known map.

    Raises:
        RunError: Nothing ties any other run to the first, or the first has no places.
    """
    first, known = runs[0], [run_places(run, progress=progress) for run in runs]
    if not known[0].places:
        raise RunError(f"{first.path}: {WITHOUT_PLACES}")
    loops = loops_between_days(first.config.loops, sensor_of(known[0]))
    unfit = {number: reason for number in range(len(runs)) if (reason := _unfit(runs, known, number))}
    fit = [KnownPlaces({}, {}) if number in unfit else places for number, places in enumerate(known)]
    searched = 0 if known_map is None else len(known_map.manifest.runs)
    new = find_shared_places(fit, loops, searched=searched, workers=workers, progress=progress)
    shared = [*measured, *new]
    found = _Recognised(shared, solve_worlds(shared, loops.gate), unfit)
    _refuse_alone(runs, len(found.solved.worlds), found.left_out(runs))
    return found


def _refuse_alone(runs: Sequence[Run], placed: int, left_out: Mapping[str, str]) -> None:
    if len(runs) > 1 and placed == 1:
        why = "; ".join(f"{path}: {reason}" for path, reason in left_out.items())
        raise RunError(
            f"{runs[0].path}: no other run is tied to it by places that both have seen ({why}); "
            "are they of one place? Else give --poses"
        )


def _unfit(runs: Sequence[Run], known: Sequence[KnownPlaces[Any]], number: int) -> str:
    """Return why a run's places cannot be compared with those of the first; empty if they can."""
    if not known[number].places:
        return WITHOUT_PLACES
    if sensor_of(known[number]) != sensor_of(known[0]):
        return f"is of sensor {sensor_of(known[number])}, and the first run of {sensor_of(known[0])}"
    if detector_of(runs[number].config) != detector_of(runs[0].config):
        return "its features are by another odometry.detector than those of the first run"
    return ""
