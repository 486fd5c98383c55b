"""What a place looked like to a LiDAR: the points by which it is recognised and measured again."""

from dataclasses import dataclass

from mapper.core.frames import Points32


@dataclass(frozen=True, slots=True, eq=False)
class ScanView:
    """One scan, thinned and deskewed.

    Attributes:
        stamp_ns: The scan's stamp.
        points_body: (N, 3) float32 metres, body frame, z roughly up.
    """

    stamp_ns: int
    points_body: Points32
