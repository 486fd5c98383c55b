"""The sharpest of every interval becomes a keyframe."""

import pytest

from mapper.core.errors import ConfigError
from mapper.odometry.sharpest_keyframe import SharpestKeyframes


def test_names_the_frame_with_most_features_of_every_interval():
    keyframes = SharpestKeyframes(4)

    named = [keyframes.add(node, features) for node, features in enumerate([5, 9, 9, 1, 2, 1, 0, 7])]

    assert named == [None, None, None, 1, None, None, None, 7]


def test_every_interval_has_one_even_without_any_feature():
    keyframes = SharpestKeyframes(3)

    assert [keyframes.add(node, 0) for node in range(6)] == [None, None, 0, None, None, 3]


def test_refuses_an_empty_interval():
    with pytest.raises(ConfigError, match="interval 0"):
        SharpestKeyframes(0)
