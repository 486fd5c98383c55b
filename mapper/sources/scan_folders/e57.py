"""E57 files (ASTM E2807): the scans of a terrestrial scanner, in one file or a file each."""

from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapper.core.errors import FrameError, SourceError
from mapper.core.frames import Cloud, Scan
from mapper.core.geometry import Transform
from mapper.core.rotations import pose_of_row
from mapper.core.timebase import GPS_EPOCH_S, NS_PER_S, Stamps
from mapper.runtime.atomic import atomic_file
from mapper.runtime.extras import extra, require
from mapper.sources.base import FrameRef, Log
from mapper.sources.cloud_files.parsing import MIN_POINTS
from mapper.sources.config import SourceConfig
from mapper.sources.listed_files import refuse_links_out
from mapper.sources.scan_stamps import stamp_at
from mapper.sources.text import time_order, truth_from
from mapper.sources.valid_returns import FARTHEST_M, valid_returns

_EXTRA, _PURPOSE = "e57", "reading E57 files"
_XYZ = ("cartesianX", "cartesianY", "cartesianZ")
_SPHERICAL = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")
_RGB = ("colorRed", "colorGreen", "colorBlue")


def recognise(path: Path) -> bool:
    """Return whether a path is an E57 file, or a folder with such files."""
    return bool(_files(path))


def read_log(path: Path, config: SourceConfig) -> Log:
    """Return the log of a file or a folder; the body is the scanner, and its stated poses are device poses.

    Raises:
        SourceError: A file is none, or damaged, or has no scan.
        DependencyError: The library that reads them is not installed.
    """
    require("pye57", _EXTRA, _PURPOSE)
    paths = _files(path)
    if path.is_dir():
        refuse_links_out(paths, log=path)
    stations = [station for file in paths for station in _stations(file)]
    if not stations:
        raise SourceError(f"{path}: no scan in it")
    stamps_ns, notes = _stamps(stations, config)
    order, order_notes = time_order(stamps_ns, what="scans")
    posed = [(int(stamps_ns[i]), stations[i].T_world_scanner) for i in order]
    poses, pose_notes = truth_from(posed, what="poses")

    def entry_at(index: int) -> FrameRef:
        stamp_ns, station = int(stamps_ns[order[index]]), stations[int(order[index])]
        return FrameRef(stamp_ns, lambda colour: _read(station, stamp_ns, colour=colour))

    return Log(
        path=path,
        name=path.resolve().stem,
        kind="e57",
        sensor="lidar",
        stamps_ns=stamps_ns[order],
        entry_at=entry_at,
        device_poses=poses,
        notes=[*notes, *order_notes, *(pose_notes if poses is not None else [])],
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Station:
    """A scan in a file, its date, and the scanner's pose if there is one."""

    path: Path
    index: int
    stamp_ns: int | None
    T_world_scanner: Transform | None


def _read(station: _Station, stamp_ns: int, *, colour: bool) -> Scan:
    """Read a scan, in the scanner's frame.

    Raises:
        FrameError: It is damaged, or has too few points within reach.
    """
    where = f"{station.path}: scan {station.index}"
    with _opened(station.path, FrameError) as file:
        fields = file.read_scan(
            station.index,
            intensity=colour,
            colors=colour,
            transform=False,
            ignore_missing_fields=True,
        )
    points, rows, far = valid_returns(_points(fields))
    if len(points) < MIN_POINTS:
        raise FrameError(
            f"{where}: {len(points)} points, {far} others are farther than {FARTHEST_M:g} m; want "
            f"{MIN_POINTS}"
        )
    kept = slice(None) if rows is None else rows
    has_colours = all(name in fields for name in _RGB)
    return Scan(
        stamp_ns,
        points,
        colors=np.column_stack([fields[name][kept] for name in _RGB]) if has_colours else None,
        far_returns=far,
        intensities=fields["intensity"][kept] if "intensity" in fields else None,
    )


def _files(path: Path) -> list[Path]:
    if path.is_dir():
        return sorted(file for file in path.glob("*.[eE]57") if file.is_file())
    return [path] if path.suffix.lower() == ".e57" else []


@contextmanager
def _opened(path: Path, error: type[FrameError] | type[SourceError]) -> Iterator[Any]:
    """Open a file; whatever goes wrong with it inside becomes an error that names it."""
    with extra(_EXTRA, _PURPOSE):
        from pye57 import E57, libe57
    try:
        with E57(str(path)) as file:
            yield file
    except (libe57.E57Exception, ValueError, TypeError, KeyError, MemoryError, OSError) as problem:
        reason = f"{problem}".splitlines()
        raise error(f"{path}: no E57 file, or damaged: {reason[0] if reason else 'too large'}") from None


def _stations(path: Path) -> list[_Station]:
    stations = []
    with _opened(path, SourceError) as file:
        for index in range(file.scan_count):
            header = file.get_header(index)
            date = header["acquisitionStart"]["dateTimeValue"].value() if _has_date(header) else 0.0
            stamp_ns = round((date + GPS_EPOCH_S) * NS_PER_S) if date > 0.0 else None
            T = None
            if header.has_pose():
                w, x, y, z = header.rotation
                T = pose_of_row(np.array([*header.translation, x, y, z, w]))
            stations.append(_Station(path, index, stamp_ns, T))
    return stations


def _has_date(header: Any) -> bool:
    return bool(header.node.isDefined("acquisitionStart/dateTimeValue"))


def _stamps(stations: list[_Station], config: SourceConfig) -> tuple[Stamps, list[str]]:
    """Return the scans' dates, or if they do not tell the scans apart their numbers, and a note on that."""
    dated = [station.stamp_ns for station in stations if station.stamp_ns is not None]
    if config.rate_hz is None and len(set(dated)) == len(stations):
        return np.array(dated, np.int64), []
    rate_hz = config.rate_hz or 1.0
    note = f"no date of its own in each scan; {rate_hz:g} scans a second assumed (source.rate_hz)"
    return np.array([stamp_at(k, rate_hz=rate_hz) for k in range(len(stations))], np.int64), [note]


def _points(fields: Any) -> NDArray[np.float32]:
    if all(name in fields for name in _XYZ):
        return np.column_stack([fields[name] for name in _XYZ]).astype(np.float32)
    r, azimuth, elevation = (fields[name] for name in _SPHERICAL)
    level = r * np.cos(elevation)
    xyz = [level * np.cos(azimuth), level * np.sin(azimuth), r * np.sin(elevation)]
    return np.column_stack(xyz).astype(np.float32)


def write_e57(path: Path, cloud: Cloud, *, name: str) -> None:
    """Write a cloud as one scan without a pose, atomically; its times have no place in E57.

    Args:
        path: File to write.
        cloud: The cloud.
        name: Name of the scan.

    Raises:
        DependencyError: The library that writes them is not installed.
    """
    with extra(_EXTRA, "writing E57 files"):
        from pye57 import E57
    fields = dict(zip(_XYZ, cloud.points.T.astype(np.float64), strict=True))
    fields |= dict(zip(_RGB, np.ascontiguousarray(cloud.colors.T), strict=True))
    if cloud.intensities is not None:
        fields["intensity"] = cloud.intensities
    with atomic_file(path) as part, closing(E57(str(part), mode="w")) as file:
        file.write_scan_raw(fields, name=name)
