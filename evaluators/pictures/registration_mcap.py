"""Recording of a registration as an MCAP file: the target, and the source after every stage."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from mapper.core.frames import Points32
from mapper.core.geometry import Transform, apply
from mapper.core.timebase import NS_PER_S
from mapper.export.figures import ESTIMATE, TRUTH
from mapper.export.mcap_log import McapLog
from mapper.export.mcap_messages import Value


def write_registration_log(
    path: Path,
    points_target: Points32,
    points_source: Points32,
    stages: Sequence[tuple[Transform, Mapping[str, Value]]],
) -> None:
    """Write /map/target, /map/source and /registration; stage k is at second k, so the playhead shows them.

    Args:
        path: MCAP file to write.
        points_target: (N, 3) metres; the recording's world is the target's frame.
        points_source: (M, 3) metres, source frame.
        stages: T_target_source after each, and a record with the same fields every time.
    """
    with McapLog(path) as log:
        log.cloud(0, points_target, colors=_one_color(points_target, TRUTH), name="target")
        for second, (T_target_source, record) in enumerate(stages):
            stamp_ns = second * NS_PER_S
            moved = apply(T_target_source, points_source.astype(np.float64))
            log.cloud(stamp_ns, moved, colors=_one_color(points_source, ESTIMATE), name="source")
            log.record("/registration", "mapper/msg/Registration", stamp_ns, record)


def _one_color(
    points: Points32, color: tuple[int, int, int]
) -> np.ndarray[tuple[int, ...], np.dtype[np.uint8]]:
    return np.broadcast_to(np.array(color, np.uint8), points.shape)
