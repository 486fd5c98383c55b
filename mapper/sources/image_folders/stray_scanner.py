"""Stray Scanner's exports (iOS): rgb.mp4, depth/ and confidence/ of numbered images, odometry.csv.

Lines of ``odometry.csv`` are ``timestamp, frame, x, y, z, qx, qy, qz, qw``, by later versions also ``fx, fy,
cx, cy``; ``camera_matrix.csv`` has three rows of the matrix of the video's frames. Depth is in
millimetres, in 16-bit PNG, or in arrays of NumPy by the first versions. Frames of the video are decoded on
demand.
"""

import threading
from collections import OrderedDict
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from mapper.core.errors import FrameError, SourceError
from mapper.core.frames import Image
from mapper.core.units import MM_PER_M
from mapper.sources.config import SourceConfig
from mapper.sources.image_files.confidence import confident_depths
from mapper.sources.image_files.decoded import DecodedColour
from mapper.sources.image_folders.posed import PosedFrames, camera_of, median_camera
from mapper.sources.image_folders.rgbd import FramePair
from mapper.sources.listed_files import refuse_links_out
from mapper.sources.text import parse_count, parse_numbers, parse_stamp, pose_from_numbers, rows

_VIDEO = "rgb.mp4"
FILES = (_VIDEO, "odometry.csv", "depth/*")
_COLUMNS = ("timestamp", "frame", "x", "y", "z", "qx", "qy", "qz", "qw")
_INTRINSICS = ("fx", "fy", "cx", "cy")
_KEPT = 12
"""Frames that are kept: threads that read ahead may ask for them in another order."""


def read_frames(folder: Path, config: SourceConfig) -> PosedFrames:
    """Return the frames of an export.

    Raises:
        SourceError: A table or the video is malformed.
    """
    path = folder / "odometry.csv"
    lines = list(rows(path, separator=","))
    header = lines[0][1] if lines else []
    if not set(_COLUMNS) <= set(header):
        raise SourceError(f"{path}: columns {', '.join(header)}; want {', '.join(_COLUMNS)}")
    at = {name: header.index(name) for name in header}
    numbers, stamps_ns, poses, intrinsics = [], [], [], []
    for number, words in lines[1:]:
        where = f"{path}:{number}"
        if len(words) != len(header):
            raise SourceError(f"{where}: {len(words)} columns, want {len(header)}")
        numbers.append(parse_count(words[at["frame"]], where=where))
        stamps_ns.append(parse_stamp(words[at["timestamp"]], where=where))
        poses.append(
            pose_from_numbers(parse_numbers([words[at[name]] for name in _COLUMNS[2:]], where=where))
        )
        if set(_INTRINSICS) <= set(header):
            intrinsics.append(parse_numbers([words[at[name]] for name in _INTRINSICS], where=where))
    matrix = folder / "camera_matrix.csv"
    if not intrinsics and matrix.is_file():
        intrinsics = [_matrix(matrix)]
    stated, notes = median_camera(np.array(intrinsics), origin=path.name) if intrinsics else (None, [])
    camera = camera_of(folder, config, stated)
    names = [f"{number:06}.png" for number in numbers]
    images = [folder / "depth" / name for name in names]
    arrays = [image.with_suffix(".npy") for image in images]
    depths, depth_notes = confident_depths(
        arrays if any(map(Path.is_file, arrays)) else images,
        [folder / "confidence" / name for name in names],
        camera.depth_units_per_m or MM_PER_M,
    )
    refuse_links_out([folder / _VIDEO, *(folder / "confidence" / name for name in names)], log=folder)
    video = Video(folder / _VIDEO)
    pairs = [
        FramePair(stamp_ns, video.frame(number), stamp_ns, depth)
        for stamp_ns, number, depth in zip(stamps_ns, numbers, depths, strict=True)
    ]
    return PosedFrames(pairs, poses, camera, MM_PER_M, [*notes, *depth_notes])


def _matrix(path: Path) -> np.ndarray:
    """Return fx, fy, cx, cy of three rows of three numbers."""
    matrix = [parse_numbers(words, where=f"{path}:{number}") for number, words in rows(path, separator=",")]
    if [len(row) for row in matrix] != [3, 3, 3]:
        raise SourceError(f"{path}: want three rows of three numbers, the camera's matrix")
    K = np.array(matrix)
    return np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2]])


class Video:
    """Video whose frames are counted, for the times of phones' frames are uneven and beside the video.

    To go back means to decode from the start, so frames are best read in order.
    """

    def __init__(self, path: Path) -> None:
        """Open a file.

        Raises:
            SourceError: It is no MPEG-4 or QuickTime file, or cannot be decoded.
        """
        self._path = path
        self._lock = threading.Lock()
        self._kept: OrderedDict[int, Image] = OrderedDict()
        try:
            with path.open("rb") as file:
                head = file.read(12)
        except OSError as error:
            raise SourceError(f"{path}: cannot be read: {error.strerror}") from None
        if head[4:8] != b"ftyp":  # FFmpeg would also follow lists of other files
            raise SourceError(f"{path}: no MPEG-4 video; export the recording again")
        self._restart()
        if not self._capture.isOpened():
            raise SourceError(f"{path}: no video that can be decoded; export the recording again")

    def frame(self, number: int) -> DecodedColour:
        """Return a frame, which is decoded when it is needed; the first has number 0."""
        where = f"{self._path}, frame {number}"
        return DecodedColour(where, partial(self._decode, number, where))

    def _restart(self) -> None:
        self._capture = cv2.VideoCapture(f"{self._path.resolve()}", cv2.CAP_FFMPEG)
        self._capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)  # the camera's matrix is of the frames as stored
        self._next = 0

    def _decode(self, number: int, where: str, in_colour: bool) -> Image:
        with self._lock:
            if number not in self._kept:
                self._read_to(number, where)
            image = self._kept[number]
        return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB if in_colour else cv2.COLOR_BGR2GRAY))

    def _read_to(self, number: int, where: str) -> None:
        if number < self._next:
            self._restart()
        while self._next <= number:
            if not self._capture.grab():
                raise FrameError(f"{where}: the video ends before it, or is damaged")
            if self._next > number - _KEPT:
                is_whole, image = self._capture.retrieve()
                if not is_whole:
                    raise FrameError(f"{where}: cannot be decoded")
                self._kept[self._next] = image
                if len(self._kept) > _KEPT:
                    self._kept.popitem(last=False)
            self._next += 1
