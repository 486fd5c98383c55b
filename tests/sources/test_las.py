import warnings
from dataclasses import replace

import laspy
import numpy as np
import pytest

from mapper.core.errors import SourceError
from mapper.core.frames import Scan
from mapper.core.geometry import apply
from mapper.sources import open_source
from mapper.sources.config import SourceConfig
from tests.support.driver_recordings import street
from tests.support.las_files import GPS_EPOCH_S, LEAP_S, WEEK_S, gps_s, write_las

FIRST_NS = 1_700_000_000_000_000_000


@pytest.fixture(scope="module")
def recorded():
    """Log of a LiDAR on a street, 10 turns a second, and its scans at a time of day."""
    log = street(azimuth_steps=120, duration_s=3.0).log()
    shift_ns = FIRST_NS - int(log.stamps_ns[0])
    return log, [replace(scan, stamp_ns=scan.stamp_ns + shift_ns) for scan in log]


def assert_same_scans(found, scans, *, first_ns=FIRST_NS):
    assert len(found) == len(scans)
    for got, want in zip(found, scans, strict=True):
        order, ranks = (np.argsort(scan.times_s, kind="stable") for scan in (got, want))
        assert abs((got.stamp_ns - first_ns) - (want.stamp_ns - FIRST_NS)) < 2_000
        assert len(got.points_body) == len(want.points_body)
        np.testing.assert_allclose(got.times_s[order], want.times_s[ranks], atol=2e-6)
        np.testing.assert_allclose(got.points_body[order], want.points_body[ranks], atol=1e-3)


@pytest.mark.parametrize("ending", [".las", ".laz"])
def test_a_strip_is_cut_into_the_turns_it_is_made_of(tmp_path, recorded, ending):
    _, scans = recorded
    log = open_source(write_las(tmp_path / f"strip{ending}", scans))
    assert log.kind == "las-strip"
    assert log.choices == ["cut into sweeps of 0.1 s (as its points turn)"]
    assert_same_scans(log, scans)


def test_the_duration_of_a_turn_is_that_of_the_points(tmp_path, recorded):
    _, scans = recorded
    slow = [
        replace(scan, stamp_ns=FIRST_NS + 2 * (scan.stamp_ns - FIRST_NS), times_s=2.0 * scan.times_s)
        for scan in scans
    ]
    log = open_source(write_las(tmp_path / "strip.las", slow))
    assert log.choices == ["cut into sweeps of 0.2 s (as its points turn)"]
    assert_same_scans(log, slow)


def test_times_of_the_week_go_on_where_it_begins_anew(tmp_path, recorded):
    _, scans = recorded
    into_s = gps_s(FIRST_NS) % WEEK_S
    path = write_las(tmp_path / "strip.las", scans, is_dated=False, shift_s=WEEK_S - into_s - 1.5)
    assert_same_scans(open_source(path), scans, first_ns=round((WEEK_S - 1.5) * 1e9))


def test_times_may_begin_with_the_strip(tmp_path, recorded):
    _, scans = recorded
    path = write_las(tmp_path / "strip.las", scans, is_dated=False, shift_s=-gps_s(FIRST_NS))
    assert_same_scans(open_source(path), scans, first_ns=0)


def test_what_does_not_turn_is_cut_by_the_usual_or_the_given_time(tmp_path, recorded):
    _, scans = recorded
    rng = np.random.default_rng(0)
    shuffled = [replace(scan, points_body=rng.permutation(scan.points_body)) for scan in scans]
    path = write_las(tmp_path / "strip.las", shuffled)
    log = open_source(path)
    assert log.choices == ["cut into sweeps of 0.1 s (source.sweep_s)"]
    assert_same_scans(log, shuffled)
    assert len(open_source(path, SourceConfig(sweep_s=0.2))) == -(-len(scans) // 2)


@pytest.mark.parametrize("wrong", [np.inf, 1e300])
@pytest.mark.parametrize("row", [0, 5000])
def test_single_wrong_times_leave_the_turns(tmp_path, recorded, wrong, row):
    _, scans = recorded
    path = write_las(tmp_path / "strip.las", scans)
    cloud = laspy.read(path)
    cloud.gps_time[row] = wrong
    cloud.write(path)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        log = open_source(path)
    assert log.choices == ["cut into sweeps of 0.1 s (as its points turn)"]
    assert abs(len(log) - len(scans)) <= 1


@pytest.mark.parametrize("ending", [".las", ".laz"])
def test_a_strip_that_was_cut_is_named_as_damaged(tmp_path, recorded, ending):
    _, scans = recorded
    path = write_las(tmp_path / f"strip{ending}", scans)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(SourceError, match=r"was the file cut|not a sound LAS file"):
        open_source(path)


def test_a_pause_begins_a_sweep(tmp_path, recorded):
    _, scans = recorded
    late_ns = 330_000_000
    paused = scans[:9] + [replace(scan, stamp_ns=scan.stamp_ns + late_ns) for scan in scans[9:]]
    assert_same_scans(open_source(write_las(tmp_path / "strip.las", paused)), paused)


def test_strips_of_a_folder_follow_each_other_with_their_truth(tmp_path, recorded):
    _, scans = recorded
    later = [replace(scan, stamp_ns=scan.stamp_ns + 5_000_000_000) for scan in scans]
    for name, part in (("b.las", scans), ("a.las", later)):
        write_las(tmp_path / name, part)
    (tmp_path / "groundtruth.txt").write_text(
        "".join(f"{FIRST_NS // 10**9 + k} 0 0 0 0 0 0 1\n" for k in (0, 1))
    )
    log = open_source(tmp_path)
    assert_same_scans(log, [*scans, *later])
    assert len(log.truth) == 2


def test_strips_in_a_map_or_out_of_order_are_refused(tmp_path, recorded):
    log, scans = recorded
    poses = iter([*log.truth.T_world_body] * 2)
    utm = np.array([450e3, 5400e3, 200.0])
    by_utm = write_las(tmp_path / "utm.laz", scans, moved=lambda scan: scan.points_body + utm)
    by_map = write_las(tmp_path / "map.las", scans, moved=lambda scan: apply(next(poses), scan.points_body))
    for path in (by_utm, by_map):
        with pytest.raises(SourceError, match="in the coordinates of a map"):
            open_source(path)
    with pytest.raises(SourceError, match="sort them by gps_time"):
        open_source(write_las(tmp_path / "any.las", scans, by_time=False))
    with pytest.raises(SourceError, match="one cloud is no log"):
        open_source(write_las(tmp_path / "scan.las", scans[:1]))


def test_scans_of_a_tripod_that_take_a_minute_are_no_strips(tmp_path):
    """A mirror turns 30 times a second about a level axis, and the head half a turn in the minute."""
    since_s = np.linspace(0.0, 60.0, 60_000, endpoint=False)
    heading, tilt = since_s / 60.0 * np.pi, 2.0 * np.pi * 30.1 * since_s
    level = np.column_stack([np.cos(heading), np.sin(heading)]) * np.cos(tilt)[:, None]
    directions = np.column_stack([level, np.sin(tilt)])
    points = directions * (5.0 / np.abs(directions).max(axis=1))[:, None]
    for k in range(3):
        scan = Scan(
            FIRST_NS + k * 200_000_000_000, points.astype(np.float32), times_s=since_s.astype(np.float32)
        )
        write_las(tmp_path / f"{k}.las", [scan])
    log = open_source(tmp_path)
    assert (log.kind, len(log)) == ("clouds", 3)
    assert len(log[0].points_body) == 60_000


@pytest.mark.parametrize("is_dated", [True, False])
def test_a_folder_of_scans_has_the_stamps_of_their_points(tmp_path, recorded, is_dated):
    _, scans = recorded
    for k, scan in enumerate(scans[:5]):
        write_las(tmp_path / f"{k:03d}.laz", [scan], is_dated=is_dated)
    log = open_source(tmp_path)
    assert (log.kind, list(log.notes)) == ("clouds", [])
    week_ns = FIRST_NS - (GPS_EPOCH_S - LEAP_S) * 10**9
    assert_same_scans(log, scans[:5], first_ns=FIRST_NS if is_dated else week_ns % (WEEK_S * 10**9))
    rate, times = open_source(tmp_path, SourceConfig(rate_hz=10.0)).notes
    assert "10 scans a second assumed" in rate
    assert "gps_time is on a clock of its own" in times


def test_times_that_begin_anew_in_each_file_are_no_stamps(tmp_path, recorded):
    _, scans = recorded
    for k, scan in enumerate(scans[:4]):
        write_las(tmp_path / f"{k:03d}.las", [scan], is_dated=False, shift_s=-gps_s(scan.stamp_ns))
    log = open_source(tmp_path)
    assert "10 scans a second assumed" in log.notes[0]
    assert log[3].times_s is not None


def test_a_damaged_file_among_scans_leaves_the_others_their_stamps(tmp_path, recorded):
    _, scans = recorded
    for k, scan in enumerate(scans[:5]):
        write_las(tmp_path / f"{k:03d}.las", [scan])
    (tmp_path / "002.las").write_bytes(b"LASF")
    log = open_source(tmp_path)
    assert abs(int(log.stamps_ns[4]) - scans[4].stamp_ns) < 2_000
