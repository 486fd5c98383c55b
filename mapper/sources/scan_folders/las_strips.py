"""LAS and LAZ strips: files of many sweeps around a moving sensor, cut into sweeps by the points' times."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mapper.core.errors import FrameError, SourceError
from mapper.core.geometry import Array
from mapper.core.timebase import NS_PER_S
from mapper.sources.base import FrameRef, Log
from mapper.sources.cloud_files.las import LAS_ENDINGS, LasExtent, las_extent, read_las, read_times_s
from mapper.sources.cloud_files.parsing import MAX_RANGE_M, MIN_POINTS, Columns
from mapper.sources.config import SourceConfig
from mapper.sources.image_folders.tum import read_truth
from mapper.sources.listed_files import refuse_links_out
from mapper.sources.point_times import LEAST_SHARE, MAX_SWEEP_S, counted_on
from mapper.sources.scan_folders.scans import read_scan
from mapper.sources.scan_frame import scan_frame_warnings
from mapper.sources.text import time_order

_SWEEP_S = 0.1
"""Usual time of a sensor's sweep; of one without turns it is as good as any."""
_MOST_LATE, _ROUNDING_S, _AT_ENDS = 0.01, 1e-6, 1000
"""Share of the points that may come too late in the file, as packets overtake others; what is lost of times
in 64 bits; and points at the ends of a strip, most of whose times are sound."""
_STEP_S, _LOOKED_AT_S, _FEWEST_POINTS = 0.005, 2.0, 10
"""Time in which a spinning LiDAR looks in one direction, part of the strip that is looked at, and how many
points of a step, and steps, tell directions."""
_MOST_POINTS, _CELL_RAD, _REPEATED = 1_000_000, 0.05, 0.2
"""Points of which directions are compared, more than a turn of any LiDAR has; cells of directions, and share
of these that points half the file later have, too: near 1 of sweeps; of a tripod's scan what lies above."""
_ONE_WAY, _MOST_UNEVEN_RAD = 0.7, 0.5
"""Length of the mean of a step's directions, 1 of a single one; and RMS deviation from an even turn."""


def recognise(path: Path) -> bool:
    """Return whether a path is, or holds first, a LAS file of several sweeps.

    A scanner on a tripod takes minutes for one, in which it looks in no direction twice. A damaged file is
    called a strip, too.
    """
    files = _files(path)
    try:
        extent = las_extent(files[0]) if files else None
        if extent is None or not abs(extent.last_s - extent.first_s) > MAX_SWEEP_S:
            return False
        return _repeats(files[0], extent)
    except (FrameError, OSError):
        return path.is_file()  # and is refused by what is wrong with it, not as a single cloud


def read_log(path: Path, config: SourceConfig) -> Log:
    """Return the log of a strip, or of the strips in a folder, a scan for each sweep.

    A sweep is a turn where the points' directions turn evenly, else 0.1 s, or ``source.sweep_s``.

    Raises:
        SourceError: The points are in the coordinates of a map, not in the order of their times, or damaged.
    """
    files = _files(path)
    if path.is_dir():
        refuse_links_out(files, log=path)
    sweeps: list[_Sweep] = []
    sweep_s, turns = config.sweep_s, False
    try:
        for file in files:
            times = _times(file)
            if sweep_s is None:
                turn_s = _turn_s(file, times)
                sweep_s, turns = turn_s or _SWEEP_S, turn_s is not None
            sweeps += _sweeps(file, times, sweep_s)
    except (FrameError, OSError) as error:
        raise SourceError(f"{error}") from None
    if not sweeps:
        raise SourceError(f"{path}: no sweep of {sweep_s:g} s has {MIN_POINTS} points")
    stamps_ns = np.array([sweep.stamp_ns for sweep in sweeps], np.int64)
    order, notes = time_order(stamps_ns, what="sweeps")
    truth_file = path / (config.truth_file or "groundtruth.txt")
    truth, truth_notes = read_truth(truth_file) if truth_file.is_file() else (None, [])
    how = "as its points turn" if turns else "source.sweep_s"

    def entry_at(index: int) -> FrameRef:
        file, stamp_ns, rows = sweeps[int(order[index])]
        return FrameRef(
            stamp_ns,
            lambda colour: read_scan(file, stamp_ns, colour=colour, scale=config.cloud_scale, rows=rows),
        )

    log = Log(
        path=path,
        name=path.resolve().stem,
        kind="las-strip",
        sensor="lidar",
        stamps_ns=stamps_ns[order],
        entry_at=entry_at,
        truth=truth,
        choices=[f"cut into sweeps of {sweep_s:g} s ({how})"],
        notes=[*notes, *truth_notes],
    )
    if scan_frame_warnings(log):
        raise SourceError(_in_map(path, "surfaces stay where they are while what is seen of them moves on"))
    return log


def _repeats(path: Path, extent: LasExtent) -> bool:
    """Return whether points half the file later lie in directions of the first ones."""
    count = min(extent.points // 8, _MOST_POINTS)
    first, later = (
        _direction_cells(read_las(path, (begin, begin + count))) for begin in (0, extent.points // 2)
    )
    return len(np.intersect1d(first, later)) > _REPEATED * min(len(first), len(later))


def _direction_cells(columns: Columns) -> NDArray[np.int64]:
    """Return the numbers of the cells of azimuth and elevation in which points lie."""
    x, y, z = (columns[axis].astype(np.float64) for axis in "xyz")
    angles = np.array([np.arctan2(y, x), np.arctan2(z, np.hypot(x, y))])
    columns_of, rows_of = np.floor(angles / _CELL_RAD).astype(np.int64)
    cells: NDArray[np.int64] = np.unique(columns_of * 1000 + rows_of)
    return cells


def _files(path: Path) -> list[Path]:
    if path.is_dir():
        return sorted(file for file in path.glob("*.[lL][aA][sSzZ]") if file.is_file())
    return [path] if path.suffix.lower() in LAS_ENDINGS and path.is_file() else []


def _in_map(path: Path, reason: str) -> str:
    return (
        f"{path}: points in the coordinates of a map, not around the sensor: {reason}; what is placed "
        "already cannot be tracked: want the scanner's own points, before they are georeferenced"
    )


class _Times(NamedTuple):
    """Times of a strip's points: (N,) seconds after ``zero_s``, 0 of those that are not sound."""

    zero_s: float
    since_s: Array
    is_sound: NDArray[np.bool_]


def _times(path: Path) -> _Times:
    """Return the times of all points of a strip around a sensor.

    Raises:
        FrameError: It has none, they count backwards, or it lies far from the origin.
    """
    extent = las_extent(path)
    if extent is None:
        raise FrameError(f"{path}: no times of its points (gps_time), unlike the first strip")
    away_m = _away_m(extent)
    if away_m > MAX_RANGE_M:
        raise FrameError(_in_map(path, f"all are {away_m:.0f} m and more away from the origin"))
    times_s = counted_on(read_times_s(path)).astype(np.float64)
    first, last = (np.nanmedian(end_s) for end_s in (times_s[:_AT_ENDS], times_s[-_AT_ENDS:]))
    is_sound = (times_s > first - MAX_SWEEP_S) & (times_s < last + MAX_SWEEP_S)
    if not is_sound[:_AT_ENDS].any():
        raise FrameError(f"{path}: the points' times (gps_time) count backwards; sort them by gps_time")
    zero_s = times_s[:_AT_ENDS][is_sound[:_AT_ENDS]].min()
    since_s = np.where(is_sound, times_s, zero_s) - zero_s  # small numbers keep their digits in sums
    return _Times(float(zero_s), since_s, is_sound)


def _away_m(extent: LasExtent) -> float:
    """Return how far the box around the points is away from the origin, along one axis."""
    return max(0.0, *extent.low, *(-high for high in extent.high))


class _Sweep(NamedTuple):
    """Sweep of a strip: its file, its time, its first point and the one after its last."""

    path: Path
    stamp_ns: int
    rows: tuple[int, int]


def _sweeps(path: Path, times: _Times, sweep_s: float) -> list[_Sweep]:
    """Return the sweeps that have enough points; after a pause the next one begins with its first point.

    Raises:
        FrameError: Its points are not in the order of their times.
    """
    latest_s = np.maximum.accumulate(times.since_s)
    if (late := float((times.is_sound & (times.since_s < latest_s - sweep_s)).mean())) > _MOST_LATE:
        raise FrameError(
            f"{path}: {late:.0%} of the points come more than a sweep of {sweep_s:g} s after later ones; "
            "sort them by gps_time"
        )
    zero_ns = round(times.zero_s * NS_PER_S)
    sweeps, row, begin_s = [], 0, 0.0
    while row < len(latest_s):
        end = int(np.searchsorted(latest_s, begin_s + sweep_s - _ROUNDING_S))
        if end - row >= MIN_POINTS:
            sweeps.append(_Sweep(path, zero_ns + round(begin_s * NS_PER_S), (row, end)))
        row, begin_s = end, begin_s + sweep_s
        if row < len(latest_s) and latest_s[row] >= begin_s + sweep_s:
            begin_s = float(latest_s[row])
    counts = [end - begin for _, _, (begin, end) in sweeps]
    return sweeps[:-1] if counts and counts[-1] < LEAST_SHARE * np.median(counts) else sweeps


def _turn_s(path: Path, times: _Times) -> float | None:
    """Return the duration of the turns of a spinning LiDAR, whole milliseconds; None where none are seen."""
    end = int(np.searchsorted(np.maximum.accumulate(times.since_s), _LOOKED_AT_S))
    columns, known = read_las(path, (0, end)), times.is_sound[:end]
    directions = np.exp(1j * np.arctan2(columns["y"], columns["x"]))
    return _period_s(np.floor(times.since_s[:end] / _STEP_S)[known], directions[known])


def _period_s(steps: Array, directions: NDArray[np.complex128]) -> float | None:
    """Return in what time directions (complex numbers, of counted steps) turn once; None if they do not."""
    numbers, of_step, counts = np.unique(steps, return_inverse=True, return_counts=True)
    sums = np.bincount(of_step, directions.real) + 1j * np.bincount(of_step, directions.imag)
    full = counts >= _FEWEST_POINTS
    if full.sum() < _FEWEST_POINTS or np.median(np.abs(sums[full]) / counts[full]) < _ONE_WAY:
        return None
    angles = np.unwrap(np.angle(sums[full]))
    slope, offset = np.polyfit(numbers[full], angles, 1)
    if np.std(angles - slope * numbers[full] - offset) > _MOST_UNEVEN_RAD or slope == 0.0:
        return None
    turn_s = 2.0 * np.pi * _STEP_S / abs(float(slope))
    return round(turn_s, 3) if 0.0 < turn_s <= MAX_SWEEP_S else None
