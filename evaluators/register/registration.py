"""One registration, step by step: its motion and distances after each stage, and the time that it took."""

import time
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from mapper.core.frames import Frame, Scan
from mapper.core.geometry import Transform
from mapper.evaluators.metrics.cloud_distance import CloudDistance, DistanceTo
from mapper.odometry.config import IsvdOdometryConfig
from mapper.registration.base import Alignment
from mapper.registration.config import AnyRegistration
from mapper.registration.factory import build_registration
from mapper.registration.hough.config import HoughGicpConfig, HoughNdtConfig

_WARM_UP_STRIDE = 10


@dataclass(frozen=True, slots=True, eq=False)
class Stage:
    """The clouds after one step.

    Attributes:
        name: "before", "Hough" or "refined".
        T_target_source: (4, 4) the motion by then.
        distance: Distance of the source from the target under it.
    """

    name: str
    T_target_source: Transform
    distance: CloudDistance


@dataclass(frozen=True, slots=True, eq=False)
class Registered:
    """A registration, step by step.

    Attributes:
        method: Its name in the configuration.
        alignment: The answer.
        stages: Stages from the beginning on; without "refined" where there was no answer at all.
        seconds: Wall time of each step, in order.
        cpu_s: CPU time of all steps, which other programs do not change.
    """

    method: str
    alignment: Alignment
    stages: tuple[Stage, ...]
    seconds: Mapping[str, float]
    cpu_s: float


def register(
    target: Frame,
    source: Frame,
    config: AnyRegistration | IsvdOdometryConfig,
    T_target_source: Transform,
) -> Registered:
    """Register two frames, and return the course of it.

    Args:
        target: Frame that stays.
        source: Frame that is aligned to it.
        config: The method.
        T_target_source: (4, 4) guess, for methods that refine one.

    Raises:
        ConfigError: A method of images was given scans.
        DataError: A frame without points.
    """
    scans = target.scan(), source.scan()
    hough = None
    if isinstance(config, IsvdOdometryConfig):
        began = time.process_time()
        from mapper.odometry.isvd.odometry import align_images

        alignment, seconds = align_images(target, source, config)
    else:
        # Loads libraries and compiled code, which is no step's time.
        _by_scans(_thinned(scans[0]), _thinned(scans[1]), config, T_target_source)
        began = time.process_time()
        alignment, hough, seconds = _by_scans(*scans, config, T_target_source)
    cpu_s = time.process_time() - began
    motions = {"before": T_target_source}
    if hough is not None:
        motions["Hough"] = hough
    if alignment.converged or alignment.information is not None:
        motions["refined"] = alignment.T_target_source
    distance = distance_to(scans[0])
    stages = (Stage(name, T, distance.of(scans[1].points_body, T)) for name, T in motions.items())
    return Registered(config.kind, alignment, tuple(stages), seconds, cpu_s)


@lru_cache(maxsize=1)
def distance_to(target: Scan) -> DistanceTo:
    """Return what measures distances from a scan's points; that of the last scan is kept."""
    return DistanceTo(target.points_body)


def _by_scans(
    target: Scan, source: Scan, config: AnyRegistration, T_target_source: Transform
) -> tuple[Alignment, Transform | None, dict[str, float]]:
    """Return the answer, Hough's own where the method has that stage, and the time of every step."""
    began = time.perf_counter()
    if isinstance(config, HoughGicpConfig | HoughNdtConfig):
        from mapper.registration.hough.aligner import Hough

        voter = Hough(config).prepare(target)
        prepared = time.perf_counter()
        course = voter.stages(source)
        hough = None if course.hough is None else course.hough.T_target_source
        return course.alignment, hough, {"prepare": prepared - began, **course.seconds}
    aligner = build_registration(config).prepare(target)
    prepared = time.perf_counter()
    alignment = aligner.align(source, T_target_source)
    return alignment, None, {"prepare": prepared - began, "align": time.perf_counter() - prepared}


def _thinned(scan: Scan) -> Scan:
    """Return every tenth point of a scan, for a first run that loads and compiles what the method needs."""
    # A view with gaps would have kernels compiled for itself and none for whole scans.
    return Scan(scan.stamp_ns, np.ascontiguousarray(scan.points_body[::_WARM_UP_STRIDE]))


def xyz_rpy(T_a_b: Transform) -> tuple[list[float], list[float]]:
    """Return a pose as metres and as roll, pitch, yaw in degrees, for a screen or a file."""
    from mapper.core.rotations import euler_from_rotation

    return T_a_b[:3, 3].tolist(), np.degrees(euler_from_rotation(T_a_b[:3, :3])).tolist()
