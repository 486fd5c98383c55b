"""Factory of the methods that register two scans."""

from typing import assert_never

from mapper.registration.base import Registration
from mapper.registration.config import (
    AnyRegistration,
    GicpConfig,
    IcpConfig,
    KissMatcherConfig,
    NdtConfig,
    PlaneIcpConfig,
)
from mapper.registration.hough.config import HoughGicpConfig, HoughNdtConfig


def build_registration(config: AnyRegistration) -> Registration:
    """Return the method that the settings choose; its module is imported only now."""
    match config:
        case HoughGicpConfig() | HoughNdtConfig():
            from mapper.registration.hough.aligner import Hough

            return Hough(config)
        case IcpConfig() | PlaneIcpConfig() | GicpConfig():
            from mapper.registration.icp import Icp

            return Icp(config)
        case NdtConfig():
            from mapper.registration.ndt import Ndt

            return Ndt(config)
        case KissMatcherConfig():
            from mapper.registration.kiss_matcher import KissMatcher

            return KissMatcher(config)
        case _:
            assert_never(config)
