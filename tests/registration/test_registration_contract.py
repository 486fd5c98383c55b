"""What every registration of scans has to do: the list comes from the configuration's union."""

from typing import get_args

import numpy as np
import pytest

from mapper.core.frames import Scan
from mapper.core.geometry import exp, inverse, length_and_angle
from mapper.registration.config import RegistrationConfig
from mapper.registration.factory import aligner_to
from mapper.simulation.config import STREET, LidarSensorConfig
from mapper.simulation.lidar import LidarSimulator

EVERY_METHOD = [member() for member in get_args(get_args(RegistrationConfig)[0])]
NEEDS_NO_GUESS = [
    config for config in EVERY_METHOD if config.kind in {"hough-gicp", "hough-ndt", "kiss-matcher"}
]
GUESS_ERROR = exp(np.array([0.01, -0.01, 0.04]), np.array([0.4, -0.3, 0.05]))

every_method = pytest.mark.parametrize("config", EVERY_METHOD, ids=lambda config: config.kind)


def street(seed):
    sensor = LidarSensorConfig(rings=48, azimuth_steps=600, motion_distortion=False)
    return LidarSimulator(STREET.model_copy(update={"seed": seed, "duration_s": 2.0, "sensor": sensor}))


@pytest.fixture(scope="module")
def pair():
    """Two scans of one street, 3 m apart, and the exact motion between them."""
    source = street(1)
    poses = source.truth.T_world_body
    i, j = 0, 6
    return source.observe(i), source.observe(j), inverse(poses[i]) @ poses[j]


@pytest.fixture(scope="module")
def elsewhere():
    """A scan of another street."""
    return street(2).observe(3)


@every_method
@pytest.mark.parametrize("forward", [True, False], ids=["forward", "backward"])
def test_recovers_a_known_motion(config, forward, pair):
    target, source, T_target_source = pair
    if not forward:
        target, source, T_target_source = source, target, inverse(T_target_source)

    found = aligner_to(target, config).align(source, T_target_source @ GUESS_ERROR)

    assert found.converged, found.reason
    offset_m, turn_rad = length_and_angle(inverse(T_target_source) @ found.T_target_source)
    assert offset_m < 0.1
    assert turn_rad < np.radians(0.3)
    assert 0.0 < found.inlier_ratio <= 1.0
    assert np.linalg.eigvalsh(found.information)[0] > 0.0


@pytest.mark.parametrize("config", NEEDS_NO_GUESS, ids=lambda config: config.kind)
def test_a_global_method_does_not_look_at_the_guess(config, pair):
    target, source, T_target_source = pair
    T_turned_source = exp(np.array([0.0, 0.0, 2.0]), np.array([4.0, -3.0, 0.0]))

    aligner = aligner_to(target, config)
    found = aligner.align(source.moved(T_turned_source), np.eye(4))
    other = aligner.align(source.moved(T_turned_source), exp(np.zeros(3), np.array([50.0, 0.0, 0.0])))

    assert found.converged, found.reason
    assert length_and_angle(T_turned_source @ inverse(T_target_source) @ found.T_target_source)[0] < 0.1
    assert found.T_target_source.tobytes() == other.T_target_source.tobytes()


@every_method
def test_the_same_scans_give_the_same_bytes_and_stay_as_they_were(config, pair):
    target, source, T_target_source = pair
    guess = T_target_source @ GUESS_ERROR
    before = [target.points_body.copy(), source.points_body.copy(), guess.copy()]

    aligner = aligner_to(target, config)
    answers = [aligner.align(source, guess), aligner.align(source, guess)]
    answers.append(aligner_to(target, config).align(source, guess))

    for other in answers[1:]:
        assert other.T_target_source.tobytes() == answers[0].T_target_source.tobytes()
        assert other.information.tobytes() == answers[0].information.tobytes()
        assert other.inlier_ratio == answers[0].inlier_ratio
    for array, kept in zip((target.points_body, source.points_body, guess), before, strict=True):
        assert np.array_equal(array, kept)


@every_method
def test_another_street_is_refused(config, pair, elsewhere):
    target, _, _ = pair
    found = aligner_to(target, config).align(elsewhere, np.eye(4))
    assert not found.converged
    assert found.reason


@pytest.mark.parametrize(
    "config", [c for c in EVERY_METHOD if c not in NEEDS_NO_GUESS], ids=lambda config: config.kind
)
def test_a_guess_under_which_the_clouds_do_not_overlap_is_refused(config, pair):
    target, source, _ = pair
    found = aligner_to(target, config).align(source, exp(np.zeros(3), np.array([500.0, 0.0, 0.0])))
    assert not found.converged
    assert found.reason


@every_method
@pytest.mark.parametrize("points", [0, 1, 30])
def test_scans_of_next_to_nothing_are_refused_on_either_side(config, points, pair):
    target, _, _ = pair
    few = Scan(0, np.random.default_rng(0).uniform(5.0, 6.0, (points, 3)).astype(np.float32))
    for a, b in ((target, few), (few, target)):
        found = aligner_to(a, config).align(b, np.eye(4))
        assert not found.converged
        assert found.reason


@every_method
def test_an_empty_field_is_refused(config):
    ranges, angles = np.meshgrid(np.linspace(2.0, 30.0, 50), np.linspace(0.0, 2.0 * np.pi, 500))
    flat = np.column_stack(
        [(ranges * np.cos(angles)).ravel(), (ranges * np.sin(angles)).ravel(), np.full(ranges.size, -1.7)]
    )
    noisy = [
        Scan(0, (flat + np.random.default_rng(seed).normal(scale=0.02, size=flat.shape)).astype(np.float32))
        for seed in (0, 1)
    ]
    found = aligner_to(noisy[0], config).align(noisy[1], np.eye(4))
    assert not found.converged
    assert found.reason
