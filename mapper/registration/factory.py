"""Factory of the methods that register two scans."""

from typing import assert_never

from mapper.core.frames import Scan
from mapper.registration.base import Aligner
from mapper.registration.config import (
    AnyRegistration,
    GicpConfig,
    IcpConfig,
    KissMatcherConfig,
    NdtConfig,
    PlaneIcpConfig,
)
from mapper.registration.hough.config import HoughGicpConfig, HoughNdtConfig


def aligner_to(target: Scan, config: AnyRegistration) -> Aligner:
    """Return the method that the settings choose, bound to a target; its module is imported only now."""
    match config:
        case HoughGicpConfig() | HoughNdtConfig():
            from mapper.registration.hough.aligner import Hough

            return Hough(target, config)
        case IcpConfig() | PlaneIcpConfig() | GicpConfig():
            from mapper.registration.icp import Icp

            return Icp(target, config)
        case NdtConfig():
            from mapper.registration.ndt import Ndt

            return Ndt(target, config)
        case KissMatcherConfig():
            from mapper.registration.kiss_matcher import KissMatcher

            return KissMatcher(target, config)
        case _:
            assert_never(config)
