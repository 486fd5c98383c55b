"""Exports of phones and published scans are read as they lie, and mapped."""

import contextlib
import json
import math
import os
import sys

import cv2
import numpy as np
import pytest

from mapper.config.loading import load_config
from mapper.core.errors import DependencyError, FrameError, SourceError
from mapper.evaluators.metrics.evaluate import evaluate
from mapper.pipeline.build import build
from mapper.simulation.source import CameraSimulator
from mapper.sources import open_source
from mapper.sources.config import CameraConfig, SourceConfig
from mapper.sources.inspection import inspect_log
from mapper.sources.writers import write_log
from tests.support.desk import DESK
from tests.support.posed_scans import WRITERS, Shots, shots_of, write_klg, write_record3d

DEVICE = {"stray-scanner", "record3d", "polycam", "nerfstudio"}
CONFIDENT = {"stray-scanner", "record3d", "polycam"}
UNTIMED = {"nerfstudio", "replica", "bop", "scannet", "bundlefusion", "redwood"}
LOSSLESS = {"nerfstudio", "bop", "redwood", "openloris"}


@pytest.fixture(scope="module")
def shots():
    small = {"width_px": 160, "height_px": 120, "frame_rate_hz": 7.5}
    log = CameraSimulator(DESK.model_copy(update=small)).log()
    frames = list(log)
    at = np.searchsorted(log.truth.stamps_ns, [frame.stamp_ns for frame in frames])
    return shots_of(frames, log.truth.T_world_body[at])


@pytest.mark.parametrize("kind", sorted(WRITERS))
def test_every_layout_is_read_as_it_was_taken(shots, tmp_path, kind):
    write, name = WRITERS[kind]
    log = open_source(write(tmp_path / name, shots))
    assert (log.kind, log.sensor, len(log)) == (kind.removesuffix("-sens"), "rgbd", len(shots.frames))
    np.testing.assert_allclose(
        np.diff(log.stamps_ns) / 1e9, 1.0 / (30.0 if kind in UNTIMED else 15.0), atol=1e-3
    )
    for frame, shot in zip(log, shots.frames, strict=True):
        assert (frame.camera.width_px, frame.camera.height_px) == (160, 120)
        np.testing.assert_allclose(frame.camera.intrinsics, shots.camera.intrinsics, rtol=1e-6)
        expected_mm = shot.depth_mm * (shot.confidence > 0) if kind in CONFIDENT else shot.depth_mm
        np.testing.assert_allclose(frame.depth_m[::2, ::2] * 1000.0, expected_mm, atol=0.1)
        difference = np.abs(frame.image.astype(int) - shot.rgb.astype(int))
        assert difference.max() == 0 if kind in LOSSLESS else difference.mean() < 6.0
    if kind == "klg":
        assert log.truth is log.device_poses is None
        return
    poses = log.device_poses if kind in DEVICE else log.truth
    assert (log.truth is None) == (kind in DEVICE)
    np.testing.assert_allclose(poses.T_world_body, [shot.T_world_camera for shot in shots.frames], atol=1e-5)


@pytest.mark.parametrize("kind", ["stray-scanner", "record3d", "polycam", "scannet-sens", "replica"])
def test_layouts_of_every_way_of_reading_are_mapped(shots, tmp_path, kind):
    write, name = WRITERS[kind]
    log = open_source(write(tmp_path / name, shots))
    run = build(log, load_config(None), tmp_path / "run")
    assert run.manifest.counts.tracked == len(shots.frames)
    assert evaluate(run.trajectory, log.device_poses if kind in DEVICE else log.truth).ate_m < 0.02


def test_a_klg_file_may_be_raw_or_cut_and_needs_a_camera(shots, tmp_path):
    path = write_klg(tmp_path / "scan.klg", shots, packed=False)
    frame = open_source(path)[1]
    np.testing.assert_array_equal(frame.image, shots.frames[1].rgb)
    np.testing.assert_allclose(frame.depth_m[::2, ::2] * 1000.0, shots.frames[1].depth_mm, atol=0.1)
    path.write_bytes(path.read_bytes()[:-5])
    log = open_source(path)
    assert len(log) == len(shots.frames) - 1
    assert any(f"it says {len(shots.frames)}" in note for note in log.notes)
    path.with_name("intrinsics.txt").unlink()
    with pytest.raises(SourceError, match=r"put a calibration\.toml"):
        open_source(path)
    path.write_bytes(b"\x03\0\0\0")
    with pytest.raises(SourceError, match="no frame in it"):
        open_source(path)


def test_a_scene_of_bop_without_poses_or_of_other_scales_is_told(shots, tmp_path):
    path = WRITERS["bop"][0](tmp_path / "000002", shots) / "scene_camera.json"
    cameras = json.loads(path.read_text())
    bare = {key: {"cam_K": one["cam_K"], "depth_scale": 0.25} for key, one in cameras.items()}
    path.write_text(json.dumps(bare))
    log = open_source(path.parent)
    assert log.truth is None
    assert not [note for note in log.notes if "poses" in note]
    bare["1"]["depth_scale"] = 1.0
    path.write_text(json.dumps(bare))
    assert any("depth_scale" in note for note in open_source(path.parent).notes)
    path.write_text("{}")
    with pytest.raises(SourceError, match="no camera"):
        open_source(path.parent)


def test_depth_of_early_stray_scanner_exports_is_arrays(shots, tmp_path):
    folder = WRITERS["stray-scanner"][0](tmp_path / "scan", shots)
    expected = [frame.depth_m for frame in open_source(folder)]
    for path in folder.glob("depth/*.png"):
        np.save(path.with_suffix(".npy"), cv2.imread(str(path), cv2.IMREAD_UNCHANGED))
        path.unlink()
    log = open_source(folder)
    assert log.kind == "stray-scanner"
    np.testing.assert_array_equal([frame.depth_m for frame in log], expected)


def test_a_missing_camera_of_stray_scanner_can_be_set(shots, tmp_path):
    folder = WRITERS["stray-scanner"][0](tmp_path / "scan", Shots(shots.camera, shots.frames[:2]))
    (folder / "camera_matrix.csv").unlink()
    with pytest.raises(SourceError, match=r"source\.camera\.fx_px"):
        open_source(folder)
    camera = CameraConfig(fx_px=250.0, fy_px=251.0, cx_px=80.0, cy_px=60.0)
    assert open_source(folder, SourceConfig(camera=camera))[0].camera.fx_px == 250.0


def test_damaged_poses_and_stamps_of_a_sens_file(shots, tmp_path):
    path = WRITERS["scannet-sens"][0](tmp_path / "scene.sens", shots)
    data = bytearray(path.read_bytes())
    second, third = (data.index(shot.T_world_camera.astype("<f4").tobytes()) for shot in shots.frames[1:3])
    data[second : second + 4] = b"\x01\x00\x80\x7f"  # a signalling NaN
    path.write_bytes(data)
    log = open_source(path)
    assert len(log) == len(shots.frames)
    assert len(log.truth) == len(log) - 1

    data[third + 64 : third + 72] = b"\xff" * 8
    path.write_bytes(data)
    assert len(open_source(path)) == 2


@pytest.mark.parametrize("kind", ["polycam", "record3d"])
def test_device_poses_can_replace_the_odometry(shots, tmp_path, kind):
    write, name = WRITERS[kind]
    log = open_source(write(tmp_path / name, shots))
    run = build(log, load_config(None, ["odometry.kind=given", "loops.kind=none"]), tmp_path / "run")
    assert run.truth is None
    assert evaluate(run.trajectory, log.device_poses).ate_m < 1e-6
    assert inspect_log(log.path, SourceConfig()).log.device_poses.startswith(f"{len(shots.frames)} poses")


@pytest.mark.parametrize("kind", sorted(WRITERS))
def test_every_layout_is_converted_without_loss(shots, tmp_path, kind):
    write, name = WRITERS[kind]
    log = open_source(write(tmp_path / name, Shots(shots.camera, shots.frames[:3])))
    assert write_log(log, tmp_path / "tum", kind="tum") == []
    again = open_source(tmp_path / "tum")
    for frame, expected in zip(again, log, strict=True):
        np.testing.assert_array_equal(frame.image, expected.image)
        np.testing.assert_allclose(frame.depth_m, expected.depth_m, atol=1.01e-4)
    for name in ("truth", "device_poses"):
        found, wanted = getattr(again, name), getattr(log, name)
        assert (found is None) == (wanted is None)
        if wanted is not None:
            np.testing.assert_allclose(found.T_world_body, wanted.T_world_body, atol=1e-6)


def test_a_record3d_recording_may_be_unpacked_and_without_confidence(shots, tmp_path):
    log = open_source(write_record3d(tmp_path / "scan", shots, confidence=False))
    assert log.kind == "record3d"
    assert (log[0].depth_m[0] > 0.0).any()


def test_a_record3d_archive_of_a_later_format_is_refused(shots, tmp_path):
    path = write_record3d(tmp_path / "scan.r3d", Shots(shots.camera, shots.frames[:2]))
    data = bytearray(path.read_bytes())
    data[data.index(b"PK\1\2") + 6] = 255
    path.write_bytes(data)
    with pytest.raises(SourceError, match=r"scan\.r3d"):
        open_source(path)


def test_without_its_library_a_record3d_recording_is_refused(shots, tmp_path, monkeypatch):
    path = write_record3d(tmp_path / "scan.r3d", Shots(shots.camera, shots.frames[:2]))
    monkeypatch.setitem(sys.modules, "lzfse", None)
    with pytest.raises(DependencyError, match=r"pip install .*\[record3d\]"):
        open_source(path)


@pytest.mark.parametrize("kind", sorted(WRITERS))
def test_damage_is_one_line_or_lost_frames(shots, tmp_path, kind):
    """Every file in turn is cut in half, emptied or made of other bytes."""
    write, name = WRITERS[kind]
    path = write(tmp_path / name, Shots(shots.camera, shots.frames[:2]))
    files = [path] if path.is_file() else [one for one in sorted(path.rglob("*")) if one.is_file()]
    rng = np.random.default_rng(0)
    for file in files:
        whole = file.read_bytes()
        noise = rng.integers(0, 256, len(whole), dtype=np.uint8).tobytes()
        for damaged in (whole[: len(whole) // 2], b"", noise, whole[:40] + noise[40:]):
            file.write_bytes(damaged)
            assert "\n" not in _read_all(path)
        file.write_bytes(whole)


@pytest.mark.parametrize("kind", sorted(WRITERS))
def test_links_out_are_refused_and_pipes_are_no_images(shots, tmp_path, kind):
    """Each image, video and packed file is in turn a link to a file elsewhere, and a pipe."""
    (tmp_path / "log").mkdir()
    write, name = WRITERS[kind]
    path = write(tmp_path / "log" / name, Shots(shots.camera, shots.frames[:2]))
    if path.suffix == ".r3d":
        path = write_record3d(tmp_path / "log" / "unpacked", Shots(shots.camera, shots.frames[:2]))
    folder = path.parent if path.is_file() else path
    images = {".png", ".jpg", ".npy", ".mp4", ".sens", ".depth", ".conf"}
    for file in [one for one in sorted(folder.rglob("*")) if one.suffix in images]:
        moved = file.rename(tmp_path / "elsewhere")
        file.symlink_to(moved)
        with pytest.raises(SourceError, match="out of the log"):
            open_source(folder)
        file.unlink()
        os.mkfifo(file)
        _read_all(folder)
        file.unlink()
        moved.rename(file)


@pytest.mark.parametrize("part", ["depth", "conf"])
def test_what_a_record3d_recording_packs_has_a_limit(shots, tmp_path, part):
    import lzfse

    path = write_record3d(tmp_path / "scan", Shots(shots.camera, shots.frames[:2]))
    (path / f"rgbd/0.{part}").write_bytes(64 * lzfse.compress(bytes(2**22)))
    with pytest.raises(FrameError, match="more than"):
        open_source(path).entry_at(0).load()


def _read_all(path):
    """Load what can be loaded; return why the log cannot be opened, if so."""
    try:
        log = open_source(path)
    except SourceError as error:
        return str(error)
    for entry in log.entries():
        with contextlib.suppress(FrameError):
            entry.load()
    return ""


def test_a_matrix_that_lost_a_number_is_no_pose(shots, tmp_path):
    folder = WRITERS["nerfstudio"][0](tmp_path / "scan", shots)
    listed = json.loads((folder / "transforms.json").read_text())
    listed["frames"][1]["transform_matrix"][2].pop()
    (folder / "transforms.json").write_text(json.dumps(listed))
    log = open_source(folder)
    assert (len(log), len(log.device_poses)) == (len(shots.frames), len(shots.frames) - 1)


@pytest.mark.parametrize(("unit_s", "is_read"), [(1.0, True), (1e-9, True), (0.0, False)])
def test_stamps_in_transforms_json_are_read_where_each_frame_has_its_own(shots, tmp_path, unit_s, is_read):
    folder = WRITERS["nerfstudio"][0](tmp_path / "scan", shots)
    listed = json.loads((folder / "transforms.json").read_text())
    stamps_ns = [1_700_000_000_000_000_000 + 250_000_000 * i for i in range(len(listed["frames"]))]
    for frame, stamp_ns in zip(reversed(listed["frames"]), stamps_ns, strict=True):
        frame["timestamp"] = stamp_ns if unit_s == 1e-9 else stamp_ns / 1e9 * unit_s
    (folder / "transforms.json").write_text(json.dumps(listed))
    assert (open_source(folder).stamps_ns.tolist() == stamps_ns) == is_read


def test_nerfs_angle_of_view_and_names_without_ending_are_read(shots, tmp_path):
    folder = WRITERS["nerfstudio"][0](tmp_path / "scan", shots)
    path = folder / "transforms.json"
    listed, camera = json.loads(path.read_text()), open_source(folder)[0].camera
    angle_rad = 2.0 * math.atan(0.5 * camera.width_px / camera.fx_px)
    frames = [
        {
            "file_path": "./" + frame["file_path"].removesuffix(".png"),
            "depth_path": frame["depth_file_path"],
            "transform_matrix": frame["transform_matrix"],
        }
        for frame in listed["frames"]
    ]
    path.write_text(json.dumps({"camera_angle_x": angle_rad, "frames": frames}))
    found = open_source(folder)[0].camera
    assert found.fx_px == found.fy_px == pytest.approx(camera.fx_px, rel=1e-9)
    assert (found.cx_px, found.cy_px) == (0.5 * (found.width_px - 1), 0.5 * (found.height_px - 1))


def test_an_image_of_endless_width_is_refused(shots, tmp_path):
    folder = WRITERS["polycam"][0](tmp_path / "scan", shots)
    first = min((folder / "keyframes/cameras").iterdir())
    first.write_text(json.dumps({**json.loads(first.read_text()), "width": 1e300}).replace("1e+300", "1e400"))
    with pytest.raises(SourceError, match=f"{first.name}: width"):
        open_source(folder)
