"""The walk that camera odometries are tried on."""

import pytest

from mapper.core.frames import RgbdFrame
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
