import numpy as np
import pytest

from mapper.core.frames import Scan
from mapper.core.geometry import inverse, length_and_angle, rotation_exp, transform
from mapper.registration.factory import aligner_to
from mapper.registration.hough.aligner import Hough
from mapper.registration.hough.config import HoughAcceptanceConfig, HoughGicpConfig, HoughNdtConfig
from mapper.simulation.config import COURTYARD, STREET
from mapper.simulation.lidar import LidarSimulator

UP = np.array([0.0, 0.0, 1.0])


def source_of(config, seed):
    sensor = config.sensor.model_copy(update={"motion_distortion": False, "rings": 32})
    return LidarSimulator(config.model_copy(update={"seed": seed, "sensor": sensor}))


def pair_of(log, i, j, *, yaw_rad, shift_m):
    """Return two scans, the second in a frame turned and set off, and the motion between them."""
    T_source_new = transform(rotation_exp(yaw_rad * UP), np.array(shift_m))
    T_i_j = inverse(log.truth.T_world_body[i]) @ log.truth.T_world_body[j]
    return log.observe(i), log.observe(j).moved(inverse(T_source_new)), T_i_j @ T_source_new


@pytest.fixture(scope="module")
def street():
    return pair_of(source_of(STREET, 3), 0, 12, yaw_rad=2.5, shift_m=(-1.0, 3.0, 0.0))


@pytest.fixture(scope="module")
def courtyard():
    log = source_of(COURTYARD, 5)
    tilts_rad = [np.arccos(log.truth.T_world_body[i][2, 2]) for i in (3, 6)]
    assert max(tilts_rad) > np.radians(20.0)
    return pair_of(log, 3, 6, yaw_rad=-2.0, shift_m=(0.0, 0.0, 0.0))


@pytest.mark.parametrize("config", [HoughGicpConfig(), HoughNdtConfig()], ids=lambda c: c.kind)
def test_recovers_any_yaw_both_ways_without_a_guess(street, config):
    target, source, T_target_source = street
    for a, b, T_a_b in ((target, source, T_target_source), (source, target, inverse(T_target_source))):
        found = aligner_to(a, config).align(b, np.eye(4))

        miss_m, miss_rad = length_and_angle(inverse(T_a_b) @ found.T_target_source)
        assert found.converged, found.reason
        assert miss_m < 0.05
        assert miss_rad < np.radians(0.2)
        assert found.pairs > 1000
        assert np.linalg.eigvalsh(found.information).min() > 0.0


def test_recovers_motion_between_tilted_scans(courtyard):
    target, source, T_target_source = courtyard

    found = aligner_to(target, HoughGicpConfig()).align(source, np.eye(4))

    miss_m, miss_rad = length_and_angle(inverse(T_target_source) @ found.T_target_source)
    assert found.converged, found.reason
    assert miss_m < 0.05
    assert miss_rad < np.radians(0.2)


@pytest.mark.parametrize("kept_ratio", [0.1, 0.25])
def test_recovers_a_sparse_scan_in_a_dense_one(street, kept_ratio):
    target, source, T_target_source = street
    keep = np.random.default_rng(0).random(len(source.points_body)) < kept_ratio
    sparse = Scan(stamp_ns=0, points_body=source.points_body[keep], origin_body=source.origin_body)

    found = aligner_to(target, HoughGicpConfig()).align(sparse, np.eye(4))

    assert found.converged, found.reason
    assert length_and_angle(inverse(T_target_source) @ found.T_target_source)[0] < 0.1


def test_returns_its_stages(street):
    target, source, T_target_source = street
    stages = Hough(target, HoughGicpConfig()).stages(source)

    gap = inverse(T_target_source) @ stages.hough.T_target_source
    assert np.linalg.norm(gap[:3, 3]) < 0.5
    assert list(stages.seconds) == ["describe", "vote", "verify", "prepare source", "refine"]
    assert min(stages.seconds.values()) >= 0.0
    assert stages.peaks[0].votes > 0
    assert stages.refined.agreeing_ratio > 0.3
    assert stages.alignment.converged


@pytest.mark.parametrize("seeds", [(0, 1), (2, 3), (4, 6)])
@pytest.mark.parametrize("config", [STREET, COURTYARD], ids=lambda c: c.scene)
def test_scans_of_different_places_are_refused(config, seeds):
    a, b = (source_of(config, seed).observe(4) for seed in seeds)

    found = aligner_to(a, HoughGicpConfig()).align(b, np.eye(4))

    assert not found.converged
    assert found.reason


def test_an_answer_beyond_the_range_is_refused():
    log = source_of(STREET, 3)
    target, source, _ = pair_of(log, 0, 0, yaw_rad=1.0, shift_m=(25.0, 0.0, 0.0))

    assert not aligner_to(target, HoughGicpConfig()).align(source, np.eye(4)).converged


def test_two_motions_as_good_as_each_other_are_none():
    rng = np.random.default_rng(0)
    x, y = rng.uniform(-20.0, 20.0, (2, 40_000))
    field = np.column_stack([x, y, rng.normal(-1.7, 0.01, x.shape)])
    posts = []
    for k in range(8):  # a ring of eight posts is the same every 45°
        angle = k * np.pi / 4.0
        height = rng.uniform(-1.7, 2.0, 600)
        around = rng.uniform(0.0, 2.0 * np.pi, 600)
        posts.append(
            np.column_stack(
                [
                    9.0 * np.cos(angle) + 0.5 * np.cos(around),
                    9.0 * np.sin(angle) + 0.5 * np.sin(around),
                    height,
                ]
            )
        )
    scan = Scan(stamp_ns=0, points_body=np.concatenate([field, *posts]).astype(np.float32))

    found = aligner_to(scan, HoughGicpConfig()).align(scan, np.eye(4))

    assert not found.converged
    assert "ambiguous" in found.reason


def nothing(_):
    return np.empty((0, 3))


def one_point(_):
    return np.array([[5.0, 1.0, 0.0]])


def empty_field(rng):
    x, y = rng.uniform(-30.0, 30.0, (2, 20_000))
    return np.column_stack([x, y, rng.normal(-1.7, 0.01, x.shape)])


def line(rng):
    return np.outer(rng.uniform(-30.0, 30.0, 5000), [1.0, 0.2, 0.05])


def one_place(_):
    return np.tile([3.0, 2.0, 1.0], (5000, 1))


def far_away(rng):
    return rng.normal(0.0, 10.0, (5000, 3)) + 5000.0


@pytest.mark.parametrize("make", [nothing, one_point, empty_field, line, one_place, far_away])
@pytest.mark.parametrize("config", [HoughGicpConfig(), HoughNdtConfig()], ids=lambda c: c.kind)
def test_bad_scans_are_refused_with_a_reason(street, make, config):
    bad = Scan(stamp_ns=0, points_body=make(np.random.default_rng(0)).astype(np.float32))

    for target, source in ((street[0], bad), (bad, street[0]), (bad, bad)):
        found = aligner_to(target, config).align(source, np.eye(4))
        assert not found.converged
        assert found.reason


def test_stricter_acceptance_refuses(street):
    target, source, _ = street
    config = HoughGicpConfig(acceptance=HoughAcceptanceConfig(min_agreeing_ratio=0.99))

    found = Hough(target, config).align(source, np.eye(4))

    assert not found.converged
    assert "overlap" in found.reason


def test_a_corridor_is_refused():
    def corridor(seed):
        rng = np.random.default_rng(seed)
        x, y = rng.uniform(-25.0, 25.0, 30_000), rng.uniform(-4.0, 4.0, 30_000)
        walls = [
            np.column_stack(
                [rng.uniform(-25.0, 25.0, 8000), np.full(8000, side), rng.uniform(-1.7, 2.0, 8000)]
            )
            for side in (-4.0, 4.0)
        ]
        points = np.concatenate([np.column_stack([x, y, np.full(30_000, -1.7)]), *walls])
        return Scan(stamp_ns=0, points_body=(points + rng.normal(0.0, 0.01, points.shape)).astype(np.float32))

    found = aligner_to(corridor(0), HoughGicpConfig()).align(corridor(1), np.eye(4))

    assert not found.converged
    assert found.reason
