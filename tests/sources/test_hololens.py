"""HoloLens 2's recordings by StreamRecorder."""

import numpy as np
import pytest

from mapper.core.errors import FrameError, SourceError
from mapper.core.geometry import apply, inverse
from mapper.core.rotations import row_of_pose
from mapper.sources import open_source
from mapper.sources.calibration_file import calibration_text
from mapper.sources.config import CameraConfig, SourceConfig
from tests.support.hololens import (
    CENTRE_PX,
    COLOUR_NS,
    COLOUR_PX,
    DEPTH_NS,
    FOCAL_PX,
    NORMAL_WORLD,
    OFFSET_M,
    T_DEPTH_RIG,
    T_RIG_COLOUR,
    rig_pose,
    unit_rays,
    write_hololens,
)

SEEN = [2, 6, 11]
"""Colour images that are the nearest to one of depth."""


def assert_shows_wall(log):
    for frame, depth_ns in zip(log, DEPTH_NS, strict=True):
        assert frame.stamp_ns + round(1e9 * frame.depth_delay_s) == depth_ns
        points_world = apply(rig_pose(depth_ns) @ T_RIG_COLOUR, frame.scan().points_body)
        assert len(points_world) > 0.9 * frame.depth_m.size
        assert np.abs(points_world @ NORMAL_WORLD - OFFSET_M).max() < 0.005


@pytest.mark.parametrize("is_raw", [False, True])
def test_frames_are_the_colour_images_nearest_to_depth_and_show_the_wall(tmp_path, is_raw):
    log = open_source(write_hololens(tmp_path / "room", is_raw=is_raw))
    assert (log.kind, log.sensor, log.name) == ("hololens", "rgbd", "room")
    assert log.stamps_ns.tolist() == [COLOUR_NS[k] for k in SEEN]
    camera = log[0].camera
    assert (camera.width_px, camera.height_px) == COLOUR_PX
    assert (camera.fx_px, camera.fy_px) == pytest.approx(FOCAL_PX)
    assert (camera.cx_px, camera.cy_px) == pytest.approx(np.array(CENTRE_PX) - 0.5)
    assert [tuple(frame.rgb[9, 9]) for frame in log] == [(10 * k + 2, 10 * k + 1, 10 * k) for k in SEEN]
    assert_shows_wall(log)
    assert (log.truth, log.device_poses.stamps_ns.tolist()) == (None, COLOUR_NS)
    true = np.array([rig_pose(stamp_ns) @ T_RIG_COLOUR for stamp_ns in COLOUR_NS])
    np.testing.assert_allclose(log.device_poses.T_world_body, true, atol=1e-5)


def test_the_first_scripts_called_the_folder_rgb(tmp_path):
    folder = write_hololens(tmp_path / "room")
    (folder / "PV").rename(folder / "rgb")
    assert_shows_wall(open_source(folder))


def test_a_pose_where_the_device_was_lost_is_left_out(tmp_path):
    folder = write_hololens(tmp_path / "room")
    path = next(folder.glob("*_pv.txt"))
    lines = path.read_text().splitlines()
    lines[5] = ",".join([*lines[5].split(",")[:3], *["0"] * 16])
    path.write_text("\n".join(lines))
    log = open_source(folder)
    assert len(log.device_poses) == 12
    assert_shows_wall(log)


def test_of_focal_lengths_that_change_the_median_is_taken_and_said(tmp_path):
    steady = open_source(write_hololens(tmp_path / "a", focal_px=(290.0, 291.0, 292.0)))
    changing = open_source(write_hololens(tmp_path / "b", focal_px=(286.0, 291.0, 296.0)))
    assert steady[0].camera.fx_px == changing[0].camera.fx_px == 291.0
    assert len(changing.notes) == len(steady.notes) + 1


def test_the_user_s_numbers_go_before_the_recording_s(tmp_path):
    folder = write_hololens(tmp_path / "room")
    path = folder / "Depth Long Throw_extrinsics.txt"
    path.write_text("1,0,0,0.1,0,1,0,0,0,0,1,0,0,0,0,1")
    row = tuple(row_of_pose(inverse(T_DEPTH_RIG @ T_RIG_COLOUR)).tolist())
    assert_shows_wall(open_source(folder, SourceConfig(camera=CameraConfig(depth_in_color=row))))


def test_a_calibration_beside_it_is_of_colour(tmp_path):
    folder = write_hololens(tmp_path / "room")
    own = open_source(folder)[0].camera
    (folder / "calibration.toml").write_text(calibration_text(own, depth_units_per_m=1000.0))
    path = next(folder.glob("*_pv.txt"))
    path.write_text(path.read_text().replace(f",{FOCAL_PX[0]:g},", ",300,"))
    assert_shows_wall(open_source(folder))


@pytest.mark.parametrize(
    ("name", "content", "named"),
    [
        ("Depth Long Throw_lut.bin", unit_rays()[1:].astype("<f4").tobytes(), "320×288"),
        ("Depth Long Throw_lut.bin", np.zeros((288, 320, 3), "<f4").tobytes(), "unit"),
        ("Depth Long Throw_lut.bin", unit_rays()[:, ::-1].astype("<f4").tobytes(), "left to right"),
        ("Depth Long Throw_extrinsics.txt", b"1,0,0,0\n0,1,0,0\n0,0,2,0\n0,0,0,1\n", "extrinsics"),
        ("Depth Long Throw_rig2world.txt", b"133444736000000000" + b",1" * 16, "rig2world"),
        ("Depth Long Throw_rig2world.txt", b"12.5" + b",1" * 16, r"rig2world\.txt:1"),
        ("2023-11-14-221320_pv.txt", b"190,107,380,214\n133444736000000000,1,2\n", r"pv\.txt:2"),
        ("2023-11-14-221320_pv.txt", b"190,107\n", "width and height"),
    ],
)
def test_a_file_that_is_malformed_is_named(tmp_path, name, content, named):
    folder = write_hololens(tmp_path / "room")
    (folder / name).write_bytes(content)
    with pytest.raises(SourceError, match=named):
        open_source(folder)


@pytest.mark.parametrize("name", ["PV", "Depth Long Throw"])
def test_images_that_are_not_unpacked_are_named(tmp_path, name):
    folder = write_hololens(tmp_path / "room")
    (folder / name).rename(tmp_path / "elsewhere")
    (folder / f"{name}.tar").write_bytes(b"")
    with pytest.raises(SourceError, match=rf"{name}\.tar"):
        open_source(folder)


def test_a_damaged_image_costs_its_frame_alone(tmp_path):
    folder = write_hololens(tmp_path / "room", is_raw=True)
    depth = sorted((folder / "Depth Long Throw").glob("*[0-9].pgm"))
    depth[0].write_bytes(depth[0].read_bytes()[:9000])
    colour = sorted((folder / "PV").iterdir())[SEEN[1]]
    colour.write_bytes(b"short")
    log = open_source(folder)
    for index in (0, 1):
        with pytest.raises(FrameError):
            log[index]
    assert log[2].depth_m.max() > 2.0


def test_an_image_that_is_a_link_out_of_the_log_is_refused(tmp_path):
    folder = write_hololens(tmp_path / "room", is_raw=True)
    image = sorted((folder / "PV").iterdir())[SEEN[0]]
    image.rename(tmp_path / "elsewhere.bytes")
    image.symlink_to(tmp_path / "elsewhere.bytes")
    with pytest.raises(SourceError, match="link"):
        open_source(folder)
