"""Registration of two RGB-D frames by ISVD, without a log around them."""

import time

from mapper.core.errors import ConfigError
from mapper.core.frames import Frame, RgbdFrame
from mapper.odometry.config import IsvdOdometryConfig
from mapper.odometry.isvd.odometry import IsvdOdometry
from mapper.odometry.isvd.registration import PairRegistration
from mapper.registration.base import Alignment


def align_images(
    target: Frame, source: Frame, config: IsvdOdometryConfig
) -> tuple[Alignment, dict[str, float]]:
    """Return the motion between two frames' features, and the seconds that "prepare" and "align" took.

    Args:
        target: Frame that stays.
        source: Frame that is aligned to it.
        config: The method; its fallback is tried where the first matching leads to no motion.

    Raises:
        ConfigError: A frame is a scan.
    """
    if not isinstance(target, RgbdFrame) or not isinstance(source, RgbdFrame):
        raise ConfigError("method isvd matches images, and these are scans; name frames of an RGB-D log")
    odometry = IsvdOdometry(config)
    began = time.perf_counter()
    seen_target = odometry.observe(target)
    detected = time.perf_counter()
    seen_source = odometry.observe(source)
    register = PairRegistration(config.registration, by_pixels=config.residual == "pixels")
    for match in (config.match, config.fallback):
        alignment, _, _ = register(seen_target, seen_source, match)
        if alignment.converged:
            break
    return alignment, {"prepare": detected - began, "align": time.perf_counter() - detected}
