"""Pairs of a scan and the map it belongs into: given by a file, or made of the logs of a folder."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field, PositiveFloat

from mapper.config.loading import read_config
from mapper.core.config import Config
from mapper.core.errors import MapperError, SourceError
from mapper.core.frames import Scan
from mapper.core.geometry import Transform, inverse, transform
from mapper.core.rotations import rotation_from_euler, rotation_from_quaternion
from mapper.core.trajectory import with_rotations
from mapper.core.voxel_grid import thin
from mapper.run.input_logs import fingerprint
from mapper.sources import open_source
from mapper.sources.base import FrameRef
from mapper.sources.cloud_files import ENDINGS
from mapper.sources.scan_folders import clouds, kitti
from mapper.sources.scan_folders.scans import read_scan

GIVEN = "pairs.toml"
ALL_RINGS, FEW_RINGS = "all rings", "16 rings"
RIGHT_M, RIGHT_DEG = 0.3, 1.0
EXTRINSIC_M, EXTRINSIC_DEG = 0.5, 2.5
"""RELLIS-3D's extrinsic calibration is itself good to about 0.1 m and 1° only."""
SCANS_PER_LOG = 4
MAP_SCANS = 20
"""Number of scans before the one that is left out, and after it, of which the map is made."""
MAP_VOXEL_M = 0.02
"""The map has one point in each voxel: MPD cannot fall much below half of its edge."""

_VLP_POINTS = 30_000  # what a VLP-16 gives in a turn; a scan with no more is not thinned further
_RINGS, _KEPT_RINGS = 64, 16


@dataclass(frozen=True, slots=True, eq=False)
class Clouds:
    """A scan and the map it belongs into.

    Attributes:
        target: The map.
        source: The scan, in its own frame.
        T_target_source: Its pose in the map; None if it is not known.
    """

    target: Scan
    source: Scan
    T_target_source: Transform | None


class PairConfig(Config):
    """One ``[[pair]]`` of ``pairs.toml``."""

    name: str
    scan: Path
    """A cloud of any kind that is read, in metres around its sensor, z up; relative to ``pairs.toml``."""
    map: Path
    """A cloud like ``scan``; without a pose, one taken within 10 m of it."""
    sensor: str = ""
    """Pairs of one sensor are summed up together; HDL and VLP beside the paper's."""
    pose: Annotated[tuple[float, ...], Field(min_length=6, max_length=6)] | None = None
    """Pose of the scan in the map: x y z in metres, roll pitch yaw in degrees."""
    within_m: PositiveFloat = RIGHT_M
    within_deg: PositiveFloat = RIGHT_DEG
    """Tolerance of a right answer."""


class PairsConfig(Config):
    """``pairs.toml``."""

    pair: Annotated[tuple[PairConfig, ...], Field(min_length=1)]


@dataclass(frozen=True, slots=True)
class GivenPair:
    """Two cloud files.

    Attributes:
        name: The pair's name.
        sensor: That of the scan.
        scan: File of the scan.
        map: File of the map.
        T_map_scan: Rows of the scan's (4, 4) pose in the map, if that is known.
        within: Tolerance of a right answer: metres and degrees.
    """

    name: str
    sensor: str
    scan: Path
    map: Path
    T_map_scan: tuple[tuple[float, ...], ...] | None
    within: tuple[float, float]

    def identity(self) -> str:
        """Return both files' fingerprints and the pose."""
        return f"{fingerprint(self.scan)} {fingerprint(self.map)} {self.T_map_scan} {self.within}"

    def clouds(self) -> Clouds:
        """Read both; a map whose pose is known is moved so that its origin is where the scan was taken."""
        target, source = _read(self.map), _read(self.scan)
        if self.T_map_scan is None:
            return Clouds(target, source, None)
        T_map_scan = np.array(self.T_map_scan)
        T_map_here = transform(np.eye(3), T_map_scan[:3, 3])
        here = target.moved(inverse(T_map_here))
        return Clouds(Scan(0, here.points_body), source, inverse(T_map_here) @ T_map_scan)


@dataclass(frozen=True, slots=True)
class LogPair:
    """A scan of a log, and a map of those around it at their true poses.

    Attributes:
        log: The log.
        index: Index of the scan, among those with a true pose.
        sensor: ``ALL_RINGS`` or ``FEW_RINGS``.
        within: Tolerance of a right answer: metres and degrees.
    """

    log: Path
    index: int
    sensor: str
    within: tuple[float, float] = (RIGHT_M, RIGHT_DEG)

    @property
    def name(self) -> str:
        """The log and which of its scans."""
        return f"{self.log.resolve().name} scan {self.index}"

    def identity(self) -> str:
        """Return the log's fingerprint, which scan it is, and how it is thinned."""
        return f"{fingerprint(self.log)} {self.index} {self.sensor} {MAP_SCANS} {MAP_VOXEL_M}"

    def clouds(self) -> Clouds:
        """Read the scans and join them."""
        pair = _left_out(self.log, self.index)
        if self.sensor == ALL_RINGS:
            return pair
        return Clouds(pair.target, fewer_rings(pair.source), pair.T_target_source)


Pair = GivenPair | LogPair
"""A scan and a map that have not been read yet; can be pickled."""


def find_pairs(logs: Path) -> list[Pair]:
    """Return the pairs of a folder: those of its ``pairs.toml``, or else those made of its logs.

    A log is the folder or one in it. Of LiDAR logs with truth, scans evenly chosen are left out one by one;
    two sensors' clouds of one moment are a pair where there is an extrinsic calibration, as in RELLIS-3D.

    Raises:
        ConfigError: ``pairs.toml`` cannot be read.
        SourceError: It names files that are missing, or there are no pairs.
    """
    if not logs.is_dir():
        raise SourceError(f"{logs}: no such folder")
    if (logs / GIVEN).is_file():
        return _given(logs / GIVEN)
    pairs = _made_of(logs)
    if not pairs:
        folders = sorted(child for child in logs.iterdir() if child.is_dir())
        pairs = [pair for folder in folders for pair in _made_of(folder)]
    if not pairs:
        raise SourceError(
            f"{logs}: no {GIVEN}, and neither it nor a folder in it is a LiDAR log with truth; "
            f"list pairs in {logs / GIVEN}: [[pair]] name, scan, map"
        )
    return pairs


def _given(path: Path) -> list[Pair]:
    pairs: list[Pair] = []
    for pair in read_config(path, PairsConfig).pair:
        scan, target = path.parent / pair.scan, path.parent / pair.map
        for file in (scan, target):
            if not file.is_file():
                raise SourceError(f"{path}: pair {pair.name!r}: {file}: no such file")
        T_map_scan = None
        if pair.pose is not None:
            x, y, z, *angles_deg = pair.pose
            T_map_scan = _rows(rotation_from_euler(*np.radians(angles_deg)), (x, y, z))
        within = (pair.within_m, pair.within_deg)
        pairs.append(GivenPair(pair.name, pair.sensor, scan, target, T_map_scan, within))
    names = [pair.name for pair in pairs]
    if twice := {name for name in names if names.count(name) > 1}:
        raise SourceError(f"{path}: {len(names)} pairs, but more than one is called {min(twice)!r}")
    return pairs


def _made_of(folder: Path) -> list[Pair]:
    return _cross_sensor(folder) or _of_log(folder)


def _cross_sensor(folder: Path) -> list[Pair]:
    """Return the simultaneous clouds of a folder with an extrinsic calibration, ``vel2os1.yaml``."""
    pairs: list[Pair] = []
    for path in sorted(folder.glob("*2*.yaml")):
        for split in re.finditer("2", path.stem):
            source, target = path.stem[: split.start()], path.stem[split.end() :]
            scans, maps = _numbered(folder, source), _numbered(folder, target)
            T_target_source = _extrinsic(path)
            if not source or not target or T_target_source is None:
                continue
            pairs += [
                GivenPair(
                    f"{folder.resolve().name} {number}",
                    f"{source} on {target}",
                    scans[number],
                    maps[number],
                    T_target_source,
                    (EXTRINSIC_M, EXTRINSIC_DEG),
                )
                for number in sorted(scans.keys() & maps.keys())
            ]
    return pairs


def _numbered(folder: Path, sensor: str) -> dict[str, Path]:
    """Return the clouds that are called by a sensor and a number: ``vel000104.bin``, ``os1_000104.bin``."""
    name = re.compile(re.escape(sensor) + r"[_-]?(\d+)")
    found = ((name.fullmatch(path.stem), path) for path in folder.iterdir() if path.suffix in ENDINGS)
    return {match[1]: path for match, path in found if match}


def _extrinsic(path: Path) -> tuple[tuple[float, ...], ...] | None:
    """Return the motion of a calibration file with ``q: w x y z`` and ``t: x y z``; None if it has others."""
    numbers: dict[str, float] = {}
    part = ""
    for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
        name, _, value = line.partition(":")
        if not value.strip():
            part = name.strip()
        else:
            try:
                numbers[f"{part}.{name.strip()}"] = float(value)
            except ValueError:
                return None
    try:
        quaternion = np.array([numbers[f"q.{axis}"] for axis in "xyzw"])
        return _rows(rotation_from_quaternion(quaternion), tuple(numbers[f"t.{axis}"] for axis in "xyz"))
    except KeyError:
        return None


def _rows(R: np.ndarray, translation_m: tuple[float, ...]) -> tuple[tuple[float, ...], ...]:
    return tuple(map(tuple, transform(R, np.array(translation_m)).tolist()))


def _of_log(folder: Path) -> list[Pair]:
    if not kitti.recognise(folder) and not clouds.recognise(folder):
        return []
    try:
        log = open_source(folder).path  # the folder, or the only log in it
        posed = _posed(log)
    except MapperError:  # several logs, or none that can be opened: the folders in it are asked next
        return []
    if len(posed) < 3:
        return []
    chosen = np.linspace(0, len(posed) - 1, SCANS_PER_LOG + 2).astype(int)[1:-1]
    pairs: list[Pair] = []
    for index in dict.fromkeys(int(i) for i in chosen):
        pairs.append(LogPair(log, index, ALL_RINGS))
        if len(posed[index][0].scan().points_body) > _VLP_POINTS:
            pairs.append(LogPair(log, index, FEW_RINGS))
    return pairs


def _posed(log: Path) -> list[tuple[FrameRef, Transform]]:
    source = open_source(log)
    truth = with_rotations(source.truth)
    if truth is None or source.sensor != "lidar":
        return []
    poses = dict(truth.items())
    return [(entry, poses[entry.stamp_ns]) for entry in source.entries_of(poses)]


@lru_cache(maxsize=1)
def _left_out(log: Path, index: int) -> Clouds:
    """Return a scan, and the map of those around it, with the world's axes, from where the middle one was."""
    posed = _posed(log)
    first, last = max(index - MAP_SCANS, 0), min(index + MAP_SCANS, len(posed) - 1)
    # Not in the middle one's own frame: a scanner in the hand leans, and a yaw is not about its z.
    T_map_world = inverse(transform(np.eye(3), posed[(first + last) // 2][1][:3, 3]))
    others = [posed[i] for i in range(first, last + 1) if i != index]
    scans, poses = [entry.scan() for entry, _ in others], [T_map_world @ T for _, T in others]
    target = merged(scans, poses, voxel_m=MAP_VOXEL_M)
    entry, T_world_body = posed[index]
    return Clouds(target, entry.scan(), T_map_world @ T_world_body)


@lru_cache(maxsize=2)
def _read(path: Path) -> Scan:
    return read_scan(path)


def perturbed(
    scan: Scan, T_target_source: Transform, rng: np.random.Generator, *, offset_m: float
) -> tuple[Scan, Transform]:
    """Return a scan in a frame of any yaw, at most a distance from the target's, and that frame's pose."""
    yaw, bearing = rng.uniform(-np.pi, np.pi, 2)
    reach_m = offset_m * np.sqrt(rng.random())
    c, s = np.cos(yaw), np.sin(yaw)
    R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ T_target_source[:3, :3]
    x, y = reach_m * np.array([np.cos(bearing), np.sin(bearing)])
    T_target_new = transform(R, np.array([x, y, T_target_source[2, 3]]))
    return scan.moved(inverse(T_target_new) @ T_target_source), T_target_new


def fewer_rings(scan: Scan) -> Scan:
    """Return every fourth of 64 rings, by elevation: about what a VLP-16 would have seen."""
    x, y, z = scan.points_body.T
    elevation = np.arctan2(z, np.hypot(x, y))
    low, high = np.percentile(elevation, [0.5, 99.5])
    keep = ((elevation - low) / (high - low) * _RINGS).astype(int) % (_RINGS // _KEPT_RINGS) == 0
    return Scan(stamp_ns=scan.stamp_ns, points_body=scan.points_body[keep], origin_body=scan.origin_body)


def merged(scans: Sequence[Scan], T_map_body: Sequence[Transform], *, voxel_m: float) -> Scan:
    """Return a map of scans, one point per voxel, as if it had been seen from its origin."""
    points = np.concatenate([scan.moved(T).points_body for scan, T in zip(scans, T_map_body, strict=True)])
    return Scan(stamp_ns=0, points_body=points[thin(points, voxel_m)])
