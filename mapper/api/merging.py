"""Finished runs together: merged to one map, and compared."""

from collections.abc import Sequence
from pathlib import Path
from typing import Literal, assert_never

from mapper.api.progress import AnyProgress, receiver_of
from mapper.core.errors import ConfigError
from mapper.merging.differences import Differences, differences_of, write_differences
from mapper.merging.merge import DEFAULT_TILE_M, Merged
from mapper.merging.merge import merge as merge_runs
from mapper.merging.merged_map import MergedMap, open_map
from mapper.merging.runs_in_map import runs_of
from mapper.merging.world_poses import Placing, as_built, by_poses, by_truth
from mapper.run.folder import Run, open_run
from mapper.run.manifest import is_merged_map
from mapper.runtime.executor import IN_PROCESS, Workers
from mapper.runtime.progress import Progress
from mapper.runtime.regular_files import AnyPath
from mapper.runtime.result_paths import DIFFS, MAPS, joined_names, place_of

Place = Literal["built", "truth", "auto"]
"""Source of the poses of the runs' worlds in the map."""


def merge(
    runs: Sequence[Run | AnyPath],
    *,
    out: AnyPath | None = None,
    place: Place | None = None,
    poses: AnyPath | None = None,
    tile_m: float = DEFAULT_TILE_M,
    workers: Workers = IN_PROCESS,
    progress: AnyProgress = None,
    overwrite: bool = False,
) -> Merged:
    """Add up the octrees of many runs tile by tile, as ``mapper merge`` does; its ``map`` is the result.

    Args:
        runs: Runs or their folders; after a merged map, they are added to it.
        out: Folder to create; None is ``maps/RUN+RUN…``, or the map itself.
        place: "built": every run's world is the map's already. "truth": the runs' truths share a frame.
            "auto": by places that the runs share; those that share none are left out. None is "built", or
            "auto" for a map that was placed so.
        poses: File of the worlds' poses in the map instead, a line each: RUN tx ty tz qx qy qz qw.
        tile_m: Approximate edge of a tile.
        workers: Workers that run the jobs.
        progress: As for ``mapper.build``.
        overwrite: Replace an existing map.

    Raises:
        ConfigError: ``place`` and ``poses`` are both given, or the runs' settings differ.
        RunError: A folder is no run, or OUT exists already.
        MapperError: A pose is missing.
    """
    if not runs:
        raise ConfigError("merge: no runs")
    receiver, folders = receiver_of(progress), [_folder_of(run) for run in runs]
    known = open_map(folders[0]) if is_merged_map(folders[0]) else None
    default: Place = "built"
    if known is None:
        built, path = (
            [_run_of(run) for run in runs],
            MAPS / joined_names(folders) if out is None else Path(out),
        )
    else:
        built = [*runs_of(known), *(_run_of(run) for run in runs[1:])]
        path = known.path if out is None else Path(out)
        overwrite |= path.resolve() == known.path.resolve()
        default = "built" if known.graph is None else "auto"
    placing = _placing(
        built, place, poses, default=default, jointly=True, known=known, workers=workers, progress=receiver
    )
    return merge_runs(
        placing, path, tile_m=tile_m, workers=workers, progress=receiver, overwrite=overwrite, known=known
    )


def diff(
    before: Run | AnyPath,
    after: Run | AnyPath,
    *,
    out: AnyPath | None = None,
    place: Place | None = None,
    poses: AnyPath | None = None,
    tolerance_m: float | None = None,
    min_voxels: int = 8,
    progress: AnyProgress = None,
    overwrite: bool = False,
) -> Differences:
    """Compare the maps of two runs, as ``mapper diff`` does: what appeared, what vanished.

    Args:
        before: The earlier run, or its folder.
        after: The later one.
        out: Folder for a list, a picture and clouds; None is ``diffs/BEFORE+AFTER``, or with a number.
        place: As for :func:`merge`; None is "auto".
        poses: As for :func:`merge`.
        tolerance_m: Surfaces closer than this are the same; None is two voxels.
        min_voxels: Smaller clusters are counted, not listed.
        progress: As for ``mapper.build``.
        overwrite: Replace OUT.

    Raises:
        RunError: A folder is no run, or OUT exists already.
        MapperError: The runs cannot be placed in one world.
    """
    receiver, earlier, later = receiver_of(progress), _run_of(before), _run_of(after)
    usual = DIFFS / joined_names([earlier.path, later.path])
    folder = place_of(None if out is None else Path(out), usual, overwrite=overwrite)
    placing = _placing(
        [earlier, later], place, poses, default="auto", jointly=False, workers=IN_PROCESS, progress=receiver
    )
    found = differences_of(*placing.placed, tolerance_m=tolerance_m, min_voxels=min_voxels)
    write_differences(folder, found, earlier, later, placed=placing.placed[-1].how, overwrite=overwrite)
    if found.warning:
        receiver.note(found.warning)
    return found


def _placing(
    runs: Sequence[Run],
    place: Place | None,
    poses: AnyPath | None,
    *,
    default: Place,
    jointly: bool,
    known: MergedMap | None = None,
    workers: Workers,
    progress: Progress,
) -> Placing:
    """Return the runs with the poses of their worlds, which shared places bend jointly or place as rigid."""
    if poses is not None:
        if place is not None:
            raise ConfigError(f"place {place} and poses {poses}: give one of them")
        return Placing(by_poses(runs, Path(poses)))
    match place or default:
        case "built":
            return Placing(as_built(runs))
        case "truth":
            return Placing(by_truth(runs))
        case "auto":
            from mapper.pipeline.session_alignment import place_by_shared_places, place_jointly  # loads GTSAM

            if not jointly:
                return place_by_shared_places(runs, workers=workers, progress=progress)
            known = known if known is not None and known.graph is not None else None
            return place_jointly(runs, known=known, workers=workers, progress=progress)
        case unreachable:
            assert_never(unreachable)


def _run_of(run: Run | AnyPath) -> Run:
    return run if isinstance(run, Run) else open_run(run)


def _folder_of(run: Run | AnyPath) -> Path:
    return run.path if isinstance(run, Run) else Path(run)
