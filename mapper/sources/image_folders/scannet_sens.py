"""ScanNet's .sens files (Dai et al. 2017), version 4: a header, then pose, stamps and images of each frame.

https://github.com/ScanNet/ScanNet/tree/master/SensReader
"""

import zlib
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import BinaryIO

import numpy as np

from mapper.core.errors import FrameError, SourceError
from mapper.core.frames import DepthImage
from mapper.core.timebase import LATEST_NS
from mapper.core.units import MM_PER_M
from mapper.runtime.regular_files import MOST_BYTES
from mapper.sources.calibration import Calibration
from mapper.sources.config import SourceConfig
from mapper.sources.image_files.decoded import DecodedDepth, FilePart
from mapper.sources.image_files.reading import depth_m_from
from mapper.sources.image_folders.numbered import RATE_HZ
from mapper.sources.image_folders.posed import PosedFrames, camera_of
from mapper.sources.image_folders.rgbd import FramePair
from mapper.sources.listed_files import only_one, refuse_links_out
from mapper.sources.scan_stamps import stamp_at
from mapper.sources.text import pose_from_matrix

FILES = (".sens", "*.sens")
_VERSION = 4
_MOST_NAME_BYTES = 1000
_CAMERAS = [
    (f"{what}_{of}", "<f4", (4, 4)) for of in ("color", "depth") for what in ("intrinsic", "extrinsic")
]
_HEADER = np.dtype(
    [
        *_CAMERAS,
        *[("color_compression", "<i4"), ("depth_compression", "<i4")],
        *[("color_px", "<u4", 2), ("depth_px", "<u4", 2), ("depth_shift", "<f4"), ("frames", "<u8")],
    ]
)
_FRAME = np.dtype([("pose", "<f4", (4, 4)), ("stamps_us", "<u8", 2), ("bytes", "<u8", 2)])
_COLOUR_ENDINGS = {1: ".png", 2: ".jpg"}
_RAW, _ZLIB = 0, 1


def read_frames(path: Path, config: SourceConfig) -> PosedFrames:
    """Return the frames of a file, or of the only one in a folder.

    Raises:
        SourceError: There are several files, or it is of another version or damaged.
    """
    if path.is_dir():
        files = sorted(filter(Path.is_file, path.glob("*.sens")))
        refuse_links_out(files, log=path)
        path = only_one(path, files, ".sens files")
    try:
        with path.open("rb") as file:
            return _read(file, path, config)
    except OSError as error:
        raise SourceError(f"{path}: cannot be read: {error.strerror}") from None


def _read(file: BinaryIO, path: Path, config: SourceConfig) -> PosedFrames:
    version, name_bytes = np.frombuffer(file.read(12).ljust(12, b"\0"), "<u4,<u8")[0].tolist()
    if version != _VERSION or name_bytes > _MOST_NAME_BYTES:
        raise SourceError(f"{path}: no .sens file of version {_VERSION}: it begins with {version}")
    file.read(name_bytes)
    if len(data := file.read(_HEADER.itemsize)) < _HEADER.itemsize:
        raise SourceError(f"{path}: ends within its header")
    header = np.frombuffer(data, _HEADER)[0]
    suffix = _COLOUR_ENDINGS.get(int(header["color_compression"]))
    depth_compression = int(header["depth_compression"])
    if suffix is None or depth_compression not in (_RAW, _ZLIB):
        raise SourceError(
            f"{path}: colour compressed by method {header['color_compression']} and depth by "
            f"{depth_compression}; read are PNG (1) and JPEG (2), and raw (0) and zlib (1)"
        )
    (fx, _, cx, _), (_, fy, cy, _) = header["intrinsic_color"][:2].tolist()
    width_px, height_px = header["color_px"].tolist()
    stated = Calibration(path.name, fx, fy, cx, cy, size_px=(width_px, height_px))
    shift = float(header["depth_shift"])
    camera = camera_of(path, config, stated)
    units_per_m = camera.depth_units_per_m or (shift if shift > 0.0 else MM_PER_M)
    pairs: list[FramePair] = []
    poses = []
    notes: list[str] = []
    count, size = int(header["frames"]), path.stat().st_size
    depth_px = tuple(header["depth_px"].tolist())
    stamps_us = []
    while len(pairs) < count:
        data = file.read(_FRAME.itemsize)
        record = np.frombuffer(data, _FRAME)[0] if len(data) == _FRAME.itemsize else None
        start = file.tell()
        colour_bytes, depth_bytes = (0, size) if record is None else record["bytes"].tolist()
        if (
            record is None
            or colour_bytes == 0  # zeros: a file system's hole may have terabytes of them
            or start + colour_bytes + depth_bytes > size
            or max(colour_bytes, depth_bytes) > MOST_BYTES
            or record["stamps_us"][0] > LATEST_NS // 1000  # damaged
        ):
            notes.append(f"{path.name}: cut off after {len(pairs)} of {count} frames")
            break
        stamps_us.append(int(record["stamps_us"][0]))
        stamp_ns = 1000 * stamps_us[-1]
        part = FilePart(path, start + colour_bytes, depth_bytes, ".png")
        decode = partial(depth_m_of_part, part, depth_px, depth_compression == _ZLIB, units_per_m)
        colour = FilePart(path, start, colour_bytes, suffix)
        pairs.append(FramePair(stamp_ns, colour, stamp_ns, DecodedDepth(part, decode, units_per_m)))
        poses.append(pose_from_matrix(record["pose"]))
        file.seek(start + colour_bytes + depth_bytes)
    if len(set(stamps_us)) < len(stamps_us):
        rate_hz = config.rate_hz or RATE_HZ
        notes.append(
            f"{path.name} has no times of frames; {rate_hz:g} frames a second assumed (source.rate_hz)"
        )
        for number, pair in enumerate(pairs):
            stamp_ns = stamp_at(number, rate_hz=rate_hz)
            pairs[number] = replace(pair, stamp_ns=stamp_ns, depth_stamp_ns=stamp_ns)
    return PosedFrames(pairs, poses, camera, units_per_m, notes)


def depth_m_of_part(
    part: FilePart, size_px: tuple[int, int], is_packed: bool, units_per_m: float
) -> DepthImage:
    """Return (H, W) depth of raw or packed 16-bit units.

    Raises:
        FrameError: They are not as many pixels, or cannot be read.
    """
    width_px, height_px = size_px
    try:
        data = part.read_bytes()
        if is_packed:
            data = zlib.decompressobj().decompress(data, 2 * width_px * height_px + 1)
        return depth_m_from(np.frombuffer(data, "<u2").reshape(height_px, width_px), units_per_m)
    except OSError as error:
        raise FrameError(f"{part}: cannot be read: {error.strerror}") from None
    except (ValueError, zlib.error) as error:
        raise FrameError(f"{part}: no depth image of {width_px}×{height_px} px: {error}") from None
