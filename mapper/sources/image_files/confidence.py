"""Confidence images of phones and tablets beside their depth images."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from mapper.core.errors import FrameError
from mapper.core.frames import DepthImage
from mapper.sources.base import ImageFile
from mapper.sources.image_files.decoded import DecodedDepth
from mapper.sources.image_files.reading import ARRAYS, read_array_m, read_depth_m, read_grey
from mapper.sources.listed_files import present

NOTE = "depth of low confidence is left out"


def confident_depths(
    depths: Sequence[Path], confidences: Sequence[Path], units_per_m: float
) -> tuple[Sequence[ImageFile], list[str]]:
    """Return depth images without depth of low confidence, where they have a confidence image, and a note.

    ARKit's confidence is 0 (low), 1 or 2; Polycam stores it as 0, 127, 255.

    Args:
        depths: 16-bit depth images, or arrays.
        confidences: 8-bit images for each, which may not exist.
        units_per_m: Units of depth per metre.
    """
    have = [a and b for a, b in zip(present(depths), present(confidences), strict=True)]
    kept: list[ImageFile] = [
        DecodedDepth(depth, partial(_read, depth, confidence, units_per_m), units_per_m)
        if is_there
        else depth
        for depth, confidence, is_there in zip(depths, confidences, have, strict=True)
    ]
    return kept, [NOTE] if any(have) else []


def without_low_confidence(depth_m: DepthImage, confidence: NDArray[np.uint8], where: str) -> DepthImage:
    """Return depth that is 0 where the confidence is, whose image may be of another size.

    Raises:
        FrameError: There is no confidence.
    """
    if not confidence.size:
        raise FrameError(f"{where}: no confidence in it")
    if confidence.shape != depth_m.shape:
        confidence = cv2.resize(confidence, depth_m.shape[::-1], interpolation=cv2.INTER_NEAREST_EXACT)
    return np.where(confidence > 0, depth_m, np.float32(0.0))


def _read(depth: Path, confidence: Path, units_per_m: float) -> DepthImage:
    is_array = depth.suffix in ARRAYS
    depth_m = read_array_m(depth, units_per_m, units_per_m) if is_array else read_depth_m(depth, units_per_m)
    return without_low_confidence(depth_m, read_grey(confidence), f"{confidence}")
