"""A Velodyne's packets, decoded to points by velodyne-decoder."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from mapper.core.errors import DataError
from mapper.core.timebase import NS_PER_S, Stamps
from mapper.runtime.extras import extra, require
from mapper.sources.point_times import MAX_SWEEP_S

_EXTRA, _PURPOSE = "velodyne", "reading a Velodyne's packets"
PACKET_BYTES = 1206
"""Payload of a data packet: 12 blocks of 100 bytes, 4 of a time stamp, and 2 of return mode and model."""


def require_decoder() -> None:
    """Refuse a log of packets where the library that decodes them is missing.

    Raises:
        DependencyError: It is not installed.
    """
    require("velodyne_decoder", _EXTRA, _PURPOSE)


def decode_packets(payloads: Sequence[bytes], received_ns: Stamps, stamp_ns: int) -> NDArray[np.void]:
    """Return the (N,) points of packets, with x, y, z in metres and time in seconds after a stamp.

    The library tells the model by the packets, and has the makers' calibration of each but the HDL-64E.

    Args:
        payloads: Data packets, of ``PACKET_BYTES`` each.
        received_ns: When each was received.
        stamp_ns: Time of the scan.

    Raises:
        DataError: They are damaged, of a model that is not known, or none.
        DependencyError: The library is not installed.
    """
    with extra(_EXTRA, _PURPOSE):
        import velodyne_decoder as library

    if len(payloads) == 0:
        raise DataError("a scan without packets")
    first_ns = int(received_ns.min())  # the library's times are unsigned, and float64
    packets = [
        library.VelodynePacket(after_first_ns / NS_PER_S, payload)
        for after_first_ns, payload in zip((received_ns - first_ns).tolist(), payloads, strict=True)
    ]
    try:
        decoder = library.ScanDecoder(library.Config())
        last, points = decoder.decode(library.PacketVector(packets), as_pcl_structs=True)
    except RuntimeError as error:
        raise DataError(f"packets that cannot be decoded: {error}") from None
    last_s = last.host + (first_ns - stamp_ns) / NS_PER_S
    if abs(last_s) <= MAX_SWEEP_S:  # else packets have no times of the host
        points["time"] += np.float32(last_s)
    return np.asarray(points)
