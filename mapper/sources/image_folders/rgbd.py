"""RGB-D logs made of image files: their frames, their camera and their accelerometer."""

import math
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from mapper.core.errors import FrameError, SourceError, listed
from mapper.core.frames import DepthImage, Image, RgbdFrame, Scan
from mapper.core.timebase import NS_PER_S
from mapper.core.trajectory import Trajectory
from mapper.sources.base import FrameRef, ImageFile, ImageFiles, Log
from mapper.sources.calibration import (
    PRIMESENSE,
    Calibration,
    DepthCamera,
    configured,
    configured_depth_intrinsics,
    configured_depth_pose,
)
from mapper.sources.calibration_file import calibration_files, read_calibration
from mapper.sources.config import CameraConfig
from mapper.sources.depth_camera_pose import with_depth_pose
from mapper.sources.image_files import exr
from mapper.sources.image_files.decoded import DecodedColour, DecodedDepth
from mapper.sources.image_files.image_sizes import RecordedCamera, Size, recorded_camera
from mapper.sources.image_files.reading import (
    ARRAYS,
    TUM_UNITS_PER_M,
    has_floats,
    read_array_m,
    read_colour,
    read_depth_m,
    read_grey,
)
from mapper.sources.imu_files import read_accelerometer
from mapper.sources.listed_files import refuse_links_out

_MIRROR_Y = np.diag([1.0, -1.0, 1.0, 1.0])


@dataclass(frozen=True, slots=True)
class RgbdImages:
    """Colour and depth image of a log, not read yet; the body is the camera.

    Attributes:
        stamp_ns: Time of the colour image, nanoseconds.
        depth_stamp_ns: Time of the depth image, nanoseconds.
        encoded: Both images as they are encoded.
        recorded: Camera of the frame, and the sizes of both images as recorded.
    """

    stamp_ns: int
    depth_stamp_ns: int
    encoded: ImageFiles
    recorded: RecordedCamera

    def entry(self) -> FrameRef:
        """Return the frame; without the encoded images where they show other views than it."""
        files = self.encoded if self.recorded.shows_recorded_views else None
        delay_ns = self.depth_stamp_ns - self.stamp_ns
        return FrameRef(self.stamp_ns, self.load, self.scan, depth_delay_ns=delay_ns, files=files)

    def load(self, colour: bool) -> RgbdFrame:
        """Read and decode both images, or the brightness alone and the depth image.

        Raises:
            FrameError: An image is missing, damaged, of the wrong kind or not as large as the log's first.
        """
        read_image = read_colour if colour else read_grey
        image = self.recorded.image(read_image(self.encoded.colour), f"{self.encoded.colour}")
        return RgbdFrame(
            self.stamp_ns,
            image,
            self.recorded.depth_m(self._depth_m(), f"{self.encoded.depth}"),
            self.recorded.camera,
            depth_delay_s=(self.depth_stamp_ns - self.stamp_ns) / NS_PER_S,
            is_depth_moved=self.recorded.registration is not None,
        )

    def scan(self) -> Scan:
        """Read and decode the depth image alone.

        Raises:
            FrameError: As ``load``.
        """
        return self.recorded.scan(self._depth_m(), f"{self.encoded.depth}", stamp_ns=self.stamp_ns)

    def pair(self) -> tuple[Image, DepthImage]:
        """Read the brightness, as the camera sees it, and the depth image as recorded.

        Raises:
            FrameError: As ``load``.
        """
        grey = self.recorded.image(read_grey(self.encoded.colour), f"{self.encoded.colour}")
        return grey, self._depth_m()

    def _depth_m(self) -> DepthImage:
        return read_depth_m(self.encoded.depth, self.encoded.depth_units_per_m)


@dataclass(frozen=True, slots=True)
class FramePair:
    """Stamps and files of one frame, before the log's camera is known."""

    stamp_ns: int
    colour: ImageFile
    depth_stamp_ns: int
    depth: ImageFile


def rgbd_log(
    pairs: Sequence[FramePair],
    calibration: Calibration,
    *,
    depth_units_per_m: float,
    path: Path,
    name: str,
    kind: str,
    truth: tuple[Trajectory | None, Iterable[str]],
    notes: Iterable[str],
) -> Log:
    """Return the log of some image files, with the readings of an accelerometer where there are any.

    Args:
        pairs: Its frames, in strictly increasing time.
        calibration: Intrinsics of all of them; the first images that can be read give their sizes. With
            fy < 0 the truth is in left-handed frames, whose y points up: both are mirrored, not the images.
        depth_units_per_m: The format's own depth image units per metre, where the calibration states none.
        path: Folder that was opened, or a file in the folder of the log.
        name: Name, as of :class:`Log`.
        kind: Format, as of :class:`Log`.
        truth: True poses, as of :class:`Log`, and notes on them.
        notes: Sentences on what finding all these left out or assumed.

    Raises:
        SourceError: No colour image can be read, they are not of the calibration's size, depth shows another
            view by its aspect ratio, an image is a link out of the log, or a line of ``accelerometer.txt`` is
            malformed.
    """
    poses, truth_notes = truth
    notes = [*notes, *truth_notes]
    if calibration.fy_px < 0.0:
        calibration = calibration.with_y_down()
        if poses is not None:
            poses = replace(poses, T_world_body=_MIRROR_Y @ poses.T_world_body @ _MIRROR_Y)
            notes.append("fy < 0: the camera's y axis points up; y of camera and truth is mirrored")
    folder = path if path.is_dir() else path.parent
    images = (image for pair in pairs for image in (pair.colour, pair.depth))
    files = (image.where if isinstance(image, DecodedColour | DecodedDepth) else image for image in images)
    refuse_links_out((file for file in files if isinstance(file, Path)), log=folder)
    units_per_m = calibration.depth_units_per_m or depth_units_per_m
    float_units_per_m = calibration.depth_units_per_m or 1.0
    array = next((pair.depth for pair in pairs if pair.depth.suffix in ARRAYS), None)
    if array is not None and array.suffix == ".exr":
        exr.require_decoder()
    recorded_units_per_m = (float_units_per_m if has_floats(array) else units_per_m) if array else None
    pairs = [_with_array(pair, units_per_m, float_units_per_m) for pair in pairs]
    accelerations, acceleration_notes = read_accelerometer(folder)

    def images_of(camera: RecordedCamera, index: int) -> RgbdImages:
        pair = pairs[index]
        files = ImageFiles(
            pair.colour,
            pair.depth,
            pair.depth.units_per_m if isinstance(pair.depth, DecodedDepth) else units_per_m,
            colour_px=camera.colour_px,
            depth_px=camera.depth_px,
            recorded_units_per_m=recorded_units_per_m,
        )
        return RgbdImages(pair.stamp_ns, pair.depth_stamp_ns, files, camera)

    camera = _camera_of(pairs, calibration, depth_units_per_m=units_per_m, path=path)
    if calibration.needs_depth_pose:
        unplaced = partial(images_of, camera)
        calibration = with_depth_pose(
            calibration, camera, lambda index: unplaced(index).pair(), len(pairs), where=f"{path}"
        )
        camera = _camera_of(pairs, calibration, depth_units_per_m=units_per_m, path=path)
    return Log(
        path=path,
        name=name,
        kind=kind,
        sensor="rgbd",
        stamps_ns=np.array([pair.stamp_ns for pair in pairs], dtype=np.int64),
        entry_at=lambda index: images_of(camera, index).entry(),
        truth=poses,
        accelerations=accelerations,
        notes=[*notes, *camera.notes(), *calibration.notes(), *acceleration_notes],
    )


def _with_array(pair: FramePair, units_per_m: float, float_units_per_m: float) -> FramePair:
    """Return a pair whose depth is decoded if it may be floats: whole numbers as in an image, else metres."""
    if pair.depth.suffix not in ARRAYS:
        return pair
    decode = partial(read_array_m, pair.depth, units_per_m, float_units_per_m)
    return replace(pair, depth=DecodedDepth(pair.depth, decode, TUM_UNITS_PER_M))


def find_calibration(folder: Path, config: CameraConfig | None, *, known: Calibration | None) -> Calibration:
    """Return a log's intrinsics: the user's, else a file's, else the known camera's.

    The calibration has depth units only where the user or a file states them.

    Args:
        folder: Folder that may hold a calibration file.
        config: The user's settings of the camera.
        known: The camera that the log's format or name implies.

    Raises:
        SourceError: None of the three exists, the file is malformed, or several of unknown names would stand
            against a camera that is only assumed.
    """
    files, first_counts = calibration_files(folder)
    names = tuple(path.name for path in files)
    if known is PRIMESENSE and not first_counts and len(files) > 1:
        known = None
    stated = read_calibration(files[0]) if first_counts else known
    units_per_m = None if stated is None else stated.depth_units_per_m
    depth = depth_camera(None if stated is None else stated.depth, config)
    if config is not None:
        units_per_m = config.depth_factor or units_per_m
    if chosen := configured(config):
        if stated is not None:  # the sign is the convention of the log's truth
            chosen = replace(chosen, fy_px=math.copysign(chosen.fy_px, stated.fy_px))
        stated = chosen
    if stated is None:
        found = f": {listed(names)} state some; name one camera.yaml or intrinsic.json" if names else ""
        raise SourceError(
            f"{folder}: intrinsics unknown{found}; put a calibration.toml with fx_px, fy_px, cx_px and "
            "cy_px there, or --set source.camera.fx_px=… and so on"
        )
    return replace(stated, depth_units_per_m=units_per_m, depth=depth, unread=names[first_counts:])


def depth_camera(stated: DepthCamera | None, config: CameraConfig | None) -> DepthCamera | None:
    """Return the depth camera that is not colour's: the user's numbers before those of a file.

    Raises:
        SourceError: Its intrinsics are unknown.
    """
    intrinsics, T_color_depth = configured_depth_intrinsics(config), configured_depth_pose(config)
    if intrinsics is None and T_color_depth is None:
        return stated
    tangents = None
    if stated is not None:
        tangents = stated.tangents if intrinsics is None else None
        intrinsics = intrinsics or stated.calibration
        T_color_depth = stated.T_color_depth if T_color_depth is None else T_color_depth
    if intrinsics is None:
        raise SourceError("source.camera: want depth_intrinsics_px too: the log's files do not state them")
    is_known = T_color_depth is not None
    origin = "source.camera" if is_known else "depth has its own camera (source.camera.depth_intrinsics_px)"
    return DepthCamera(intrinsics, T_color_depth, origin, tangents)


def assumed_camera_note(camera: Calibration) -> str:
    """Return the note on a log whose camera is taken to be that of its format."""
    return f"camera assumed to be the {camera.origin}; if not, put a calibration.toml beside the log"


def _camera_of(
    pairs: Sequence[FramePair], calibration: Calibration, *, depth_units_per_m: float, path: Path
) -> RecordedCamera:
    colour_px = depth_px = first_size([pair.colour for pair in pairs], read_grey, where=f"{path}")
    with suppress(SourceError):  # each frame says why it has no depth
        depths = [pair.depth for pair in pairs]
        depth_px = first_size(depths, lambda file: read_depth_m(file, depth_units_per_m), where=f"{path}")
    return recorded_camera(calibration, colour_px=colour_px, depth_px=depth_px, where=f"{path}")


def first_size(
    files: Sequence[ImageFile], read: Callable[[ImageFile], Image | DepthImage], *, where: str
) -> Size:
    """Return width and height of the first image that can be read.

    Raises:
        SourceError: None can; the message begins with ``where``.
    """
    first_reason = ""
    for file in files:
        try:
            height_px, width_px = read(file).shape
        except FrameError as error:
            first_reason = first_reason or str(error)
        else:
            return width_px, height_px
    raise SourceError(f"{where}: none of {len(files)} images can be read; the first: {first_reason}")


def unpaired_note(
    alone: int, total: int, *, max_gap_s: float, names: tuple[str, str] = ("colour", "depth")
) -> list[str]:
    """Return a note on images without one of the other kind near in time, if there are any."""
    if not alone:
        return []
    left_out = "left out"
    if 2 * alone > total:
        left_out = "more than half of the log is left out (source.max_pair_gap_s)"
    one, other = names
    return [
        f"{alone} of {total} {one} images have no {other} image within {max_gap_s * 1e3:g} ms; {left_out}"
    ]
