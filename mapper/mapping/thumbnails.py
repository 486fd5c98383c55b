"""Thumbnails of a log's images: small JPEG copies and their camera."""

import cv2

from mapper.core.errors import DataError
from mapper.core.frames import Image, PinholeCamera

_QUALITY = 80  # of 100 on libjpeg's scale


def encode_jpeg(image: Image, *, width_px: int) -> bytes:
    """Return an image as JPEG, shrunk to ``width_px`` if it is wider. Pure and thread-safe.

    Args:
        image: (H, W, 3) uint8 RGB or (H, W) uint8 grey.
        width_px: Largest width of the result; the aspect ratio is kept.
    """
    height, width = image.shape[:2]
    if width > width_px:
        image = cv2.resize(
            image, (width_px, _height_px(width, height, width_px)), interpolation=cv2.INTER_AREA
        )
    if image.ndim == 3:
        image = cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
    done, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    if not done:
        raise DataError(f"image {image.shape} cannot be encoded as JPEG")
    return bytes(data)


def shrunk_camera(camera: PinholeCamera, *, width_px: int) -> PinholeCamera:
    """Return the camera of the image of :func:`encode_jpeg` at the same ``width_px``."""
    if camera.width_px <= width_px:
        return camera
    return camera.resized(width_px, _height_px(camera.width_px, camera.height_px, width_px))


def _height_px(width: int, height: int, width_px: int) -> int:
    return max(round(height * width_px / width), 1)
