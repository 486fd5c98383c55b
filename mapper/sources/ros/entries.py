"""Frames of a recording that have not been read yet; see :class:`mapper.sources.base.Entry`."""

from dataclasses import dataclass

from mapper.core.errors import DataError, FrameError
from mapper.core.frames import DepthImage, PinholeCamera, RgbdFrame, Scan
from mapper.core.geometry import Transform
from mapper.sources.base import ImageFiles
from mapper.sources.images import check_size, encode_colour, encode_depth, scan_of
from mapper.sources.ros.clouds import scan_from
from mapper.sources.ros.images import depth_file_of, depth_m_of, image_of
from mapper.sources.ros.messages import CloudMessage, FileMessage, ImageMessage, Message, decode
from mapper.sources.ros.recording import Place, Recording, Topic


@dataclass(frozen=True, slots=True)
class Located:
    """A message that has not been read yet."""

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


@dataclass(frozen=True, slots=True)
class RgbdMessages:
    """A colour and a depth message; the body is the camera."""

    colour: Located
    depth: Located
    camera: PinholeCamera
    units_per_m: float
    colour_suffix: str

    @property
    def stamp_ns(self) -> int:
        """Return the colour image's time."""
        return self.colour.stamp_ns

    @property
    def files(self) -> ImageFiles:
        """Return the images as files: as they are where they are files, else encoded as PNG."""
        return ImageFiles(
            _ColourFile(self.colour, self.colour_suffix),
            _DepthFile(self.depth, self.units_per_m),
            self.depth.stamp_ns,
            self.units_per_m,
        )

    def load(self, *, colour: bool = True) -> RgbdFrame:
        """Read and decode both images.

        Raises:
            FrameError: A message is damaged, in an encoding that is not read, or of another size.
        """
        image = image_of(self.colour.image(), colour=colour, where=f"{self.colour}")
        check_size(image.shape, self.camera, f"{self.colour}")
        return RgbdFrame(self.stamp_ns, image, self._depth_m(), self.camera)

    def scan(self) -> Scan:
        """Read and decode the depth image alone.

        Raises:
            FrameError: As ``load``.
        """
        return scan_of(self._depth_m(), self.camera, stamp_ns=self.stamp_ns)

    def _depth_m(self) -> DepthImage:
        depth_m = depth_m_of(self.depth.image(), units_per_m=self.units_per_m, where=f"{self.depth}")
        check_size(depth_m.shape, self.camera, f"{self.depth}")
        return depth_m


@dataclass(frozen=True, slots=True)
class CloudEntry:
    """A cloud message."""

    cloud: Located
    T_body_frame: Transform
    files: ImageFiles | None = None

    @property
    def stamp_ns(self) -> int:
        """Return the cloud's time."""
        return self.cloud.stamp_ns

    def load(self, *, colour: bool = True) -> Scan:
        """Read the cloud, with the time of each point where the message has it.

        Raises:
            FrameError: The message is damaged, or its points have no x, y and z.
        """
        message = self.cloud.read()
        if not isinstance(message, CloudMessage):
            raise FrameError(f"{self.cloud}: {self.cloud.topic.type} is no point cloud")
        return scan_from(message, T_body_frame=self.T_body_frame, with_colours=colour, where=f"{self.cloud}")

    def scan(self) -> Scan:
        """Read the cloud without its colours.

        Raises:
            FrameError: As ``load``.
        """
        return self.load(colour=False)


@dataclass(frozen=True, slots=True)
class _ColourFile:
    """A colour image as a file; see :class:`mapper.sources.base.ImageFile`."""

    message: Located
    suffix: str

    def read_bytes(self) -> bytes:
        message = self.message.image()
        if isinstance(message, FileMessage):
            return bytes(message.data)
        return encode_colour(image_of(message, colour=True, where=f"{self.message}"))


@dataclass(frozen=True, slots=True)
class _DepthFile:
    """A depth image as a PNG of 16 bits; see :class:`mapper.sources.base.ImageFile`."""

    message: Located
    units_per_m: float
    suffix: str = ".png"

    def read_bytes(self) -> bytes:
        message = self.message.image()
        file = depth_file_of(message)
        if file is not None:
            return file
        depth_m = depth_m_of(message, units_per_m=self.units_per_m, where=f"{self.message}")
        return encode_depth(depth_m, self.units_per_m)
