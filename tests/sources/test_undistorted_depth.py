"""The setting that removes the distortion of a log's depth images."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from mapper.core.errors import FrameError
from mapper.core.frames import Scan
from mapper.sources import depth_distortion, open_source
from mapper.sources.chained import chained, sessions_of
from mapper.sources.config import BodyConfig, SourceConfig
from mapper.sources.depth_distortion import distortion_of
from mapper.sources.inspection import inspect_log
from mapper.sources.selection import selected
from mapper.sources.writers import write_log
from tests.support.bent_depth import bent_log, images, smooth_error
from tests.support.command_line import mapper
from tests.support.logs import CountedReads, MemoryEntry, log_in_memory
from tests.support.paths import FR1_XYZ

ON, OFF = SourceConfig(), SourceConfig(undistort_depth=False)
ERROR_PER_M = smooth_error()


@pytest.fixture(scope="module")
def bent():
    return bent_log(error_per_m=ERROR_PER_M)


def test_frames_are_corrected_by_what_the_log_shows(bent):
    frame, recorded = selected(bent, ON)[3], bent[3]
    np.testing.assert_array_equal(frame.depth_m, distortion_of(bent).corrected(recorded.depth_m))
    exact_m = images(frames=4, sigma_per_m=0.0)[3]
    assert np.abs(frame.depth_m - exact_m).mean() < 0.7 * np.abs(recorded.depth_m - exact_m).mean()
    assert frame.removed_distortion_per_m == distortion_of(bent).rms_per_m
    assert recorded.removed_distortion_per_m == 0.0
    assert frame.image is recorded.image
    scan = selected(bent, ON).entry_at(3).scan()
    np.testing.assert_array_equal(scan.points_body, frame.scan().points_body)


def test_frames_stay_as_they_are_without_the_setting(bent):
    assert selected(bent, OFF)[3].depth_m is bent[3].depth_m
    assert selected(bent, OFF).removed_distortion is None


def test_it_is_measured_once_whichever_thread_is_first(bent):
    counted = CountedReads(bent, damaged={7})
    log = selected(counted.log, ON)
    assert not counted.reads, "no frame is read before one is asked for"
    with ThreadPoolExecutor(2) as threads:
        loaded = list(threads.map(lambda k: log[k].depth_m.tobytes(), [5, 6, 5, 6]))
    assert loaded[:2] == loaded[2:]
    assert len(counted.reads) == len(bent) + 4
    again = selected(CountedReads(bent, damaged={7}).log, ON)
    assert [again[6].depth_m.tobytes(), again[5].depth_m.tobytes()] == [loaded[1], loaded[0]]
    with pytest.raises(FrameError, match="damaged"):
        log[7]


def test_a_part_of_a_log_is_corrected_by_the_whole(bent):
    part = selected(bent, ON.model_copy(update={"first_frame": 2, "stride": 3, "last_frame": 9}))
    whole = selected(bent, ON)
    assert part[1].depth_m.tobytes() == whole[5].depth_m.tobytes() == whole[4:7][1].depth_m.tobytes()
    near = selected(bent, ON.model_copy(update={"body": BodyConfig(max_range_m=2.0)}))[5].depth_m
    np.testing.assert_array_equal(near[near > 0.0], whole[5].depth_m[near > 0.0])


def test_logs_of_a_chain_are_corrected_each_by_its_own(bent):
    exact = bent_log(error_per_m=0.0)
    both = chained(selected(bent, ON), selected(exact, ON))
    assert both[3].depth_m.tobytes() == selected(bent, ON)[3].depth_m.tobytes()
    assert both[len(bent) + 3].depth_m is exact[3].depth_m
    first, second = (session.log.removed_distortion() for session in sessions_of(both))
    assert first is not None
    assert second is None


def test_a_conversion_measures_no_distortion(bent, tmp_path, monkeypatch):
    write_log(bent, tmp_path / "log.mcap", kind="mcap")
    monkeypatch.setattr(depth_distortion, "measure_distortion", lambda *_: pytest.fail("it is not needed"))
    mapper("convert", tmp_path / "log.mcap", "--out", tmp_path / "log", "--as", "tum")


def test_an_inspection_tells_how_large_it_is(bent, tmp_path):
    write_log(bent, tmp_path / "log.mcap", kind="mcap")
    (note,) = [note for note in inspect_log(tmp_path / "log.mcap", ON).log.notes if "bent" in note]
    assert note.startswith("depth images are bent, all in the same way, by ")
    assert "bent" not in " ".join(inspect_log(tmp_path / "log.mcap", OFF).log.notes)


def test_scans_have_no_depth_images():
    log = log_in_memory([MemoryEntry(0, Scan(0, np.ones((3, 3), np.float32)))], sensor="lidar")
    assert selected(log, ON) is log
    assert distortion_of(log) is None


@pytest.mark.skipif(not FR1_XYZ.is_dir(), reason=f"no {FR1_XYZ}")
def test_clutter_on_a_real_desk_is_no_distortion():
    log = open_source(FR1_XYZ, OFF)
    assert distortion_of(log) is None, "its removal made the map thicker, also by the true poses"


def test_a_log_without_readable_frames_has_none():
    log = log_in_memory([MemoryEntry(0, FrameError("damaged"))])
    assert distortion_of(log) is None


@pytest.mark.parametrize("kind", ["tum", "mcap"])
def test_logs_of_any_format_are_corrected(bent, tmp_path, kind):
    path = tmp_path / ("log.mcap" if kind == "mcap" else "log")
    write_log(bent, path, kind=kind)
    recorded, log = open_source(path, OFF), open_source(path, ON)
    expected_m = distortion_of(recorded).corrected(recorded[3].depth_m)
    np.testing.assert_array_equal(log[3].depth_m, expected_m)


@pytest.mark.parametrize(("name", "kind"), [("log", "tum"), ("log.bag", "bag")])
def test_a_log_written_anew_has_the_depth_that_was_recorded(bent, tmp_path, name, kind):
    write_log(bent, tmp_path / "log.mcap", kind="mcap")
    source = open_source(tmp_path / "log.mcap", ON)
    assert write_log(source, tmp_path / name, kind=kind) == []
    written = open_source(tmp_path / name, OFF)
    assert np.abs(source[3].depth_m - bent[3].depth_m).max() > 0.05
    np.testing.assert_allclose(written[3].depth_m, bent[3].depth_m, atol=2e-4)
