"""Colour and depth images of a log as those of one camera: of one size, registered, without other lenses."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from mapper.core.errors import FrameError, SourceError
from mapper.core.frames import DepthImage, Image, PinholeCamera, RgbdFrame, Scan, ray_table
from mapper.sensing.depth_registration import DepthRegistration
from mapper.sources.calibration import Calibration, DepthCamera

Size = tuple[int, int]
"""Width and height, px."""

_SAME_VIEW = 0.01
"""Most that the aspect ratios of images of the same view differ by: sides are rounded to multiples of 8 or
16 (ScanNet's 1296×968 with 640×480 by 0.4 %, RealSense's 1280×720 with 848×480 by 0.6 %), and cropped ones
differ by 4 % at least (5:4 is 1.25, 4:3 1.33, 16:9 1.78)."""
_ENOUGH_PX = 640
"""Longer side from which frames are large enough. Poses get better with the size of the colour image up to
this, not with that of the depth image: logs of 320×240 depth have an ATE of 18 to 20 mm at this size, 7 to
8 mm at 640×480 and 7 mm at 960×720; with 192×144 depth it is 36 mm, 11 mm at 384×288, and 5 to 8 mm at
576×432 and more."""


@dataclass(frozen=True, slots=True, eq=False)
class RecordedCamera:
    """Camera of a log's frames, and what makes its images of those that are recorded.

    Attributes:
        camera: Camera of the frames: of both images once they are read.
        colour_px: Size of the colour images as recorded.
        depth_px: Size of the depth images as recorded.
        undistortion: (H, W) columns and rows in the resized images of the pixels of the camera, where the
            lens is none of its model.
        registration: Projection of depth images of a camera of their own.
    """

    camera: PinholeCamera
    colour_px: Size
    depth_px: Size
    undistortion: tuple[NDArray[np.float32], NDArray[np.float32]] | None = None
    registration: DepthRegistration | None = None

    @property
    def shows_recorded_views(self) -> bool:
        """Whether frames are the recorded images, at most in another size."""
        return self.undistortion is None and self.registration is None

    def image(self, recorded: Image, where: str) -> Image:
        """Return a colour or grey image as the camera sees it.

        Args:
            recorded: (H, W, 3) or (H, W) image as recorded.
            where: Name of the image in an error.

        Raises:
            FrameError: It has another size than those of the log.
        """
        _check_size(recorded, self.colour_px, where)
        size_px = (self.camera.width_px, self.camera.height_px)
        image = recorded
        if size_px != self.colour_px:
            is_reduced = size_px[0] * size_px[1] < self.colour_px[0] * self.colour_px[1]
            means = cv2.INTER_AREA if is_reduced else cv2.INTER_LINEAR
            image = cv2.resize(recorded, size_px, interpolation=means)
        if self.undistortion is not None:
            image = cv2.remap(image, *self.undistortion, cv2.INTER_LINEAR)
        return image

    def depth_m(self, recorded: DepthImage, where: str) -> DepthImage:
        """Return a depth image as the camera sees it: of the nearest pixels, for means lie beside edges.

        Args:
            recorded: (H, W) depth as recorded.
            where: Name of the image in an error.

        Raises:
            FrameError: As ``image``.
        """
        _check_size(recorded, self.depth_px, where)
        if self.registration is not None:
            return self.registration.register(recorded)
        size_px = (self.camera.width_px, self.camera.height_px)
        depth_m = recorded
        if size_px != self.depth_px:
            depth_m = cv2.resize(recorded, size_px, interpolation=cv2.INTER_NEAREST_EXACT)
        if self.undistortion is not None:
            depth_m = cv2.remap(depth_m, *self.undistortion, cv2.INTER_NEAREST)
        return depth_m

    def scan(self, recorded: DepthImage, where: str, *, stamp_ns: int) -> Scan:
        """Return a depth image's returns in the camera's frame; a depth camera's own along its own rays.

        Args:
            recorded: (H, W) depth as recorded.
            where: Name of the image in an error.
            stamp_ns: Time of the frame.

        Raises:
            FrameError: As ``image``.
        """
        if self.registration is None:
            depth_m = self.depth_m(recorded, where)
            no_image = np.broadcast_to(np.uint8(0), depth_m.shape)
            return RgbdFrame(stamp_ns, no_image, depth_m, self.camera).scan()
        _check_size(recorded, self.depth_px, where)
        points, origin = self.registration.back_project(recorded)
        return Scan(stamp_ns, points, origin)

    def notes(self) -> list[str]:
        """Return a sentence on what is resized, if anything is."""
        if self.colour_px == self.depth_px or self.registration is not None:
            return []
        size_px = (self.camera.width_px, self.camera.height_px)
        recorded_px = {"colour": self.colour_px, "depth": self.depth_px}
        resized = [name for name, px in recorded_px.items() if px != size_px]
        return [
            f"colour of {_text(self.colour_px)} and depth of {_text(self.depth_px)} px are taken to show the "
            f"same view; {' and '.join(resized)} {'are' if len(resized) > 1 else 'is'} resized to "
            f"{_text(size_px)}"
        ]


def recorded_camera(
    calibration: Calibration, *, colour_px: Size, depth_px: Size, where: str
) -> RecordedCamera:
    """Return the camera of frames whose colour and depth images may differ in size.

    Args:
        calibration: Intrinsics of the colour image, or, if they are said to hold for its size, of the depth
            image. Without a depth camera of its own both images show one view.
        colour_px: Size of the colour images.
        depth_px: Size of the depth images.
        where: Name of the log in an error.

    Raises:
        SourceError: The images show different views by their aspect ratios, or the calibration holds for
            neither.
    """
    if calibration.depth is not None:
        camera = calibration.camera(width_px=colour_px[0], height_px=colour_px[1])
        camera = camera.resized(*_reduced_size(colour_px))
        registration = _registration(calibration.depth, depth_px, camera)
        return RecordedCamera(camera, colour_px, depth_px, _undistortion(calibration, camera), registration)
    if not is_same_view(colour_px, depth_px):
        raise SourceError(
            f"{where}: colour has {_text(colour_px)} px and depth {_text(depth_px)}, which is another aspect "
            "ratio and so another view; export depth that is registered to colour, crop both to one view, or "
            "give the depth camera: source.camera.depth_intrinsics_px and depth_in_color"
        )
    is_of_depth = calibration.size_px == depth_px
    width_px, height_px = depth_px if is_of_depth else colour_px
    camera = calibration.camera(width_px=width_px, height_px=height_px)
    resized = camera.resized(*_common_size(colour_px, depth_px))
    return RecordedCamera(resized, colour_px, depth_px, _undistortion(calibration, resized))


def is_same_view(colour_px: Size, depth_px: Size) -> bool:
    """Return whether images of these sizes may show the same view: whether their aspect ratios agree."""
    ratio = (colour_px[0] * depth_px[1]) / (colour_px[1] * depth_px[0])
    return abs(ratio - 1.0) <= _SAME_VIEW


def depth_rays(depth: DepthCamera, depth_px: Size) -> NDArray[np.float32]:
    """Return the (H, W, 2) x/z and y/z of every pixel's ray of a depth camera.

    Raises:
        SourceError: Its calibration holds for another size, or is none of a camera.
    """
    if depth.tangents is not None:
        return depth.tangents
    width_px, height_px = depth_px
    own, lens = depth.calibration.camera(width_px=width_px, height_px=height_px), depth.calibration.lens
    return ray_table(own) if lens is None else lens.rays(own)


def _registration(depth: DepthCamera, depth_px: Size, camera: PinholeCamera) -> DepthRegistration:
    T_color_depth = np.eye(4) if depth.T_color_depth is None else depth.T_color_depth
    return DepthRegistration(depth_rays(depth, depth_px), camera, T_color_depth)


def _undistortion(
    calibration: Calibration, camera: PinholeCamera
) -> tuple[NDArray[np.float32], NDArray[np.float32]] | None:
    return None if calibration.lens is None else calibration.lens.maps(camera)


def _reduced_size(colour_px: Size) -> Size:
    """Return the least size that is large enough, of which colour's is a multiple; else colour's."""
    width_px, height_px = colour_px
    factors = range(max(colour_px) // _ENOUGH_PX, 1, -1)
    factor = next((n for n in factors if width_px % n == 0 and height_px % n == 0), 1)
    return width_px // factor, height_px // factor


def _common_size(colour_px: Size, depth_px: Size) -> Size:
    """Return the least multiple of the depth image's size that is large enough, or else colour's size.

    In a multiple of its size every depth pixel covers as many pixels as any other.
    """
    factor = -(-min(_ENOUGH_PX, max(colour_px)) // max(depth_px))
    multiple = (factor * depth_px[0], factor * depth_px[1])
    return multiple if factor == 1 or max(multiple) <= max(colour_px) else colour_px


def _check_size(image: Image | DepthImage, size_px: Size, where: str) -> None:
    found_px = (image.shape[1], image.shape[0])
    if found_px != size_px:
        raise FrameError(f"{where}: {_text(found_px)} px, but the log has {_text(size_px)}")


def _text(size_px: Size) -> str:
    return f"{size_px[0]}×{size_px[1]}"
