"""Runs of a merged map: their entries in the manifest, their poses, and their maps where these were bent."""

import shutil
from collections.abc import Sequence, Set
from functools import partial
from pathlib import Path

from mapper.core.errors import MapperError
from mapper.graph.g2o import write_g2o
from mapper.loops.closure import write_closures
from mapper.mapping.config import edits_of
from mapper.merging.jobs import FusedRun, Workspace, fuse_run
from mapper.merging.merged_map import FUSED, RUNS, MapManifest, RunInMap
from mapper.merging.placing import Placed, Placing
from mapper.merging.stages import Stages
from mapper.run import files
from mapper.run.doubtful_frames import without_doubtful
from mapper.run.fingerprint import fingerprint
from mapper.runtime.atomic import atomic_file
from mapper.sources.trajectory_files import write_tum


def runs_to_fuse(placed: Sequence[Placed], *, within_m: float) -> tuple[set[int], list[str]]:
    """Return the numbers of the runs to fuse again, and a line for each that should be and cannot."""
    again, rigid = set[int](), list[str]()
    for number, item in enumerate(placed):
        if item.kept is not None:
            again |= {number} if item.kept.fused_again else set()
            continue
        if item.moved_m <= within_m:
            continue
        try:
            item.run.open_log()
        except MapperError as error:
            rigid.append(
                f"{error}; so {item.run.path} is placed as a rigid body, and bends of up to "
                f"{item.moved_m:.2g} m stay in its map"
            )
        else:
            again.add(number)
    return again, rigid


def described_runs(placing: Placing, *, fused_again: Set[int]) -> tuple[RunInMap, ...]:
    """Return the manifest's entries of the runs before they are merged."""
    first_nodes = (
        [None] * len(placing.placed) if placing.joint is None else placing.joint.first_nodes.values()
    )
    return tuple(
        RunInMap(
            path=str(item.run.path.resolve()),
            fingerprint=fingerprint(item.run.file(files.OCTREE_MAP)),
            T_map_world=tuple(tuple(row) for row in item.T_map_world.tolist()),
            placed=item.how,
            folder=f"{RUNS}/{number:04d}_{item.run.path.resolve().name}",
            first_node=first_node,
            moved_m=round(item.moved_m, 6),
            fused_again=number in fused_again,
            keepout=edits_of(item.run.manifest.edits).keepout,
        )
        for number, (item, first_node) in enumerate(zip(placing.placed, first_nodes, strict=True))
    )


def write_poses(folder: Path, placing: Placing, manifest: MapManifest) -> None:
    """Write every run's trajectory in the map, and the joint graph with the loops between runs."""
    for item, run in zip(placing.placed, manifest.runs, strict=True):
        (folder / run.folder).mkdir(parents=True, exist_ok=True)
        write_tum(folder / run.folder / files.TRAJECTORY, item.trajectory_map)
        if item.kept is not None and run.fused_again:
            for name in (files.OCTREE_MAP, FUSED):
                with atomic_file(folder / run.folder / name) as part:
                    shutil.copyfile(item.kept.folder / name, part)
    if placing.joint is not None:
        write_g2o(folder / files.GRAPH, placing.joint.graph)
        write_closures(folder / files.LOOPS, placing.joint.loops)


def fuse_runs(
    workspace: Workspace, stages: Stages, placed: Sequence[Placed], manifest: MapManifest
) -> list[Path]:
    """Fuse the runs that have moved again; return the file of every run's octree."""
    octrees = [item.run.path.resolve() / files.OCTREE_MAP for item in placed]
    jobs = {}
    for number, (item, run) in enumerate(zip(placed, manifest.runs, strict=True)):
        if run.fused_again:
            octrees[number] = workspace.folder / run.folder / files.OCTREE_MAP
        if run.fused_again and item.bent is not None:
            poses = without_doubtful(item.bent, item.run.records)
            write_tum(workspace.folder / run.folder / FUSED, poses)
            jobs[f"{number:04d}"] = partial(
                fuse_run, workspace, number, item.run.path.resolve(), poses, octrees[number]
            )
    if jobs:
        list(stages.run("fuse", jobs, FusedRun))
    return octrees
