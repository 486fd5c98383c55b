"""Real images changed in ways that do not change the path, or change it as is known."""

from dataclasses import replace
from functools import cache

import cv2
import numpy as np
import pytest

from mapper.core.geometry import inverse, length_and_angle, transform
from mapper.odometry.config import LocalMapConfig
from mapper.odometry.factory import build_frame_odometry
from mapper.sources import open_source
from tests.support.paths import DATA

TEDDY = DATA / "tum_fr3_teddy"
pytestmark = pytest.mark.skipif(not TEDDY.is_dir(), reason=f"{TEDDY} is not here")
TURNED = transform(np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), np.zeros(3))
"""Pose of a camera whose images are turned clockwise by 90°, in the camera of the images as they are."""


@cache
def recorded():
    return [entry.load() for entry in list(open_source(TEDDY).entries())[:90:3]]


def last_pose(change):
    """Return the pose (4, 4) of the last image in the first, of frames that are changed."""
    odometry = build_frame_odometry(LocalMapConfig())
    poses = [odometry.track(odometry.observe(change(frame))).T_world_body for frame in recorded()]
    return inverse(poses[0]) @ poses[-1]


@cache
def unchanged():
    return last_pose(lambda frame: frame)


def test_the_path_does_not_depend_on_which_way_up_images_are():
    def turned(frame):
        of = frame.camera
        camera = replace(
            of,
            width_px=of.height_px,
            height_px=of.width_px,
            fx_px=of.fy_px,
            fy_px=of.fx_px,
            cx_px=of.height_px - 1 - of.cy_px,
            cy_px=of.cx_px,
        )
        image, depth_m = (cv2.rotate(one, cv2.ROTATE_90_CLOCKWISE) for one in (frame.image, frame.depth_m))
        return replace(frame, image=image, depth_m=depth_m, camera=camera)

    off_m, off_rad = length_and_angle(inverse(unchanged()) @ TURNED @ last_pose(turned) @ inverse(TURNED))
    assert off_m < 0.01
    assert off_rad < np.radians(1.0)


def darker(frame):
    return replace(frame, image=np.round((frame.image / 255.0) ** 1.8 * 110.0).astype(np.uint8))


def compressed(frame):
    _, data = cv2.imencode(".jpg", frame.image, [cv2.IMWRITE_JPEG_QUALITY, 25])
    return replace(frame, image=cv2.imdecode(data, cv2.IMREAD_COLOR))


def blurred(frame):
    return replace(frame, image=cv2.blur(frame.image, (7, 1)))


def noisy(frame):
    noise = np.random.default_rng(frame.stamp_ns).normal(0.0, 12.0, frame.image.shape)
    return replace(frame, image=np.clip(frame.image + noise, 0, 255).astype(np.uint8))


def with_holes(frame):
    cells = np.random.default_rng(frame.stamp_ns).random((15, 20)).astype(np.float32)
    holes = cv2.resize(cells, frame.depth_m.shape[::-1]) > 0.55
    return replace(frame, depth_m=np.where(holes, np.float32(0.0), frame.depth_m))


def coarse(frame):
    return replace(frame, depth_m=np.round(frame.depth_m / 0.03).astype(np.float32) * np.float32(0.03))


@pytest.mark.parametrize("change", [darker, compressed, blurred, noisy, with_holes, coarse])
def test_the_path_does_not_depend_on_how_good_images_are(change):
    off_m, off_rad = length_and_angle(inverse(unchanged()) @ last_pose(change))
    assert off_m < 0.02
    assert off_rad < np.radians(1.0)
