"""Two cameras of any lens before a slanted wall, and their images as data sets and drivers keep them."""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from mapper.core.frames import PinholeCamera
from mapper.core.geometry import Transform, exp, inverse
from mapper.core.rotations import row_of_pose
from mapper.sources.ros.encode_ros import SerializedMessage, camera_info_message
from tests.support.recordings import changed, image
from tests.support.tum_logs import FIRST_NS

SIZE_PX = (320, 240)
PERIOD_NS = 100_000_000
NORMAL_WORLD, OFFSET_M = np.array([0.25, -0.1, 1.0]) / np.linalg.norm([0.25, -0.1, 1.0]), 2.0
"""The wall: points p with n·p = offset."""
T_IMU_LEFT = exp(np.array([0.2, -1.4, 0.3]), np.array([0.05, -0.02, 0.01]))


@dataclass(frozen=True)
class RigCamera:
    """Camera of a pair.

    Attributes:
        matrix: (3, 3) intrinsics.
        distortion: Coefficients.
        T_left_camera: (4, 4) pose in the left camera.
        is_fisheye: Whether the coefficients are of an equidistant fisheye.
    """

    matrix: np.ndarray
    distortion: tuple[float, ...]
    T_left_camera: Transform
    is_fisheye: bool = False

    def render(self, T_world_left: Transform) -> np.ndarray:
        """Return the (H, W) grey image: the ray of every pixel meets the wall."""
        columns, rows = np.meshgrid(*map(np.arange, SIZE_PX))
        pixels = np.column_stack([columns.ravel(), rows.ravel()]).astype(np.float64)[:, np.newaxis]
        undistort = cv2.fisheye.undistortPoints if self.is_fisheye else cv2.undistortPoints
        rays = undistort(pixels, self.matrix, np.array(self.distortion)).reshape(-1, 2)
        T = T_world_left @ self.T_left_camera
        directions = np.column_stack([rays, np.ones(len(rays))]) @ T[:3, :3].T
        along = (OFFSET_M - NORMAL_WORLD @ T[:3, 3]) / (directions @ NORMAL_WORLD)
        points = T[:3, 3] + along[:, np.newaxis] * directions
        return texture(points[:, 0], points[:, 1]).astype(np.uint8)


def texture(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the (H, W) grey values of a smooth random pattern: patches of a few centimetres."""
    pattern = np.random.default_rng(3).uniform(0, 255, (256, 256)).astype(np.float32)
    pattern = np.clip(3.0 * (cv2.GaussianBlur(pattern, (0, 0), 1.2) - 128) + 128, 0, 255)
    across, down = (np.mod(v / 0.02, 255.0).astype(np.float32).reshape(SIZE_PX[::-1]) for v in (x, y))
    return cv2.remap(pattern.astype(np.float32), across, down, cv2.INTER_LINEAR)


def matrix(fx: float, fy: float, cx: float, cy: float) -> np.ndarray:
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


BARREL = (
    RigCamera(matrix(260.0, 258.0, 163.0, 117.0), (-0.28, 0.07, 2e-4, 2e-5), np.eye(4)),
    RigCamera(
        matrix(262.0, 261.0, 158.0, 122.0),
        (-0.27, 0.06, -1e-4, 1e-4),
        exp(np.array([0.01, -0.02, 0.015]), np.array([0.11, 0.001, -0.002])),
    ),
)
"""Raw cameras as EuRoC's: of other intrinsics each, and not quite parallel."""
FISHEYE = (
    RigCamera(
        matrix(190.0, 190.0, 161.0, 119.0), (0.003, 0.0007, -0.002, 0.0002), np.eye(4), is_fisheye=True
    ),
    RigCamera(
        matrix(190.5, 190.4, 158.0, 121.0),
        (0.0034, 0.0017, -0.0026, 0.0005),
        exp(np.array([0.0, 0.03, 0.01]), np.array([0.101, 0.002, 0.001])),
        is_fisheye=True,
    ),
)
"""As TUM-VI's."""
RECTIFIED = tuple(
    RigCamera(matrix(280.0, 280.0, 160.0, 119.0), (0.0,) * 4, exp(np.zeros(3), np.array([x, 0.0, 0.0])))
    for x in (0.0, 0.12)
)
T_RECTIFIED_FIRST = exp(np.array([0.01, -0.02, 0.005]), np.zeros(3))
"""Rotation that rectifies the first camera of KITTI's raw drives."""


def poses_world(count: int) -> list[Transform]:
    """Return T_world_left of some frames: the rig moves sideways and turns."""
    return [
        exp(np.array([0.0, 0.03 * k, 0.01 * k]), np.array([0.05 * k, 0.0, 0.02 * k])) for k in range(count)
    ]


def write_euroc(
    folder: Path, cameras: tuple[RigCamera, ...], count: int = 2, *, kalibr: bool = False
) -> Path:
    """Write a folder in EuRoC's layout; the cameras are described as by EuRoC or by Kalibr."""
    stamps_ns = [FIRST_NS + k * PERIOD_NS for k in range(count)]
    lists = "".join(f"{stamp_ns},{stamp_ns}.png\r\n" for stamp_ns in stamps_ns)
    for k, camera in enumerate(cameras):
        place = folder / "mav0" / f"cam{k}"
        (place / "data").mkdir(parents=True)
        (place / "data.csv").write_text("#timestamp [ns],filename\r\n" + lists)
        for stamp_ns, T_world_left in zip(stamps_ns, poses_world(count), strict=True):
            cv2.imwrite(str(place / "data" / f"{stamp_ns}.png"), camera.render(T_world_left))
        T_imu_camera = T_IMU_LEFT @ camera.T_left_camera
        K = [float(camera.matrix[i]) for i in ((0, 0), (1, 1), (0, 2), (1, 2))]
        if kalibr:
            continue
        (place / "sensor.yaml").write_text(
            "#General sensor definitions.\nsensor_type: camera\ncomment: VI-Sensor cam (MT9M034)\n\n"
            f"# Sensor extrinsics wrt. the body-frame.\nT_BS:\n  cols: 4\n  rows: 4\n"
            f"  data: {T_imu_camera.ravel().tolist()}\n\nrate_hz: 20\nresolution: {list(SIZE_PX)}\n"
            f"camera_model: pinhole\nintrinsics: {K} #fu, fv, cu, cv\n"
            f"distortion_model: radial-tangential\ndistortion_coefficients: {list(camera.distortion)}\n"
        )
    if kalibr:
        (folder / "dso").mkdir()
        (folder / "dso" / "camchain.yaml").write_text(camera_chain(cameras))
    truth = folder / "mav0" / "state_groundtruth_estimate0"
    truth.mkdir()
    lines = [
        "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z []"
    ]
    for stamp_ns, T_world_left in zip(stamps_ns, poses_world(count), strict=True):
        x, y, z, qx, qy, qz, qw = row_of_pose(T_world_left @ inverse(T_IMU_LEFT)).tolist()
        lines.append(f"{stamp_ns},{x},{y},{z},{qw},{qx},{qy},{qz}")
    (truth / "data.csv").write_text("\n".join(lines) + "\n")
    return folder


def camera_chain(
    cameras: tuple[RigCamera, ...], *, has_imu: bool = True, topics: tuple[str, ...] = ("/cam0", "/cam1")
) -> str:
    """Return the text of Kalibr's camchain.yaml, with poses of the IMU or of the camera before."""
    text = ""
    for k, camera in enumerate(cameras):
        T_before_camera = inverse(cameras[max(k - 1, 0)].T_left_camera) @ camera.T_left_camera
        T = inverse(T_IMU_LEFT @ camera.T_left_camera if has_imu else T_before_camera)
        rows = "".join(f"  - {row}\n" for row in T.tolist())
        pose = f"  {'T_cam_imu' if has_imu else 'T_cn_cnm1'}:\n{rows}" if has_imu or k else ""
        model = "equidistant" if camera.is_fisheye else "radtan"
        text += (
            f"cam{k}:\n{pose}  cam_overlaps: [{1 - k}]\n  camera_model: pinhole\n"
            f"  distortion_coeffs: {list(camera.distortion)}\n  distortion_model: {model}\n"
            f"  intrinsics: {[float(camera.matrix[i]) for i in ((0, 0), (1, 1), (0, 2), (1, 2))]}\n"
            f"  resolution: {list(SIZE_PX)}\n  rostopic: {topics[k]}/image_raw\n"
        )
    return text


def write_imu(folder: Path, count: int) -> None:
    """Write EuRoC's readings of a unit at rest: gravity along the world's −y, the images' up."""
    place = folder / "mav0" / "imu0"
    place.mkdir()
    felt = T_IMU_LEFT[:3, :3] @ np.array([0.0, -9.81, 0.0])
    rows = [
        f"{FIRST_NS + k * 5_000_000},0.01,0.02,{0.03 + 1e-6 * k},{felt[0]},{felt[1]},{felt[2]}"
        for k in range(count)
    ]
    header = (
        "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],"
        "a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]"
    )
    (place / "data.csv").write_text("\n".join([header, *rows]) + "\n")


def write_kitti(folder: Path, count: int = 2) -> Path:
    """Write a KITTI sequence of grey, rectified pairs."""
    P = ""
    for k, camera in enumerate(RECTIFIED):
        (folder / f"image_{k}").mkdir(parents=True)
        for i, T_world_left in enumerate(poses_world(count)):
            cv2.imwrite(str(folder / f"image_{k}" / f"{i:06d}.png"), camera.render(T_world_left))
        projection = np.column_stack([camera.matrix, camera.matrix @ -camera.T_left_camera[:3, 3]])
        P += f"P{k}: " + " ".join(f"{v:.12e}" for v in projection.ravel()) + "\n"
    (folder / "calib.txt").write_text(P)
    (folder / "times.txt").write_text("".join(f"{0.1 * k:.6e}\n" for k in range(count)))
    poses = (" ".join(f"{v:.9e}" for v in T[:3].ravel()) for T in poses_world(count))
    (folder / "poses.txt").write_text("\n".join(poses) + "\n")
    return folder


def write_kitti_drive(
    day: Path,
    cameras: tuple[RigCamera, ...] = RECTIFIED,
    *,
    numbers: tuple[int, int] = (0, 1),
    is_rectified: bool = True,
) -> Path:
    """Write a raw drive of two pairs into the folder of a day; the cameras are described in the latter.

    The first camera is the left one, turned by ``T_RECTIFIED_FIRST`` where pairs are rectified. Camera 3
    began an image earlier where they are not.
    """
    drive = day / f"{day.name}_drive_0001_{'sync' if is_rectified else 'extract'}"
    lines = [("R_rect_00", T_RECTIFIED_FIRST[:3, :3])]
    for side, (number, camera) in enumerate(zip(numbers, cameras, strict=True)):
        name, early = f"{number:02d}", 0 if is_rectified else side
        folder = drive / f"image_{name}" / "data"
        folder.mkdir(parents=True)
        for k, T_world_left in enumerate(poses_world(2)):
            cv2.imwrite(str(folder / f"{k + early:010d}.png"), camera.render(T_world_left))
        times = [f"2011-09-26 13:02:2{5 + k // 10}.{k % 10}5{side}360375" for k in range(2 + early)]
        if early:
            times.insert(0, "2011-09-26 13:02:24.950360375")
        (folder.parent / "timestamps.txt").write_text("\n".join(times) + "\n")
        T_camera_left = inverse(camera.T_left_camera)
        lines += [
            (f"S_{name}", np.array(SIZE_PX)),
            (f"K_{name}", camera.matrix),
            (f"D_{name}", np.array([*camera.distortion, 0.0])),
            (f"R_{name}", T_camera_left[:3, :3]),
            (f"T_{name}", T_camera_left[:3, 3]),
            (f"S_rect_{name}", np.array(SIZE_PX) if is_rectified else np.array([310, 230])),
            (f"P_rect_{name}", np.column_stack([camera.matrix, camera.matrix @ T_camera_left[:3, 3]])),
        ]
    (day / "calib_cam_to_cam.txt").write_text("calib_time: 09-Jan-2012 13:57:47\n" + _kitti_text(lines))
    return drive


def write_kitti_navigation(drive: Path) -> np.ndarray:
    """Write ``oxts`` of a drive and its mounting, and return its place in the rectified left camera."""
    packets, day = drive / "oxts" / "data", drive.parent
    packets.mkdir(parents=True)
    words = [*("49.0", "8.4", "116.0"), *["0.0"] * 20, "0.05", "0.0", "4", "10", "4", "4", "0"]
    (packets / "0000000000.txt").write_text(" ".join(words))
    (drive / "oxts/timestamps.txt").write_text("2011-09-26 13:02:25.050360375\n")
    place_lidar, T_first_lidar = np.array([-0.81, 0.32, -0.8]), exp(np.array([1.2, -1.2, 1.1]), np.ones(3))
    mounted = [("R", np.eye(3)), ("T", place_lidar)]
    (day / "calib_imu_to_velo.txt").write_text("calib_time: 25-May-2012 16:47:16\n" + _kitti_text(mounted))
    mounted = [("R", T_first_lidar[:3, :3]), ("T", T_first_lidar[:3, 3])]
    (day / "calib_velo_to_cam.txt").write_text("calib_time: 15-Mar-2012 11:37:16\n" + _kitti_text(mounted))
    return (T_RECTIFIED_FIRST @ T_first_lidar @ [*place_lidar, 1.0])[:3]


def _kitti_text(lines: list[tuple[str, np.ndarray]]) -> str:
    return "".join(f"{name}: {' '.join(f'{v:.9e}' for v in m.ravel())}\n" for name, m in lines)


def recorded(
    cameras: tuple[RigCamera, ...],
    topics: tuple[str, str],
    *,
    projections: tuple[np.ndarray, ...],
    rotations=None,
) -> list[SerializedMessage]:
    """Return both cameras' messages, each with a CameraInfo of a projection (3, 4) and a rotation."""
    messages = []
    for k, (camera, topic) in enumerate(zip(cameras, topics, strict=True)):
        R = np.eye(3) if rotations is None else rotations[k]
        for i, T_world_left in enumerate(poses_world(2)):
            stamp_ns = FIRST_NS + i * PERIOD_NS
            messages.append(image(stamp_ns, topic, camera.render(T_world_left), "mono8", frame=f"optical{k}"))
            K, topic_of_info = camera.matrix, topic.rpartition("/")[0] + "/camera_info"
            intrinsics = PinholeCamera(
                *SIZE_PX, K[0, 0], K[1, 1], K[0, 2], K[1, 2], (*camera.distortion, 0.0)
            )
            info = camera_info_message(stamp_ns, topic_of_info, intrinsics, frame=f"optical{k}")
            messages.append(changed(info, r=R.ravel(), p=projections[k].ravel()))
    return messages


def projections(baseline_m: float, camera: RigCamera = RECTIFIED[0]) -> list[np.ndarray]:
    """Return the (3, 4) projections of two rectified cameras."""
    K = camera.matrix
    return [np.column_stack([K, K @ [-x, 0.0, 0.0]]) for x in (0.0, baseline_m)]
