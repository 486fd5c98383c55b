"""Azure Kinect's recordings (.mkv): colour, depth of its own camera, both cameras' calibration, and the IMU.

https://learn.microsoft.com/azure/kinect-dk/record-file-format: tracks COLOR (JPEG, NV12 or YUY2), DEPTH (big
endian millimetres) and IMU, and ``calibration.json``, whose intrinsics are shares of the whole sensor's size.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from pydantic import BaseModel, Field, FiniteFloat, PositiveInt

from mapper.core.errors import FrameError, SourceError
from mapper.core.frames import DepthImage, Image
from mapper.core.geometry import Transform, inverse, nearest_rotation, transform
from mapper.core.units import MM_PER_M
from mapper.sources.base import ImageFile, Log
from mapper.sources.calibration import Calibration, DepthCamera
from mapper.sources.config import SourceConfig
from mapper.sources.image_files.decoded import DecodedColour, DecodedDepth, FilePart
from mapper.sources.image_files.matroska import MAGIC, Track, read_matroska
from mapper.sources.image_files.reading import bytes_of, depth_m_from
from mapper.sources.image_files.size import MOST_MEGAPIXELS
from mapper.sources.image_folders.pairing import ImageList, pair_images
from mapper.sources.image_folders.posed import camera_of
from mapper.sources.image_folders.rgbd import rgbd_log
from mapper.sources.imu_files import accelerations_of, gyroscope_of
from mapper.sources.json_files import parse_json
from mapper.sources.lens import Lens

_COLOUR, _DEPTH = "CALIBRATION_CameraPurposePhotoVideo", "CALIBRATION_CameraPurposeDepth"
_DEPTH_MODES = {
    (320, 288): (512, 96, 90),
    (640, 576): (1024, 192, 180),
    (512, 512): (512, 0, 0),
    (1024, 1024): (1024, 0, 0),
}
"""Side of the whole sensor in a mode's pixels, and first column and row of its part, by the images' size."""
_CODEC = slice(16, 20)  # of a BITMAPINFOHEADER
_JPEG, _DEPTH_CODEC = b"MJPG", b"b16g"
_RAW = {b"NV12": (cv2.COLOR_YUV2RGB_NV12, 1.5), b"YUY2": (cv2.COLOR_YUV2RGB_YUY2, 2.0)}
"""Conversions to colour, and bytes a pixel."""
_SAMPLE = np.dtype([("at_ns", "<u8"), ("mps2", "<f4", 3), ("turned_at_ns", "<u8"), ("radps", "<f4", 3)])


class _Intrinsics(BaseModel):
    model: str = Field(alias="ModelType")
    parameters: list[FiniteFloat] = Field(alias="ModelParameters", min_length=14)


class _Place(BaseModel):
    R: list[FiniteFloat] = Field(alias="Rotation", min_length=9, max_length=9)
    t: list[FiniteFloat] = Field(alias="Translation", min_length=3, max_length=3)


class _Camera(BaseModel):
    purpose: str = Field(alias="Purpose")
    intrinsics: _Intrinsics = Field(alias="Intrinsics")
    place: _Place = Field(alias="Rt")
    width_px: PositiveInt = Field(alias="SensorWidth")
    height_px: PositiveInt = Field(alias="SensorHeight")

    @property
    def device_pose(self) -> Transform:
        """(4, 4) T_camera_device; the device is the depth camera."""
        R = nearest_rotation(np.array(self.place.R, np.float64).reshape(3, 3))
        return transform(R, np.array(self.place.t, np.float64))

    def calibration(
        self, where: str, whole_px: tuple[int, int], first_px: tuple[float, float]
    ) -> Calibration:
        """Return the intrinsics of a part of the sensor, whose pixel centres are whole numbers."""
        if "BrownConrady" not in self.intrinsics.model and "Rational6KT" not in self.intrinsics.model:
            raise SourceError(
                f"{where}: lens model {self.intrinsics.model}; want Brown-Conrady's or Rational6KT"
            )
        cx, cy, fx, fy, k1, k2, k3, k4, k5, k6, _, _, p2, p1 = self.intrinsics.parameters[:14]
        (width, height), (column, row) = whole_px, first_px
        lens = Lens("rational_polynomial", (k1, k2, p1, p2, k3, k4, k5, k6))
        centre = cx * width - column - 0.5, cy * height - row - 0.5
        return Calibration(where, fx * width, fy * height, *centre, lens=lens)


class _Cameras(BaseModel):
    cameras: list[_Camera] = Field(alias="Cameras")


class _Calibration(BaseModel):
    information: _Cameras = Field(alias="CalibrationInformation")


def recognise(path: Path) -> bool:
    """Return whether a path is a Matroska file."""
    if path.suffix.lower() != ".mkv" or not path.is_file():
        return False
    with path.open("rb") as file:
        return file.read(len(MAGIC)) == MAGIC


def read_log(path: Path, config: SourceConfig) -> Log:
    """Return the log of a recording.

    Raises:
        SourceError: It has no colour, no depth or no calibration, is of an unknown mode, or no images pair.
    """
    found = read_matroska(path)
    tracks = {name.upper(): track for name, track in found.tracks.items()}
    colour, depth = tracks.get("COLOR", Track()), tracks.get("DEPTH", Track())
    for name, track in (("COLOR", colour), ("DEPTH", depth)):
        if not track.images:
            raise SourceError(
                f"{path}: no images in a track {name}; want an Azure Kinect's recording of both"
            )
    stated = _calibration(found.attachments.get("calibration.json"), colour, depth, f"{path}")
    units_per_m = (config.camera and config.camera.depth_factor) or MM_PER_M
    pairs, notes = pair_images(
        _ordered(colour, [_colour(colour, part) for part in colour.images]),
        _ordered(depth, [_depth(depth, part, units_per_m) for part in depth.images]),
        config,
        path=path,
    )
    if found.is_cut_off:
        notes.append(f"{path.name}: cut off; what is whole is read")
    log = rgbd_log(
        pairs,
        camera_of(path, config, stated),
        depth_units_per_m=units_per_m,
        path=path,
        name=path.resolve().stem,
        kind="azure-kinect",
        truth=(None, []),
        notes=notes,
    )
    return _with_imu(log, tracks.get("IMU", Track()))


def _calibration(data: bytes | None, colour: Track, depth: Track, where: str) -> Calibration:
    if data is None:
        raise SourceError(f"{where}: no calibration.json attached to it; want an Azure Kinect's recording")
    where = f"{where}: calibration.json"
    stated = parse_json(data.decode(errors="replace"), _Calibration, where=where).information.cameras
    cameras = {camera.purpose: camera for camera in stated}
    if missing := {_COLOUR, _DEPTH} - cameras.keys():
        raise SourceError(f"{where}: no camera {min(missing)}")
    if (depth.width_px, depth.height_px) not in _DEPTH_MODES:
        raise SourceError(
            f"{where}: depth of {depth.width_px}×{depth.height_px} px is of no mode of the sensor"
        )
    side_px, column, row = _DEPTH_MODES[depth.width_px, depth.height_px]
    of_depth = cameras[_DEPTH].calibration(where, (side_px, side_px), (column, row))
    whole = cameras[_COLOUR]
    whole_height_px = colour.width_px * whole.height_px // whole.width_px
    top_px = (whole_height_px - colour.height_px) / 2  # of modes of another ratio rows are cut off
    camera = whole.calibration(where, (colour.width_px, whole_height_px), (0, top_px))
    T_color_depth = whole.device_pose @ inverse(cameras[_DEPTH].device_pose)
    return replace(camera, depth=DepthCamera(of_depth, T_color_depth, "calibration.json"))


def _ordered(track: Track, images: Sequence[ImageFile]) -> ImageList:
    stamps_ns, first = np.unique(track.stamps_ns, return_index=True)
    return ImageList(stamps_ns.astype(np.int64), [images[i] for i in first])


def _colour(track: Track, part: FilePart) -> ImageFile:
    codec = track.codec_private[_CODEC]
    if codec == _JPEG:
        return replace(part, suffix=".jpg")
    if codec not in _RAW:
        raise SourceError(f"{part}: colour of codec {codec!r}; want MJPG, NV12 or YUY2")
    return DecodedColour(part, partial(_raw_colour, part, (track.width_px, track.height_px), codec))


def _raw_colour(part: FilePart, size_px: tuple[int, int], codec: bytes, is_colour: bool) -> Image:
    conversion, bytes_per_px = _RAW[codec]
    (width_px, height_px), data = size_px, _pixels(part, size_px, bytes_per_px)
    rows = (height_px * 3 // 2, width_px) if codec == b"NV12" else (height_px, width_px, 2)
    rgb = cv2.cvtColor(data.reshape(rows), conversion)
    return np.asarray(rgb if is_colour else cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), np.uint8)


def _depth(track: Track, part: FilePart, units_per_m: float) -> DecodedDepth:
    if (codec := track.codec_private[_CODEC]) != _DEPTH_CODEC:
        raise SourceError(f"{part}: depth of codec {codec!r}; want {_DEPTH_CODEC!r}")
    decode = partial(_depth_m, part, (track.width_px, track.height_px), units_per_m)
    return DecodedDepth(part, decode, units_per_m)


def _depth_m(part: FilePart, size_px: tuple[int, int], units_per_m: float) -> DepthImage:
    units = _pixels(part, size_px, 2.0).view(">u2").astype(np.uint16)
    return depth_m_from(units.reshape(size_px[1], size_px[0]), units_per_m)


def _pixels(part: FilePart, size_px: tuple[int, int], bytes_per_px: float) -> Image:
    """Return the bytes of an image that is not compressed."""
    pixels = size_px[0] * size_px[1]
    if part.size != bytes_per_px * pixels or pixels > MOST_MEGAPIXELS * 10**6:
        raise FrameError(f"{part}: {part.size} bytes are no image of {size_px[0]}×{size_px[1]} px")
    return np.frombuffer(bytes_of(part), np.uint8)


def _with_imu(log: Log, track: Track) -> Log:
    """Return the log with the readings of a track's samples, one in each block."""
    whole = [i for i, sample in enumerate(track.samples) if len(sample) == _SAMPLE.itemsize]
    if not whole:
        return log
    samples = np.frombuffer(b"".join(track.samples[i] for i in whole), _SAMPLE)
    stamps_ns = np.array(track.stamps_ns, np.int64)[whole]
    later_ns = (samples["turned_at_ns"] - samples["at_ns"]).astype(np.int64)
    rates = samples["radps"].astype(np.float64)
    gyroscope, notes = gyroscope_of(f"{log.path.name}, IMU", stamps_ns + later_ns, rates)
    measured = samples["mps2"].astype(np.float64)
    accelerations, more = accelerations_of(f"{log.path.name}, IMU", stamps_ns, measured)
    notes = list(dict.fromkeys([*log.notes, *notes, *more]))
    return replace(log, gyroscope=gyroscope, accelerations=accelerations, notes=notes)
