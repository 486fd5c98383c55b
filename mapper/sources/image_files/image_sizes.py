"""Sizes of a log's colour and depth images, and the one size that both are brought to."""

from dataclasses import dataclass

import cv2

from mapper.core.errors import FrameError, SourceError
from mapper.core.frames import DepthImage, Image, PinholeCamera
from mapper.sources.calibration import Calibration
from mapper.sources.undistorted import Lens

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


@dataclass(frozen=True, slots=True)
class RecordedCamera:
    """Camera of a log's frames, and the sizes that its images are recorded in.

    Attributes:
        camera: Camera of the frames: of both images once they are brought to its size.
        colour_px: Size of the colour images as recorded.
        depth_px: Size of the depth images as recorded.
        lens: Distortion that is still in the images.
    """

    camera: PinholeCamera
    colour_px: Size
    depth_px: Size
    lens: Lens | None = None

    def image(self, recorded: Image, where: str) -> Image:
        """Return a colour or grey image in the camera's size.

        Args:
            recorded: (H, W, 3) or (H, W) image as recorded.
            where: Name of the image in an error.

        Raises:
            FrameError: It has another size than those of the log.
        """
        _check_size(recorded, self.colour_px, where)
        size_px = (self.camera.width_px, self.camera.height_px)
        if size_px == self.colour_px:
            return recorded
        is_reduced = size_px[0] * size_px[1] < self.colour_px[0] * self.colour_px[1]
        means = cv2.INTER_AREA if is_reduced else cv2.INTER_LINEAR
        resized: Image = cv2.resize(recorded, size_px, interpolation=means)
        return resized

    def depth_m(self, recorded: DepthImage, where: str) -> DepthImage:
        """Return a depth image in the camera's size: of the nearest pixels, for means lie beside edges.

        Args:
            recorded: (H, W) depth as recorded.
            where: Name of the image in an error.

        Raises:
            FrameError: As ``image``.
        """
        _check_size(recorded, self.depth_px, where)
        size_px = (self.camera.width_px, self.camera.height_px)
        if size_px == self.depth_px:
            return recorded
        resized: DepthImage = cv2.resize(recorded, size_px, interpolation=cv2.INTER_NEAREST_EXACT)
        return resized

    def notes(self) -> list[str]:
        """Return a sentence on what is resized, if anything is."""
        if self.colour_px == self.depth_px:
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
    """Return the camera of frames whose colour and depth images may differ in size, not in view.

    Args:
        calibration: Intrinsics of the colour image, or, if they are said to hold for its size, of the depth
            image.
        colour_px: Size of the colour images.
        depth_px: Size of the depth images.
        where: Name of the log in an error.

    Raises:
        SourceError: The images show different views by their aspect ratios, or the calibration holds for
            neither.
    """
    if not is_same_view(colour_px, depth_px):
        raise SourceError(
            f"{where}: colour has {_text(colour_px)} px and depth {_text(depth_px)}, which is another aspect "
            "ratio and so another view; export depth that is registered to colour, or crop both to one view"
        )
    is_of_depth = calibration.size_px == depth_px
    width_px, height_px = depth_px if is_of_depth else colour_px
    camera = calibration.camera(width_px=width_px, height_px=height_px)
    resized = camera.resized(*_common_size(colour_px, depth_px))
    return RecordedCamera(resized, colour_px, depth_px, calibration.lens)


def is_same_view(colour_px: Size, depth_px: Size) -> bool:
    """Return whether images of these sizes may show the same view: whether their aspect ratios agree."""
    ratio = (colour_px[0] * depth_px[1]) / (colour_px[1] * depth_px[0])
    return abs(ratio - 1.0) <= _SAME_VIEW


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
