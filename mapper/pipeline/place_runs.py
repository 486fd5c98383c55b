"""Placing runs by the places that they share: no common truth or world is needed."""

from collections.abc import Sequence
from typing import Any

from mapper.core.errors import RunError
from mapper.loops.map_constraints import KnownPlaces
from mapper.loops.shared_places import find_shared_places
from mapper.merging.placing import Placed, Placing
from mapper.merging.placing_by_places import solve_worlds
from mapper.pipeline.known_map import detector_of, loops_between_days, run_places, sensor_of
from mapper.run.folder import Run
from mapper.runtime.progress import SILENT, Progress

_FIRST = "first"
_UNKNOWN = "no place of it was recognised in the others"


def place_by_shared_places(runs: Sequence[Run], *, progress: Progress = SILENT) -> Placing:
    """Place runs in the world of the first by the places that they share, over other runs where need be.

    The runs' keyframes are recognised in each other as a log's are in a finished map; their own maps stay as
    they are, and each run is placed as a rigid body. Places of all runs are held in memory.

    Args:
        runs: At least one; the first must have places. A run of before places were stored has them observed
            again from its log.
        progress: Receives stages and notes.

    Returns:
        The first run and those that are tied to it, and why the others are not.

    Raises:
        RunError: Nothing ties any other run to the first, or the first has no places.
        ConfigError: The first run's places cannot be recognised by similarity.
    """
    first, known = runs[0], [run_places(run, progress=progress) for run in runs]
    if not known[0].places:
        raise RunError(
            f"{first.path}: no keyframe of it can be recognised; build it with loops.kind=places or scans"
        )
    loops = loops_between_days(first.config.loops, sensor_of(known[0]))
    unfit = {number: reason for number in range(len(runs)) if (reason := _unfit(runs, known, number))}
    fit = [KnownPlaces({}, {}) if number in unfit else places for number, places in enumerate(known)]
    shared = find_shared_places(fit, loops, progress=progress)
    solved = solve_worlds(shared, loops.gate)
    worlds = solved.worlds
    reasons = dict.fromkeys(range(len(runs)), _UNKNOWN) | dict(solved.refused) | unfit
    left_out = {str(run.path): reasons[number] for number, run in enumerate(runs) if number not in worlds}
    if len(runs) > 1 and len(worlds) == 1:
        why = "; ".join(f"{path}: {reason}" for path, reason in left_out.items())
        raise RunError(
            f"{first.path}: no other run is tied to it by places that both have seen ({why}); "
            "are they of one place? Else give --poses"
        )
    placed = [
        Placed(
            runs[number],
            world.T_map_world,
            f"by {world.places} places, RMS {world.rms_m:.2g} m" if number else _FIRST,
        )
        for number, world in worlds.items()
    ]
    doubts = [
        f"{runs[first].path} and {runs[second].path}: the places that they share contradict those that they "
        "share with other runs, and were not used"
        for first, second in solved.contradicting
    ]
    return Placing(placed, left_out, doubts)


def _unfit(runs: Sequence[Run], known: Sequence[KnownPlaces[Any]], number: int) -> str:
    """Return why a run's places cannot be compared with those of the first; empty if they can."""
    if not known[number].places:
        return "no keyframe of it can be recognised; build it with loops.kind=places or scans"
    if sensor_of(known[number]) != sensor_of(known[0]):
        return f"is of sensor {sensor_of(known[number])}, and the first run of {sensor_of(known[0])}"
    if detector_of(runs[number].config) != detector_of(runs[0].config):
        return "its features are by another odometry.detector than those of the first run"
    return ""
