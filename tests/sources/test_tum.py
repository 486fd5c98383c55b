import re

import cv2
import numpy as np
import pytest

from mapper.core.errors import FrameError, SourceError
from mapper.core.frames import PinholeCamera
from mapper.core.rotations import row_of_pose
from mapper.core.timebase import nearest
from mapper.sources import open_source
from mapper.sources.calibration import FREIBURG
from mapper.sources.config import CameraConfig, SourceConfig
from tests.support.depth_cameras import BESIDE, seen_from
from tests.support.paths import FR1_XYZ
from tests.support.tum_logs import DEPTH_LEAD_NS, FIRST_NS, PERIOD_NS, picture, write_picture


def edit(path, change):
    path.write_text(change(path.read_text()))


def test_reads_every_frame_with_exact_stamps_pixels_and_truth(tiny_tum_log):
    source = open_source(tiny_tum_log(4))
    assert (source.kind, source.name, len(source), source.notes) == ("tum", "log", 4, [])
    assert source.stamps_ns.tolist() == [FIRST_NS + i * PERIOD_NS for i in range(4)]
    for i, entry in enumerate(source.entries()):
        rgb, units = picture(i)
        frame = entry.load()
        np.testing.assert_array_equal(frame.rgb, rgb)
        np.testing.assert_array_equal(frame.depth_m, units.astype(np.float32) / np.float32(5000))
        assert entry.depth_stamp_ns == entry.stamp_ns - DEPTH_LEAD_NS
        assert entry.load(colour=False).image.shape == (48, 64)
    assert (frame.camera.fx_px, frame.camera.cy_px, frame.camera.width_px) == (60.0, 23.5, 64)
    np.testing.assert_allclose(source.truth.positions_world[:, 0], [0, 0.01, 0.02, 0.03])
    assert source.accelerations is None
    assert source.stamps_ns.tolist() == source.stamps_ns.tolist()
    np.testing.assert_array_equal(source[1].depth_m, source[1].depth_m)


@pytest.mark.parametrize(
    ("lost", "end"), [(2, "left out"), (3, "more than half of the log is left out (source.max_pair_gap_s)")]
)
def test_colour_without_near_depth_is_left_out_and_counted(tiny_tum_log, lost, end):
    log = tiny_tum_log(5)
    edit(log / "depth.txt", lambda text: "\n".join(text.splitlines()[:-lost]))
    source = open_source(log)
    assert len(source) == 5 - lost
    assert source.notes == [f"{lost} of 5 colour images have no depth image within 20 ms; {end}"]


def test_the_pair_gap_is_inclusive_to_the_nanosecond_and_says_how_far_the_closest_is(tiny_tum_log):
    log = tiny_tum_log(3)
    assert len(open_source(log, SourceConfig(max_pair_gap_s=0.009999))) == 3
    with pytest.raises(SourceError, match=r"within 9\.998 ms; the closest pair is 0\.009999 s apart"):
        open_source(log, SourceConfig(max_pair_gap_s=0.009998))
    edit(log / "depth.txt", lambda text: text.replace("\n13050311", "\n13050411"))
    with pytest.raises(SourceError, match=r"within 20 ms; the closest pair is 9999\.92 s apart") as refused:
        open_source(log)
    offset_s = float(re.search(r"source\.depth_offset_s=(-[\d.]+)", str(refused.value))[1])
    assert len(open_source(log, SourceConfig(depth_offset_s=offset_s))) > 0


@pytest.mark.parametrize("form", ["rgb of 1/{}", '"rgb/{}"', "'rgb of 1/{}'", "LOG/rgb/{}"])
def test_names_in_lists_may_have_blanks_and_quotes_and_be_absolute(tiny_tum_log, form):
    log = tiny_tum_log(3)
    if "of 1" in form:
        (log / "rgb").rename(log / "rgb of 1")
    edit(log / "rgb.txt", lambda text: re.sub(r"rgb/(.*)", lambda name: form.format(name[1]), text))
    edit(log / "rgb.txt", lambda text: text.replace("LOG", f"{log}"))
    assert len(open_source(log)) == 3


def test_listed_files_that_do_not_exist_are_dropped_and_counted(tiny_tum_log):
    log = tiny_tum_log(4)
    next(iter(sorted((log / "rgb").iterdir()))).unlink()
    source = open_source(log)
    assert len(source) == 3
    assert source.notes == ["rgb.txt: 1 of 4 listed images do not exist; dropped"]


def test_lists_out_of_order_are_sorted_and_repeats_dropped(tiny_tum_log):
    log = tiny_tum_log(4)
    want = open_source(log).stamps_ns.tolist()
    edit(log / "rgb.txt", lambda text: "\n".join([*reversed(text.splitlines()), text.splitlines()[-1]]))
    source = open_source(log)
    assert source.stamps_ns.tolist() == want
    assert any("out of time order in 3 places; sorted" in note for note in source.notes)
    assert any("1 stamps appear twice" in note for note in source.notes)


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("rgb.txt", "", r"rgb\.txt: empty list"),
        ("depth.txt", None, r"depth\.txt: cannot be read: No such file"),
        ("depth.txt", "# only a comment\n", r"depth\.txt: empty list"),
        ("rgb.txt", "1.0 rgb/a.png extra\n", r"rgb\.txt: none of its 1 images exists; .* extra"),
        ("rgb.txt", "# x\nsoon rgb/a.png\n", r"rgb\.txt:2: stamp 'soon' is not a decimal number"),
        ("rgb.txt", "1.0 rgb/none.png\n", r"rgb\.txt: none of its 1 images exists"),
        ("rgb.txt", b"\xff\xfe\x00", r"rgb\.txt: not a text file"),
        ("groundtruth.txt", "1.0 0 0\n", r"groundtruth\.txt:1: 3 columns, want 8"),
        ("groundtruth.txt", "1.0 0 0 x 0 0 0 1\n", r"groundtruth\.txt:1: could not convert string"),
        ("accelerometer.txt", "1.0 0 0\n", r"accelerometer\.txt:1: 3 columns, want 4"),
        ("calibration.toml", "fx_px = 500.0\n", r"calibration\.toml: no number fy_px"),
        ("calibration.toml", "fx_px = \n", r"calibration\.toml: not valid TOML"),
    ],
)
def test_malformed_files_are_named_with_their_line(tiny_tum_log, name, text, message):
    log = tiny_tum_log(2)
    (log / name).unlink(missing_ok=True)
    if text is not None:
        (log / name).write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(SourceError, match=message) as caught:
        open_source(log)
    assert "\n" not in str(caught.value)


BAD = "1305031102.5 nan nan nan nan nan nan nan\n1305031102.6 0 0 0 0 0 0 0\nnan 0 0 0 0 0 0 1\n"


@pytest.mark.parametrize(
    ("text", "stamps_ns", "noted"),
    [
        (None, [], []),
        ("# header\n", [], ["no usable pose"]),
        (BAD, [], ["3 of 3 poses are not finite rigid motions; dropped", "no usable pose"]),
        *(
            (f"{stamp} 0 0 0 0 0 0 1\n", [1305031102_500000123], [])
            for stamp in ("1305031102500000123", "1305031102500000.123", "1305031102500.000123")
        ),
        (
            f"{BAD}1305031102.5 0 0 0 0 0 0 1\n",
            [1305031102_500000000],
            ["3 of 4 poses are not finite rigid motions; dropped"],
        ),
    ],
)
def test_truth_is_of_the_usable_poses(tiny_tum_log, text, stamps_ns, noted):
    log = tiny_tum_log(2)
    (log / "groundtruth.txt").unlink() if text is None else (log / "groundtruth.txt").write_text(text)
    source = open_source(log)
    assert ([] if source.truth is None else source.truth.stamps_ns.tolist()) == stamps_ns
    assert source.notes == [f"groundtruth.txt: {note}" for note in noted]


def test_accelerations_are_read_in_time_order(tiny_tum_log):
    log = tiny_tum_log(2)
    (log / "accelerometer.txt").write_text("# t ax ay az\n2.0 0 0 9.81\n1.0 0.5 0 -9.7\n3.0 inf 0 0\n")
    source = open_source(log)
    assert source.accelerations.stamps_ns.tolist() == [1_000_000_000, 2_000_000_000]
    np.testing.assert_array_equal(source.accelerations.acceleration_mps2, [[0.5, 0, -9.7], [0, 0, 9.81]])
    expected = "accelerometer.txt: 1 of 3 accelerations are not finite"
    assert any(note.startswith(expected) for note in source.notes)


def test_a_single_bad_frame_is_its_own_error(tiny_tum_log):
    log = tiny_tum_log(3)
    victim = sorted((log / "depth").iterdir())[1]
    victim.write_bytes(victim.read_bytes()[:-20])
    first, second, third = open_source(log).entries()
    first.load()
    third.load()
    with pytest.raises(FrameError, match=rf"{victim.name}: truncated PNG"):
        second.load()


def test_images_of_another_size_are_their_own_error(tiny_tum_log):
    log = tiny_tum_log(3)
    colour, depth = (sorted((log / name).iterdir())[2] for name in ("rgb", "depth"))
    write_picture(colour.with_name("big.png"), depth, 0, width_px=80, height_px=40)
    *_, last = open_source(log).entries()
    with pytest.raises(FrameError, match=rf"{depth.name}: 80×40 px, but the log has 64×48"):
        last.load()


def test_the_camera_is_as_large_as_the_first_readable_image(tiny_tum_log):
    log = tiny_tum_log(3)
    sorted((log / "rgb").iterdir())[0].write_bytes(b"")
    assert open_source(log)[1].camera.width_px == 64
    for path in (log / "rgb").iterdir():
        path.write_bytes(b"")
    with pytest.raises(SourceError, match=r"none of 3 images can be read; the first: .*: empty file"):
        open_source(log)


@pytest.mark.parametrize(
    ("folder", "why"),
    [
        ("log", r"calibration\.toml .*--set source\.camera\.fx_px="),
        ("rgbd_dataset_freiburg2_desk", r"camera of TUM freiburg2: holds for 640×480 px, but .* 64×48"),
    ],
)
def test_without_a_calibration_the_camera_is_known_by_the_folder_s_name_or_asked_for(
    tiny_tum_log, folder, why
):
    log = tiny_tum_log(2, folder=folder)
    (log / "calibration.toml").unlink()
    with pytest.raises(SourceError, match=why):
        open_source(log)


def test_the_users_camera_wins_over_the_file_and_a_depth_factor_leaves_it_alone(tiny_tum_log):
    log = tiny_tum_log(2)
    numbers = {"fx_px": 50, "fy_px": 51, "cx_px": 32, "cy_px": 24}
    for camera, fx_px in (({}, 60), (numbers, 50)):
        source = open_source(log, SourceConfig(camera=CameraConfig(**camera, depth_factor=1000)))
        assert (source[0].camera.fx_px, source.entry_at(0).files.depth_units_per_m) == (fx_px, 1000)


@pytest.mark.skipif(not FR1_XYZ.is_dir(), reason=f"{FR1_XYZ} is missing")
def test_the_real_freiburg1_xyz():
    source = open_source(FR1_XYZ)
    assert (len(source), len(source.truth), source.notes) == (798, 3000, [])
    stamps = np.array(source.stamps_ns.tolist())
    assert stamps[[0, -1]].tolist() == [1305031102175304000, 1305031128747363000]
    _, gap_ns = nearest(source.truth.stamps_ns, stamps)
    assert (gap_ns <= 20_000_000).sum() == 796
    assert len(open_source(FR1_XYZ, SourceConfig(require_truth=True))) == 796
    frame = next(iter(source.entries())).load()
    assert frame.camera == FREIBURG["1"].camera(width_px=640, height_px=480)
    assert frame.image.shape == (480, 640, 3)
    assert 0.5 < np.median(frame.depth_m[frame.depth_m > 0]) < 2.0


def test_depth_of_a_camera_of_its_own_is_registered_by_the_calibration_or_by_settings(tiny_tum_log):
    registered = [frame.depth_m for frame in open_source(tiny_tum_log(3, folder="registered"))]
    log = tiny_tum_log(3)
    source, wide = open_source(log), PinholeCamera(106, 60, 53.0, 53.0, 52.4, 30.1)
    for entry in source.entries():
        depth_m = seen_from(entry.load().depth_m, entry.load().camera, wide, BESIDE)
        assert cv2.imwrite(str(entry.files.depth), np.rint(depth_m * 5000.0).astype(np.uint16))
    with pytest.raises(SourceError, match=r"another aspect ratio.*source\.camera\.depth_intrinsics_px"):
        open_source(log)
    own, pose = (53.0, 53.0, 52.4, 30.1), tuple(row_of_pose(BESIDE).tolist())
    by_settings = CameraConfig(depth_intrinsics_px=own, depth_in_color=pose)
    found = [open_source(log, SourceConfig(camera=by_settings))]
    for partial, missing in (
        ({"depth_intrinsics_px": own}, "0 of its frames .*depth_in_color"),
        ({"depth_in_color": pose}, "depth_intrinsics_px"),
    ):
        with pytest.raises(SourceError, match=missing):
            open_source(log, SourceConfig(camera=CameraConfig(**partial)))
    lines = f"depth_intrinsics_px = {list(own)}\ndepth_in_color = {list(pose)}\n"
    edit(log / "calibration.toml", lambda text: text + lines)
    found.append(open_source(log))
    for one in found:
        assert sum("15.0 mm" in note for note in one.notes) == 1
        for depth_m, frame in zip(registered, one, strict=True):
            both = (frame.depth_m > 0.0) & (depth_m > 0.0)
            assert both.sum() > 0.9 * (depth_m > 0.0).sum()
            assert np.abs(frame.depth_m - depth_m)[both].max() < 0.005
    other = CameraConfig(depth_in_color=(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0))
    (note,) = (one for one in open_source(log, SourceConfig(camera=other)).notes if "registered" in one)
    assert "(source.camera)" in note


def test_fractions_of_listed_stamps_without_leading_zeros_are_whole_numbers(tiny_tum_log):
    folder = tiny_tum_log(12)
    expected_ns = [1_700_000_000_007_000_000 + i * 100_000_000 for i in range(12)]
    for name in ("rgb.txt", "depth.txt"):
        files = [line.split()[1] for line in (folder / name).read_text().splitlines()[1:]]
        stamps = [f"{ns // 10**9}.{ns % 10**9}" for ns in expected_ns]
        lines = (" ".join(words) for words in zip(stamps, files, strict=True))
        (folder / name).write_text("\n".join(lines) + "\n")
    log = open_source(folder)
    assert log.stamps_ns.tolist() == expected_ns
    assert sum("leading zeros" in note for note in log.notes) == 2


@pytest.mark.parametrize(("apart_s", "noted"), [(1.0, 1), (0.5, 0)])
def test_stamps_that_count_frames_are_noted(tiny_tum_log, apart_s, noted):
    folder = tiny_tum_log(12)
    for name in ("rgb.txt", "depth.txt"):
        files = [line.split()[1] for line in (folder / name).read_text().splitlines()[1:]]
        lines = (f"{1 + apart_s * k} {file}" for k, file in enumerate(files))
        (folder / name).write_text("\n".join(lines) + "\n")
    assert sum("source.rate_hz" in note for note in open_source(folder).notes) == noted


@pytest.mark.parametrize(
    ("header", "separator", "slash"),
    [("", ",", "/"), ("timestamp,filename\n", ", ", "/"), ("timestamp filename\n", "\t", "\\")],
)
def test_lists_of_other_programs_are_read(tiny_tum_log, header, separator, slash):
    log = tiny_tum_log(3)
    expected = open_source(log).stamps_ns.tolist()
    for name in ("rgb.txt", "depth.txt"):
        lines = [line.split() for line in (log / name).read_text().splitlines() if line[0] != "#"]
        rows = [f"{stamp}{separator}{file.replace('/', slash)}" for stamp, file in lines]
        (log / name).write_text(header + "\n".join(rows))
    assert open_source(log).stamps_ns.tolist() == expected


def test_a_header_names_the_order_of_the_truths_columns(tiny_tum_log):
    log = tiny_tum_log(3)
    expected = open_source(log).truth.T_world_body
    rows = [line.split() for line in (log / "groundtruth.txt").read_text().splitlines() if line[0] != "#"]
    turned = ["timestamp,tx,ty,tz,qw,qx,qy,qz", *(",".join([*row[:4], row[7], *row[4:7]]) for row in rows)]
    (log / "groundtruth.txt").write_text("\n".join(turned))
    np.testing.assert_allclose(open_source(log).truth.T_world_body, expected, atol=1e-12)
