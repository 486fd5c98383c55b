"""Finished maps in which a new log can be localised: runs, and merged maps of runs."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mapper.config.build import BuildConfig
from mapper.core.config import Config
from mapper.core.errors import RunError
from mapper.core.frames import Sensor
from mapper.core.geometry import Transform
from mapper.features.frame_view import ImageView
from mapper.loops.config import AnyLoops, PlaceLoopsConfig, ScanLoopsConfig
from mapper.loops.factory import build_verifier, keyframe_loops
from mapper.loops.map_constraints import KnownPlaces
from mapper.loops.place_file import AnyPlace, read_places
from mapper.merging import open_map_folder
from mapper.merging.merged_map import MergedMap
from mapper.merging.runs_in_map import runs_of
from mapper.octree.grid import OccupancyGrid
from mapper.pipeline.reobserve import reobserve
from mapper.run import files
from mapper.run.folder import Run
from mapper.runtime.progress import SILENT, Progress

_MAX_MOVED_RATIO = 0.14
"""Least ``max_moved_ratio`` of scans: the map was made on another day."""


WITHOUT_PLACES = "no keyframe of it can be recognised; build it with loops.kind=places or scans"
"""What is said of a run without places."""


@dataclass(frozen=True, slots=True, eq=False)
class KnownMap:
    """A finished map with what its places are recognised by.

    Attributes:
        path: Folder of the run or of the merged map.
        slice: Its 2D navigation map.
        config: Settings by which its places were observed: those of its first run.
        places: Places of all of its runs, in the map's frame.
    """

    path: Path
    slice: OccupancyGrid
    config: BuildConfig
    places: KnownPlaces[Any]

    @property
    def sensor(self) -> Sensor:
        """Sensor by which its places were seen."""
        return sensor_of(self.places)


def load_known_map(path: Path, *, progress: Progress = SILENT) -> KnownMap:
    """Return a run, or a merged map whose runs are still there, with its places.

    A run whose stored places a user deleted has them observed again from its log.

    Raises:
        RunError: There is no such map, it has no places, its runs have changed or were observed by other
            settings, or the log of a run without stored places is no longer there.
    """
    folder = open_map_folder(path)
    members = [(folder, folder.graph.T_world_node)] if isinstance(folder, Run) else _members(folder)
    first, _ = members[0]
    places: dict[int, AnyPlace] = {}
    T_map_node: dict[int, Transform] = {}
    for run, T_map_own in members:
        if detector_of(run.config) != detector_of(first.config):
            raise RunError(
                f"{run.path}: its features are by another odometry.detector than those of {first.path}; "
                "localise in one of them"
            )
        for node, place in run_places(run, progress=progress).places.items():
            number = len(places)
            places[number], T_map_node[number] = place, T_map_own[node]
    if not places:
        raise RunError(f"{path}: {WITHOUT_PLACES}")
    return KnownMap(path, folder.slice, first.config, KnownPlaces(places, T_map_node))


def _members(merged: MergedMap) -> list[tuple[Run, dict[int, Transform]]]:
    members = []
    graph = merged.graph
    for member, run in zip(merged.manifest.runs, runs_of(merged), strict=True):
        if graph is None or member.first_node is None:
            T_map_own = run.graph.moved(np.array(member.T_map_world)).T_world_node
        else:
            T_map_own = {
                node: graph.T_world_node[member.first_node + node] for node in run.graph.T_world_node
            }
        members.append((run, T_map_own))
    return members


def sensor_of(places: KnownPlaces[Any]) -> Sensor:
    """Return what places were seen by; there is at least one."""
    place = next(iter(places.places.values()))
    if isinstance(place, ImageView):
        return "rgbd"
    return "lidar" if place.points_body[:, 2].any() else "lidar-2d"


def loops_between_days(config: AnyLoops, sensor: Sensor) -> PlaceLoopsConfig | ScanLoopsConfig:
    """Return how keyframes are compared with those of another day, on which some things stood elsewhere."""
    loops = keyframe_loops(config, sensor)
    if isinstance(loops, PlaceLoopsConfig):
        return loops
    moved = max(loops.verification.max_moved_ratio, _MAX_MOVED_RATIO)
    return loops.model_copy(
        update={"verification": loops.verification.model_copy(update={"max_moved_ratio": moved})}
    )


def detector_of(config: BuildConfig) -> Config | None:
    """Return the settings of the features by which places are recognised; None of scans."""
    return getattr(config.odometry, "detector", None)


def run_places(run: Run, *, progress: Progress = SILENT) -> KnownPlaces[Any]:
    """Return the places of a run at its solved nodes, in its world; stored or observed again."""
    T_world_node = run.graph.T_world_node
    places = {
        node: place for node, place in places_of(run, progress=progress).items() if node in T_world_node
    }
    return KnownPlaces(places, T_world_node)


def places_of(run: Run, *, progress: Progress = SILENT) -> Mapping[int, AnyPlace]:
    """Return the stored places of a run; without these they are observed again from its log."""
    if (run.path / files.PLACES).exists():
        return read_places(run.file(files.PLACES))
    log = run.open_log()
    verifier = build_verifier(keyframe_loops(run.config.loops, log.sensor).verification)
    graph = run.graph
    views = reobserve(log, run.trajectory, set(graph.stamps_ns.values()), run.config, progress=progress)
    return {node: verifier.describe(views[stamp_ns]) for node, stamp_ns in graph.stamps_ns.items()}
