"""Odometry factory."""

from functools import partial
from typing import TYPE_CHECKING, Any, assert_never

from mapper.core.errors import ConfigError
from mapper.core.trajectory import Trajectory
from mapper.graph.config import WheelFactorsConfig, WheelNoiseConfig
from mapper.odometry.base import FrameOdometry, MotionCheck, Odometry
from mapper.odometry.config import (
    FrameOdometryConfig,
    GivenOdometryConfig,
    IsvdOdometryConfig,
    LocalMapConfig,
    OdometryConfig,
    OwnOdometryConfig,
    PnpConfig,
    WheelsOdometryConfig,
)
from mapper.odometry.scans.config import (
    AnyScanOdometryConfig,
    GicpOdometryConfig,
    HoughOdometryConfig,
    IcpOdometryConfig,
    KissOdometryConfig,
)

if TYPE_CHECKING:
    from mapper.odometry.scans.scan_matcher import ScanMatcher
    from mapper.sensing.gyroscope import Gyroscope
    from mapper.sources.base import Log


def odometry_for(
    config: OdometryConfig,
    log: "Log",
    motion_check: MotionCheck | None = None,
    wheels: WheelFactorsConfig | None = None,
) -> Odometry[Any]:
    """Return the odometry that the settings choose for a log: with its poses, adapted to its surroundings.

    Args:
        config: Settings of one method.
        log: The log.
        motion_check: Another measurement of the motion, which rules out poses after a gap.
        wheels: Whether 2D scans are predicted by the log's wheels, and their noise; None is no.

    Raises:
        ConfigError: Wheel odometry or known poses are chosen, and the log has none.
        DataError: The file of known poses is malformed.
    """
    from mapper.odometry.given_poses import poses_for
    from mapper.odometry.scans.adapted_lengths import adapted_to

    if isinstance(config, IsvdOdometryConfig | LocalMapConfig | PnpConfig) and config.depth_noise is None:
        config = config.model_copy(update={"depth_noise": log.depth_noise})
    is_predicted = log.sensor == "lidar-2d" and wheels is not None and wheels.use
    return build_odometry(
        adapted_to(config, log),
        poses_for(config, log),
        motion_check,
        log.gyroscope,
        log.wheels if is_predicted else None,
        wheels,
    )


def build_odometry(
    config: OdometryConfig,
    poses: Trajectory | None = None,
    motion_check: MotionCheck | None = None,
    gyroscope: "Gyroscope | None" = None,
    wheels: Trajectory | None = None,
    wheel_noise: WheelNoiseConfig | None = None,
) -> Odometry[Any]:
    """Return the odometry that the settings choose, before its first frame; its module is imported only now.

    Args:
        config: Settings of one method.
        poses: T_odom_body of the log's wheel odometry, or known poses, as ``poses_for`` returns them.
        motion_check: Another measurement of the motion, which rules out poses after a gap.
        gyroscope: Angular velocities of the log, if it has any.
        wheels: T_odom_body by which an odometry from scans predicts the motion, if it does.
        wheel_noise: Errors of most wheels; None is those of the defaults.

    Raises:
        ConfigError: Wheel odometry or known poses are chosen, and the log has none; or a caller's own.
    """
    match config:
        case WheelsOdometryConfig():
            from mapper.odometry.wheel_odometry import WheelsOdometry

            if poses is None:
                raise ConfigError(
                    "odometry.kind=wheels: the log has no wheel odometry; put wheels.txt or encoders.txt "
                    "into its folder, or name a recording's topic: --set source.topics.wheels=/odom"
                )
            return WheelsOdometry(config, poses)
        case GivenOdometryConfig():
            from mapper.odometry.given_poses import GivenOdometry

            if poses is None:
                raise ConfigError(
                    "odometry.kind=given: the log has neither true nor device poses; name a file of poses: "
                    "--set odometry.path=poses.tum"
                )
            return GivenOdometry(config, poses)
        case OwnOdometryConfig():
            raise ConfigError(
                f"odometry.kind=own: {config.name} odometry is an object of the program that built the run; "
                "choose another kind, or give it to mapper.build(…, odometry=…)"
            )
        case _:
            return build_frame_odometry(config, motion_check, gyroscope, wheels, wheel_noise)


def build_frame_odometry(
    config: FrameOdometryConfig,
    motion_check: MotionCheck | None = None,
    gyroscope: "Gyroscope | None" = None,
    wheels: Trajectory | None = None,
    wheel_noise: WheelNoiseConfig | None = None,
) -> FrameOdometry[Any]:
    """Return the odometry that the settings choose among those that use the frames' images or scans."""
    if isinstance(config, AnyScanOdometryConfig):
        from mapper.odometry.scans.odometry import ScanOdometry

        return ScanOdometry(config, _build_matcher(config), gyroscope, wheels, wheel_noise)
    match config:
        case IsvdOdometryConfig():
            from mapper.odometry.isvd.odometry import IsvdOdometry

            return IsvdOdometry(config, motion_check=motion_check, gyroscope=gyroscope)
        case LocalMapConfig():
            from mapper.odometry.keyframes.motion_model_tracker import MotionPoseTracker
            from mapper.odometry.keyframes.odometry import KeyframeOdometry

            return KeyframeOdometry(config, partial(MotionPoseTracker, config), motion_check, gyroscope)
        case PnpConfig():
            from mapper.odometry.keyframes.odometry import KeyframeOdometry
            from mapper.odometry.keyframes.pnp_tracker import PnpPoseTracker

            return KeyframeOdometry(config, PnpPoseTracker, motion_check, gyroscope)
        case _:
            assert_never(config)


def _build_matcher(config: AnyScanOdometryConfig) -> "ScanMatcher":
    """Return the scan matcher that the settings choose, before its first scan."""
    match config:
        case GicpOdometryConfig():
            from mapper.odometry.scans.gicp_matcher import GicpMatcher

            return GicpMatcher(config)
        case IcpOdometryConfig():
            from mapper.odometry.scans.icp_matcher import IcpMatcher

            return IcpMatcher(config)
        case KissOdometryConfig():
            from mapper.odometry.scans.kiss_icp_matcher import KissMatcher

            return KissMatcher(config)
        case HoughOdometryConfig():
            from mapper.odometry.scans.scan_to_scan import ScanToScanMatcher

            return ScanToScanMatcher(config)
        case _:
            assert_never(config)
