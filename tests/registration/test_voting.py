import numpy as np
import pytest

from mapper.core.geometry import apply
from mapper.registration.hough.config import VotingConfig
from mapper.registration.hough.voting import DISTINCT_RAD, vote


def turned(centres, alpha_rad):
    c, s = np.cos(alpha_rad), np.sin(alpha_rad)
    return centres @ np.array([[c, s], [-s, c]])


@pytest.fixture
def rng():
    return np.random.default_rng(4)


def brute_force(target, source, alpha_rad, config):
    """Return one slice of the accumulator, summed over 3×3 bins (Nagy et al. 2016, alg. 1)."""
    half = int(np.ceil((config.max_offset_m + config.width_m) / config.bin_m))
    offsets = target[:, None] - turned(source, alpha_rad)[None]
    bins = np.floor(offsets.reshape(-1, 2) / config.bin_m + 0.5).astype(int) + half
    grid = np.zeros((2 * half + 3, 2 * half + 3), int)
    inside = ((bins >= -1) & (bins <= 2 * half + 1)).all(axis=1)
    np.add.at(grid, tuple((bins[inside] + 1).T), 1)
    return sum(grid[i : i + 2 * half + 1, j : j + 2 * half + 1] for i in range(3) for j in range(3))


@pytest.mark.parametrize("alpha_deg", [-170.0, -90.0, 0.0, 37.0, 180.0])
def test_finds_the_motion_of_a_constellation_among_strangers(rng, alpha_deg):
    source = rng.uniform(-40.0, 40.0, (80, 2))
    target = (
        turned(source, np.radians(alpha_deg)) + np.array([6.3, -8.8]) + rng.normal(0.0, 0.2, source.shape)
    )
    target = np.concatenate([target[:50], rng.uniform(-40.0, 40.0, (60, 2))])

    best, second, *_ = vote(target, source, VotingConfig())

    assert abs(best.dx_m - 6.3) < 0.5
    assert abs(best.dy_m + 8.8) < 0.5
    turn = best.alpha_rad - np.radians(alpha_deg)
    assert abs(np.arctan2(np.sin(turn), np.cos(turn))) < np.radians(1.5)
    assert best.votes > 1.5 * second.votes
    assert best.score == pytest.approx(best.votes / np.sqrt(len(target) * len(source)))


def test_a_constellation_stands_still_on_itself(rng):
    centres = rng.uniform(-40.0, 40.0, (100, 2))

    best = vote(centres, centres, VotingConfig())[0]

    assert best.alpha_rad == 0.0
    assert np.hypot(best.dx_m, best.dy_m) < 0.25  # a bin that began at zero would say half a metre


def test_its_motion_takes_source_centres_to_their_partners(rng):
    source = rng.uniform(-30.0, 30.0, (60, 2))
    target = turned(source, 0.5) + np.array([3.0, 2.0])

    best = vote(target, source, VotingConfig(angles=720))[0]

    moved = apply(best.motion, np.column_stack([source, np.zeros(len(source))]))
    assert np.abs(moved[:, :2] - target).max() < 1.0


def test_votes_are_those_of_the_plain_accumulator(rng):
    config = VotingConfig(angles=8, peaks=1)
    # On a lattice of a quarter bin, plus an eighth, the rounding before the binning changes nothing.
    target = np.round(rng.uniform(-30.0, 30.0, (150, 2)) * 4.0) / 4.0 + 0.25
    source = np.round(rng.uniform(-30.0, 30.0, (120, 2)) * 4.0) / 4.0 + 0.125

    best = vote(target, source, config)[0]

    quarter_turns = [0.0, 0.5 * np.pi, np.pi, -0.5 * np.pi]
    assert best.votes >= max(brute_force(target, source, a, config).max() for a in quarter_turns)
    if np.isclose(best.alpha_rad % (0.5 * np.pi), 0.0):
        assert best.votes == brute_force(target, source, best.alpha_rad, config).max()


def test_an_offset_beyond_the_range_is_not_found(rng):
    source = rng.uniform(-40.0, 40.0, (80, 2))
    target = source + np.array([20.0, 0.0])

    near, far = (vote(target, source, VotingConfig(max_offset_m=m))[0] for m in (10.0, 25.0))

    assert abs(far.dx_m - 20.0) < 0.3
    assert far.votes > 2 * near.votes


def test_peaks_are_distinct_and_descending(rng):
    config = VotingConfig(peaks=12)
    peaks = vote(rng.uniform(-40, 40, (90, 2)), rng.uniform(-40, 40, (90, 2)), config)

    assert len(peaks) == 12
    assert [p.votes for p in peaks] == sorted((p.votes for p in peaks), reverse=True)
    for i, a in enumerate(peaks):
        for b in peaks[:i]:
            turn = a.alpha_rad - b.alpha_rad
            turn = abs(np.arctan2(np.sin(turn), np.cos(turn)))
            apart_m = np.hypot(a.dx_m - b.dx_m, a.dy_m - b.dy_m)
            assert apart_m > config.width_m or turn > DISTINCT_RAD


def test_nothing_votes_for_nothing():
    assert vote(np.empty((0, 2)), np.ones((3, 2)), VotingConfig()) == []
    assert vote(np.ones((3, 2)), np.empty((0, 2)), VotingConfig()) == []
    assert vote(np.zeros((1, 2)), np.full((1, 2), 500.0), VotingConfig()) == []
