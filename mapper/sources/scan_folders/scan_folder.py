"""LiDAR logs made of folders of clouds: their files, their stamps and the LiDAR's true poses."""

import os
from collections.abc import Iterable, Sequence
from contextlib import suppress
from fnmatch import fnmatch
from pathlib import Path

import numpy as np

from mapper.core.errors import FrameError, SourceError
from mapper.core.geometry import Transform, inverse, spread_indices
from mapper.core.timebase import NS_PER_S, Stamps
from mapper.core.trajectory import Trajectory
from mapper.sources.base import FrameRef, Log
from mapper.sources.cloud_files import EMPTY, ENDINGS, read_cloud, why_no_points
from mapper.sources.cloud_files.las import LAS_ENDINGS, first_time_s
from mapper.sources.config import SourceConfig
from mapper.sources.image_folders.tum import read_truth
from mapper.sources.listed_files import refuse_links_out
from mapper.sources.point_times import times_told
from mapper.sources.scan_folders.scans import read_scan
from mapper.sources.scan_stamps import BY_NUMBERS, in_order, line_of_each, scan_stamps
from mapper.sources.text import time_order, told_without_rotations, truth_from
from mapper.sources.trajectory_files import is_mulran, is_tum, read_kitti, read_mulran

_TEXT_ENDINGS = (".txt", ".csv")
_SAMPLED = 5
"""Text files of a folder that are tried before it is taken for one of clouds."""


def is_cloud_name(path: Path) -> bool:
    """Return whether a path is called as a cloud is: by its ending, and a text file also by a number."""
    ending = path.suffix.lower()
    return ending in ENDINGS and (ending not in _TEXT_ENDINGS or path.stem.rstrip(")")[-1:].isdecimal())


def most_clouds(folder: Path) -> int:
    """Return how many files of a folder, which need not exist, are named as clouds of one format."""
    return max(map(len, _by_ending(folder).values()))


def clouds_in(folder: Path, pattern: str | None) -> tuple[list[Path], list[str]]:
    """Return a folder's clouds in order, and notes on what is left out.

    Args:
        folder: Its own files count, not those of its folders; it need not exist.
        pattern: Glob of the names; None takes the ending that most of the clouds have.

    Raises:
        SourceError: There are text files only, and no points in them.
    """
    if pattern is not None:
        matching = [path for path in _files(folder) if fnmatch(path.name, pattern)]
        by_ending = {"": [path for path in matching if path.suffix.lower() in ENDINGS]}
    else:
        by_ending = _by_ending(folder)
    chosen: list[Path] = []
    notes, refused = [], []
    for ending, paths in sorted(by_ending.items(), key=lambda item: -len(item[1])):
        if reason := _why_no_points(paths):
            refused.append(f"{len(paths)} {paths[0].suffix} files are no clouds: {reason}")
        elif paths and chosen:
            notes.append(f"{len(paths)} {ending} files left out; source.pattern chooses others")
        else:
            chosen = chosen or paths
    if refused and not chosen:
        raise SourceError(f"{folder}: {refused[0]}; want lines of x y z")
    return in_order(chosen), [*notes, *(f"{reason}; left out" for reason in refused)]


def first_of(folders: Iterable[Path], names: Sequence[str]) -> Path | None:
    """Return the first file in these folders that has one of the names."""
    return next((path for folder in folders for name in names if (path := folder / name).is_file()), None)


def scan_log(
    path: Path,
    files: Sequence[Path],
    *,
    kind: str,
    stamps_file: Path | None,
    truth_file: Path | None,
    config: SourceConfig,
    T_posed_lidar: Transform | None = None,
    notes: Iterable[str] = (),
) -> tuple[Log, list[Path]]:
    """Return the log of some clouds, and these in time order.

    Args:
        path: Folder that was opened.
        files: The clouds, one or more, in the order of the lines of the two text files.
        kind: Format of the log.
        stamps_file: A stamp a line, for names that carry none.
        truth_file: TUM's lines with stamps, or KITTI's, one a cloud.
        config: Rate, scale, and the text files that the user names instead.
        T_posed_lidar: Pose of the LiDAR in what KITTI's lines are the poses of; None is the LiDAR itself.
        notes: Sentences on what finding the clouds left out or assumed.

    Raises:
        SourceError: A text file is missing or malformed, or has not one stamp for every cloud, or a file is a
            link out of the log.
        DataError: A line of KITTI's poses is malformed.
    """
    refuse_links_out(filter(None, [*files, stamps_file, truth_file]), log=path)
    stamps_ns, stamp_notes = scan_stamps(
        files,
        chosen=_chosen(path, config.stamps_file),
        beside=stamps_file,
        rate_hz=config.rate_hz,
        recorded=lambda: _las_stamps(files),
    )
    truth, truth_notes = _read_truth(
        _chosen(path, config.truth_file) or truth_file, files, stamps_ns, T_posed_lidar
    )
    order, order_notes = time_order(stamps_ns, what="scans")
    ordered = [files[k] for k in order]
    bin_columns, choices, time_notes = _told_by(ordered[0], int(stamps_ns[order[0]]), config)

    def entry_at(index: int) -> FrameRef:
        stamp_ns = int(stamps_ns[order[index]])
        return FrameRef(
            stamp_ns,
            lambda colour: read_scan(
                ordered[index],
                stamp_ns,
                colour=colour,
                scale=config.cloud_scale,
                bin_columns=bin_columns,
            ),
        )

    log = Log(
        path=path,
        name=path.resolve().name,
        kind=kind,
        sensor="lidar",
        stamps_ns=stamps_ns[order],
        entry_at=entry_at,
        truth=truth,
        choices=choices,
        notes=[*notes, *stamp_notes, *order_notes, *truth_notes, *time_notes],
    )
    return log, ordered


def _told_by(path: Path, stamp_ns: int, config: SourceConfig) -> tuple[int | None, list[str], list[str]]:
    """Return the numbers of a record that all clouds have, and what the times of a cloud's points are."""
    columns = config.bin_columns
    with suppress(FrameError):  # it is reported when it is read
        cloud = read_cloud(path, scale=config.cloud_scale, bin_columns=columns)
        choices, notes = times_told(
            cloud.names, lambda _: np.empty(0) if cloud.times is None else cloud.times, stamp_ns
        )
        if path.suffix.lower() == ".bin" and columns is None and "ring" in cloud.names:
            columns = len(cloud.names)
            choices.append(f"records of {columns} float32: {' '.join(cloud.names)}; source.bin_columns")
        return columns, choices, notes
    return columns, [], []


def _las_stamps(files: Sequence[Path]) -> Stamps | None:
    """Return the time of each LAS file's first point; None of other files, and where they do not increase.

    Files that cannot be read, which are told later, get times between those of their neighbours.
    """
    if any(path.suffix.lower() not in LAS_ENDINGS for path in files):
        return None
    times_s = np.full(len(files), np.nan)
    for index, path in enumerate(files):
        with suppress(FrameError):
            times_s[index] = first_time_s(path)
    known = np.flatnonzero(times_s >= 0.0)
    if not len(known):
        return None
    times_s = np.interp(np.arange(len(files)), known, times_s[known])
    return np.round(times_s * NS_PER_S).astype(np.int64) if (np.diff(times_s) > 0.0).all() else None


def _by_ending(folder: Path) -> dict[str, list[Path]]:
    by_ending: dict[str, list[Path]] = {ending: [] for ending in ENDINGS}
    for path in filter(is_cloud_name, _files(folder)):
        by_ending[path.suffix.lower()].append(path)
    return by_ending


def _why_no_points(paths: Sequence[Path]) -> str | None:
    """Return why some files are no clouds; None if one of a few that are looked at may be."""
    if not paths or paths[0].suffix.lower() not in _TEXT_ENDINGS:
        return None
    reason, paths = None, sorted(paths)
    for index in spread_indices(len(paths), _SAMPLED):
        found = why_no_points(paths[index])
        if found is None:
            return None
        if reason is None or reason.endswith(EMPTY):  # an image without objects has an empty file of labels
            reason = f"{paths[index].name}: {found}"
    return reason


def _files(folder: Path) -> list[Path]:
    try:
        with os.scandir(folder) as found:  # tells files from folders without a stat of each
            return [folder / one.name for one in found if one.name[0] != "." and one.is_file()]  # macOS' ._
    except OSError:  # there is none, it may not be read, or is a link to itself
        return []


def _chosen(folder: Path, file: Path | None) -> Path | None:
    if file is None:
        return None
    path = folder / file
    if not path.is_file():
        raise SourceError(
            f"{path}: no such file; source.stamps_file and truth_file start at the log's folder"
        )
    return path


def _read_truth(
    path: Path | None, files: Sequence[Path], stamps_ns: Stamps, T_posed_lidar: Transform | None
) -> tuple[Trajectory | None, list[str]]:
    if path is None:
        return None, []
    if is_mulran(path):
        return told_without_rotations(read_mulran(path), [], what=path.name)
    if is_tum(path):
        return read_truth(path)
    T_world_posed = read_kitti(path).T_world_body
    lines = line_of_each(files, len(T_world_posed))
    posed = [] if lines is None else [(i, line) for i, line in enumerate(lines) if line < len(T_world_posed)]
    notes = []
    if len(posed) < len(files) or posed[-1][1] < len(T_world_posed) - 1:
        notes.append(
            f"{path.name}: {len(T_world_posed)} poses for {len(posed)} of {len(files)} scans, {BY_NUMBERS}"
        )
    if not posed:
        return None, notes
    T_world_lidar = T_world_posed
    if T_posed_lidar is not None:  # the world is where the LiDAR began, as it is for KITTI's camera
        T_world_lidar = inverse(T_posed_lidar) @ T_world_posed @ T_posed_lidar
    truth, more = truth_from([(int(stamps_ns[i]), T_world_lidar[line]) for i, line in posed], what=path.name)
    return told_without_rotations(truth, [*notes, *more], what=path.name)
