"""Exports that copy a file of the run, or write it in another text form."""

import shutil
from pathlib import Path

from mapper.core.errors import RunError
from mapper.run import files
from mapper.run.folder import Run
from mapper.run.map_folder import MapFolder
from mapper.runtime.atomic import atomic_file
from mapper.runtime.progress import Progress
from mapper.sources.trajectory_files import write_kitti


def octomap(run: MapFolder, path: Path, _progress: Progress) -> None:
    """Write the octree: free or occupied as ``.bt``, log-odds as ``.ot``; with wider voxels if so configured.

    Raises:
        RunError: Wider voxels are to replace the run's own octree.
    """
    level, full = run.config.octomap.level, path.suffix.lower() == ".ot"
    name = files.OCTREE_OT if full else files.OCTREE_BT
    if level == 0:
        _copy(run, name, path)
        return
    if _is_same(run.path / name, path):
        raise RunError(f"{path}: is the run's own octree; name another file to write level {level} to")
    from mapper.octree.octomap_file import write_bt, write_ot

    octree = run.octree.coarser(level, parent=run.config.octomap.parent)
    (write_ot if full else write_bt)(path, octree)


def native(run: Run, path: Path, _progress: Progress) -> None:
    """Copy the octree with all its attributes, compressed."""
    _copy(run, files.OCTREE_MAP, path)


def cloud(run: Run, path: Path, _progress: Progress) -> None:
    """Copy the coloured cloud, binary PLY."""
    _copy(run, files.CLOUD, path)


def tum(run: Run, path: Path, _progress: Progress) -> None:
    """Copy the trajectory with exact stamps."""
    _copy(run, files.TRAJECTORY, path)


def g2o(run: Run, path: Path, _progress: Progress) -> None:
    """Copy the pose graph with its nodes at the solution."""
    _copy(run, files.GRAPH, path)


def kitti(run: Run, path: Path, _progress: Progress) -> None:
    """Write the trajectory without its stamps, for which KITTI text has no place."""
    write_kitti(path, run.trajectory)


def grid(run: MapFolder, path: Path, _progress: Progress) -> None:
    """Write the slice's YAML with PGM and PNG beside it; the YAML names the PGM, so this is no copy."""
    slice_world = run.slice
    if not _is_same(run.path / f"{files.SLICE}.yaml", path):
        from mapper.export.grid import write_grid

        write_grid(path.parent, path.stem, slice_world)


def _copy(run: MapFolder, name: str, path: Path) -> None:
    source = run.file(name)
    if not source.is_file():
        raise RunError(f"{source}: is missing from the run; build it again")
    if not _is_same(source, path):
        with atomic_file(path) as part:
            shutil.copyfile(source, part)


def _is_same(source: Path, path: Path) -> bool:
    return path.exists() and source.exists() and source.samefile(path)
