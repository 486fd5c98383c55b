import shutil

import cv2
import numpy as np
import pytest

from mapper.core.errors import DependencyError, FrameError, SourceError
from mapper.core.geometry import exp
from mapper.sources import open_source
from mapper.sources.config import SourceConfig
from mapper.sources.depth_scale import read_spread, why_no_depth
from mapper.sources.image_files.reading import read_array_m
from tests.support.tum_logs import CALIBRATION, write_picture

POSES = [exp(np.array([0.1 * i, -0.2, 0.3 * i]), np.array([i, 2.0, -0.5 * i])) for i in range(4)]


def matrix_text(T):
    return "\n".join(" ".join(f"{v:.7e}" for v in row) for row in T) + "\n"


def seven_scenes(folder, n=4):
    for i in range(n):
        stem = folder / f"frame-{i:06d}"
        write_picture(stem.with_suffix(".color.png"), stem.with_suffix(".depth.png"), i)
        stem.with_suffix(".pose.txt").write_text(matrix_text(POSES[i]))
    (folder / "calibration.toml").write_text(CALIBRATION)
    return folder


def redwood(folder, names, *, colour="rgb", ending=".jpg"):
    for i, name in enumerate(names):
        write_picture(folder / colour / f"{name}{ending}", folder / "depth" / f"{name}.png", i)
    (folder / "calibration.toml").write_text(CALIBRATION)
    return folder


def test_a_list_of_stamps_goes_before_an_assumed_rate(tmp_path):
    folder = redwood(tmp_path, ["000003", "000004", "000005"])
    (folder / "rgb/timestamps.txt").write_text("".join(f"{k} {0.25 * k}\n" for k in range(9)))
    source = open_source(folder)
    assert source.stamps_ns.tolist() == [750_000_000, 1_000_000_000, 1_250_000_000]
    assert not any("source.rate_hz" in note for note in source.notes)
    assert open_source(folder, SourceConfig(rate_hz=1.0)).stamps_ns.tolist()[0] == 3_000_000_000
    (folder / "rgb/timestamps.txt").write_text("1\n2\n")
    source = open_source(folder)
    assert source.stamps_ns.tolist()[0] == 100_000_000
    assert any("timestamps.txt is not used" in note for note in source.notes)


def test_seven_scenes(tmp_path):
    source = open_source(seven_scenes(tmp_path / "chess"))
    assert (source.kind, source.name, len(source)) == ("7-scenes", "chess", 4)
    assert source.stamps_ns.tolist() == [0, 33333333, 66666667, 100000000]
    np.testing.assert_allclose(source.truth.T_world_body, POSES, atol=1e-6)
    assert next(iter(source.entries())).files.depth_units_per_m == 1000
    assert any("30 frames a second assumed" in note for note in source.notes)


def test_a_lost_seven_scenes_pose_is_no_truth(tmp_path):
    folder = seven_scenes(tmp_path)
    (folder / "frame-000001.pose.txt").write_text(matrix_text(np.full((4, 4), -np.inf)))
    (folder / "frame-000002.pose.txt").write_text(matrix_text(np.zeros((4, 4))))
    source = open_source(folder)
    assert source.truth.stamps_ns.tolist() == [0, 100000000]
    assert "pose files: 2 of 4 poses are not finite rigid motions; dropped" in source.notes


def test_a_folder_with_one_sequence_opens_it_and_with_two_names_them(tmp_path):
    seven_scenes(tmp_path / "seq-01")
    assert len(open_source(tmp_path)) == 4
    seven_scenes(tmp_path / "seq-02")
    with pytest.raises(SourceError, match="holds 2 sequences; open one of seq-01, seq-02"):
        open_source(tmp_path)


def test_the_rate_is_an_option_and_gaps_in_the_numbers_keep_their_time(tmp_path):
    folder = redwood(tmp_path, ["00001", "00002", "00005"])
    source = open_source(folder, SourceConfig(rate_hz=10.0))
    assert source.stamps_ns.tolist() == [100_000_000, 200_000_000, 500_000_000]
    assert source.kind == "redwood"


def test_names_with_microseconds_carry_the_stamp(tmp_path):
    names = ["0000001-000000033369", "0000002-000000066739", "0000003-000000100108"]
    source = open_source(redwood(tmp_path, names))
    assert source.stamps_ns.tolist() == [33369000, 66739000, 100108000]
    assert source.notes == []


def test_images_without_a_partner_are_counted(tmp_path):
    folder = redwood(tmp_path, ["00001", "00002", "00003"], colour="image")
    (folder / "depth/00002.png").unlink()
    (folder / "image/00003.jpg").unlink()
    source = open_source(folder)
    assert len(source) == 1
    assert "1 colour images have no partner of the same number; left out" in source.notes
    assert "1 depth images have no partner of the same number; left out" in source.notes


@pytest.mark.parametrize(
    ("colour", "depth"),
    [
        ("rgb_png", "depth_png"),
        ("color_left", "depth"),
        ("Images", "Depth"),
        ("colour", "kinect-depth"),
        ("img", "dpt"),
        ("frames", "depth"),
    ],
)
def test_folders_of_other_names_are_found(tmp_path, colour, depth):
    folder = redwood(tmp_path, [f"{i}" for i in range(7)], colour=colour)
    (folder / "depth").rename(folder / depth)
    source = open_source(folder)
    assert (source.kind, len(source)) == ("redwood", 7)
    assert [note for note in source.notes if "left out" in note or "read" in note] == []


def test_the_images_with_the_most_pairs_are_read(tmp_path):
    """Two pictures beside the folders once made a log of two frames."""
    folder = redwood(tmp_path, [f"{i:04d}" for i in range(9)], colour="rgb_png")
    (folder / "depth").rename(folder / "depth_png")
    for i in range(2):
        write_picture(folder / f"color_{i}.png", folder / f"depth_{i}.png", i)
    source = open_source(folder)
    assert len(source) == 9
    assert {entry.files.colour.parent.name for entry in source.entries()} == {"rgb_png"}


def test_of_several_folders_the_shortest_name_is_read_and_the_others_are_named(tmp_path):
    folder = redwood(tmp_path, ["1", "2", "3"])
    shutil.copytree(folder / "depth", folder / "depth_filtered")
    shutil.copytree(folder / "depth", folder / "depth_colorized")
    shutil.copytree(folder / "rgb", folder / "rgb_mask")
    source = open_source(folder)
    files = next(source.entries()).files
    assert (files.colour.parent.name, files.depth.parent.name) == ("rgb", "depth")
    assert "depth/ is read, not depth_filtered/, depth_colorized/" in source.notes
    assert "rgb/ is read, not rgb_mask/" in source.notes


@pytest.mark.parametrize(("colour", "images", "pairs"), [("rgb", 5, 2), ("color_raw", 9, 1)])
def test_a_log_of_less_than_half_of_its_images_is_noted(tmp_path, colour, images, pairs):
    """Its own pairs, or one that lies beside the folders."""
    folder = redwood(tmp_path, [f"{i}" for i in range(images)], colour=colour)
    assert not any("less than half" in note for note in open_source(folder).notes)
    lost = sorted((folder / "depth").iterdir())[0 if colour == "color_raw" else pairs :]
    for path in lost:
        path.rename(path.with_name(f"at_{path.stem}.25.png"))
    if colour == "color_raw":
        write_picture(folder / "color_0.png", folder / "depth_0.png", 0)
    source = open_source(folder)
    want = f"only {pairs} pairs are read of {images} images, less than half; names of colour and depth must"
    assert len(source) == pairs
    assert any(note.startswith(want) for note in source.notes)


def test_redwood_trajectory_counts_images_from_zero(tmp_path):
    folder = redwood(tmp_path, ["00001", "00002", "00003"])
    blocks = [f"{i} {i} {i + 1}\n{matrix_text(POSES[i])}" for i in (0, 2)]
    (folder / "livingroom1-traj.log").write_text("".join(blocks))
    source = open_source(folder, SourceConfig(rate_hz=10.0))
    assert source.truth.stamps_ns.tolist() == [100_000_000, 300_000_000]
    np.testing.assert_allclose(source.truth.T_world_body, [POSES[0], POSES[2]], atol=1e-6)


@pytest.mark.parametrize("name", ["traj.txt", "poses.txt", "poses/{}.txt"])
@pytest.mark.parametrize("rows", [3, 4])
def test_a_matrix_a_line_or_a_file_is_the_truth(tmp_path, name, rows):
    folder = redwood(tmp_path, ["2", "3", "10"])
    T = np.array([exp([0.0, 0.0, 0.1 * k], [0.5 * k, 0.0, 0.0]) for k in range(3)])
    texts = [" ".join(f"{value:.9f}" for value in one[:rows].ravel()) for one in T]
    if "{}" in name:
        (folder / "poses").mkdir()
        for number, one in zip((2, 3, 10), T, strict=True):
            (folder / name.format(number)).write_text(matrix_text(one))
    else:
        (folder / name).write_text("\n".join(texts))
    log = open_source(folder)
    np.testing.assert_allclose(log.truth.T_world_body, T, atol=1e-6)
    if "{}" not in name:
        (folder / name).write_text("\n".join(texts[:2]))
        log = open_source(folder)
        assert (log.truth, sum("is not used: 2 poses for 3" in note for note in log.notes)) == (None, 1)


def test_poses_of_another_kind_are_not_used_and_named(tmp_path):
    folder = redwood(tmp_path, ["0", "1"])
    (folder / "poses.txt").write_text("1 2 3 0 0 0 1\n1 2 3 0 0 0 1\n")
    log = open_source(folder)
    assert (log.truth, sum("poses.txt is not used: 7 columns" in note for note in log.notes)) == (None, 1)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("0 0 1\n1 0 0 0\n", r"trajectory\.log: 2 lines, want blocks of 5"),
        ("9 9 10\n" + "1 0 0 0\n" * 4, r"trajectory\.log:1: pose of image 9, but there are only 3 images"),
        ("0 0 1\n" + "1 0 0\n" * 4, r"trajectory\.log:2: 3 columns, want 4"),
        ("a b c\n" + "1 0 0 0\n" * 4, r"trajectory\.log:1: 'a' is no number of a frame"),
    ],
)
def test_a_malformed_trajectory_is_named_with_its_line(tmp_path, text, message):
    folder = redwood(tmp_path, ["00001", "00002", "00003"])
    (folder / "trajectory.log").write_text(text)
    with pytest.raises(SourceError, match=message):
        open_source(folder)


def test_an_exported_scannet_folder(tmp_path):
    folder = tmp_path / "scene0000_00"
    (folder / "pose").mkdir(parents=True)
    (folder / "intrinsic").mkdir()
    for i in range(3):
        write_picture(folder / f"color/{i}.jpg", tmp_path / "unused.png", i, width_px=108, height_px=80)
        write_picture(tmp_path / "unused.jpg", folder / f"depth/{i}.png", i, width_px=64, height_px=48)
        T = np.full((4, 4), -np.inf) if i == 1 else POSES[i]  # the camera was lost there
        (folder / f"pose/{i}.txt").write_text(matrix_text(T))
    for name, fx in (("color", 90.0), ("depth", 53.0)):
        K = np.diag([fx, fx, 1.0, 1.0])
        K[:2, 2] = 53.5, 39.5
        (folder / f"intrinsic/intrinsic_{name}.txt").write_text(matrix_text(K))
    with pytest.raises(SourceError, match="colour has 108×80 px and depth 64×48, which is another aspect"):
        open_source(folder)
    for i in range(3):
        write_picture(folder / f"color/{i}.jpg", tmp_path / "unused.png", i, width_px=128, height_px=96)
    source = open_source(folder)
    assert (source[2].camera.width_px, source[2].camera.fx_px) == (128, 90.0)
    assert source[2].depth_m.shape == (96, 128)
    np.testing.assert_allclose(source.truth.T_world_body, [POSES[0], POSES[2]], atol=1e-6)
    assert "pose files: 1 of 3 poses are not finite rigid motions; dropped" in source.notes


def test_the_nominal_camera_is_assumed_only_for_its_own_size(tmp_path):
    small = redwood(tmp_path / "small", ["0"])
    (small / "calibration.toml").unlink()
    with pytest.raises(SourceError, match=r"PrimeSense's nominal camera: holds for 640×480 px, but .* 64×48"):
        open_source(small)
    full = tmp_path / "full"
    write_picture(full / "color/0.png", full / "depth/0.png", 0, width_px=640, height_px=480)
    source = open_source(full)
    assert source[0].camera.fx_px == 525.0
    assert any("PrimeSense's nominal camera" in note for note in source.notes)


def test_a_tum_folder_that_lost_a_list_is_not_taken_for_numbered_images(tiny_tum_log):
    log = tiny_tum_log(2)
    (log / "rgb.txt").unlink()
    source = open_source(log)
    assert (source.kind, len(source)) == ("tum", 2)
    assert source.entry_at(0).files.depth_units_per_m == 5000.0


def with_depth(folder, ending, depth):
    """Return a log whose depth images are of one array."""
    folder = redwood(folder, ["000000", "000001"])
    for path in (folder / "depth").iterdir():
        path.unlink()
        other = path.with_suffix(ending)
        if ending == ".exr":
            write_exr(other, Z=depth)
        elif ending == ".npy":
            np.save(other, depth)
        else:
            cv2.imwrite(str(other), depth)
    return open_source(folder)


@pytest.mark.parametrize(
    ("ending", "kind", "unit_m", "wrong", "assumed"),
    [
        (".tiff", np.float32, 1.0, 400, 1),
        (".npy", np.float32, 1.0, 400, 1),
        (".pfm", np.float32, 1.0, 400, 1),
        (".exr", np.float32, 1.0, 400, 1),
        (".tiff", np.uint16, 0.001, 2, 1000),
    ],
)
def test_depth_is_metres_in_floats_and_else_millimetres_and_doubted_where_it_is_no_camera_s(
    tmp_path, ending, kind, unit_m, wrong, assumed
):
    expected_m = np.full((48, 64), 1.5)
    log = with_depth(tmp_path / "a", ending, (expected_m / unit_m).astype(kind))
    np.testing.assert_array_equal(log[0].depth_m, expected_m)
    log = with_depth(tmp_path / "b", ending, np.full((48, 64), wrong, kind))
    assert f"depth_factor={assumed} right" in why_no_depth(log, read_spread(log))
    if kind is np.float32:
        with pytest.raises(FrameError, match="depth_factor=1000"):
            with_depth(tmp_path / "c", ending, np.full((48, 64), 1e5, kind))[0]


def write_exr(path, **channels):
    library = pytest.importorskip("OpenEXR")
    header = {"compression": library.ZIP_COMPRESSION, "type": library.scanlineimage}
    with library.File(header, {name.replace("__", "."): values for name, values in channels.items()}) as file:
        file.write(str(path))


@pytest.mark.parametrize("name", ["Z", "View__Depth__Z", "V", "R"])
@pytest.mark.parametrize("kind", [np.float16, np.float32])
def test_the_channel_of_depth_of_openexr_is_found_and_what_is_far_off_is_no_depth(tmp_path, name, kind):
    depth_m = np.full((48, 64), 1.5, kind)
    depth_m[0] = np.inf if kind is np.float16 else 1e10  # as Blender writes pixels that show nothing
    write_exr(tmp_path / "0.exr", **{name: depth_m, "A": np.ones_like(depth_m)})
    found_m = read_array_m(tmp_path / "0.exr", 1000.0, 1.0)
    np.testing.assert_array_equal(found_m, np.where(depth_m > 2.0, 0.0, depth_m))


def test_openexr_that_cannot_be_read_is_refused_in_words(tmp_path, monkeypatch):
    write_exr(tmp_path / "0.exr", A=np.ones((48, 64), np.float32))
    other = (tmp_path / "0.exr").read_bytes()
    write_exr(tmp_path / "0.exr", Z=np.ones((48, 64), np.float32))
    whole = (tmp_path / "0.exr").read_bytes()
    huge = whole.replace((63).to_bytes(4, "little"), (10**7).to_bytes(4, "little"))
    for data, why in ((other, "channels A; want"), (whole[:400], "not a sound"), (huge, "megapixels")):
        (tmp_path / "0.exr").write_bytes(data)
        with pytest.raises(FrameError, match=why):
            read_array_m(tmp_path / "0.exr", 1000.0, 1.0)
    monkeypatch.setattr("mapper.runtime.extras.find_spec", lambda _: None)
    with pytest.raises(DependencyError, match=r"octree-mapper\[exr\]"):
        with_depth(tmp_path / "log", ".exr", np.ones((48, 64), np.float32))


def test_folders_whose_numbers_do_not_meet_are_named(tmp_path):
    folder = redwood(tmp_path, ["000000", "000001"])
    for path in (folder / "depth").iterdir():
        path.rename(path.with_name(f"1{path.name}"))
    with pytest.raises(SourceError, match=r"rgb/, depth/ have no number in common"):
        open_source(folder)
