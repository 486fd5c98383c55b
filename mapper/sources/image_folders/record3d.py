"""Record3D's recordings (iOS): .r3d, a ZIP archive of metadata, rgbd/N.jpg, N.depth and N.conf; or unpacked.

``metadata`` is JSON: w, h and K (column by column) of the images, dw, dh of depth, fps or frameTimestamps,
and poses of ARKit's camera as qx qy qz qw x y z. Depth is float32 metres, confidence a byte, both by LZFSE.
"""

import zipfile
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, PositiveFloat, PositiveInt

from mapper.core.errors import FrameError, SourceError
from mapper.core.frames import DepthImage
from mapper.core.timebase import NS_PER_S
from mapper.runtime.extras import extra
from mapper.runtime.regular_files import MOST_BYTES
from mapper.sources.config import SourceConfig
from mapper.sources.image_files.confidence import NOTE, without_low_confidence
from mapper.sources.image_files.decoded import DecodedColour, DecodedDepth
from mapper.sources.image_files.reading import TUM_UNITS_PER_M, bytes_of, decode_colour, decode_grey
from mapper.sources.image_files.size import MOST_MEGAPIXELS
from mapper.sources.image_folders.posed import (
    PosedFrames,
    camera_of,
    median_camera,
    pose_of_opengl,
)
from mapper.sources.image_folders.rgbd import FramePair
from mapper.sources.json_files import parse_json
from mapper.sources.listed_files import refuse_links_out
from mapper.sources.scan_stamps import stamp_at
from mapper.sources.text import poses_from_numbers

FILES = (".r3d", "metadata", "rgbd/*.jpg")
_FPS = 60.0
_BLOCK = b"bvx"
_LEAST_BLOCK_BYTES = 20_000
"""A block but the last has 40 000 bytes or more, and unpacks to 27 MB at most."""
_EXTRA, _PURPOSE = "record3d", "reading Record3D's depth"


class _Metadata(BaseModel):
    w: PositiveInt
    h: PositiveInt
    K: list[float]
    dw: PositiveInt | None = None
    dh: PositiveInt | None = None
    fps: PositiveFloat = _FPS
    frameTimestamps: list[float] | None = None  # noqa: N815
    perFrameIntrinsicCoeffs: list[list[float]] | None = None  # noqa: N815
    poses: list[list[float]] | None = None

    def pixels(self) -> int:
        """Return the largest number of pixels of depth, which is not finer than colour."""
        return min((self.dw or self.w) * (self.dh or self.h), MOST_MEGAPIXELS * 10**6)


class _Members:
    """Files of a recording, by their names within it; safe in any thread."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._archive: zipfile.ZipFile | None = None
        if path.is_dir():
            refuse_links_out([path / "metadata", *path.glob("rgbd/*")], log=path)
            return
        try:
            self._archive = zipfile.ZipFile(path)
        except (OSError, zipfile.BadZipFile, NotImplementedError) as error:
            raise SourceError(f"{path}: no Record3D recording: {error}") from None

    def names(self) -> list[str]:
        if self._archive is not None:
            return self._archive.namelist()
        return [path.relative_to(self._path).as_posix() for path in self._path.glob("rgbd/*")]

    def read(self, name: str) -> bytes:
        if self._archive is None:
            return bytes_of(self._path / name)
        try:
            if (size := self._archive.getinfo(name).file_size) > MOST_BYTES:
                raise FrameError(f"{self._path}: {name} has {size} bytes; {MOST_BYTES} are read at most")
            return self._archive.read(name)
        except (OSError, KeyError, zipfile.BadZipFile, RuntimeError, ValueError, EOFError) as error:
            raise FrameError(f"{self._path}: {name} cannot be read: {error}") from None


def read_frames(path: Path, config: SourceConfig) -> PosedFrames:
    """Return the frames of a recording.

    Raises:
        SourceError: It is no such archive, or its metadata are malformed.
        DependencyError: The library that unpacks depth is not installed.
    """
    with extra(_EXTRA, _PURPOSE):
        import lzfse  # noqa: F401
    members = _Members(path)
    where = f"{path}: metadata"
    metadata = parse_json(members.read("metadata").decode(errors="replace"), _Metadata, where=where)
    if len(metadata.K) != 9:
        raise SourceError(f"{where}: K has {len(metadata.K)} numbers, want 9")
    K = metadata.K
    stated, notes = median_camera(
        metadata.perFrameIntrinsicCoeffs or [[K[0], K[4], K[6], K[7]]],
        origin="metadata",
        size_px=(metadata.w, metadata.h),
    )
    names = set(members.names())
    numbers = sorted(
        int(name[5:-4])
        for name in names
        if name.startswith("rgbd/") and name.endswith(".jpg") and name[5:-4].isdecimal()
    )
    has_confidence = any(name.endswith(".conf") for name in names)
    with_depth = [number for number in numbers if f"rgbd/{number}.depth" in names]
    pairs = [
        FramePair(
            (stamp_ns := _stamp_ns(metadata, number)),
            _colour(members, path, f"rgbd/{number}.jpg"),
            stamp_ns,
            _depth(members, path, f"rgbd/{number}", metadata, f"rgbd/{number}.conf" in names),
        )
        for number in with_depth
    ]
    if len(pairs) < len(numbers):
        notes.append(f"{len(numbers) - len(pairs)} of {len(numbers)} frames have no depth; left out")
    if metadata.frameTimestamps is None:
        notes.append(f"metadata has no times of frames; its rate of {metadata.fps:g} a second is taken")
    return PosedFrames(
        pairs,
        [_pose(metadata, number) for number in with_depth],
        camera_of(path, config, stated),
        TUM_UNITS_PER_M,
        [*notes, *([NOTE] if has_confidence else [])],
    )


def _stamp_ns(metadata: _Metadata, number: int) -> int:
    stamps = metadata.frameTimestamps
    if stamps is None or number >= len(stamps):
        return stamp_at(number, rate_hz=metadata.fps)
    return round(stamps[number] * NS_PER_S)


def _pose(metadata: _Metadata, number: int) -> NDArray[np.float64] | None:
    poses = metadata.poses or []
    if number >= len(poses) or len(poses[number]) != 7:
        return None
    qx, qy, qz, qw, *position = poses[number]
    T = poses_from_numbers(np.array([[*position, qx, qy, qz, qw]], np.float64))[0]
    return None if T is None else pose_of_opengl(T)


def _colour(members: _Members, path: Path, name: str) -> DecodedColour:
    where = f"{path}: {name}"
    file: Callable[[], bytes] = partial(members.read, name)
    return DecodedColour(
        where, lambda in_colour: (decode_colour if in_colour else decode_grey)(file(), where), file, ".jpg"
    )


def _depth(members: _Members, path: Path, stem: str, metadata: _Metadata, is_confident: bool) -> DecodedDepth:
    where = f"{path}: {stem}.depth"

    def decode() -> DepthImage:
        most = metadata.pixels()
        numbers = np.frombuffer(_unpack(members.read(f"{stem}.depth"), where, most_bytes=4 * most), np.uint8)
        shape = _shape(metadata, len(numbers) // 4)
        if shape is None or len(numbers) != 4 * shape[0] * shape[1]:
            raise FrameError(f"{where}: {len(numbers)} bytes are no image of 32-bit depth of the stated size")
        depth_m: DepthImage = np.nan_to_num(
            numbers.view("<f4").reshape(shape), nan=0.0, posinf=0.0, neginf=0.0
        )
        if is_confident:
            levels = np.frombuffer(_unpack(members.read(f"{stem}.conf"), where, most_bytes=most), np.uint8)
            if len(levels) != depth_m.size:
                raise FrameError(f"{where}: {len(levels)} bytes of confidence for {depth_m.size} pixels")
            depth_m = without_low_confidence(depth_m, levels.reshape(shape), where)
        return depth_m

    return DecodedDepth(where, decode, TUM_UNITS_PER_M)


def _unpack(data: bytes, where: str, *, most_bytes: int) -> bytes:
    """Return what LZFSE packed; its library has no limit, so the number of blocks is limited."""
    import lzfse

    if data.count(_BLOCK) > 2 + most_bytes // _LEAST_BLOCK_BYTES:
        raise FrameError(f"{where}: unpacks to more than the {most_bytes} bytes of an image")
    try:
        return bytes(lzfse.decompress(data))
    except (lzfse.error, ValueError, MemoryError) as error:
        raise FrameError(f"{where}: cannot be unpacked: {error}") from None


def _shape(metadata: _Metadata, pixels: int) -> tuple[int, int] | None:
    """Return rows and columns of depth: stated, or those of a number of pixels with the images' aspect."""
    if metadata.dw and metadata.dh:
        return metadata.dh, metadata.dw
    columns = round((pixels * metadata.w / metadata.h) ** 0.5)
    return (pixels // columns, columns) if columns and pixels % columns == 0 else None
