"""The model is read by readers written from COLMAP's and nerfstudio's formats."""

import json

import cv2
import numpy as np
import pytest

from mapper.core.errors import RunError
from mapper.core.frames import NO_DISTORTION, PinholeCamera
from mapper.export.colmap import View, transforms_of, write_model
from mapper.export.exporters import export
from mapper.run.cloud import Cloud, read_cloud

CAMERA = PinholeCamera(64, 48, 60.0, 61.0, 31.5, 23.5, (0.1, -0.2, 0.001, 0.002, 0.05))


@pytest.fixture(scope="module")
def folder(desk_run, tmp_path_factory):
    return export(desk_run, "colmap", tmp_path_factory.mktemp("colmap") / "model")


def rows_of(path):
    return [line.split() for line in path.read_text().splitlines()]


def poses_of(path):
    """Return {name: T_camera_world} of ``images.txt``, whose every second line lists features."""
    lines = rows_of(path)
    assert not any(lines[1::2])
    found = {}
    for _, qw, qx, qy, qz, tx, ty, tz, _, name in lines[::2]:
        w, x, y, z = map(float, (qw, qx, qy, qz))
        T = np.eye(4)
        T[:3, :3] = [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
        T[:3, 3] = float(tx), float(ty), float(tz)
        found[name] = T
    return found


def test_the_folder_has_the_images_of_the_log_and_the_cloud(desk_run, desk_log, folder):
    stride = desk_run.config.cloud.frame_stride
    images = sorted((folder / "images").iterdir())
    assert len(images) == len(desk_run.tracked_trajectory.stamps_ns[::stride])
    logged = {path.read_bytes() for path in (desk_log / "rgb").iterdir()}
    assert all(image.read_bytes() in logged for image in images)
    np.testing.assert_array_equal(read_cloud(folder / "points.ply").points, desk_run.cloud.points)
    points = np.array(rows_of(folder / "sparse" / "0" / "points3D.txt"), np.float32)
    np.testing.assert_array_equal(points[:, 0], np.arange(1, len(points) + 1))
    np.testing.assert_array_equal(points[:, 1:4], desk_run.cloud.points)
    np.testing.assert_array_equal(points[:, 4:7], desk_run.cloud.colors)


def test_poses_are_those_of_the_run_in_both_files(desk_run, folder):
    poses = poses_of(folder / "sparse" / "0" / "images.txt")
    frames = json.loads((folder / "transforms.json").read_text())["frames"]
    assert [frame["file_path"] for frame in frames] == [f"images/{name}" for name in poses]
    T_world_body = desk_run.tracked_trajectory.T_world_body[:: desk_run.config.cloud.frame_stride]
    for frame, T_camera_world, T in zip(frames, poses.values(), T_world_body, strict=True):
        np.testing.assert_allclose(np.linalg.inv(T_camera_world), T, atol=1e-9)
        from_opengl = np.diag([1.0, -1.0, -1.0, 1.0])
        np.testing.assert_allclose(frame["transform_matrix"] @ from_opengl, T, atol=1e-12)


def test_points_project_to_their_colours(folder):
    """Half a pixel or a mirrored axis would show."""
    ((_, model, width, height, *numbers),) = rows_of(folder / "sparse" / "0" / "cameras.txt")
    assert model == "PINHOLE"
    fx, fy, cx, cy = map(float, numbers)
    points = np.array(rows_of(folder / "sparse" / "0" / "points3D.txt"), float)
    for name, T in poses_of(folder / "sparse" / "0" / "images.txt").items():
        image = cv2.imread(str(folder / "images" / name))[:, :, ::-1]
        assert image.shape[:2] == (int(height), int(width))
        x, y, z = T[:3, :3] @ points[:, 1:4].T + T[:3, 3:]
        seen = z > 0.3
        column, row = np.floor([fx * x[seen] / z[seen] + cx, fy * y[seen] / z[seen] + cy]).astype(int)
        inside = (column >= 0) & (column < image.shape[1]) & (row >= 0) & (row < image.shape[0])
        differences = image[row[inside], column[inside]].astype(float) - points[seen][inside, 4:7]
        assert inside.sum() > 1000
        assert np.median(np.abs(differences)) < 20


def test_cameras_with_and_without_distortion(tmp_path):
    plain = PinholeCamera(64, 48, 60.0, 61.0, 31.5, 23.5)
    assert plain.distortion == NO_DISTORTION
    views = [
        View("a.png", CAMERA, np.eye(4)),
        View("b.png", plain, np.eye(4)),
        View("c.png", CAMERA, np.eye(4)),
    ]
    write_model(tmp_path, views, Cloud(np.empty((0, 3), np.float32), np.empty((0, 3), np.uint8)))

    intrinsics = "64 48 60.0 61.0 32.0 24.0"
    assert (tmp_path / "cameras.txt").read_text().splitlines() == [
        f"1 FULL_OPENCV {intrinsics} 0.1 -0.2 0.001 0.002 0.05 0.0 0.0 0.0",
        f"2 PINHOLE {intrinsics}",
    ]
    assert [row[8] for row in rows_of(tmp_path / "images.txt")[::2]] == ["1", "2", "1"]
    own = [frame["k1"] for frame in transforms_of(views)["frames"]]
    assert own == [0.1, 0.0, 0.1]
    shared = transforms_of(views[::2])
    assert (shared["k3"], shared["cx"], shared["w"]) == (0.05, 32.0, 64)
    assert "k3" not in shared["frames"][0]


def test_a_map_of_scans_has_no_images(desk_run, tmp_path, monkeypatch):
    class Scans:
        path, sensor = tmp_path / "scans", "lidar"

    monkeypatch.setattr(type(desk_run), "open_log", lambda _: Scans)
    with pytest.raises(RunError, match="this log has scans"):
        export(desk_run, "colmap", tmp_path / "model")
    assert not (tmp_path / "model").exists()
