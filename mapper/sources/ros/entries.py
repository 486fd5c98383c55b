"""Frames of a recording that have not been read yet; see :class:`mapper.sources.base.FrameRef`."""

from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from mapper.core.errors import DataError, FrameError
from mapper.core.frames import DepthImage, Image, Scan
from mapper.sources.base import FrameRef, ImageFiles
from mapper.sources.image_files.decoded import DecodedColour, DecodedDepth
from mapper.sources.image_files.image_sizes import RecordedCamera
from mapper.sources.image_folders.rgbd import RgbdImages
from mapper.sources.laser_scan import planar
from mapper.sources.ros.cloud_messages import scan_from
from mapper.sources.ros.decode import decode
from mapper.sources.ros.frame_tree import FrameTree, is_fixed
from mapper.sources.ros.image_messages import depth_file_of, depth_m_of, image_of, is_depth
from mapper.sources.ros.messages import CloudMessage, FileMessage, ImageMessage, Message, frame_of
from mapper.sources.ros.recording import Place, Recording, Topic
from mapper.sources.stereo import StereoCamera


@dataclass(frozen=True, slots=True)
class Located:
    """Message that has not been read yet."""

    recording: Recording
    topic: Topic
    stamp_ns: int
    place: Place

    def __str__(self) -> str:
        return f"{self.recording.path}: {self.topic.name} at {self.stamp_ns}"

    def read(self) -> Message:
        """Read and decode it.

        Raises:
            FrameError: It is damaged.
        """
        data = self.recording.read(self.place)
        try:
            return decode(self.topic, data)
        except DataError as error:
            raise FrameError(f"{self}: {error}") from None

    def image(self) -> ImageMessage:
        """Read and decode an image message, not its image.

        Raises:
            FrameError: It is damaged.
        """
        message = self.read()
        if not isinstance(message, ImageMessage):
            raise FrameError(f"{self}: {self.topic.type} is no image")
        return message


def rgbd_images(
    colour: Located,
    depth: Located,
    recorded: RecordedCamera,
    *,
    units_per_m: float,
    float_units_per_m: float | None,
    colour_suffix: str,
    shift: int,
) -> RgbdImages:
    """Return the images of a colour and a depth message; the body is the camera.

    As files the images are what the messages hold where that is a file, else encoded as PNG.

    Args:
        colour: Colour or grey image; its time is the frame's.
        depth: Depth image, registered to it.
        recorded: Camera of the frame, and the sizes of both images.
        units_per_m: 16-bit depth units per metre.
        float_units_per_m: Units per metre of depth that is recorded as 32-bit numbers; None if it is not.
        colour_suffix: Ending of a colour image's file.
        shift: Bits below those that are used of a grey image of 16.
    """

    def depth_m() -> DepthImage:
        return depth_m_of(
            depth.image(),
            units_per_m=units_per_m,
            float_units_per_m=float_units_per_m or 1.0,
            where=f"{depth}",
        )

    return RgbdImages(
        colour.stamp_ns,
        depth.stamp_ns,
        ImageFiles(
            DecodedColour(
                colour,
                partial(read_image, colour, shift=shift),
                lambda: _file_of(colour.image()),
                colour_suffix,
            ),
            DecodedDepth(depth, depth_m, units_per_m, lambda: depth_file_of(depth.image())),
            units_per_m,
            colour_px=recorded.colour_px,
            depth_px=recorded.depth_px,
            recorded_units_per_m=float_units_per_m,
        ),
        recorded,
    )


def stereo_entry(
    left: Located, right: Located, camera: StereoCamera, recorded: RecordedCamera, *, shift: int
) -> FrameRef:
    """Return the entry of a left and a right image, whose body is the rectified left camera.

    Args:
        left: Left image; its time is the frame's.
        right: Right image.
        camera: Rectifies and matches them.
        recorded: Camera of the frame, and the size of both images.
        shift: Bits below those that are used of grey images of 16.
    """
    read_left, read_right = (partial(read_image, one, shift=shift) for one in (left, right))
    depth = camera.depth_of(read_left, read_right, left)
    images = ImageFiles(
        camera.image_of(read_left, left),
        depth,
        depth.units_per_m,
        colour_px=recorded.colour_px,
        depth_px=recorded.depth_px,
    )
    return RgbdImages(left.stamp_ns, right.stamp_ns, images, recorded).entry()


def read_image(image: Located, in_colour: bool, *, shift: int) -> Image:
    """Read an image in colour or grey; ``shift`` as of :func:`image_of`."""
    return image_of(image.image(), colour=in_colour, shift=shift, where=f"{image}")


def _file_of(message: ImageMessage) -> bytes | None:
    return bytes(message.data) if isinstance(message, FileMessage) and not is_depth(message) else None


def cloud_entry(
    cloud: Located, body: str, tree: FrameTree, *, scale: float | None = None, is_planar: bool = False
) -> FrameRef:
    """Return the entry of a point cloud message, with the time of each point where the message has it.

    It cannot be read if the message is damaged, its points have no x, y and z, or tf does not tie their frame
    to the body's.

    Args:
        cloud: The message.
        body: Coordinate frame of the scan.
        tree: Coordinate frames that tie each message's own frame to the body's.
        scale: Metres per unit of the points, as the user set it.
        is_planar: They are of a 2D laser.
    """

    def read(colour: bool) -> Scan:
        message = cloud.read()
        if not isinstance(message, CloudMessage):
            raise FrameError(f"{cloud}: {cloud.topic.type} is no point cloud")
        message = replace(message, stamp_ns=cloud.stamp_ns)
        frame = frame_of(message)
        T_body_frame = tree.find(body, frame, stamp_ns=cloud.stamp_ns)
        if T_body_frame is None:
            when = "" if tree.find(body, frame) is None else " at that time"
            raise FrameError(
                f"{cloud}: its points are in frame {frame}, which tf does not connect to {body}{when}"
            )
        scan = scan_from(
            message, T_body_frame=T_body_frame, with_colours=colour, where=f"{cloud}", scale=scale
        )
        if frame != body and is_fixed(frame):
            # Where the sensor was is not stated; what turned its points into that frame has deskewed them.
            scan = replace(scan, origin_body=np.zeros(3), times_s=None)
        return planar(scan) if is_planar else scan

    return FrameRef(cloud.stamp_ns, read)
