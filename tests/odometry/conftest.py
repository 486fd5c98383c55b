"""The walk that camera odometries are tried on."""

import pytest

from mapper.core.frames import RgbdFrame
from mapper.odometry.base import FrameOdometry, FrameResult
from mapper.odometry.config import LocalMapConfig
from mapper.odometry.factory import build_frame_odometry
from mapper.sources.base import Log
from tests.support.desk_frames import desk_frames, desk_walk


@pytest.fixture
def source() -> Log:
    """A synthetic log of three seconds before a desk."""
    return desk_walk()


@pytest.fixture
def frames() -> list[RgbdFrame]:
    """Its frames, without colours."""
    return list(desk_frames())


@pytest.fixture(scope="session")
def walked() -> tuple[list[FrameResult], FrameOdometry]:
    """What the default odometry said of each frame, and the odometry after them; tests change copies."""
    odometry = build_frame_odometry(LocalMapConfig())
    return [odometry.track(odometry.observe(frame)) for frame in desk_frames()], odometry
