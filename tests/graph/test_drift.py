import numpy as np
import pytest

from mapper.core.geometry import adjoint, exp, inverse, transform
from mapper.graph.drift import innovations
from mapper.graph.model import BetweenFactor, PoseSigmas

SIGMAS = PoseSigmas(rotation_rad=0.01, translation_m=0.03)


def chain(n, rng):
    """Noisy steps of a random walk, and its true poses."""
    truth = [np.eye(4)]
    for _ in range(n):
        truth.append(truth[-1] @ exp(rng.normal(0, 0.2, 3), rng.normal(0, 0.3, 3)))
    steps = [factor(k, k + 1, noisy(truth, k, k + 1, rng)) for k in range(n)]
    return truth, steps


def noisy(truth, i, j, rng):
    error = exp(rng.normal(0, SIGMAS.rotation_rad, 3), rng.normal(0, SIGMAS.translation_m, 3))
    return inverse(truth[i]) @ truth[j] @ error


def factor(i, j, T_i_j, origin="odometry"):
    return BetweenFactor(i, j, T_i_j, SIGMAS.information, origin)


def test_honest_loops_are_as_far_off_as_chi_squared_says():
    """Mean 6 and median 5.35: the accumulated covariance is neither too wide nor too narrow."""
    rng = np.random.default_rng(0)
    apart = []
    for _ in range(300):
        truth, steps = chain(30, rng)
        i, j = rng.choice(31, 2, replace=False).tolist()
        apart += innovations(steps, [factor(i, j, noisy(truth, i, j, rng), "loop")]).tolist()
    assert np.mean(apart) == pytest.approx(6.0, abs=0.8)
    assert np.median(apart) == pytest.approx(5.35, abs=0.8)


def test_the_same_error_says_less_after_a_longer_way():
    steps = [factor(k, k + 1, transform(np.eye(3), [0.1, 0.0, 0.0])) for k in range(100)]
    off = [transform(np.eye(3), [0.1 * j, 0.0, 0.3]) for j in (2, 20, 100)]
    loops = [factor(0, j, T, "loop") for j, T in zip((2, 20, 100), off, strict=True)]
    near, middle, far = innovations(steps, loops)
    assert near > 3.0 * middle
    assert middle > 3.0 * far


def backwards(forward):
    """The same measurement, told from the other node."""
    to_i = adjoint(forward.T_i_j)
    information = np.linalg.inv(to_i @ np.linalg.inv(forward.information) @ to_i.T)
    return BetweenFactor(forward.j, forward.i, inverse(forward.T_i_j), 0.5 * (information + information.T))


def test_steps_may_be_measured_backwards_and_come_in_any_order():
    rng = np.random.default_rng(1)
    _, steps = chain(12, rng)
    loop = factor(2, 9, exp(rng.normal(0, 0.1, 3), rng.normal(0, 0.1, 3)), "loop")
    forward = innovations(steps, [loop])
    mixed = [backwards(step) if k % 2 else step for k, step in enumerate(steps)]
    assert innovations(mixed[::-1], [loop]) == pytest.approx(forward)


def test_the_surest_of_parallel_factors_counts():
    sure = BetweenFactor(0, 1, np.eye(4), 100.0 * np.eye(6))
    unsure = BetweenFactor(0, 1, transform(np.eye(3), [5.0, 0.0, 0.0]), np.eye(6))
    loop = BetweenFactor(0, 1, transform(np.eye(3), [0.2, 0.0, 0.0]), 100.0 * np.eye(6), "loop")
    assert innovations([unsure, sure], [loop]) == pytest.approx([0.2**2 / 0.02])


def test_where_nothing_leads_nothing_is_said():
    steps = [factor(0, 1, np.eye(4)), factor(5, 6, np.eye(4))]
    far = transform(np.eye(3), [9.0, 0.0, 0.0])
    assert innovations(steps, [factor(0, 6, far, "loop"), factor(0, 9, far, "loop")]).tolist() == [0.0, 0.0]
    assert innovations([], [factor(0, 1, far, "loop")]).tolist() == [0.0]


def test_a_node_without_known_factors_is_reached_by_its_loops():
    """As the frame of a map, to which constraints alone lead: a false one is far from what the others say."""
    rng = np.random.default_rng(3)
    truth, steps = chain(20, rng)
    far = transform(np.eye(3), np.array([4.0, -3.0, 1.0]))
    loops = [factor(99, k, far @ noisy([np.eye(4), *truth], 0, k + 1, rng), "loop") for k in range(0, 20, 2)]
    loops[4] = factor(99, 8, far @ truth[8] @ exp(np.zeros(3), np.array([2.0, 0.0, 0.0])), "loop")
    apart = innovations(steps, loops)
    assert apart[4] > 10.0 * np.median(apart)
    assert np.delete(apart, 4).max() < 30.0
