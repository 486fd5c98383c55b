"""Intrinsics in the files that other programs and data sets put beside their images."""

import pytest

from mapper.core.errors import SourceError
from mapper.sources import open_source
from mapper.sources.calibration_file import calibration_file, read_calibration
from tests.support.tum_logs import write_picture

MATRIX = "60.0 0.0 31.5\n0.0 61.0 23.5\n0.0 0.0 1.0\n"
OPEN3D = '{"width": 64, "height": 48, "intrinsic_matrix": [60.0, 0, 0, 0, 61.0, 0, 31.5, 23.5, 1]}'
KALIBR = """cam0:
  cam_overlaps: []
  camera_model: pinhole
  distortion_coeffs: [0.1, -0.2, 0.001, 0.002]
  distortion_model: radtan
  intrinsics: [60.0, 61.0, 31.5, 23.5]
  resolution: [64, 48]
"""
INFO = """m_sensorName = StructureSensor
m_colorWidth = 64
m_colorHeight = 48
m_depthShift = 1000
m_calibrationColorIntrinsic = 60.0 0 31.5 0 0 61.0 23.5 0 0 0 1 0 0 0 0 1
"""
REPLICA = '{"camera": {"w": 64, "h": 48, "fx": 60, "fy": 61, "cx": 31.5, "cy": 23.5, "scale": 6553.5}}'
TWO_CAMERAS = KALIBR + KALIBR.replace("cam0", "cam1").replace("31.5", "33.0")
NERFSTUDIO = '{"fl_x": 60.0, "fl_y": 61, "cx": 31.5, "cy": 23.5, "w": 64, "h": 48, "aabb_scale": 16}'
OPENLORIS = """%YAML:1.0
d400_color_optical_frame:
   fps: 30
   height: 48
   width: 64
   intrinsics: !!opencv-matrix
     cols: 4
     dt: d
     rows: 1
     data: [ 6.0e+01, 3.15e+01, 6.1e+01, 2.35e+01 ] # fx cx fy cy

t265_fisheye1_optical_frame:
   height: 800
   width: 848
   intrinsics: !!opencv-matrix
     cols: 4
     dt: d
     rows: 1
     data: [ 2.8e+02, 4.1e+02, 2.8e+02, 4.0e+02 ]
"""
FILES = [
    ("camera_intrinsic.json", OPEN3D),
    ("intrinsic.json", OPEN3D),
    ("cam_params.json", REPLICA),
    ("tuesday-camchain.yaml", KALIBR),
    ("camera-intrinsics.txt", MATRIX),
    ("K.txt", MATRIX.replace(" ", ", ")),
    ("calibration.txt", "# fx fy cx cy\n60 61 31.5 23.5\n"),
    ("intrinsics.txt", "60 61 31.5 23.5 0 0 0 0 0"),
    ("intrinsic/intrinsic_color.txt", "60 0 31.5 0\n0 61 23.5 0\n0 0 1 0\n0 0 0 1\n"),
    ("info.txt", INFO),
    ("sensors.yaml", OPENLORIS),
    ("intrinsics.txt", "60 31.5 61 23.5"),
    ("intrinsics.K.txt", MATRIX),
    ("cam.info.txt", "width = 64\nheight = 48\nfx = 60\nfy = 61\ncx = 31.5\ncy = 23.5\n"),
    ("cam.info.txt", "K: [60.0, 0.0, 31.5, 0.0, 61.0, 23.5, 0.0, 0.0, 1.0]\n"),
    ("transforms.json", NERFSTUDIO),
    ("transforms.json", '{"camera_model": "OPENCV", "frames": [' + NERFSTUDIO + "]}"),
    (
        "metadata.json",
        '{"w": 64, "h": 48, "fps": 60, "K": [60.0, 0, 0, 0, 61.0, 0, 31.5, 23.5, 1], "poses": []}',
    ),
]


@pytest.mark.parametrize(("name", "text"), FILES)
def test_intrinsics_beside_numbered_images_are_not_assumed(tmp_path, name, text):
    for i in range(3):
        write_picture(tmp_path / "color" / f"{i:06d}.jpg", tmp_path / "depth" / f"{i:06d}.png", i)
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).write_text(text)
    log = open_source(tmp_path)
    camera = log.entry_at(0).load().camera
    assert (camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px) == (60.0, 61.0, 31.5, 23.5)
    assert camera.distortion[:2] == ((0.1, -0.2) if "camchain" in name else (0.0, 0.0))
    assert log.entry_at(0).files.depth_units_per_m == (6553.5 if name == "cam_params.json" else 1000.0)
    assert not any("assumed to be" in note for note in log.notes)


def test_intrinsics_beside_the_only_sequence_of_a_folder_are_found(tmp_path):
    for i in range(3):
        stem = tmp_path / "seq-01" / f"frame-{i:06d}"
        write_picture(stem.with_suffix(".color.png"), stem.with_suffix(".depth.png"), i)
    (tmp_path / "camera-intrinsics.txt").write_text(MATRIX)
    assert open_source(tmp_path).entry_at(0).load().camera.fx_px == 60.0


@pytest.mark.parametrize("text", [b"recorded on a Tuesday\n", b"am Dienstag, den 3. M\xe4rz\n"])
def test_notes_on_something_else_are_no_calibration(tmp_path, text):
    (tmp_path / "info.txt").write_bytes(text)
    assert calibration_file(tmp_path) is None


@pytest.mark.parametrize(
    ("name", "text", "why"),
    [
        ("camchain.yaml", TWO_CAMERAS, "intrinsics is there twice; keep the colour camera's alone"),
        ("camera.yaml", "Camera1.fx: 60.0\nCamera2.fx: 61.0\n", "fx is there twice"),
        ("camchain.yaml", KALIBR.replace("pinhole", "omni"), "omni lens; only Brown–Conrady"),
        ("K.txt", "60 0 31.5\n0 61 23.5\n", "want a 3×3 matrix, or a line of fx fy cx cy"),
        ("K.txt", "sixty", "K.txt: not valid TXT: could not convert string to float: 'sixty'"),
        ("intrinsic.json", "[1]", "no table of numbers"),
        ("intrinsic.json", "{", "not valid JSON"),
        ("info.txt", "m_calibrationColorIntrinsic: 1", "no number fx_px"),
        ("transforms.json", '{"fl_x": 60, "is_fisheye": true}', "fisheye lens"),
        ("transforms.json", '{"fl_x": 60, "camera_model": "OPENCV_FISHEYE"}', "fisheye lens"),
    ],
)
def test_what_is_none_or_of_two_cameras_is_refused_in_words(tmp_path, name, text, why):
    (tmp_path / name).write_text(text)
    with pytest.raises(SourceError, match=why):
        read_calibration(tmp_path / name)


def test_a_file_of_another_name_is_mentioned_where_intrinsics_are_unknown(tiny_tum_log):
    folder = tiny_tum_log()
    (folder / "calibration.toml").unlink()
    (folder / "TUM1.yaml").write_text("Camera.fx: 60.0\n")
    with pytest.raises(SourceError, match=r"unknown; .*; if TUM1.yaml has them, call it camera.yaml"):
        open_source(folder)
