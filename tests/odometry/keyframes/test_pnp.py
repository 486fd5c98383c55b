"""P3P on known points, and PnP odometry on a short synthetic log (Zhao et al. 2020)."""

import numpy as np
import pytest

from mapper.config.loading import load_config
from mapper.core.geometry import angle_between, apply, exp, inverse
from mapper.core.trajectory import trajectory_from
from mapper.evaluators.metrics.trajectory_errors import ate_rmse_m
from mapper.odometry.config import PnpConfig
from mapper.odometry.factory import build_frame_odometry
from mapper.registration.reprojection import ransac_p3p
from tests.support.paths import CONFIGS

INTRINSICS = np.array([525.0, 525.0, 319.5, 239.5])
PAPER = CONFIGS / "zhao.toml"


def tracked(frames, config):
    odometry = build_frame_odometry(config)
    return [odometry.track(odometry.observe(frame)) for frame in frames]


def path_of(tracks):
    return trajectory_from((t.stamp_ns, t.T_world_body) for t in tracks)


def pairs(rng, *, count=200, noise_px=0.5):
    """World points, their pixels, and the T_camera_world that they were seen with."""
    T_camera_world = exp(rng.normal(0.0, 0.5, 3), rng.normal(0.0, 1.0, 3))
    points_camera = rng.uniform([-1.5, -1.0, 1.0], [1.5, 1.0, 4.0], (count, 3))
    pixels = points_camera[:, :2] / points_camera[:, 2:] * INTRINSICS[:2] + INTRINSICS[2:]
    return (
        apply(inverse(T_camera_world), points_camera),
        pixels + rng.normal(0, noise_px, pixels.shape),
        T_camera_world,
    )


@pytest.mark.parametrize("seed", range(4))
def test_p3p_finds_the_pose_among_as_many_wrong_pairs_as_right_ones(seed):
    rng = np.random.default_rng(seed)
    points_world, pixels, truth = pairs(rng)
    pixels[:100] = pixels[rng.permutation(100)]

    T_camera_world, agreeing = ransac_p3p(points_world, pixels, INTRINSICS, tolerance_px=4.0, iterations=100)

    assert (agreeing >= 100).mean() > 0.95
    assert len(agreeing) > 90
    miss = inverse(truth) @ T_camera_world
    assert np.linalg.norm(miss[:3, 3]) < 0.02
    assert angle_between(miss[:3, :3], np.eye(3)) < 0.01


def test_p3p_draws_the_same_samples_every_time():
    points_world, pixels, _ = pairs(np.random.default_rng(7))
    pixels[:120] += 60.0
    first, second = (
        ransac_p3p(points_world, pixels, INTRINSICS, tolerance_px=4.0, iterations=100) for _ in range(2)
    )
    assert first[0].tobytes() == second[0].tobytes()
    assert (first[1] == second[1]).all()


def test_another_seed_draws_other_pairs():
    points_world, pixels, truth = pairs(np.random.default_rng(7), noise_px=2.0)
    pixels[:80] += 60.0
    poses = [
        ransac_p3p(points_world, pixels, INTRINSICS, tolerance_px=4.0, iterations=100, seed=seed)
        for seed in (0, 1, 2)
    ]
    assert len({T_camera_world.tobytes() for T_camera_world, _ in poses}) == 3
    for T_camera_world, agreeing in poses:
        assert (np.diff(agreeing) > 0).all()
        assert (agreeing >= 80).mean() > 0.95
        assert np.linalg.norm((inverse(truth) @ T_camera_world)[:3, 3]) < 0.05


def test_points_in_one_line_have_no_pose():
    line = np.outer(np.linspace(1.0, 2.0, 30), [0.1, 0.2, 1.0])
    pixels = np.tile(INTRINSICS[2:], (30, 1)) + np.random.default_rng(0).uniform(-200, 200, (30, 2))
    assert ransac_p3p(line, pixels, INTRINSICS, tolerance_px=1.0, iterations=100) is None


def test_it_follows_the_truth(source, frames):
    tracks = tracked(frames, PnpConfig())
    assert [t.diagnostics.method for t in tracks] == ["start"] + ["pnp"] * (len(frames) - 1)
    assert ate_rmse_m(path_of(tracks), source.truth) < 0.01
    assert 1 < sum(t.is_keyframe for t in tracks) < len(frames) // 2


def test_pixels_alone_suffice(source, frames):
    """Depth still makes landmarks, but is in no residual."""
    config = PnpConfig(depth_residual=False)
    observation = build_frame_odometry(config).observe(frames[0])
    assert np.isnan(observation.measured[:, 2]).all()
    assert observation.has_depth.mean() > 0.5
    assert ate_rmse_m(path_of(tracked(frames, config)), source.truth) < 0.02


def test_without_a_local_map_only_what_matching_found_is_used(frames):
    searched, matched = (tracked(frames[:4], PnpConfig(local_keyframes=n)) for n in (15, 0))
    assert matched[1].diagnostics.matches < searched[1].diagnostics.matches
    assert matched[-1].diagnostics.method == "pnp"


def test_the_papers_settings_track_as_published(source, frames):
    config = load_config(PAPER).odometry
    assert (config.kind, config.ransac_iterations, config.ransac_tolerance_px) == ("pnp", 100, 4.0)
    assert ate_rmse_m(path_of(tracked(frames, config)), source.truth) < 0.02
