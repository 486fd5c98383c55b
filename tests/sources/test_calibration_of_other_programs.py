"""Intrinsics in the files that other programs and data sets put beside their images."""

from contextlib import nullcontext

import cv2
import numpy as np
import pytest

from mapper.core.errors import SourceError
from mapper.sources import open_source
from mapper.sources.calibration_file import calibration_files, read_calibration
from mapper.sources.config import SourceConfig
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
FISHEYE_MODEL, FLAG = '"camera_model": "OPENCV_FISHEYE"', '"is_fisheye": true'
FISHEYE_OF_NERFSTUDIO = f'{{"k1": 0.1, "k2": -0.2, "k3": 0.001, "k4": 0.002, {FISHEYE_MODEL}, '
ORB_SLAM3 = """%YAML:1.0
Camera.type: "KannalaBrandt8"  # as a T265 has it, not radtan
Camera1.fx: 60.0
Camera1.fy: 61.0
Camera1.cx: 31.5
Camera1.cy: 23.5
Camera1.k1: 0.1
Camera1.k2: -0.2
Camera1.k3: 0.001
Camera1.k4: 0.002
Camera.width: 64
Camera.height: 48
"""
TOML = "fx_px = 60.0\nfy_px = 61.0\ncx_px = 31.5\ncy_px = 23.5\n"
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
    ("K.txt", "[60, 0, 31.5; 0, 61, 23.5; 0, 0, 1]"),
    ("intrinsics.txt", "[[60. 0. 31.5]\n [0. 61. 23.5]\n [0. 0. 1.]]\n"),
    (
        "intrinsics.json",
        '{"depth_scale": 0.001, "depth": {"fx": 40, "fy": 40, "ppx": 32, "ppy": 24}, '
        '"color": {"width": 64, "height": 48, "fx": 60, "fy": 61, "ppx": 31.5, "ppy": 23.5, "coeffs": [0]}}',
    ),
    ("calibration.txt", "# fx fy cx cy\n60 61 31.5 23.5\n"),
    ("intrinsics.txt", "60 61 31.5 23.5 0 0 0 0 0"),
    ("intrinsic/intrinsic_color.txt", "60 0 31.5 0\n0 61 23.5 0\n0 0 1 0\n0 0 0 1\n"),
    ("info.txt", INFO),
    ("sensors.yaml", OPENLORIS),
    ("calib/000.yaml", KALIBR.replace("[0.1, -0.2, 0.001, 0.002]", "[0.0, 0.0, 0.0, 0.0]")),
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


def numbers_of(path):
    found = read_calibration(path)
    return (found.fx_px, found.fy_px, found.cx_px, found.cy_px, *found.distortion)


K = np.array([[60.0, 0.0, 31.5], [0.0, 61.0, 23.5], [0.0, 0.0, 1.0]])
D = [0.1, -0.2, 0.001, 0.002, 0.3]


@pytest.mark.parametrize("name", ["left.xml", "left.yml", "left.json"])
@pytest.mark.parametrize("key", ["camera_matrix", "cameraMatrix", "intrinsic_matrix", "K"])
def test_intrinsics_as_opencv_stores_them(tmp_path, name, key):
    path = tmp_path / name
    storage = cv2.FileStorage(str(path), cv2.FileStorage_WRITE)
    storage.write("image_width", 64)
    storage.write(key, K)
    storage.write({"cameraMatrix": "distCoeffs"}.get(key, "distortion_coefficients"), np.array([D]))
    storage.write("avg_reprojection_error", 0.3)
    storage.release()
    assert numbers_of(path) == (60.0, 61.0, 31.5, 23.5, *D)
    if key.startswith("camera"):
        assert calibration_files(tmp_path) == ([path], True)


@pytest.mark.parametrize(
    ("name", "arrays", "is_bent"),
    [
        ("K.npy", K, False),
        ("camera_matrix.npy", np.pad(K, ((0, 1), (0, 1))).astype(np.float32), False),
        ("intrinsics.npy", np.array([60.0, 61.0, 31.5, 23.5]), False),
        ("intrinsics.npy", np.array([[60.0, 61.0, 31.5, 23.5, *D]]), True),
        ("calibration.npz", {"mtx": K, "dist": np.array([D]), "rvecs": np.zeros((20, 3, 1))}, True),
        ("camera_params.npz", {"K": K, "D": np.array(D), "size": np.array([64, 48])}, True),
    ],
)
def test_intrinsics_in_arrays(tmp_path, name, arrays, is_bent):
    path = tmp_path / name
    (lambda: np.savez(path, **arrays) if isinstance(arrays, dict) else np.save(path, arrays))()
    assert calibration_files(tmp_path) == ([path], True)
    assert numbers_of(path) == pytest.approx((60.0, 61.0, 31.5, 23.5, *(D if is_bent else [0.0] * 5)))


COLMAP_HEAD = (
    "# Camera list with one line of data per camera:\n#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n"
)


@pytest.mark.parametrize(
    ("camera", "fy", "coefficients"),
    [
        ("SIMPLE_PINHOLE 64 48 60 32 24", 60.0, []),
        ("PINHOLE 64 48 60 61 32 24", 61.0, []),
        ("SIMPLE_RADIAL 64 48 60 32 24 0.1", 60.0, [0.1]),
        ("RADIAL 64 48 60 32 24 0.1 -0.2", 60.0, [0.1, -0.2]),
        ("OPENCV 64 48 60 61 32 24 0.1 -0.2 0.001 0.002", 61.0, D[:4]),
    ],
)
@pytest.mark.parametrize("place", [".", "sparse/0"])
def test_the_first_pixel_of_colmap_s_camera_is_half_a_pixel_from_its_corner(
    tmp_path, camera, fy, coefficients, place
):
    path = tmp_path / place / "cameras.txt"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f"{COLMAP_HEAD}# Number of cameras: 1\n1 {camera}\n")
    assert calibration_files(tmp_path) == ([path], True)
    assert numbers_of(path) == (60.0, fy, 31.5, 23.5, *coefficients, *[0.0] * (5 - len(coefficients)))
    assert read_calibration(path).size_px == (64, 48)


def test_lenses_of_colmap(tmp_path):
    path = tmp_path / "cameras.txt"
    path.write_text(f"{COLMAP_HEAD}1 OPENCV_FISHEYE 64 48 60 61 32 24 0.1 -0.2 0.001 0.002\n")
    assert read_calibration(path).lens.is_fisheye
    path.write_text(f"{COLMAP_HEAD}1 FULL_OPENCV 64 48 60 61 32 24 {' '.join(map(str, D))} 0.1 0.2 0.3\n")
    assert read_calibration(path).lens.coefficients == [*D, 0.1, 0.2, 0.3]
    for cameras, why in (
        ("1 FOV 64 48 60 61 32 24 0.1\n", "FOV with 5 parameters; known are"),
        ("1 PINHOLE 64 48 60 61 32 24\n2 PINHOLE 64 48 60 61 33 24\n", "2 different cameras"),
    ):
        path.write_text(COLMAP_HEAD + cameras)
        with pytest.raises(SourceError, match=why):
            read_calibration(path)


def test_text_of_windows_is_read_by_its_mark(tmp_path):
    for encoding in ("utf-16", "utf-8-sig"):
        (tmp_path / "K.txt").write_text(MATRIX, encoding=encoding)
        assert read_calibration(tmp_path / "K.txt").fx_px == 60.0
    (tmp_path / "camera.toml").write_bytes(TOML.encode("utf-16-be"))
    with pytest.raises(SourceError, match=r"camera\.toml"):
        read_calibration(tmp_path / "camera.toml")


@pytest.mark.parametrize("name", ["K.npy", "calibration.npz"])
@pytest.mark.parametrize("data", [b"", b"PK\x03\x04 cut", b"\x93NUMPY\x01\x00\x10\x00{'descr': "])
def test_damaged_arrays_of_intrinsics_are_refused_in_words(tmp_path, name, data):
    (tmp_path / name).write_bytes(data)
    with pytest.raises(SourceError, match=name):
        read_calibration(tmp_path / name)


def test_intrinsics_beside_the_only_sequence_of_a_folder_are_found(tmp_path):
    for i in range(3):
        stem = tmp_path / "seq-01" / f"frame-{i:06d}"
        write_picture(stem.with_suffix(".color.png"), stem.with_suffix(".depth.png"), i)
    (tmp_path / "camera-intrinsics.txt").write_text(MATRIX)
    assert open_source(tmp_path).entry_at(0).load().camera.fx_px == 60.0


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("camchain.yaml", KALIBR.replace("radtan", "equidistant")),
        ("camera.yaml", ORB_SLAM3),
        ("transforms.json", NERFSTUDIO.replace("{", FISHEYE_OF_NERFSTUDIO, 1)),
        ("transforms.json", NERFSTUDIO.replace("{", FISHEYE_OF_NERFSTUDIO.replace(FISHEYE_MODEL, FLAG), 1)),
        (
            "calibration.toml",
            TOML + 'distortion_model = "equidistant"\ndistortion = [0.1, -0.2, 0.001, 0.002]\n',
        ),
    ],
)
def test_a_fisheye_s_four_coefficients_are_taken_out_of_the_images(tmp_path, name, text):
    (tmp_path / name).write_text(text)
    calibration = read_calibration(tmp_path / name)
    assert calibration.lens.is_fisheye
    assert list(calibration.lens.coefficients) == [0.1, -0.2, 0.001, 0.002]
    assert not any(calibration.distortion)
    for i in range(2):
        write_picture(tmp_path / "color" / f"{i:06d}.png", tmp_path / "depth" / f"{i:06d}.png", i)
    log = open_source(tmp_path)
    frame, recorded = log[0], cv2.imread(str(tmp_path / "color/000000.png"))[:, :, ::-1]
    columns, rows = calibration.lens.maps(frame.camera)
    assert log.entry_at(0).files is None
    np.testing.assert_array_equal(frame.image, cv2.remap(recorded, columns, rows, cv2.INTER_LINEAR))
    assert sum("equidistant is taken out" in note for note in log.notes) == 1


def test_eight_coefficients_are_a_rational_lens(tmp_path):
    azure = [0.52, -2.6, 0.0006, -0.0002, 1.5, 0.4, -2.42, 1.43]
    path = tmp_path / "calibration.toml"
    path.write_text(f"{TOML}distortion = {azure}\n")
    lens = read_calibration(path).lens
    assert not lens.is_fisheye
    assert lens.coefficients == azure
    depth = "depth_intrinsics_px = [60, 60, 31, 23]\ndepth_in_color = [0, 0, 0, 0, 0, 0, 1]\n"
    path.write_text(f"{TOML}{depth}depth_distortion = {azure}\n")
    calibration = read_calibration(path)
    assert (calibration.lens, calibration.depth.calibration.lens.coefficients) == (None, azure)


def test_notes_on_something_else_are_no_calibration_and_intrinsics_that_are_not_read_are_named(
    tiny_tum_log, tmp_path
):
    for text in (b"recorded on a Tuesday\n", b"am Dienstag, den 3. M\xe4rz\n"):
        (tmp_path / "info.txt").write_bytes(text)
        assert calibration_files(tmp_path) == ([], False)
    folder = tiny_tum_log()
    assert not any("camera_info.yaml" in note for note in open_source(folder).notes)
    (folder / "camera_info.yaml").write_text("camera_matrix:\n  data: [90, 0, 31.5, 0, 90, 23.5, 0, 0, 1]\n")
    log = open_source(folder)
    assert sum("camera_info.yaml" in note for note in log.notes) == 1
    assert next(iter(log)).camera.fx_px == 60.0


@pytest.mark.parametrize(
    ("name", "text", "why"),
    [
        ("camchain.yaml", TWO_CAMERAS, "intrinsics is there twice; keep the colour camera's alone"),
        ("camera.yaml", "Camera1.fx: 60.0\nCamera2.fx: 61.0\n", "fx is there twice"),
        ("camchain.yaml", KALIBR.replace("pinhole", "omni"), "omni lens; known are"),
        ("K.txt", "60 0 31.5\n0 61 23.5\n", "want a 3×3 matrix, or a line of fx fy cx cy"),
        ("K.txt", "sixty", "K.txt: not valid TXT: could not convert string to float: 'sixty'"),
        ("intrinsic.json", "[1]", "no table of numbers"),
        ("intrinsic.json", "{", "not valid JSON"),
        ("info.txt", "m_calibrationColorIntrinsic: 1", "no number fx_px"),
        (
            "camchain.yaml",
            KALIBR.replace("radtan", "fov").replace(", 0.001, 0.002", ""),
            "fov lens; known are",
        ),
        ("camchain.yaml", KALIBR + "  other: equidistant\n", "lenses of two models, radtan and equidistant"),
        ("transforms.json", NERFSTUDIO.replace("{", '{"camera_model": "FOV", ', 1), "FOV lens; known are"),
    ],
)
def test_what_is_none_or_of_two_cameras_is_refused_in_words(tmp_path, name, text, why):
    (tmp_path / name).write_text(text)
    with pytest.raises(SourceError, match=why):
        read_calibration(tmp_path / name)


def test_a_file_of_another_name_is_read_if_it_alone_has_intrinsics(tiny_tum_log):
    folder = tiny_tum_log()
    (folder / "calibration.toml").unlink()
    (folder / "settings.yaml").write_text("voxel_size: 0.1\nk: 5\n")
    with pytest.raises(SourceError, match="intrinsics unknown"):
        open_source(folder)
    (folder / "TUM1.yaml").write_text(ORB_SLAM3.split("Camera1.k1")[0].replace("KannalaBrandt8", "PinHole"))
    assert next(iter(open_source(folder))).camera.fx_px == 60.0
    (folder / "TUM2.yaml").write_text("Camera.fx: 61.0\n")
    with pytest.raises(SourceError, match="intrinsics unknown"):
        open_source(folder)


@pytest.mark.parametrize(
    ("name", "text", "is_read"),
    [
        ("calib.txt", "60, 60 32 24", True),
        ("my_camera.txt", "60 0 32\n0 60 24\n0 0 1\n", True),
        ("rgb_intrinsics_left.txt", "fx: 60\nfy: 60\ncx: 32\ncy: 24\n", True),
        ("cam_pose.txt", "1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n", False),
        ("notes.txt", "60 60 32 24", False),
        ("calib.txt", "P0: 718 0 607 0 0 718 185 0 0 0 1 0\n", False),
    ],
)
def test_text_that_is_called_calibration_is_read_by_its_numbers(tiny_tum_log, name, text, is_read):
    folder = tiny_tum_log()
    (folder / "calibration.toml").unlink()
    (folder / name).write_text(text)
    with nullcontext() if is_read else pytest.raises(SourceError, match="intrinsics unknown"):
        assert next(iter(open_source(folder))).camera.fx_px == 60.0


@pytest.mark.parametrize("scale", [0.0002, 5000])
def test_intrinsics_as_librealsense_prints_them(tmp_path, scale):
    path = tmp_path / "intrinsics.json"
    text = f"""{{"width": 64, "height": 48, "fx": 60.0, "fy": 61.0, "ppx": 31.5, "ppy": 23.5,
        "depth_scale": {scale}, "model": "Inverse Brown Conrady", "coeffs": [0, 0, 0, 0, 0]}}"""
    path.write_text(text)
    assert read_calibration(path).depth_units_per_m == pytest.approx(5000.0)
    assert (read_calibration(path).cx_px, read_calibration(path).cy_px) == (31.5, 23.5)
    path.write_text(text.replace("[0, 0", "[0.1, 0"))
    with pytest.raises(SourceError, match="Inverse Brown Conrady lens"):
        read_calibration(path)


def test_two_files_of_unknown_names_are_named_and_one_can_be_chosen(tmp_path):
    for i in range(2):
        write_picture(tmp_path / "color" / f"{i:06d}.png", tmp_path / "depth" / f"{i:06d}.png", i)
    (tmp_path / "mine.yaml").write_text(KALIBR)
    (tmp_path / "yours.yaml").write_text(KALIBR.replace("31.5", "33.0"))
    with pytest.raises(SourceError, match=r"mine\.yaml, yours\.yaml .* camera\.yaml .*source\.camera\.fx_px"):
        open_source(tmp_path)
    numbers = {"fx_px": 60.0, "fy_px": 61.0, "cx_px": 31.5, "cy_px": 23.5}
    chosen = open_source(tmp_path, SourceConfig.model_validate({"camera": numbers}))
    assert chosen[0].camera.cx_px == 31.5
    assert [note for note in chosen.notes if "not from mine.yaml, yours.yaml" in note]
    (tmp_path / "yours.yaml").rename(tmp_path / "camera.yaml")
    assert open_source(tmp_path)[0].camera.cx_px == 33.0
