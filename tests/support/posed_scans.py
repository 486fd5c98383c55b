"""Exports of phones' apps and published scans, written after the formats' own descriptions.

Stray Scanner: github.com/strayrobots/scanner, docs/format.md. Record3D: its .r3d archives. Polycam: raw data
(polyform). nerfstudio: data conventions. Replica: as NICE-SLAM's download. ScanNet: SensReader. OpenLORIS:
its folders of one sequence.
"""

import json
import struct
import zipfile
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import lzfse
import numpy as np

from mapper.core.frames import PinholeCamera, RgbdFrame
from mapper.core.rotations import row_of_pose

OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


@dataclass(frozen=True)
class Shot:
    """Frame of a scan: colour, depth in millimetres as a phone stores it, confidence 0, 1 or 2, and pose."""

    stamp_s: float
    rgb: np.ndarray
    depth_mm: np.ndarray
    confidence: np.ndarray
    T_world_camera: np.ndarray


@dataclass(frozen=True)
class Shots:
    """A scan, with its camera at the size of the colour images."""

    camera: PinholeCamera
    frames: Sequence[Shot]

    @property
    def K(self) -> np.ndarray:  # noqa: N802
        return self.camera.matrix


def shots_of(frames: Sequence[RgbdFrame], poses: np.ndarray) -> Shots:
    """Take depth at half the colour's size; its upper rows are of low confidence, and wrong."""
    taken = []
    for i, (frame, T) in enumerate(zip(frames, poses, strict=True)):
        height, width = frame.depth_m.shape
        small = cv2.resize(frame.depth_m, (width // 2, height // 2), interpolation=cv2.INTER_NEAREST_EXACT)
        depth_mm = np.rint(small * 1000.0).astype(np.uint16)
        confidence = np.full(depth_mm.shape, 2, np.uint8)
        confidence[: height // 4] = 1
        confidence[:4] = 0
        depth_mm[:4] = 300
        taken.append(Shot(1000.0 + i / 15.0, frame.image, depth_mm, confidence, T))
    return Shots(frames[0].camera, taken)


def _save(path: Path, image: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), image[..., ::-1] if image.ndim == 3 else image)


def write_stray_scanner(folder: Path, shots: Shots) -> Path:
    folder.mkdir()
    height, width = shots.frames[0].rgb.shape[:2]
    video = cv2.VideoWriter(f"{folder}/rgb.mp4", cv2.VideoWriter_fourcc(*"mp4v"), 15.0, (width, height))
    lines = ["timestamp, frame, x, y, z, qx, qy, qz, qw"]
    for i, shot in enumerate(shots.frames):
        video.write(np.ascontiguousarray(shot.rgb[..., ::-1]))
        _save(folder / f"depth/{i:06}.png", shot.depth_mm)
        _save(folder / f"confidence/{i:06}.png", shot.confidence)
        row = row_of_pose(shot.T_world_camera).tolist()
        lines.append(", ".join([f"{shot.stamp_s:.6f}", f"{i:06}", *(f"{v:.9f}" for v in row)]))
    video.release()
    (folder / "odometry.csv").write_text("\n".join(lines) + "\n")
    (folder / "camera_matrix.csv").write_text("\n".join(", ".join(map(str, row)) for row in shots.K) + "\n")
    header = "timestamp, a_x, a_y, a_z, alpha_x, alpha_y, alpha_z"
    rows = [f"{999.0 + i / 100.0:.6f}, 0.01, -0.02, 0.03, 0.1, 0.2, -0.1" for i in range(500)]
    (folder / "imu.csv").write_text("\n".join([header, *rows]) + "\n")
    return folder


def write_record3d(path: Path, shots: Shots, *, confidence: bool = True) -> Path:
    """Write an archive, or if the name has no ending its unpacked folder."""
    poses = [row_of_pose(shot.T_world_camera @ OPENGL).tolist() for shot in shots.frames]
    height, width = shots.frames[0].rgb.shape[:2]
    rows, columns = shots.frames[0].depth_mm.shape
    metadata = {
        "w": width,
        "h": height,
        "dw": columns,
        "dh": rows,
        "fps": 15,
        "K": shots.K.T.ravel().tolist(),
        "frameTimestamps": [shot.stamp_s for shot in shots.frames],
        "poses": [[*pose[3:], *pose[:3]] for pose in poses],
    }
    files = {"metadata": json.dumps(metadata).encode()}
    for i, shot in enumerate(shots.frames):
        jpeg = cv2.imencode(".jpg", shot.rgb[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes()
        depth = (shot.depth_mm / np.float32(1000.0)).astype("<f4")
        depth[depth == 0.0] = np.nan
        files[f"rgbd/{i}.jpg"] = jpeg
        files[f"rgbd/{i}.depth"] = lzfse.compress(depth.tobytes())
        if confidence:
            files[f"rgbd/{i}.conf"] = lzfse.compress(shot.confidence.tobytes())
    if path.suffix == ".r3d":
        with zipfile.ZipFile(path, "w") as archive:
            for name, data in files.items():
                archive.writestr(name, data)
        return path
    for name, data in files.items():
        (path / name).parent.mkdir(parents=True, exist_ok=True)
        (path / name).write_bytes(data)
    return path


def write_polycam(folder: Path, shots: Shots) -> Path:
    height, width = shots.frames[0].rgb.shape[:2]
    keyframes = folder / "keyframes"
    for shot in shots.frames:
        name = f"{round((1_442_007.0 + shot.stamp_s) * 1e6)}"
        _save(keyframes / f"images/{name}.jpg", shot.rgb)
        _save(keyframes / f"depth/{name}.png", shot.depth_mm)
        _save(keyframes / f"confidence/{name}.png", np.array([0, 127, 255], np.uint8)[shot.confidence])
        T = shot.T_world_camera @ OPENGL
        K = shots.K
        camera = {
            "fx": K[0, 0],
            "fy": K[1, 1],
            "cx": K[0, 2],
            "cy": K[1, 2],
            "width": width,
            "height": height,
        }
        camera |= {f"t_{row}{column}": T[row, column] for row in range(3) for column in range(4)}
        camera |= {"blur_score": 115.28, "timestamp": 638443502, "neighbors": [1, 2]}
        (keyframes / "cameras").mkdir(exist_ok=True)
        (keyframes / f"cameras/{name}.json").write_text(json.dumps(camera))
    return folder


def write_nerfstudio(folder: Path, shots: Shots) -> Path:
    height, width = shots.frames[0].rgb.shape[:2]
    K, frames = shots.K, []
    for i, shot in enumerate(shots.frames):
        _save(folder / f"images/frame_{i + 1:05}.png", shot.rgb)
        _save(folder / f"depth/frame_{i + 1:05}.png", shot.depth_mm)
        frames.append(
            {
                "file_path": f"images/frame_{i + 1:05}.png",
                "depth_file_path": f"depth/frame_{i + 1:05}.png",
                "transform_matrix": (shot.T_world_camera @ OPENGL).tolist(),
            }
        )
    table = {"fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2], "cy": K[1, 2], "w": width, "h": height}
    table |= {"camera_model": "OPENCV", "k1": 0.0, "k2": 0.0, "p1": 0.0, "p2": 0.0, "frames": frames[::-1]}
    (folder / "transforms.json").write_text(json.dumps(table, indent=1))
    return folder


def write_replica(folder: Path, shots: Shots) -> Path:
    scene = folder / "room0"
    lines = []
    for i, shot in enumerate(shots.frames):
        _save(scene / f"results/frame{i:06}.jpg", shot.rgb)
        depth = cv2.resize(shot.depth_mm, shot.rgb.shape[1::-1], interpolation=cv2.INTER_NEAREST_EXACT)
        _save(scene / f"results/depth{i:06}.png", np.rint(depth * 6.5535).astype(np.uint16))
        lines.append(" ".join(f"{v:.9e}" for v in shot.T_world_camera.ravel()))
    (scene / "traj.txt").write_text("\n".join(lines) + "\n")
    height, width = shots.frames[0].rgb.shape[:2]
    K = shots.K
    camera = {"w": width, "h": height, "fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2], "cy": K[1, 2]}
    (folder / "cam_params.json").write_text(json.dumps({"camera": {**camera, "scale": 6553.5}}))
    return scene


def write_bop(folder: Path, shots: Shots) -> Path:
    cameras = {}
    for i, shot in enumerate(shots.frames):
        _save(folder / f"rgb/{i:06}.png", shot.rgb)
        _save(folder / f"depth/{i:06}.png", shot.depth_mm * 4)
        T = np.linalg.inv(shot.T_world_camera)
        cameras[str(i)] = {
            "cam_K": shots.K.ravel().tolist(),
            "depth_scale": 0.25,
            "cam_R_w2c": T[:3, :3].ravel().tolist(),
            "cam_t_w2c": (1000.0 * T[:3, 3]).tolist(),
        }
    (folder / "scene_camera.json").write_text(json.dumps(cameras, indent=2))
    return folder


def write_klg(path: Path, shots: Shots, *, packed: bool = True) -> Path:
    records = [struct.pack("<i", len(shots.frames))]
    for shot in shots.frames:
        depth = cv2.resize(
            shot.depth_mm, shot.rgb.shape[1::-1], interpolation=cv2.INTER_NEAREST_EXACT
        ).tobytes()
        image = shot.rgb.tobytes()
        if packed:
            depth, image = zlib.compress(depth), cv2.imencode(".jpg", shot.rgb[..., ::-1])[1].tobytes()
        stamp_us = round(shot.stamp_s * 1e6)
        records.append(struct.pack("<qii", stamp_us, len(depth), len(image)) + depth + image)
    path.write_bytes(b"".join(records))
    K = shots.K
    path.with_name("intrinsics.txt").write_text(f"{K[0, 0]} {K[1, 1]} {K[0, 2]} {K[1, 2]}\n")
    return path


def write_sens(path: Path, shots: Shots) -> Path:
    height, width = shots.frames[0].rgb.shape[:2]
    rows, columns = shots.frames[0].depth_mm.shape
    K4, K_depth = np.eye(4), np.eye(4)
    K4[:3, :3] = shots.K
    K_depth[:3, :3] = shots.camera.resized(columns, rows).matrix
    name = b"StructureSensor"
    data = struct.pack("<IQ", 4, len(name)) + name
    for matrix in (K4, np.eye(4), K_depth, np.eye(4)):
        data += matrix.astype("<f4").tobytes()
    data += struct.pack("<iiIIIIfQ", 2, 1, width, height, columns, rows, 1000.0, len(shots.frames))
    for shot in shots.frames:
        colour = cv2.imencode(".jpg", shot.rgb[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes()
        depth = zlib.compress(shot.depth_mm.astype("<u2").tobytes())
        stamp_us = round(shot.stamp_s * 1e6)
        data += shot.T_world_camera.astype("<f4").tobytes()
        data += struct.pack("<QQQQ", stamp_us, stamp_us, len(colour), len(depth)) + colour + depth
    data += struct.pack("<Q", 0)
    path.write_bytes(data)
    return path


def write_scannet(folder: Path, shots: Shots) -> Path:
    for i, shot in enumerate(shots.frames):
        _save(folder / f"color/{i}.jpg", shot.rgb)
        _save(folder / f"depth/{i}.png", shot.depth_mm)
        (folder / "pose").mkdir(exist_ok=True)
        np.savetxt(folder / f"pose/{i}.txt", shot.T_world_camera, fmt="%.6f")
    K4 = np.eye(4)
    K4[:3, :3] = shots.K
    (folder / "intrinsic").mkdir()
    np.savetxt(folder / "intrinsic/intrinsic_color.txt", K4, fmt="%.6f")
    np.savetxt(folder / "intrinsic/extrinsic_color.txt", np.eye(4), fmt="%.6f")
    return folder


def write_bundlefusion(folder: Path, shots: Shots) -> Path:
    height, width = shots.frames[0].rgb.shape[:2]
    rows, columns = shots.frames[0].depth_mm.shape
    for i, shot in enumerate(shots.frames):
        stem = f"frame-{i:06}"
        _save(folder / f"{stem}.color.jpg", shot.rgb)
        _save(folder / f"{stem}.depth.png", shot.depth_mm)
        np.savetxt(folder / f"{stem}.pose.txt", shot.T_world_camera, fmt="%.6f")
    K4 = np.eye(4)
    K4[:3, :3] = shots.K
    info = {
        "m_versionNumber": 4,
        "m_sensorName": "StructureSensor",
        "m_colorWidth": width,
        "m_colorHeight": height,
        "m_depthWidth": columns,
        "m_depthHeight": rows,
        "m_depthShift": 1000,
        "m_calibrationColorIntrinsic": " ".join(f"{v:.6f}" for v in K4.ravel()),
        "m_frames.size": len(shots.frames),
    }
    (folder / "info.txt").write_text("".join(f"{name} = {value}\n" for name, value in info.items()))
    return folder


def write_arrays(folder: Path, shots: Shots) -> Path:
    for i, shot in enumerate(shots.frames):
        _save(folder / f"rgb/{i:04}.png", shot.rgb)
        (folder / "depth").mkdir(exist_ok=True)
        np.save(folder / f"depth/{i:04}.npy", (shot.depth_mm / 1000.0).astype(np.float32))
        (folder / "pose").mkdir(exist_ok=True)
        np.savetxt(folder / f"pose/{i:04}.txt", shot.T_world_camera, fmt="%.9f")
    K = shots.K
    (folder / "intrinsics.txt").write_text(f"{K[0, 0]} {K[1, 1]} {K[0, 2]} {K[1, 2]}\n")
    return folder


def write_openloris(folder: Path, shots: Shots) -> Path:
    lists: dict[str, list[str]] = {"color": [], "aligned_depth": []}
    truth = ["#Time px py pz qx qy qz qw"]
    for shot in shots.frames:
        stamp = f"{1_560_000_000 + shot.stamp_s:.6f}"
        _save(folder / f"color/{stamp}.png", shot.rgb)
        _save(folder / f"aligned_depth/{stamp}.png", shot.depth_mm)
        for name in lists:
            lists[name].append(f"{stamp} {name}/{stamp}.png")
        truth.append(" ".join([stamp, *(f"{v:.9f}" for v in row_of_pose(shot.T_world_camera).tolist())]))
    for name, lines in lists.items():
        (folder / f"{name}.txt").write_text("\n".join(["#Time file", *lines]) + "\n")
    (folder / "groundtruth.txt").write_text("\n".join(truth) + "\n")
    height, width = shots.frames[0].rgb.shape[:2]
    K = shots.K
    (folder / "sensors.yaml").write_text(
        "%YAML:1.0\n---\nd400_color_optical_frame:\n"
        f"   width: {width}\n   height: {height}\n   fps: 30\n   distortion_model: none\n"
        "   intrinsics: !!opencv-matrix\n      rows: 1\n      cols: 4\n      dt: d\n"
        f"      data: [ {K[0, 0]}, {K[0, 2]}, {K[1, 1]}, {K[1, 2]} ]\n"
        "   distortion_coefficients: !!opencv-matrix\n      rows: 1\n      cols: 5\n      dt: d\n"
        "      data: [ 0., 0., 0., 0., 0. ]\n"
    )
    return folder


WRITERS: dict[str, tuple[Callable[[Path, Shots], Path], str]] = {
    "stray-scanner": (write_stray_scanner, "scan"),
    "record3d": (write_record3d, "scan.r3d"),
    "polycam": (write_polycam, "scan"),
    "nerfstudio": (write_nerfstudio, "scan"),
    "replica": (write_replica, "scan"),
    "bop": (write_bop, "000001"),
    "klg": (write_klg, "scan.klg"),
    "scannet-sens": (write_sens, "scene0000_00.sens"),
    "scannet": (write_scannet, "scan"),
    "bundlefusion": (write_bundlefusion, "scan"),
    "redwood": (write_arrays, "scan"),
    "openloris": (write_openloris, "scan"),
}
"""Writers of all formats, and what each calls its folder or file."""
