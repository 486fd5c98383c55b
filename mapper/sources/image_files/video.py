"""Frames of a video file, decoded by OpenCV in the order in which they were taken."""

import threading
from collections import OrderedDict
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from mapper.core.errors import FrameError, SourceError
from mapper.core.frames import Image
from mapper.sources.image_files.decoded import DecodedColour

_KEPT = 12
"""Frames that are kept: threads that read ahead may ask for them in another order."""


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
