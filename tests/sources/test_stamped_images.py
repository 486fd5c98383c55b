"""Folders of images without TUM's lists: pairs in associations.txt, or stamps in the names."""

import numpy as np
import pytest

from mapper.core.errors import SourceError
from mapper.sources import open_source
from mapper.sources.config import CameraConfig, SourceConfig
from mapper.sources.depth_scale import depth_warnings, read_spread
from mapper.sources.image_folders.tum import METRES_NOTE, MILLIMETRES_NOTE, UNITS_NOTE
from tests.support.tum_logs import CALIBRATION, FIRST_NS, PERIOD_NS, write_picture

N = 4
STAMPS_NS = [FIRST_NS + i * PERIOD_NS for i in range(N)]


def seconds(stamp_ns):
    return f"{stamp_ns // 10**9}.{stamp_ns % 10**9:09d}"[:17]


def written(folder, colour="rgb/{}.png", depth="depth/{}.png", name=seconds, late_ns=0):
    """Write images under names of their stamps; depth is late by some time."""
    for i, stamp_ns in enumerate(STAMPS_NS):
        paths = [folder / colour.format(name(stamp_ns)), folder / depth.format(name(stamp_ns + late_ns))]
        write_picture(*paths, i)
    (folder / "calibration.toml").write_text(CALIBRATION)
    return folder


@pytest.mark.parametrize(
    ("colour", "depth", "name"),
    [
        ("rgb/{}.png", "depth/{}.png", seconds),
        ("{}_color.jpg", "{}_depth.png", seconds),
        ("color/frame_{}.jpg", "aligned_depth/{}.png", lambda stamp_ns: stamp_ns),
        ("images/{}.png", "depth/{}.png", lambda stamp_ns: stamp_ns // 1000),
        # librealsense's rs-convert -p out
        ("out_Color_{}.png", "out_Depth_{}.png", lambda ns: f"{ns // 10**6}.{ns // 1000 % 1000:03d}000000"),
    ],
)
def test_images_named_by_their_stamps_need_no_list(tmp_path, colour, depth, name):
    log = open_source(written(tmp_path, colour, depth, name, late_ns=4_000_000))
    assert (log.kind, len(log), list(log.notes)) == ("tum", N, [MILLIMETRES_NOTE])
    assert log.stamps_ns.tolist() == [stamp_ns // 1000 * 1000 for stamp_ns in STAMPS_NS]
    entry = log.entry_at(1)
    assert (entry.files.depth_units_per_m, entry.depth_delay_ns) == (1000.0, 4_000_000)


def test_depth_before_colour_pairs_by_time_and_not_by_its_place(tmp_path):
    log = open_source(written(tmp_path, late_ns=-PERIOD_NS))
    assert len(log) == N - 1
    assert log.entry_at(0).depth_stamp_ns == log.stamps_ns[0]


@pytest.mark.parametrize("name", ["associations.txt", "associate.txt", "assoc.txt", "desk.txt"])
@pytest.mark.parametrize("is_depth_first", [False, True])
def test_a_list_of_pairs_takes_the_place_of_both_lists(tmp_path, name, is_depth_first):
    lines = ["# rgb depth", ""]
    for i, stamp_ns in enumerate(STAMPS_NS):
        write_picture(tmp_path / "rgb" / f"a{i}.png", tmp_path / "depth" / f"b{i}.png", i)
        pair = [f"{seconds(stamp_ns)} rgb/a{i}.png", f"{seconds(stamp_ns + 5_000_000)} depth/b{i}.png"]
        lines.append(" ".join(reversed(pair) if is_depth_first else pair))
    (tmp_path / name).write_text("\n".join(lines))
    (tmp_path / "calibration.toml").write_text(CALIBRATION)
    log = open_source(tmp_path)
    assert (log.kind, len(log), list(log.notes)) == ("tum", N, [UNITS_NOTE])
    entry = log.entry_at(2)
    files = entry.files
    assert (files.colour.name, files.depth.name, files.depth_units_per_m) == ("a2.png", "b2.png", 5000.0)
    assert entry.depth_delay_ns == 5_000_000


def test_pairs_that_lead_out_of_the_folder_are_refused(tmp_path):
    (tmp_path / "associations.txt").write_text("1.0 ../rgb/a.png 1.0 depth/a.png\n")
    with pytest.raises(SourceError, match=r"txt:1: '../rgb/a.png' leads out of the log's folder"):
        open_source(tmp_path)


@pytest.mark.parametrize("unit", ["microseconds", "nanoseconds"])
def test_numbers_that_advance_as_times_are_times(tmp_path, unit):
    factor = {"microseconds": 1000, "nanoseconds": 1}[unit]
    for i in range(N):
        name = f"{i * PERIOD_NS // factor}.png"
        write_picture(tmp_path / "rgb" / name, tmp_path / "depth" / name, i)
    log = open_source(tmp_path, SourceConfig(camera=CameraConfig(fx_px=60, fy_px=60, cx_px=32, cy_px=24)))
    assert log.stamps_ns.tolist() == [i * PERIOD_NS for i in range(N)]
    assert any(note.startswith(f"numbers in file names are taken for {unit}") for note in log.notes)


def test_a_folder_of_a_log_names_it(tmp_path):
    written(tmp_path / "office")
    with pytest.raises(SourceError, match=r"known format .*; office in it is one"):
        open_source(tmp_path)


def test_numbers_of_too_many_digits_are_no_numbers(tmp_path):
    for i in range(N):
        write_picture(tmp_path / "rgb" / f"{i:025d}.png", tmp_path / "depth" / f"{i:025d}.png", i)
    with pytest.raises(SourceError, match="not a log of a known format"):
        open_source(tmp_path)


@pytest.mark.parametrize(("stated", "is_assumed"), [("", True), ("depth_factor = 5000\n", False)])
def test_millimetres_taken_for_tums_units_are_told_without_a_truth(tiny_tum_log, stated, is_assumed):
    folder = tiny_tum_log()
    (folder / "groundtruth.txt").unlink()
    (folder / "calibration.toml").write_text(CALIBRATION + stated)
    write_near(folder)
    log = open_source(folder)
    assert (UNITS_NOTE in log.notes) == is_assumed
    why = "a twentieth of it is within 0.22 m, but cameras measure 0.3 to 8 m; is source.camera"
    assert [why in warning for warning in depth_warnings(log, read_spread(log))] == [True]


def write_near(folder):
    """Write depth of 1 m to 3 m in millimetres."""
    import cv2

    for path in (folder / "depth").iterdir():
        units = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        ramp = np.linspace(1000, 3000, units.size).reshape(units.shape)
        assert cv2.imwrite(str(path), ramp.astype(np.uint16))


def test_floats_in_the_list_of_a_tum_folder_are_metres(tiny_tum_log):
    folder = tiny_tum_log()
    (folder / "calibration.toml").write_text(CALIBRATION)
    for path in (folder / "depth").iterdir():
        np.save(path.with_suffix(".npy"), np.full((48, 64), 1.5, np.float32))
    (folder / "depth.txt").write_text((folder / "depth.txt").read_text().replace(".png", ".npy"))
    log = open_source(folder)
    assert [note in log.notes for note in (METRES_NOTE, UNITS_NOTE)] == [True, False]
    assert log[0].depth_m.max() == 1.5
