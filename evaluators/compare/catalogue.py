"""Catalogue of the methods of `mapper compare`, set up for a log's sensor, and RKO-LIO."""

import atexit
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any, cast, get_args

import numpy as np

from mapper.config.loading import load_config
from mapper.core.config import AnyConfig, scale_length, with_changes
from mapper.core.errors import ConfigError
from mapper.core.frames import RgbdFrame, Scan, Sensor
from mapper.core.geometry import Array, interpolate, transform
from mapper.core.rotations import rotation_from_quaternion
from mapper.core.timebase import NS_PER_S
from mapper.core.trajectory import Trajectory, trajectory_from
from mapper.evaluators.compare.config import CompareConfig
from mapper.evaluators.compare.methods import (
    Method,
    OdometryTracker,
    Tracker,
    odometry_method,
    registration_method,
)
from mapper.odometry.base import FrameOdometry
from mapper.odometry.config import IsvdOdometryConfig, LocalMapConfig, PnpConfig
from mapper.odometry.factory import build_frame_odometry
from mapper.odometry.scans.config import KissOdometryConfig
from mapper.pipeline.track import begin_calibrated, session_odometry
from mapper.registration.config import NEED_NO_GUESS, VOXEL_M, RegistrationConfig
from mapper.registration.factory import aligner_to
from mapper.registration.hough.config import HoughConfig
from mapper.runtime.extras import extra, install_line, require
from mapper.sources.base import Log

if TYPE_CHECKING:
    from mapper.registration.rgbd import HybridRgbd

RKO_LIO = "rko-lio"
SCAN_TO_MAP = "scan-to-map"
"""The odometry of LiDAR logs in `mapper build`, with the times of points, the gyroscope and the wheels."""
_LIBRARIES = {
    "rgbd": "open3d",
    "ndt": "open3d",
    "hough-ndt": "open3d",
    "kiss-matcher": "kiss_matcher",
    "kiss-icp": "kiss_icp",
    RKO_LIO: "rko_lio",
}
"""Optional libraries of methods, by the method's name."""
_INDOORS = 0.1
"""A depth camera sees 4 m where a LiDAR sees 40."""
_MAX_CAMERA_TILT_RAD = 1.05
"""A hand-held camera is tilted down to tables."""


def methods_for(source: Log, config: CompareConfig) -> tuple[list[Method], list[str]]:
    """Return the chosen methods that can use a log, and sentences on those that cannot.

    Raises:
        ConfigError: No method of such a name, or none of them can use the log.
        DependencyError: The library of a method that is named is not installed.
    """
    images, scans = _image_methods(config.rgbd.max_depth_m), _scan_methods(source)
    names = [method.name for method in (*images, *scans)]
    if RKO_LIO in config.methods and RKO_LIO not in names:
        raise ConfigError(f"{source.path}: {RKO_LIO} needs scans, angular velocities and accelerations")
    for name in config.methods:
        if name not in names:
            raise ConfigError(f"no method {name!r}; want one of {', '.join(names)}")
        if name in _LIBRARIES:
            require(_LIBRARIES[name], "peers", f"--method {name}")
    known = {} if config.methods else {n: lib for n, lib in _LIBRARIES.items() if n in names}
    absent = {name: library for name, library in known.items() if find_spec(library) is None}
    chosen = config.methods or [name for name in names if name not in absent]
    unusable = [m.name for m in images if m.name in chosen and source.sensor != "rgbd"]
    methods = [m for m in (*images, *scans) if m.name in chosen and m.name not in unusable]
    notes = [f"{', '.join(unusable)}: left out, for the log has no images"] if unusable else []
    if absent:
        libraries = ", ".join(sorted(set(absent.values())))
        notes.append(f"{', '.join(absent)}: left out without {libraries}: {install_line('peers')}")
    if not methods:
        raise ConfigError(f"{source.path}: {notes[0]}; choose others of {', '.join(m.name for m in scans)}")
    return methods, notes


def _image_methods(max_depth_m: float) -> list[Method]:
    odometries = (
        LocalMapConfig(max_depth_m=max_depth_m),
        IsvdOdometryConfig(max_depth_m=max_depth_m),
        PnpConfig(max_depth_m=max_depth_m),
    )

    def hybrid(target: RgbdFrame) -> "HybridRgbd":
        from mapper.registration.rgbd import HybridRgbd  # Open3D takes seconds to load

        return HybridRgbd(target, max_depth_m=max_depth_m)

    return [
        *(
            odometry_method(one.kind, partial(build_frame_odometry, one), sees_images=True)
            for one in odometries
        ),
        registration_method("rgbd", hybrid, uses_guess=True, sees_images=True),
    ]


def _scan_methods(source: Log) -> list[Method]:
    """Return the registrations of scans, first those that need a guess, and the odometries of scans."""
    sensor = source.sensor
    registrations = [
        registration_method(
            one.kind, partial(aligner_to, config=one), uses_guess=one.kind not in NEED_NO_GUESS
        )
        for one in registrations_for(sensor)
    ]
    kiss = kiss_icp(sensor)
    methods = [
        *sorted(registrations, key=lambda method: not method.uses_guess),
        odometry_method(kiss.kind, partial(build_frame_odometry, kiss), sees_images=False),
    ]
    if sensor != "rgbd":
        methods.append(_follower(SCAN_TO_MAP, partial(_default_tracker, source)))
    if sensor == "lidar" and source.gyroscope is not None and source.accelerations is not None:
        methods.append(_follower(RKO_LIO, partial(RkoLioTracker, source)))
    return methods


def _follower(name: str, tracker: Callable[[], Tracker]) -> Method:
    """Return a method that follows whole logs alone, and gets the times of points."""
    return Method(
        name, sees_images=False, uses_guess=False, tracker=tracker, registration=None, sees_times=True
    )


def _default_tracker(source: Log) -> Tracker:
    config = load_config(None, sensor=source.sensor)
    odometry = session_odometry(source, config)
    begin_calibrated(odometry, source, config.workers)
    return OdometryTracker(cast(FrameOdometry[Any], odometry))


def registrations_for(sensor: Sensor) -> list[Any]:
    """Return the settings of every registration of scans: its own for LiDARs, shrunk for depth cameras."""
    members: tuple[Any, ...] = get_args(get_args(RegistrationConfig)[0])
    return [_fitted(member(), sensor) for member in members]


def kiss_icp(sensor: Sensor) -> KissOdometryConfig:
    """Return KISS-ICP as published: without our checks of its answers."""
    published = KissOdometryConfig(rescue=None, usual_ratio=0.0, lost_ratio=0.0)
    return published if sensor == "lidar" else shrunk(published, _INDOORS)


def shrunk(config: AnyConfig, ratio: float) -> AnyConfig:
    """Return settings with every length, at any depth, at a part of its size."""

    def change(name: str, value: Any) -> Any:
        return scale_length(value, ratio) if name.endswith("_m") else value

    return with_changes(config, change)


def _fitted(config: Any, sensor: Sensor) -> Any:
    if sensor != "rgbd":
        return config
    if isinstance(config, HoughConfig):
        return _hough_indoors(config)
    return config.model_copy(update={"voxel_m": VOXEL_M[sensor]})  # its other lengths are multiples


def _hough_indoors(config: HoughConfig) -> HoughConfig:
    """Return the Hough methods shrunk, but for how high above the ground a sensor may stand."""
    heights = {"min_height_m", "max_height_m"}
    small = shrunk(config, _INDOORS)
    levelling = small.constellation.levelling.model_copy(
        update=config.constellation.levelling.model_dump(include=heights)
        | {"max_tilt_rad": _MAX_CAMERA_TILT_RAD}
    )
    constellation = small.constellation.model_copy(update={"levelling": levelling})
    return small.model_copy(update={"constellation": constellation})


class RkoLioTracker:
    """Tracker by the library with its defaults, on one thread: no loops, no settings of a log.

    It gets the readings as the log states them, the unit at the body's origin, and turned to the body's axes
    if the log has the mounting: it estimates no calibration. Its poses are those at the ends of the sweeps.
    """

    def __init__(self, log: Log) -> None:
        """Begin before the first scan.

        Raises:
            ConfigError: The log lacks angular velocities or accelerations.
            DependencyError: The library is not installed.
        """
        with extra("peers", "--method rko-lio"):
            from rko_lio.config import LIOConfig
            from rko_lio.lio import LIO
            from rko_lio.rko_lio_pybind import RegistrationError
        if log.gyroscope is None or log.accelerations is None:
            raise ConfigError(f"{log.path}: no angular velocities or no accelerations, which rko-lio needs")
        self._stamps_ns, self._rates = log.gyroscope.stamps_ns, log.gyroscope.rates_radps
        readings = log.accelerations.acceleration_mps2
        at = (self._stamps_ns, log.accelerations.stamps_ns)
        self._accelerations: Array = np.stack([np.interp(*at, column) for column in readings.T], axis=1)
        self._T_body_imu = transform(
            np.eye(3) if log.gyroscope.R_body_imu is None else log.gyroscope.R_body_imu, np.zeros(3)
        )
        self._lost, self._used = RegistrationError, 0
        self._frames_ns: list[int] = []
        with _silence():
            self._lio = LIO(LIOConfig(max_num_threads=1))

    def add(self, scan: Scan) -> bool:
        """Add the readings until the end of a scan, then the scan; it is lost if nothing corresponds."""
        times_s = np.zeros(len(scan.points_body)) if scan.times_s is None else scan.times_s.astype(np.float64)
        times_ns = scan.stamp_ns + np.round(times_s * NS_PER_S).astype(np.int64)
        until = int(np.searchsorted(self._stamps_ns, times_ns.max(), side="right"))
        with _silence():
            for i in range(self._used, until):
                self._lio.add_imu_measurement(
                    self._accelerations[i], self._rates[i], int(self._stamps_ns[i]), self._T_body_imu
                )
            self._used = until
            try:
                self._lio.register_scan(scan.points_body, times_ns, np.eye(4))
            except self._lost:
                return False
        self._frames_ns.append(scan.stamp_ns)
        return True

    def trajectory(self) -> Trajectory:
        """Return the poses at the scans' stamps, by constant velocity between the ends of the sweeps."""
        ends_ns, rows = self._lio.poses_with_timestamps()  # x y z and quaternion, x first
        poses = [transform(rotation_from_quaternion(row[3:]), row[:3]) for row in np.array(rows)]
        if len(poses) < 2:
            return trajectory_from(())
        last = np.clip(np.searchsorted(ends_ns, self._frames_ns), 1, len(poses) - 1)
        return trajectory_from(
            (
                stamp_ns,
                interpolate(
                    poses[i - 1], poses[i], (stamp_ns - ends_ns[i - 1]) / (ends_ns[i] - ends_ns[i - 1])
                ),
            )
            for stamp_ns, i in zip(self._frames_ns, last, strict=True)
        )


@contextmanager
def _silence() -> Iterator[None]:
    """Drop what the library prints on standard output, now and, its timings, when the program ends."""
    sys.stdout.flush()
    kept = os.dup(1)
    try:
        _close_output()
        yield
    finally:
        os.dup2(kept, 1)
        os.close(kept)
        atexit.unregister(_close_output)
        atexit.register(_close_output)


def _close_output() -> None:
    sys.stdout.flush()
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    os.close(nowhere)
