"""ISVD: exactness, trimming, stop rules, quality, information and honest failure."""

import numpy as np
import pytest

from mapper.core.geometry import apply, exp, fit_rigid, inverse, length_and_angle, log
from mapper.registration.config import IsvdConfig
from mapper.registration.isvd import Isvd, rigid_fit_information, trim


def room(rng: np.random.Generator, n: int = 200) -> np.ndarray:
    return rng.uniform([-1.5, -1.0, 0.8], [1.5, 1.0, 3.5], (n, 3))


def motion(rng: np.random.Generator) -> np.ndarray:
    return exp(rng.normal(0.0, 0.05, 3), rng.normal(0.0, 0.05, 3))


def pairs_with_outliers(seed: int, *, wrong: int, noise_m: float = 0.002):
    rng = np.random.default_rng(seed)
    T_target_source = motion(rng)
    source = room(rng)
    target = apply(T_target_source, source) + rng.normal(0.0, noise_m, source.shape)
    target[:wrong] = room(rng, wrong)
    return target, source, T_target_source


@pytest.mark.parametrize("config", [IsvdConfig(), IsvdConfig(threshold="halving", min_error_mm=5.0)])
@pytest.mark.parametrize("seed", range(4))
def test_recovers_a_motion_among_wrong_pairs(config, seed):
    target, source, T_target_source = pairs_with_outliers(seed, wrong=60)

    found = Isvd(config).fit(target, source)

    translation_m, rotation_rad = length_and_angle(inverse(T_target_source) @ found.T_target_source)
    assert found.converged
    assert translation_m < 0.003
    assert rotation_rad < 0.002
    assert 0.69 < found.inlier_ratio < 0.75
    assert found.inlier_rmse_m < 0.01


def test_is_exact_without_noise_and_in_both_directions():
    target, source, T_target_source = pairs_with_outliers(0, wrong=0, noise_m=0.0)
    isvd = Isvd(IsvdConfig())

    forward, backward = isvd.fit(target, source), isvd.fit(source, target)

    assert np.allclose(forward.T_target_source, T_target_source, atol=1e-12)
    assert np.allclose(backward.T_target_source, inverse(T_target_source), atol=1e-12)


@pytest.mark.parametrize("seed", range(4))
def test_every_iteration_fits_what_the_one_before_left(seed):
    target, source, _ = pairs_with_outliers(seed, wrong=50, noise_m=0.008)
    thresholds_m = np.array([1.2, 0.2, 0.05, 0.02, 0.01, 0.005])

    R, t, used = trim(target, source, thresholds_m, 0.0, 30)

    kept = np.arange(len(target))
    for threshold_m in thresholds_m:
        expected, fitted = fit_rigid(target[kept], source[kept])[0], kept
        kept = kept[np.linalg.norm(target[kept] - apply(expected, source[kept]), axis=1) <= threshold_m]
        if len(kept) < 30:
            break
    assert np.array_equal(used, fitted)
    assert np.allclose(R, expected[:3, :3], rtol=0.0, atol=1e-12)
    assert np.allclose(t, expected[:3, 3], rtol=0.0, atol=1e-12)


def test_points_in_a_plane_give_a_rotation_and_no_mirror():
    rng = np.random.default_rng(3)
    T_target_source = motion(rng)
    source = room(rng, 60)
    source[:, 2] = 1.5
    noise_m = rng.normal(0.0, 0.002, source.shape)

    R, t, _ = trim(apply(T_target_source, source) + noise_m, source, np.array([1.0]), 0.0, 3)

    assert np.linalg.det(R) == pytest.approx(1.0)
    assert np.allclose(R, T_target_source[:3, :3], atol=5e-3)
    assert np.allclose(t, T_target_source[:3, 3], atol=1e-2)


def test_thresholds_are_those_of_equation_4_2():
    # The pair that is 70 mm off survives j = 3 (th = 69 mm needs more than that) but not a smaller threshold.
    rng = np.random.default_rng(2)
    source = room(rng, 4000)
    target = source.copy()
    target[0, 0] += 0.0680
    target[1, 0] += 0.0700

    _, kept_by_two = Isvd(IsvdConfig(max_iterations=3)).trim_pairs(target, source)
    _, kept_by_three = Isvd(IsvdConfig(max_iterations=4)).trim_pairs(target, source)

    assert {0, 1} <= set(kept_by_two.tolist())  # th₂ = 1200 · 2^-2.6 = 198 mm
    assert 0 in kept_by_three  # th₃ = 1200 · 3^-2.6 = 69.0 mm
    assert 1 not in kept_by_three


def test_the_halving_threshold_begins_at_a_metre():
    source = room(np.random.default_rng(2), 4000)
    target = source.copy()
    target[0, 0] += 0.300
    for max_iterations, is_kept in ((2, True), (4, False)):  # 500 and 125 mm
        config = IsvdConfig(threshold="halving", max_iterations=max_iterations)
        _, kept = Isvd(config).trim_pairs(target, source)
        assert (0 in kept) == is_kept


def test_auto_stops_before_too_few_pairs_remain():
    target, source, _ = pairs_with_outliers(3, wrong=0, noise_m=0.01)

    _, kept = Isvd(IsvdConfig()).trim_pairs(target, source)
    _, kept_of_few = Isvd(IsvdConfig()).trim_pairs(target[:60], source[:60])

    assert 100 <= len(kept) < 200
    assert 30 <= len(kept_of_few) < 60


def test_quality_is_the_inverse_mean_city_block_distance():
    target, source, _ = pairs_with_outliers(4, wrong=0, noise_m=0.004)

    found, weight = Isvd(IsvdConfig(max_iterations=1)).fit_weighted(target, source)

    residuals = target - apply(found.T_target_source, source)
    assert weight == pytest.approx(1.0 / np.abs(residuals).sum(axis=1).mean())


def test_icp_step_of_algorithm_5_agrees_for_a_small_motion():
    rng = np.random.default_rng(6)
    source = room(rng, 150)
    T_target_source = exp(np.array([0.01, -0.01, 0.005]), np.array([0.01, 0.0, -0.01]))

    found = Isvd(IsvdConfig(step="icp", threshold="halving", min_error_mm=5.0)).fit(
        apply(T_target_source, source), source
    )

    assert np.allclose(found.T_target_source, T_target_source, atol=1e-9)


def test_information_predicts_the_scatter_of_repeated_fits():
    rng = np.random.default_rng(7)
    source, T_target_source, noise_m = room(rng, 60), motion(rng), 0.01
    errors = []
    for _ in range(600):
        target = apply(T_target_source, source) + rng.normal(0.0, noise_m, source.shape)
        rotation_rad, translation_m = log(inverse(T_target_source) @ fit_rigid(target, source)[0])
        errors.append(np.concatenate([rotation_rad, translation_m]))

    distances = np.full(60, noise_m * np.sqrt(3.0 * (1.0 - 6.0 / 180.0)))
    predicted = np.linalg.inv(rigid_fit_information(source, distances))

    measured = np.cov(np.array(errors).T)
    scale = np.sqrt(np.outer(np.diag(predicted), np.diag(predicted)))
    assert np.abs((measured - predicted) / scale).max() < 0.2


@pytest.mark.parametrize(
    ("target", "source", "why"),
    [
        (np.empty((0, 3)), np.empty((0, 3)), "0 pairs"),
        (room(np.random.default_rng(8), 19), room(np.random.default_rng(8), 19), "19 pairs"),
        (room(np.random.default_rng(8)), room(np.random.default_rng(9)), "agree"),
        (
            np.linspace(0.0, 1.0, 50)[:, None] * [1.0, 2.0, 3.0],
            np.linspace(0.0, 1.0, 50)[:, None] * [1.0, 2.0, 3.0],
            "line",
        ),
    ],
    ids=["none", "few", "unrelated", "collinear"],
)
def test_no_answer_has_a_reason(target, source, why):
    found, weight = Isvd(IsvdConfig()).fit_weighted(target, source)

    assert not found.converged
    assert why in found.reason
    assert weight == 0.0
