import numpy as np
import pytest

from mapper.sources.point_times import field_times_s, relative_times_s, time_field, times_told

STAMP_NS = 1_567_410_201_745_204_700
SWEEP_S = np.linspace(0.0, 0.0999, 1000)
UNITS = [(1, "field t, seconds"), (1e3, "milliseconds"), (1e6, "microseconds"), (1e9, "nanoseconds")]


@pytest.mark.parametrize(
    "values",
    [
        pytest.param(np.round(SWEEP_S * 1e9).astype(np.uint32), id="ouster: ns after the stamp"),
        pytest.param(SWEEP_S.astype(np.float32), id="velodyne: s after the stamp"),
        pytest.param(np.round(SWEEP_S * 1e6).astype(np.uint32), id="µs after the stamp"),
        pytest.param((SWEEP_S * 1e3).astype(np.float32), id="ms after the stamp"),
        pytest.param(STAMP_NS / 1e9 + SWEEP_S, id="hesai: s of the epoch"),
        pytest.param(STAMP_NS + SWEEP_S * 1e9, id="livox: float ns of the epoch"),
        pytest.param(STAMP_NS + np.round(SWEEP_S * 1e9).astype(np.uint64), id="ns of the epoch"),
        pytest.param(345_678.9 + SWEEP_S, id="s of the GPS week"),
    ],
)
def test_every_unit_and_clock_becomes_seconds_after_the_stamp(values):
    times_s = relative_times_s(values, STAMP_NS)
    assert times_s.dtype == np.float32
    np.testing.assert_allclose(times_s, SWEEP_S, atol=1e-6)
    (choice,), notes = times_told(["x", "t"], lambda _: values, STAMP_NS)
    unit = np.ptp(values.astype(np.float64)) / SWEEP_S[-1]
    name = next(name for size, name in UNITS if unit == pytest.approx(size, rel=0.01))
    reference = "from the stamp" if values[0] == 0 else "on the clock of the stamps"
    assert (name in choice, "own" in choice) == (True, values[0] == 345_678.9)
    assert (reference in choice) == (len(notes) == 0)


@pytest.mark.parametrize(
    ("field", "values", "word"),
    [
        ("t", np.zeros(9, np.uint32), "holds no times"),
        ("t", np.float32(1.7e9 + SWEEP_S), "32 bits"),
        ("t", np.uint64(2**32 - 50_000_000 + SWEEP_S * 1e9).astype(np.uint32), "begins anew"),
        ("point_stamp", SWEEP_S[::-1], "holds no times"),
        ("time_of_flight", np.random.default_rng(0).uniform(0.0, 600.0, 1000), "holds no times"),
        ("ring", SWEEP_S, None),
    ],
)
def test_times_that_are_not_used_or_counted_on_are_told(field, values, word):
    choices, notes = times_told(["x", field], lambda _: values, STAMP_NS)
    assert bool(choices) == (word == "begins anew")
    assert (word is None) == (not notes)
    assert word is None or word in notes[0]


def test_a_stamp_at_the_end_of_the_sweep_gives_negative_times():
    before_s = SWEEP_S - SWEEP_S[-1]
    np.testing.assert_allclose(relative_times_s(before_s.astype(np.float32), STAMP_NS), before_s, atol=1e-6)
    absolute_s = STAMP_NS / 1e9 + before_s
    np.testing.assert_allclose(relative_times_s(absolute_s, STAMP_NS), before_s, atol=1e-6)


def test_nanoseconds_of_the_epoch_stay_exact():
    values = np.array([STAMP_NS + 7, STAMP_NS + 100_000_007], dtype=np.uint64)
    np.testing.assert_array_equal(relative_times_s(values, STAMP_NS), np.float32([7e-9, 0.100000007]))


def test_part_of_a_sweep_keeps_its_place_in_it():
    part = np.array([70_000_000, 100_000_000], dtype=np.uint32)
    np.testing.assert_allclose(relative_times_s(part, STAMP_NS), [0.07, 0.1])


@pytest.mark.parametrize(
    "values",
    [
        pytest.param(np.zeros(0, dtype=np.uint32), id="none"),
        pytest.param(np.zeros(5), id="all the same"),
        pytest.param(np.array([0.0, np.nan, 0.1]), id="not finite"),
        pytest.param(np.array([0.0, 1.6e18]), id="years apart"),
        pytest.param(np.array([0, 10_000_000_000], dtype=np.int64), id="ten seconds apart"),
    ],
)
def test_values_that_tell_nothing_give_no_times(values):
    assert relative_times_s(values, STAMP_NS) is None


def test_the_field_is_found_in_any_case():
    assert time_field(["x", "y", "z", "GPS_Time", "t"]) == "GPS_Time"
    assert time_field(["x", "y", "z", "intensity"]) is None


@pytest.mark.parametrize("damaged", [0.0, np.nan, 5.0, 1e12])
def test_a_few_damaged_times_cost_their_points_alone(damaged):
    times = np.linspace(0.0, 0.1, 1000) + 1.7e9
    times[10:20] = damaged
    found = relative_times_s(times, stamp_ns=int(1.7e18))
    assert np.isnan(found).sum() == 10
    sound = np.r_[0:10, 20:1000]
    np.testing.assert_allclose(found[sound], np.linspace(0.0, 0.1, 1000)[sound], atol=1e-6)


def test_a_signalling_nan_costs_its_point_alone():
    times = np.linspace(0.0, 0.1, 1000, dtype=np.float32)
    times.view(np.uint32)[10] = 0x7F800001
    with np.errstate(all="raise"):
        found = relative_times_s(times, stamp_ns=0)
    assert np.flatnonzero(np.isnan(found)).tolist() == [10]


@pytest.mark.parametrize(
    ("period_s", "unit", "kind"),
    [
        *((1, 1e9, "f8"), (3600, 1e6, "f8"), (3600, 1.0, "f8"), (86_400, 1.0, "f8"), (604_800, 1e3, "f8")),
        (2**32 * 1e-9, 1e9, "u4"),
    ],
)
def test_a_clock_or_a_32_bit_counter_that_begins_anew_is_counted_on(period_s, unit, kind):
    values = (period_s - 0.03 + np.arange(1000) * 1e-4) % period_s * unit
    for stamp_ns in (0, STAMP_NS):
        found = relative_times_s(values.astype(kind), stamp_ns=stamp_ns)
        np.testing.assert_allclose(np.diff(found), 1e-4, atol=1e-6)


def test_a_sweep_of_a_second_with_a_blind_sector_is_as_it_was():
    values = np.r_[0.0:0.3:1e-3, 0.7:1.0:1e-3]
    np.testing.assert_allclose(relative_times_s(values, stamp_ns=STAMP_NS), values, atol=1e-6)


def test_times_of_which_many_are_damaged_are_none():
    times = np.linspace(0.0, 1e8, 1000) + 1.7e18
    times[:100] = 0.0
    assert relative_times_s(times, stamp_ns=int(1.7e18)) is None


@pytest.mark.parametrize("share", [0.01, 0.04])
def test_damage_that_repeats_with_a_ring_or_a_column_is_no_more_than_its_share(share):
    times = np.linspace(0.0, 0.1, 20_000)
    times[:: round(1.0 / share)] = np.nan
    found = relative_times_s(times, stamp_ns=STAMP_NS)
    assert np.isnan(found).mean() == pytest.approx(share, rel=0.02)


def test_the_last_32_bits_of_the_epoch_are_no_offsets_from_the_stamp():
    for k in range(40):
        stamp_ns = STAMP_NS + k * 1_000_000_000
        ns = (stamp_ns + np.round(SWEEP_S * 1e9).astype(np.int64)) % 2**32
        times_s = relative_times_s(ns.astype(np.uint32), stamp_ns)
        if ns[0] > 100_000_000:  # 1 in 43 sweeps looks like offsets from its stamp
            np.testing.assert_allclose(times_s, SWEEP_S, atol=1e-6)


def test_zeros_of_returns_without_a_time_are_none_but_those_of_a_first_column_stay():
    columns = np.repeat(np.linspace(0.0, 0.0999, 100), 10)
    times_s = np.round(columns * 1e9).astype(np.uint32)
    np.testing.assert_allclose(relative_times_s(times_s, STAMP_NS), columns, atol=1e-6)
    for every in (9, 2):
        some_s = times_s.copy()
        some_s[::every] = 0
        found_s = relative_times_s(some_s, STAMP_NS)
        assert np.isnan(found_s).sum() == (some_s == 0).sum()
        known = some_s > 0
        np.testing.assert_allclose(found_s[known], columns[known], atol=1e-6)
    times_s[np.arange(len(times_s)) % 5 > 0] = 0
    assert relative_times_s(times_s, STAMP_NS) is None


@pytest.mark.parametrize("name", ["time_us", "rel_time", "t_ns", "dt", "ts", "tOffset", "timeStampUs"])
@pytest.mark.parametrize("rings", [1, 16])
def test_a_field_called_like_a_time_is_one_if_it_increases_along_the_rings(name, rings):
    values = np.tile(np.round(SWEEP_S * 1e6), rings).astype(np.int32)
    assert time_field(["x", "intensity", name]) == name
    times_s = field_times_s(name, values, STAMP_NS)
    np.testing.assert_allclose(times_s, np.tile(SWEEP_S, rings), atol=1e-6)
