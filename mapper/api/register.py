"""Registration of two clouds, of arrays, files or logs' frames, and the first guess of their motion."""

import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from mapper.api.logs import read_frame
from mapper.config.loading import Settings, load_source_config, overridden
from mapper.config.register import check_method, register_config
from mapper.core.errors import ConfigError
from mapper.core.frames import Cloud, Frame, RgbdFrame, Scan, Sensor
from mapper.core.geometry import Transform, is_rigid, point_rows, transform
from mapper.core.rotations import pose_of_row, rotation_from_euler
from mapper.odometry.config import IsvdOdometryConfig
from mapper.registration.base import Alignment
from mapper.registration.factory import aligner_to
from mapper.runtime.regular_files import AnyPath
from mapper.sources.config import SourceConfig


def parse_guess(text: str | None) -> Transform:
    """Return the (4, 4) T_target_source of a guess; identity for None.

    Args:
        text: Six numbers, x y z in metres and roll pitch yaw in degrees; or a file with a 4×4 or 3×4 matrix,
            or a line of TUM (stamp x y z qx qy qz qw; the stamp may be absent).

    Raises:
        ConfigError: It is none of these.
    """
    if text is None:
        return np.eye(4)
    path = Path(text)
    is_file = path.is_file()
    numbers = _numbers(path.read_text(errors="replace") if is_file else text, text)
    if is_file and len(numbers) in (12, 16):
        rows = numbers.reshape(-1, 4)
        T_target_source = transform(rows[:3, :3], rows[:3, 3])
        if not is_rigid(T_target_source) or (len(rows) == 4 and not np.allclose(rows[3], [0, 0, 0, 1])):
            raise ConfigError(f"--guess {text}: the matrix is no rigid motion")
        return T_target_source
    if is_file and len(numbers) in (7, 8):
        return pose_of_row(numbers[-7:])
    if len(numbers) == 6:
        return transform(rotation_from_euler(*np.radians(numbers[3:])), numbers[:3])
    raise ConfigError(
        f'--guess {text}: {len(numbers)} numbers; want "x y z roll pitch yaw" in metres and degrees, '
        "or a file with a 4×4 matrix or a TUM line"
    )


def _numbers(content: str, text: str) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    lines = [line for line in content.splitlines() if not line.lstrip().startswith("#")]
    try:
        numbers = np.array([float(word) for line in lines for word in line.replace(",", " ").split()])
    except ValueError:
        raise ConfigError(
            f'--guess {text}: no such file, and not "x y z roll pitch yaw" in metres and degrees'
        ) from None
    if not np.isfinite(numbers).all():
        raise ConfigError(f"--guess {text}: a number is not finite")
    return numbers


Registrable = ArrayLike | Cloud | Frame | AnyPath
"""(N, 3) points in metres, a cloud, a frame, a cloud's file, or ``LOG@N``."""


def register(
    source: Registrable,
    target: Registrable,
    *,
    method: str = "hough-gicp",
    guess: ArrayLike | AnyPath | None = None,
    settings: Settings | None = None,
) -> Alignment:
    """Register two clouds: find the pose of the source in the target.

    Args:
        source: Cloud that is aligned: (N, 3) points in metres, a file (.bin .pcd .ply .xyz .npy .las .laz),
            ``LOG@N`` for the n-th frame of a log, or a frame. Points are kept as float32, so they lie within
            a kilometre of their origin.
        target: Cloud that it is aligned to, given likewise.
        method: "hough-gicp" or "hough-ndt", which search all motions of clouds with z up; "kiss-matcher",
            which searches any; "icp", "plane-icp", "gicp" or "ndt", which refine the guess; "isvd" for
            RGB-D frames.
        guess: Pose of the source in the target to begin with: (4, 4), "x y z roll pitch yaw" in metres and
            degrees, or a file; None is the same place.
        settings: Values by dotted name, such as ``{"registration.voxel_m": 0.05}`` for a cloud of some
            metres: every length of a method is a multiple of it. Arrays and files begin with 0.3 m.

    Returns:
        The motion ``T_target_source``, whether it ``converged``, else the ``reason``, and how well the clouds
        agree (``inlier_ratio``, ``inlier_rmse_m``).

    Raises:
        ConfigError: No such method or setting, or a guess that the method does not use.
        DataError: The points are not (N, 3), or not finite.
        SourceError: A file or a frame cannot be read.

    Example:
        >>> import numpy
        >>> cloud = numpy.random.default_rng(0).uniform(-5.0, 5.0, (4000, 3)) * [1.0, 1.0, 0.2]
        >>> found = mapper.register(cloud - [0.1, 0.0, 0.0], cloud, method="icp")
        >>> found.converged, float(found.T_target_source[0, 3].round(1))
        (True, 0.1)
    """
    check_method(method, guess=None if guess is None else "given")
    T_target_source = _guess(guess)
    settings = settings or {}
    opening = load_source_config(settings=settings)
    (target_frame, target_sensor), (source_frame, source_sensor) = (
        _frame(cloud, name, opening) for cloud, name in ((target, "target"), (source, "source"))
    )
    config = overridden(register_config(method, target_sensor, source_sensor), settings=settings).registration
    if isinstance(config, IsvdOdometryConfig):
        from mapper.odometry.isvd.odometry import align_images

        return align_images(target_frame, source_frame, config)[0]
    return aligner_to(target_frame.scan(), config).align(source_frame.scan(), T_target_source)


def _frame(cloud: Registrable, name: str, config: SourceConfig) -> tuple[Frame, Sensor]:
    match cloud:
        case RgbdFrame():
            return cloud, "rgbd"
        case Scan():
            return cloud, "lidar"
        case str() | os.PathLike():
            return read_frame(cloud, config)
        case _:
            _, rows = point_rows(cloud, f"register: {name}")
            return Scan(0, rows.astype(np.float32)), "lidar"


def _guess(guess: Any) -> Transform:
    match guess:
        case None:
            return np.eye(4)
        case str() | os.PathLike():
            return parse_guess(os.fspath(guess))
        case _:
            T_target_source = np.asarray(guess, dtype=np.float64)
            if T_target_source.shape != (4, 4) or not is_rigid(T_target_source):
                raise ConfigError(
                    f"guess: an array {T_target_source.shape}, want a rigid motion (4, 4), or text of six"
                )
            return T_target_source
