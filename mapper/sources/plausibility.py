"""Plausibility of a log before it is tracked: its stamps, its depth, and its scans."""

from collections.abc import Mapping

from mapper.core.frames import RgbdFrame
from mapper.sources.base import Log
from mapper.sources.depth_outlines import outline_warnings
from mapper.sources.depth_scale import depth_warnings
from mapper.sources.image_order import time_warnings
from mapper.sources.scan_frame import scan_frame_warnings, sweep_warnings


def log_warnings(log: Log, frames: Mapping[int, RgbdFrame]) -> list[tuple[str, str]]:
    """Return what is implausible about a log: the kind of each warning, and a sentence; few frames are read.

    Args:
        log: The log.
        frames: Some of its frames, as of :func:`mapper.sources.depth_scale.read_spread`.
    """
    found = (
        ("stamps", time_warnings(log)),
        ("depth", depth_warnings(log, frames)),
        ("depth", outline_warnings(frames.values())),
        ("frame", scan_frame_warnings(log)),
        ("sweep", sweep_warnings(log)),
    )
    return [(kind, sentence) for kind, sentences in found for sentence in sentences]
