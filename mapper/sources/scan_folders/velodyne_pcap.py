"""Captures of a Velodyne's packets (.pcap, .pcapng), as VeloView, tcpdump and Wireshark write them."""

from collections import Counter
from collections.abc import Iterator
from ipaddress import ip_address
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import numpy as np

from mapper.core.errors import DataError, FrameError, SourceError
from mapper.core.frames import Scan
from mapper.sources.base import FrameRef, Log
from mapper.sources.captures import ENDINGS, Datagram, captured, first_datagrams
from mapper.sources.config import SourceConfig
from mapper.sources.point_times import LEAST_SHARE
from mapper.sources.ros.cloud_messages import scan_from
from mapper.sources.ros.messages import CloudMessage
from mapper.sources.text import time_order
from mapper.sources.velodyne_packets import PACKET_BYTES, decode_packets, require_decoder

_MAKERS = {b"\xee\xff": "a Hesai's", b"\x55\xaa": "a RoboSense's"}
"""Whose packets begin with these bytes."""


class _Turn(NamedTuple):
    """Packets of a turn: where they begin, how many were captured until its last, how many are its own.

    Its time is its last packet's.
    """

    offset: int
    captured: int
    packets: int
    stamp_ns: int


def recognise(path: Path) -> bool:
    """Return whether a path is named as a capture."""
    return path.suffix.lower() in ENDINGS and path.is_file()


def read_log(path: Path, config: SourceConfig) -> Log:
    """Return the log of a capture: a scan for each turn of the sensor that sent most packets.

    Raises:
        SourceError: It is no capture, or has no packets of a Velodyne.
        DependencyError: The library that decodes packets is not installed.
    """
    by_sender = _turns(path)
    if not by_sender:
        raise SourceError(
            f"{path}: no packets of a Velodyne in it (UDP, {PACKET_BYTES} bytes), nor whole ones of an "
            f"Ouster (a filter by port keeps the first fragments alone){_most_sent(path)}; play those of "
            "another LiDAR through its driver and record its PointCloud2"
        )
    require_decoder()
    sender = max(by_sender, key=lambda one: sum(turn.packets for turn in by_sender[one]))
    turns, notes = by_sender[sender], []
    if len(by_sender) > 1:
        notes.append(
            f"packets of {len(by_sender)} sensors; those of {ip_address(sender)}, the most, are mapped"
        )
    usual = np.median([turn.packets for turn in turns])
    whole = [turn for turn in turns if turn.packets >= LEAST_SHARE * usual]
    if len(whole) < len(turns):
        notes.append(f"{len(turns) - len(whole)} of {len(turns)} turns are cut; left out")
    stamps_ns = np.array([turn.stamp_ns for turn in whole], np.int64)
    order, order_notes = time_order(stamps_ns, what=path.name)

    def entry_at(index: int) -> FrameRef:
        turn = whole[int(order[index])]
        return FrameRef(
            turn.stamp_ns, lambda colour: _read(path, sender, turn, config.cloud_scale, colour=colour)
        )

    return Log(
        path=path,
        name=path.resolve().stem,
        kind="velodyne-pcap",
        sensor="lidar",
        stamps_ns=stamps_ns[order],
        entry_at=entry_at,
        notes=[*notes, *order_notes],
    )


def _read(path: Path, sender: bytes, turn: _Turn, scale: float | None, *, colour: bool) -> Scan:
    """Read and decode the packets of a turn; the body is the LiDAR.

    Raises:
        FrameError: They are damaged, or the file has changed.
    """
    where = f"{path}: turn at {turn.stamp_ns}"
    found = islice(_captured(path, turn.offset), turn.captured)
    packets = [packet for _, packet in found if packet is not None and packet.sender == sender]
    received_ns = np.array([packet.received_ns for packet in packets], np.int64)
    try:
        points = decode_packets([packet.payload for packet in packets], received_ns, turn.stamp_ns)
    except DataError as error:
        raise FrameError(f"{where}: {error}") from None
    message = CloudMessage(turn.stamp_ns, "", points)
    return scan_from(message, T_body_frame=np.eye(4), with_colours=colour, where=where, scale=scale)


def _most_sent(path: Path) -> str:
    """Return what most datagrams are, as the end of a clause; empty without any."""
    found = first_datagrams(path)
    kinds = Counter((len(one.payload), one.port, _MAKERS.get(one.payload[:2], "")) for one in found)
    if not kinds:
        return ""
    (size, port, maker), _ = kinds.most_common(1)[0]
    return f", but {f'{maker}, ' if maker else ''}{size} bytes to port {port}"


def _turns(path: Path) -> dict[bytes, list[_Turn]]:
    """Return the turns of each sensor, by its address: a turn ends where the azimuth of a packet falls."""
    turns: dict[bytes, list[_Turn]] = {}
    last: dict[bytes, tuple[int, int]] = {}
    for number, (offset, packet) in enumerate(_captured(path)):
        if packet is None:
            continue
        azimuth = int.from_bytes(packet.payload[2:4], "little")
        of_sender = turns.setdefault(packet.sender, [])
        last_azimuth, first_number = last.get(packet.sender, (azimuth, number))
        if not of_sender or azimuth < last_azimuth:
            first_number = number
            of_sender.append(_Turn(offset, 0, 0, 0))
        begun = of_sender[-1]
        of_sender[-1] = _Turn(begun.offset, number - first_number + 1, begun.packets + 1, packet.received_ns)
        last[packet.sender] = azimuth, first_number
    return turns


def _captured(path: Path, offset: int | None = None) -> Iterator[tuple[int, Datagram | None]]:
    """Yield the place of every captured packet from one on, and what it is if it has a data packet's size.

    Raises:
        SourceError: It is no capture.
    """
    for place, one in captured(path, offset):
        yield place, one if one is not None and len(one.payload) == PACKET_BYTES else None
