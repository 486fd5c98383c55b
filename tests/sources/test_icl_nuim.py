"""ICL-NUIM folders: the published camera looks along z with y up, so its poses are left-handed."""

import shutil

import numpy as np
import pytest

from mapper.config.loading import load_config
from mapper.core.errors import SourceError
from mapper.core.geometry import exp
from mapper.core.rotations import quaternion_from_rotation
from mapper.core.timebase import NS_PER_S
from mapper.core.trajectory import Trajectory
from mapper.evaluators.metrics.evaluate import evaluate
from mapper.pipeline.track import track_log
from mapper.runtime.progress import SILENT
from mapper.sources import open_source
from mapper.sources.config import CameraConfig, SourceConfig
from mapper.sources.trajectory_files import write_tum
from tests.support.tum_logs import CALIBRATION, write_picture

MIRROR_Y = np.diag([1.0, -1.0, 1.0, 1.0])
POSES = np.array([exp(np.array([0.1 * i, -0.2, 0.3 * i]), np.array([i, 2.0, -0.5 * i])) for i in range(4)])
Y_UP = CALIBRATION.replace("fy_px = 61.0", "fy_px = -61.0")


def pose_lines(numbers, T_world_body):
    """Lines as published, of a camera and a world whose y axes point up."""
    for number, T in zip(numbers, MIRROR_Y @ T_world_body @ MIRROR_Y, strict=True):
        values = [*T[:3, 3], *quaternion_from_rotation(T[:3, :3])]
        yield " ".join([str(number), *(repr(float(v)) for v in values)])


def icl_nuim(folder, n=4, *, truth="livingRoom1.gt.freiburg", **size):
    """Frames 0 … n - 1; as in the data set, the first has no pose."""
    for i in range(n):
        write_picture(folder / f"rgb/{i}.png", folder / f"depth/{i}.png", i, **size)
    (folder / "associations.txt").write_text(
        "".join(f"{i} depth/{i}.png {i} rgb/{i}.png\n" for i in range(n))
    )
    (folder / truth).write_text("\n".join(pose_lines(range(1, n), POSES[1:n])) + "\n")
    return folder


def test_the_published_camera_depth_and_rate_are_taken(tmp_path):
    source = open_source(icl_nuim(tmp_path / "living_room_traj1_frei_png", width_px=640, height_px=480))
    assert (source.kind, source.name) == ("icl-nuim", "living_room_traj1_frei_png")
    assert source.stamps_ns.tolist() == [0, 33333333, 66666667, 100000000]
    frame = next(source.entries()).load()
    camera = frame.camera
    assert (camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px) == (481.2, 480.0, 319.5, 239.5)
    assert frame.depth_m[-1, -1] == pytest.approx((5000 + 20 * 479 + 10 * 639) / 5000.0)
    assert source.notes == ["fy < 0: the camera's y axis points up; y of camera and truth is mirrored"]


@pytest.mark.parametrize("is_listed", [True, False])
@pytest.mark.parametrize("camera", [{}, {"fx_px": 60, "fy_px": 61, "cx_px": 31.5, "cy_px": 23.5}])
def test_the_truth_is_of_frame_numbers_and_mirrored_whoever_states_the_camera(tmp_path, camera, is_listed):
    folder = icl_nuim(tmp_path)
    if not camera:
        (folder / "calibration.toml").write_text(Y_UP)
    if not is_listed:
        (folder / "associations.txt").unlink()
    source = open_source(folder, SourceConfig(rate_hz=10.0, camera=CameraConfig(**camera)))
    assert (source.kind, len(source), source[0].camera.fy_px) == ("icl-nuim", 4, 61.0)
    assert source.truth.stamps_ns.tolist() == [100_000_000, 200_000_000, 300_000_000]
    np.testing.assert_allclose(source.truth.T_world_body, POSES[1:], atol=1e-12)


def test_images_on_a_mirrored_axis_show_the_same_points(tmp_path):
    """What a pixel shows must lie where the published numbers put it, but for the mirrored y."""
    folder = icl_nuim(tmp_path)
    (folder / "calibration.toml").write_text(Y_UP)
    source = open_source(folder)
    frame = list(source.entries())[2].load()
    T_world_body = source.truth.T_world_body[1]
    row, column = 40, 11
    depth_m = float(frame.depth_m[row, column])
    published_camera = np.array(
        [(column - 31.5) * depth_m / 60.0, (row - 23.5) * depth_m / -61.0, depth_m, 1.0]
    )
    published_world = MIRROR_Y @ POSES[2] @ MIRROR_Y @ published_camera

    scan = frame.scan()
    index = int((frame.depth_m.ravel()[: row * 64 + column] > 0.0).sum())
    point_world = T_world_body @ [*scan.points_body[index], 1.0]

    np.testing.assert_allclose(point_world, MIRROR_Y @ published_world, atol=1e-5)


def test_a_list_of_numbers_alone_is_enough_but_the_camera_is_noted(tmp_path):
    folder = icl_nuim(tmp_path, truth="groundtruth.txt", width_px=640, height_px=480)
    (folder / "depth/3.png").unlink()
    source = open_source(folder)
    assert (source.kind, len(source), len(source.truth)) == ("icl-nuim", 3, 3)
    assert "associations.txt: 1 of 4 listed pairs do not exist; dropped" in source.notes
    assert any("camera assumed to be the camera of ICL-NUIM" in note for note in source.notes)
    assert any("source.rate_hz" in note for note in source.notes)
    assert source.are_units_assumed
    (folder / "groundtruth.txt").unlink()
    assert not any("mirrored" in note for note in open_source(folder).notes)


def test_associations_by_stamp_are_not_taken_for_frame_numbers(tiny_tum_log):
    log = tiny_tum_log(3)
    stamps = [path.stem for path in sorted((log / "rgb").iterdir())]
    lines = [f"{stamp} rgb/{stamp}.png {stamp} depth/{stamp}.png" for stamp in stamps]
    (log / "associations.txt").write_text("\n".join(lines) + "\n")
    assert open_source(log).kind == "tum"


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("livingRoom1.gt.freiburg", "1 2 3\n", r"freiburg:1: 3 columns, want 8: number tx ty tz qx qy qz qw"),
        ("livingRoom1.gt.freiburg", "1.5 0 0 0 0 0 0 1\n", r"freiburg:1: '1\.5' is no number of a frame"),
        ("associations.txt", "0 depth/0.png 0 rgb/0.png\n1 rgb/1.png\n", r"associations\.txt:2: 2 columns"),
        ("associations.txt", "0 depth/0.png 0 rgb/0.png\na d b c\n", r"associations\.txt:2: 'a' is no"),
        ("associations.txt", "7 depth/7.png 7 rgb/7.png\n", r"associations\.txt: none of its 1 pairs"),
        ("associations.txt", "# none\n", r"associations\.txt: empty list; want lines of number depth/number"),
        (
            "associations.txt",
            "0 depth/0.png 0 rgb/0.png\n1 ../depth/1.png 1 rgb/1.png\n",
            r"associations\.txt:2: '\.\./depth/1\.png' leads out of the log's folder",
        ),
    ],
)
def test_a_malformed_file_is_named_with_its_line(tmp_path, name, text, message):
    folder = icl_nuim(tmp_path)
    (folder / name).write_text(text)
    with pytest.raises(SourceError, match=message):
        open_source(folder)


def test_a_negative_fy_is_understood_in_any_format(tiny_tum_log):
    log = tiny_tum_log(3)
    upright = open_source(log)
    (log / "calibration.toml").write_text(Y_UP + "distortion = [0.1, 0.0, 0.02, 0.03, 0.0]\n")
    source = open_source(log)
    camera = source[0].camera
    assert (camera.fy_px, camera.distortion) == (61.0, (0.1, 0.0, -0.02, 0.03, 0.0))
    np.testing.assert_allclose(
        source.truth.T_world_body, MIRROR_Y @ upright.truth.T_world_body @ MIRROR_Y, atol=1e-12
    )


def test_tracking_has_the_error_of_the_same_frames_in_a_tum_folder(desk_log, tmp_path):
    """With a truth that is not mirrored the errors would not be equal: 9 mm are added to the ATE."""
    source = open_source(desk_log)
    icl, tum = tmp_path / "traj1_frei_png", tmp_path / "tum"
    lists = {"rgb": [], "depth": []}
    for folder in (icl, tum):
        (folder / "rgb").mkdir(parents=True)
        (folder / "depth").mkdir()
    numbers = range(1, len(source) + 1)
    for number, entry in zip(numbers, source.entries(), strict=True):
        for kind, path in (("rgb", entry.files.colour), ("depth", entry.files.depth)):
            for folder in (icl, tum):
                shutil.copy(path, folder / kind / f"{number}.png")
            lists[kind].append(f"{number / 30:.9f} {kind}/{number}.png\n")
    for kind, lines in lists.items():
        (tum / f"{kind}.txt").write_text("".join(lines))
    stamps_ns = np.round(np.array(numbers) * NS_PER_S / 30).astype(np.int64)
    truth = source.truth.T_world_body
    write_tum(tum / "groundtruth.txt", Trajectory(stamps_ns, truth))
    (icl / "traj1.gt.freiburg").write_text("\n".join(pose_lines(numbers, truth)) + "\n")
    (icl / "associations.txt").write_text("".join(f"{n} depth/{n}.png {n} rgb/{n}.png\n" for n in numbers))
    calibration = (desk_log / "calibration.toml").read_text()
    (tum / "calibration.toml").write_text(calibration)
    (icl / "calibration.toml").write_text(calibration.replace("fy_px = ", "fy_px = -"))

    metrics = {}
    for folder in (icl, tum):
        log = open_source(folder)
        found = track_log(log, load_config(None, ["loops.kind=none"]), progress=SILENT).trajectory()
        metrics[log.kind] = {m.name: m.value for m in evaluate(found, log.truth)}

    assert metrics["icl-nuim"] == pytest.approx(metrics["tum"], rel=1e-6, abs=1e-9)
    assert metrics["icl-nuim"]["ATE RMSE, SE(3)-aligned"] < 0.02
