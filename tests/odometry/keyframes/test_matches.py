"""Matches of a frame: which features agree with its pose, and their pixels in an earlier frame."""

import numpy as np
import pytest

from mapper.features.config import OrbConfig
from mapper.odometry.config import IsvdOdometryConfig, LocalMapConfig, WheelsOdometryConfig
from mapper.odometry.factory import build_frame_odometry, build_odometry
from mapper.sources import open_source
from tests.support.desk_frames import blank

CONFIGS = {"local-map": LocalMapConfig(), "isvd": IsvdOdometryConfig(detector=OrbConfig())}


def followed(config, log, count=8):
    """Odometry, track, view and matches after each frame."""
    odometry = build_frame_odometry(config)
    for entry in list(open_source(log).entries())[:count]:
        observation = odometry.read(entry)
        track = odometry.track(observation)
        yield track, odometry.view(observation), odometry.matches()


def rows(pixels):
    return {tuple(row) for row in pixels.tolist()}


@pytest.mark.parametrize("config", CONFIGS.values(), ids=CONFIGS)
def test_matched_features_have_the_pixels_of_an_earlier_frame(config, desk_log):
    seen, pixels = [], 0
    for track, view, matches in followed(config, desk_log):
        if seen:
            assert matches.is_inlier.sum() == track.diagnostics.inliers or track.is_keyframe
            has_previous = np.isfinite(matches.previous_px[:, 0])
            assert not (has_previous & ~matches.is_inlier).any()
            before = matches.previous_px[has_previous]
            assert rows(before) <= set().union(*map(rows, seen))
            assert len(before) > 0.3 * matches.is_inlier.sum()
            steps_px = np.linalg.norm(view.pixels[has_previous] - before, axis=1)
            assert np.median(steps_px) < 20.0  # of a hand that sways; features at random are 100 px apart
            pixels += len(before)
        seen.append(view.pixels)
    assert pixels > 300


def test_isvd_matches_with_the_frame_just_before(desk_log):
    (_, before, _), (track, _, matches) = followed(CONFIGS["isvd"], desk_log, count=2)
    assert matches.is_inlier.sum() == track.diagnostics.inliers
    assert rows(matches.previous_px[matches.is_inlier]) <= rows(before.pixels)


@pytest.mark.parametrize("config", CONFIGS.values(), ids=CONFIGS)
def test_the_first_frame_has_no_earlier_pixels_and_a_lost_one_no_matches(config, desk_log):
    ((_, _, matches),) = followed(config, desk_log, count=1)
    assert matches is None or np.isnan(matches.previous_px).all()
    odometry = build_frame_odometry(config)
    entries = list(open_source(desk_log).entries())
    odometry.track(odometry.read(entries[0]))
    odometry.track(odometry.read(entries[1]))
    assert len(odometry.matches().is_inlier) > 0
    assert odometry.track(odometry.observe(blank(entries[2].load()))).node is None
    assert odometry.matches() is None


def test_wheel_odometry_has_no_matches(desk_log):
    source = open_source(desk_log)
    odometry = build_odometry(WheelsOdometryConfig(), source.truth)
    assert odometry.track(odometry.read(next(source.entries()))).node == 0
    assert odometry.matches() is None
