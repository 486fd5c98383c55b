"""Covariances of the LiDAR odometries, and their growth where a motion is predicted."""

from dataclasses import replace

import numpy as np
import pytest

from mapper.core.frames import Scan
from mapper.core.geometry import apply, exp, inverse, log
from mapper.odometry.scan_to_map.keyframe_tree import KeyframeTree
from mapper.odometry.scan_to_map.observed_part import MEASURED, Blend
from mapper.odometry.scan_to_map.scan_fit import fit_of
from mapper.odometry.scan_to_map.scan_noise import PredictedPart, ScanNoise
from mapper.registration.refining import refine
from tests.support.room_scans import OFF, keyframe, room_scan


def test_the_covariance_covers_what_noise_does():
    squares, truth = [], exp(np.array([0.0, 0.0, 0.03]), np.array([0.3, 0.1, 0.0]))
    for seed in range(12):
        key = keyframe(room_scan(0, seed=2 * seed, noise_m=0.03))
        scan = keyframe(room_scan(1, truth, seed=2 * seed + 1, noise_m=0.03)).deskewed
        found = refine(
            key.deskewed.prepared, scan.prepared, truth, kind="plane-icp", pair_distances_m=(0.5,)
        ).T_target_source
        fit = fit_of(key, scan, found, max_pair_distance_m=0.5)
        error = np.concatenate(log(inverse(truth) @ found))
        squares.append(error @ np.linalg.solve(fit.surface_covariance, error) / 6.0)

    assert 0.4 < np.mean(squares) < 2.5


def noise_of(T_key_scan, *, noise_m, off_m=0.0):
    """Return the sigmas of a room's scan, which is held off its place by a shift along x."""
    key = keyframe(room_scan(0, seed=1, noise_m=noise_m))
    scan = keyframe(room_scan(1, T_key_scan, seed=2, noise_m=noise_m)).deskewed
    found = T_key_scan @ exp(np.zeros(3), np.array([off_m, 0.0, 0.0]))
    fit = fit_of(key, scan, found, max_pair_distance_m=0.5)
    noise = ScanNoise().of(fit, MEASURED, T_key_scan, T_key_scan, 0.1, np.zeros((6, 6)))
    return np.sqrt(np.diag(noise.covariance))


def test_a_turn_on_the_spot_is_known_as_well_as_none():
    still = noise_of(np.eye(4), noise_m=0.01)
    turned = noise_of(exp(np.array([0.0, 0.0, 0.6]), np.zeros(3)), noise_m=0.01)

    assert turned[:3].max() < 2.0 * still[:3].max()  # the azimuth of a turning sensor has no scale error


def test_the_model_error_follows_the_distances_from_surfaces():
    T_key_scan = exp(np.array([0.0, 0.0, 0.03]), np.array([0.5, 0.1, 0.0]))
    near, far = (noise_of(T_key_scan, noise_m=noise_m) for noise_m in (0.005, 0.05))

    assert far[3:].min() > 3.0 * near[3:].min()


def test_a_pose_off_the_surfaces_is_uncertain_by_as_much():
    held, right = noise_of(OFF, noise_m=0.01, off_m=0.05), noise_of(OFF, noise_m=0.01)

    assert right[3] < 0.01
    assert 0.03 < held[3] < 0.1


def field_scan(T_world_body, posts_m, *, seed):
    """Return a scan of level ground with some square posts."""
    rng = np.random.default_rng(seed)
    ground = np.column_stack([rng.uniform(-20.0, 20.0, (9000, 2)), np.full(9000, -1.8)])
    faces = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])[
        rng.integers(0, 4, (len(posts_m), 400))
    ]
    across = rng.uniform(-0.7, 0.7, (len(posts_m), 400, 1)) * faces[..., ::-1]
    sides = np.array(posts_m)[:, None] + 0.7 * faces + across
    posts = np.concatenate([sides, rng.uniform(-1.8, 3.0, (len(posts_m), 400, 1))], axis=2).reshape(-1, 3)
    world = np.concatenate([ground, posts])
    world += rng.normal(0.0, 0.02, world.shape)
    return Scan(seed, apply(inverse(T_world_body), world).astype(np.float32))


def field_fit(posts_m):
    key = keyframe(field_scan(np.eye(4), posts_m, seed=1))
    scan = keyframe(field_scan(OFF, posts_m, seed=2)).deskewed
    return fit_of(key, scan, OFF, max_pair_distance_m=0.5)


def test_the_pairs_on_one_post_do_not_measure_a_rotation_about_it():
    alone, three = field_fit([(8.0, 4.0)]), field_fit([(8.0, 4.0), (-6.0, 7.0), (3.0, -9.0)])

    assert alone.shown_m[0] > 1.0  # of the outer points
    assert three.observability.min() == 1.0
    assert 0.0 < three.shown_m[0] < 0.05
    assert alone.shown_m[5] == three.shown_m[5] == 0.0  # many pairs show it


def test_the_error_of_a_motion_that_few_pairs_show_is_part_of_the_covariance():
    fit = field_fit([(8.0, 4.0), (-6.0, 7.0), (3.0, -9.0)])
    to_motion = np.linalg.inv(fit.degeneracy.motions.T)[0]
    variances = []
    for shown_m in (0.0, 0.3):
        shown = replace(fit, shown_m=np.array([shown_m, 0.0, 0.0, 0.0, 0.0, 0.0]))
        noise = ScanNoise().of(shown, MEASURED, OFF, OFF, 0.1, np.zeros((6, 6)))
        variances.append(to_motion @ noise.covariance @ to_motion)

    assert variances[1] - variances[0] == pytest.approx(0.09, rel=1e-6)


@pytest.mark.parametrize(("motion", "sigma"), [(3, 0.03), (2, 0.0132)])
def test_a_motion_that_two_scans_leave_open_is_no_doubt(motion, sigma):
    doubts = doubts_of_blends(motion, sigma, gains=[0.0] * 4)
    assert [bool(doubt) for doubt in doubts] == [False, False, True, True]


def test_a_motion_that_is_half_seen_is_no_doubt_however_long():
    assert not any(doubts_of_blends(3, 0.03, gains=[0.5] * 100))


def test_the_error_of_a_prediction_grows_as_that_of_random_accelerations_does():
    """Poses that constant velocity predicts from themselves, with a new error each time."""
    errors = np.random.default_rng(1).normal(0.0, 0.01, (4000, 20))
    positions = np.cumsum(np.cumsum(errors, axis=1), axis=1)
    part, variance = PredictedPart(), np.zeros(6)
    variance[3] = 0.01**2
    for k in range(20):
        covariance, _ = part.add(blend_of(3, 0.0, variance), np.eye(4), 0.1)
        assert np.sqrt(covariance[3, 3]) == pytest.approx(positions[:, k].std(), rel=0.05)


def blend_of(motion, gain, variances):
    gains = np.ones(6)
    gains[motion] = gain
    return Blend(np.diag(gains), np.zeros((6, 6)), np.diag(variances), np.sqrt(variances))


def doubts_of_blends(motion, sigma, *, gains):
    """Return the doubts of scans 0.1 s apart that show one motion by a gain, predicted to a sigma."""
    key, scan = keyframe(room_scan(0, seed=1)), keyframe(room_scan(1, OFF, seed=2)).deskewed
    fit = fit_of(key, scan, OFF, max_pair_distance_m=0.5)
    fit = replace(fit, observability=np.array([0.0, 1.0, 1.0, 1.0, 1.0, 1.0]))
    noise, variances = ScanNoise(), np.zeros(6)
    variances[motion] = sigma**2
    return [
        noise.of(fit, blend_of(motion, gain, variances), OFF, np.eye(4), 0.1, np.zeros((6, 6))).doubts
        for gain in gains
    ]


def test_covariances_of_keyframes_are_those_of_the_factors_between_them():
    tree = KeyframeTree(100)
    between = [
        tree.add(node, parent, np.eye(4), np.eye(6))[0, 0] for node, parent in enumerate([0, 0, 1, 3], 1)
    ]
    assert between == [1.0, 2.0, 3.0, 1.0]
    for node in range(5, 100):  # by turns on two branches
        covariance = tree.add(node, node - 2, np.eye(4), np.eye(6))
    assert covariance[0, 0] <= 100.0


def test_the_covariance_from_surfaces_is_computed_once():
    key, scan = keyframe(room_scan(0, seed=1)), keyframe(room_scan(1, seed=2)).deskewed

    fit = fit_of(key, scan, np.eye(4), max_pair_distance_m=0.5)

    assert fit.surface_covariance is fit.surface_covariance
