import numpy as np
import pytest

from mapper.core.errors import SourceError
from mapper.core.frames import PinholeCamera
from mapper.core.geometry import transform
from mapper.sources.calibration import FREIBURG, Calibration, freiburg_camera
from mapper.sources.calibration_file import calibration_text, read_calibration

ROS = """
image_width: 640
image_height: 480
camera_name: kinect
camera_matrix:
  rows: 3
  cols: 3
  data: [517.3, 0, 318.6, 0, 516.5,
         255.3, 0, 0, 1]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [0.26, -0.95, -0.005, 0.0026, 1.16]
"""
ROS_ECHO = """height: 480
width: 640
distortion_model: plumb_bob
d:
- 0.26
- -0.95
- -0.005
- 0.0026
- 1.16
k:
- 517.3
- 0.0
- 318.6
- 0.0
- 516.5
- 255.3
- 0.0
- 0.0
- 1.0
"""
OPENCV = """%YAML:1.0
---
image_width: 640
image_height: 480
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 517.3, 0., 318.6, 0., 516.5, 255.3, 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 1
   cols: 5
   dt: d
   data: [ 0.26, -0.95, -0.005, 0.0026, 1.16 ]
"""
ORB_SLAM = """%YAML:1.0
# Camera calibration
Camera.fx: 517.3  # px
Camera.fy: 516.5
Camera.cx: 318.6
Camera.cy: 255.3
Camera.k1: 0.26
Camera.k2: -0.95
Camera.p1: -0.005
Camera.p2: 0.0026
Camera.k3: 1.16
Camera.width: 640
Camera.height: 480
"""
OURS = """
[camera]
width_px = 640
height_px = 480
fx_px = 517.3
fy_px = 516.5
cx_px = 318.6
cy_px = 255.3
distortion = [0.26, -0.95, -0.005, 0.0026, 1.16]
"""
WANT = PinholeCamera(640, 480, 517.3, 516.5, 318.6, 255.3, (0.26, -0.95, -0.005, 0.0026, 1.16))


@pytest.mark.parametrize(
    ("name", "text"),
    [("a.yaml", ROS), ("b.yaml", ROS_ECHO), ("c.yml", OPENCV), ("d.yaml", ORB_SLAM), ("e.toml", OURS)],
)
def test_every_dialect_gives_the_same_camera(tmp_path, name, text):
    path = tmp_path / name
    path.write_text(text)
    calibration = read_calibration(path)
    assert calibration.camera(width_px=640, height_px=480) == WANT
    why = r"holds for 640×480 px, but the images have 320×240.* if they are resized, .*fx_px=\d"
    with pytest.raises(SourceError, match=why):
        calibration.camera(width_px=320, height_px=240)
    assert calibration.depth_units_per_m is None


def test_what_is_written_reads_back_exactly(tmp_path):
    camera = PinholeCamera(321, 243, 1 / 3, 2.0 / 7, 100 / 3, 1e2 / 7 + 60, (0.1, 0.2, 0.3, 0.4, 0.5))
    path = tmp_path / "calibration.toml"
    path.write_text(calibration_text(camera, depth_units_per_m=999.7))
    calibration = read_calibration(path)
    assert calibration.camera(width_px=321, height_px=243) == camera
    assert calibration.depth_units_per_m == 999.7


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.toml", "fx_px = 5.0\nfy_px = 5.0\ncx_px = 1.0\n", "no number cy_px"),
        ("a.toml", "fx_px = 'five'\n", "fx_px = 'five' is not a number"),
        ("a.toml", OURS + "depht_factor = 5000\n", "depht_factor: unknown key; known are"),
        ("a.toml", OURS + "depth_factor = 0\n", r"depth_factor 0, want 0\.001 to 1e\+07 units"),
        ("a.toml", OURS.replace("1.16]", "1.16, 0.0, 3.0]"), "7 distortion coefficients"),
        ("a.yaml", ROS.replace("plumb_bob", "equidistant"), "5 distortion coefficients; want .*4 of"),
        ("a.yaml", "name: kinect\n", "no number fx_px"),
        ("a.toml", OURS.replace("width_px = 640", "width_px = 1e400"), "width: inf is not finite"),
        ("a.toml", OURS.replace("= 517.3", "= 1" + 400 * "0"), "int too large to convert to float"),
        ("a.toml", OURS.replace("= 517.3", "= " + 5000 * "1"), "not valid TOML: Exceeds the limit"),
        ("a.toml", "x = " + 100_000 * "[", "not valid TOML: maximum recursion depth"),
        ("a.toml", ".".join("x" * 9000) + " = 1", "not valid TOML: a key of 9000 parts"),
        ("a.yaml", ROS.replace("640", "nan"), "width: nan is not finite"),
        ("a.yaml", ROS + "range: inf\nfar: [1.0, nan]\nfx: .inf\nfx_px: nan\n", "fx: nan is not finite"),
    ],
)
def test_a_bad_file_is_named_with_the_reason(tmp_path, name, text, message):
    path = tmp_path / name
    path.write_text(text)
    with pytest.raises(SourceError, match=rf"{name}: {message}"):
        read_calibration(path)


@pytest.mark.parametrize(
    ("numbers", "why"),
    [
        ((517.3, 318.6, 516.5, 255.3), "fy and cx have changed places"),
        ((517.3, 250.0, 318.6, 255.3), "the focal lengths cannot be right"),
        ((517.3, 516.5, 639.0, 255.3), "the principal point cannot be right"),
        ((517.3, 516.5, 318.6, 4.0), "the principal point cannot be right"),
        ((517.3, 516.5, 241.0, 322.0), "cx and cy have changed places"),
    ],
)
def test_numbers_that_no_camera_has_are_refused(numbers, why):
    with pytest.raises(SourceError, match=why):
        Calibration("K.txt", *numbers).camera(width_px=640, height_px=480)
    cropped_and_not_square = (540.0, 630.0, 110.0, 400.0)
    camera = Calibration("K.txt", *cropped_and_not_square).camera(width_px=640, height_px=480)
    assert tuple(camera.intrinsics) == cropped_and_not_square


@pytest.mark.parametrize("number", ["-1e308", "1e100", "50.0"])
def test_a_distortion_without_an_inverse_is_refused(tmp_path, number):
    path = tmp_path / "calibration.toml"
    path.write_text(OURS.replace("[0.26, -0.95, -0.005, 0.0026, 1.16]", f"[0.0, 0.0, 0.0, {number}, 0.0]"))
    calibration = read_calibration(path)
    with pytest.raises(SourceError, match=r"calibration\.toml: distortion 0, 0, 0, .*, 0 cannot"):
        calibration.camera(width_px=640, height_px=480)


@pytest.mark.parametrize(
    ("name", "camera"),
    [
        ("rgbd_dataset_freiburg1_xyz", "1"),
        ("rgbd_dataset_Freiburg2_desk.bag", "2"),
        ("fr3_office", "3"),
        ("tum_fr1_xyz", "1"),
        *((name, None) for name in ("desk", "fr4_desk", "freiburg12", "afr1_x", "frame1")),
    ],
)
def test_freiburg_cameras_are_known_by_name(name, camera):
    assert freiburg_camera("something", name) is FREIBURG.get(camera)


def test_a_depth_camera_beside_colour_s_is_read(tmp_path):
    path = tmp_path / "calibration.toml"
    own = "fx_px = 517.3\nfy_px = 516.5\ncx_px = 318.6\ncy_px = 255.3\n"
    lens, pose = (
        "depth_intrinsics_px = [425.0, 426.0, 423.7, 238.9]\n",
        "depth_in_color = [0.015, 0, 0, 0, 0, 0, 2]\n",
    )
    path.write_text(own + lens + pose + "depth_distortion = [0.1, 0, 0, 0, 0.2]\n")
    depth = read_calibration(path).depth
    numbers = (
        depth.calibration.fx_px,
        depth.calibration.fy_px,
        depth.calibration.cx_px,
        depth.calibration.cy_px,
    )
    assert numbers == (425.0, 426.0, 423.7, 238.9)
    assert depth.calibration.distortion == (0.1, 0.0, 0.0, 0.0, 0.2)
    np.testing.assert_allclose(depth.T_color_depth, transform(np.eye(3), [0.015, 0.0, 0.0]))
    path.write_text(own)
    assert read_calibration(path).depth is None
    path.write_text(own + lens)
    assert read_calibration(path).needs_depth_pose
    for wrong in (
        pose,
        lens + "depth_in_color = [0, 0, 0, 0, 0, 0, 0]\n",
        "depth_distortion = [0, 0, 0, 0, 0]\n",
    ):
        path.write_text(own + wrong)
        with pytest.raises(SourceError, match="want depth_intrinsics_px"):
            read_calibration(path)
