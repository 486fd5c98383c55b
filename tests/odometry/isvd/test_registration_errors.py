"""Information of registrations by how far frames repeat the errors of those before."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from mapper.core.geometry import transform
from mapper.core.timebase import NS_PER_S
from mapper.graph.noise import with_model_error
from mapper.odometry.isvd.frames import PoseCandidate
from mapper.odometry.isvd.registration_errors import RegistrationErrors
from mapper.registration.base import Alignment
from mapper.registration.variance_factor import ResidualStatistics

INFORMATION = np.diag([1e7] * 3 + [1e6] * 3)
T_EARLIER_NEW = transform(np.eye(3), np.array([0.1, 0.0, 0.0]))
FRAME_NS = NS_PER_S // 10


def candidate(scores=None, *, node=0, residuals=True):
    """Return a registration against a node, of residuals as large as their weights say."""
    statistics = ResidualStatistics(1.0, 1.0, scores) if residuals else None
    alignment = Alignment(T_EARLIER_NEW, True, 1.0, 0.0, information=INFORMATION, residuals=statistics)
    earlier = SimpleNamespace(node=node)
    return PoseCandidate(earlier, alignment, 0.5 * INFORMATION, 1.0, np.empty((0, 2), np.intp), np.eye(4))


def repetition(scores, *, nodes=lambda _: 0, frame_ns=FRAME_NS):
    errors = RegistrationErrors()
    for n, one in enumerate(scores):
        errors.add(n * frame_ns, [candidate(one, node=nodes(n))])
    return errors.repetition


def independent(count):
    return np.random.default_rng(3).normal(0.0, 72**-0.5, (count, 12, 6))


def test_independent_errors_average_out():
    assert repetition(independent(600)) == pytest.approx(1.1, abs=0.15)


def test_errors_that_all_frames_of_a_second_repeat_do_not():
    same = np.tile(independent(1), (600, 1, 1))
    # 1 + 2 (e⁻⁰·¹ + e⁻⁰·² + …), and 30 registrations of which nothing is known
    assert repetition(same) == pytest.approx(20.0, rel=0.1)


def test_errors_that_half_repeat_lie_between():
    rng = np.random.default_rng(4)
    scores = [rng.normal(0.0, 72**-0.5, (12, 6))]
    for _ in range(1000):
        scores.append(0.5 * scores[-1] + 0.75**0.5 * rng.normal(0.0, 72**-0.5, (12, 6)))
    # 1 + 2 Σ (0.5 e⁻⁰·¹)ᵏ
    assert repetition(scores) == pytest.approx(2.65, rel=0.1)


def test_other_keyframes_and_long_gaps_repeat_nothing():
    same = np.tile(independent(1), (600, 1, 1))
    assert repetition(same, nodes=lambda n: n) == pytest.approx(1.1, abs=0.02)
    assert repetition(same, frame_ns=10 * NS_PER_S) == pytest.approx(1.1, abs=0.02)


def test_repeated_errors_lower_the_information():
    errors = RegistrationErrors()
    same = independent(1)[0]
    for n in range(100):
        errors.add(n * FRAME_NS, [candidate(same)])
    found = errors.rescaled(candidate(same)) * errors.repetition
    shown = with_model_error(INFORMATION, T_EARLIER_NEW, scale=0.125)
    assert np.linalg.slogdet(found)[1] == pytest.approx(np.linalg.slogdet(shown)[1])


def test_registrations_keep_their_weights_relative_to_each_other():
    errors = RegistrationErrors()
    one, other = candidate(independent(1)[0]), candidate(independent(2)[1], node=1)
    other = replace(other, information=np.diag([1e4, 1e5, 1e6, 1e3, 1e4, 1e5]))  # of things that move
    errors.add(0, [one, other])
    np.testing.assert_allclose(
        errors.rescaled(one) / errors.rescaled(one)[0, 0], one.information / one.information[0, 0]
    )
    ratio = errors.rescaled(one)[0, 0] / errors.rescaled(other)[0, 0]
    assert ratio == pytest.approx(one.information[0, 0] / other.information[0, 0])


def test_registrations_without_residuals_count_as_they_are():
    errors = RegistrationErrors()
    plain = candidate(residuals=False)
    errors.add(0, [plain])
    np.testing.assert_array_equal(errors.rescaled(plain), plain.information)
