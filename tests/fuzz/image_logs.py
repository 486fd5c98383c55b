"""Inputs of image folders whose images have no list: numbered or stamped names, and truths of their own."""

from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from mapper.core.frames import PinholeCamera
from mapper.core.timebase import NS_PER_S
from mapper.sources.calibration_file import calibration_text
from tests.support.azure_kinect import Capture, write_azure_kinect
from tests.support.hololens import write_hololens
from tests.support.recordings import CAMERA
from tests.support.tum_logs import FIRST_NS, picture, write_picture

FRAMES = 4
CALIBRATION_YAML = """%YAML:1.0
Camera.fx: 60.0
Camera.fy: 61.0
Camera.cx: 31.5
Camera.cy: 23.5
Camera.width: 64
Camera.height: 48
DepthMapFactor: 1000.0
distortion_coefficients: !!opencv-matrix
   rows: 1
   cols: 5
   data: [ 0.1, -0.2, 0.001, 0.002, 0.05 ]
"""


def pose(i: int) -> np.ndarray:
    T_world_body = np.eye(4)
    T_world_body[0, 3] = 0.1 * i
    return T_world_body


def _numbered(colour: str, depth: str) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        log = folder / "log"
        poses = []
        for i in range(FRAMES):
            write_picture(log / f"rgb/{i:06}{colour}", log / f"depth/{i:06}{depth}", i)
            matrix = "\n".join(" ".join(f"{value:.6f}" for value in row) for row in pose(i))
            poses.append(f"{i} {i} {i + 1}\n{matrix}\n")
        (log / "trajectory.log").write_text("".join(poses))
        (log / "camera.yaml").write_text(CALIBRATION_YAML)
        return log

    return make


def _seven_scenes(folder: Path) -> Path:
    log = folder / "log"
    for i in range(FRAMES):
        write_picture(log / f"frame-{i:06}.color.png", log / f"frame-{i:06}.depth.png", i)
        np.savetxt(log / f"frame-{i:06}.pose.txt", pose(i), fmt="%.7e", delimiter="\t")
    (log / "calibration.toml").write_text(calibration_text(CAMERA, depth_units_per_m=1000.0))
    return log


def _without_poses(folder: Path) -> Path:
    log = _numbered(".png", ".png")(folder)
    (log / "trajectory.log").unlink()
    return log


def _poznan(folder: Path) -> Path:
    log = _without_poses(folder)
    rows = [f"{i} {0.1 * i} 0 1 0 0 {i}" for i in range(FRAMES)]
    (log / "groundtruth.txt").write_text("\n".join(["# number x y z roll pitch yaw, deg", *rows]) + "\n")
    return log


def _icl_nuim(folder: Path) -> Path:
    log = _without_poses(folder)
    pairs = [f"{i} depth/{i:06}.png {i} rgb/{i:06}.png" for i in range(FRAMES)]
    (log / "associations.txt").write_text("\n".join(pairs) + "\n")
    rows = [f"{i} {0.1 * i} 0 1 0 0 0 1" for i in range(FRAMES)]
    (log / "livingRoom1.gt.freiburg").write_text("\n".join(rows) + "\n")
    return log


def _stamped(folder: Path) -> Path:
    log = _without_poses(folder)
    for image in sorted(log.glob("*/*.png")):
        image.rename(image.with_stem(f"{FIRST_NS + int(image.stem) * NS_PER_S // 10}"))
    return log


def _azure_kinect(folder: Path) -> Path:
    depth = PinholeCamera(320, 288, 252.0, 252.0, 160.0, 165.0)
    units = np.full((288, 320), 1500, np.uint16)
    captures = [Capture(100_000 * i, picture(i)[0], units) for i in range(FRAMES)]
    readings = [(1000 * i, (0.0, 0.0, 9.8), (0.1, 0.0, 0.0)) for i in range(100)]
    places = {"colour": CAMERA, "depth": depth, "T_color_depth": np.eye(4)}
    return write_azure_kinect(folder / "log.mkv", captures, samples=readings, **places)


IMAGE_LOGS: Mapping[str, Callable[[Path], Path]] = {
    "redwood, png": _numbered(".png", ".png"),
    "redwood, jpg": _numbered(".jpg", ".png"),
    "redwood, tiff": _numbered(".tiff", ".tiff"),
    "redwood, bmp": _numbered(".bmp", ".pgm"),
    "7-scenes": _seven_scenes,
    "poznan": _poznan,
    "icl-nuim": _icl_nuim,
    "stamped images": _stamped,
    "azure-kinect": _azure_kinect,
    "hololens": lambda folder: write_hololens(folder / "log", is_raw=True),
}
"""Makers of these inputs."""
