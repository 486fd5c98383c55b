"""Captures of packets (.pcap, .pcapng) as UDP datagrams, put together where they were sent in fragments."""

import struct
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import NamedTuple

from dpkt.pcap import UniversalReader

from mapper.core.errors import SourceError
from mapper.core.timebase import NS_PER_S

ENDINGS = (".pcap", ".pcapng")
_LINKS = {1: (12, 14), 113: (14, 16), 276: (0, 20)}
"""Ethernet and Linux' two kinds of "any" interface: place of the protocol, and bytes of the header; all
others are taken for bare IP."""
_VLANS = (0x8100, 0x88A8)
_UDP, _FRAGMENT = 17, 44
_TRIED = 2000
"""Captured packets by which it is told whose they are: as many as come in a third of a second."""
_MOST_BYTES = 1 << 18
"""Most of a packet that tcpdump and Wireshark capture."""
_MOST_PARTIAL = 64
"""Datagrams that are put together at a time: of older ones a fragment was lost."""


class Datagram(NamedTuple):
    """UDP datagram of a capture.

    Attributes:
        received_ns: When its last fragment was captured.
        sender: Address of its sender, 4 or 16 bytes.
        port: Port that it was sent to.
        payload: What was sent.
        offset: Place of its first fragment in the file.
        captured: Number of captured packets from there to its last fragment.
    """

    received_ns: int
    sender: bytes
    port: int
    payload: bytes
    offset: int
    captured: int


class _Fragment(NamedTuple):
    """Part of what IP carries: of which datagram, from which byte, whether more follow, and its bytes."""

    key: tuple[bytes, int]
    start: int
    is_last: bool
    data: bytes


def captured(path: Path, offset: int | None = None) -> Iterator[tuple[int, Datagram | None]]:
    """Yield the place of every captured packet from one on, and the UDP datagram that it completes.

    Raises:
        SourceError: It is no capture.
    """
    try:
        with path.open("rb") as file:
            try:
                reader = UniversalReader(file)
                packets, link = iter(reader), reader.datalink()
            except Exception as error:  # the library raises whatever the bytes that it meets raise
                raise SourceError(f"{path}: no capture of packets: {error}") from None
            if offset is not None:
                file.seek(offset)
            partial: dict[tuple[bytes, int], tuple[int, int, dict[int, _Fragment]]] = {}
            number = 0
            while True:
                place = file.tell()
                try:
                    received_s, data = next(packets)
                except Exception:  # it ends, is cut off, or damaged from here on
                    return
                if not 0 < len(data) <= _MOST_BYTES:  # damaged; a file system's hole may have terabytes of 0
                    return
                number += 1
                fragment = _fragment(data, link)
                if fragment is None:
                    yield place, None
                    continue
                first, first_number, fragments = partial.setdefault(fragment.key, (place, number, {}))
                fragments[fragment.start] = fragment
                whole = _joined(fragments)
                if whole is None and len(partial) > _MOST_PARTIAL:
                    del partial[next(iter(partial))]
                if whole is not None:
                    del partial[fragment.key]
                received_ns, sender = round(received_s * NS_PER_S), fragment.key[0]
                yield place, _datagram(whole or b"", received_ns, sender, first, number - first_number + 1)
    except OSError as error:
        raise SourceError(f"{path}: cannot be read: {error.strerror}") from None


def first_datagrams(path: Path) -> Iterator[Datagram]:
    """Yield the datagrams among the first captured packets.

    Raises:
        SourceError: It is no capture.
    """
    return (one for _, one in islice(captured(path), _TRIED) if one is not None)


def read_datagram(path: Path, offset: int, count: int) -> bytes | None:
    """Return the payload of the datagram that ``count`` packets from a place on make up; None if gone."""
    found = (one for _, one in islice(captured(path, offset), count) if one is not None)
    return next((one.payload for one in found if one.offset == offset), None)


def _fragment(data: bytes, link: int) -> _Fragment | None:
    """Return what IP carries of a UDP datagram; None of other packets and of damaged ones."""
    try:
        if link in _LINKS:
            at, start = _LINKS[link]
            while struct.unpack_from(">H", data, at)[0] in _VLANS:
                at, start = at + 4, start + 4
            data = data[start:]
        if data[0] >> 4 == 4:
            size, number, flags, protocol = struct.unpack_from(">2xHHHxB", data)
            sender, rest = data[12:16], data[4 * (data[0] & 15) : size or None]
            place, is_last = 8 * (flags & 0x1FFF), not flags & 0x2000
        else:
            size, protocol = struct.unpack_from(">4xHB", data)
            sender, rest, number, place, is_last = data[8:24], data[40 : 40 + size], 0, 0, True
            if protocol == _FRAGMENT:
                protocol, flags, number = struct.unpack_from(">BxHI", rest)
                rest, place, is_last = rest[8:], flags & 0xFFF8, not flags & 1
    except (IndexError, struct.error):
        return None
    return _Fragment((sender, number), place, is_last, rest) if protocol == _UDP else None


def _joined(fragments: dict[int, _Fragment]) -> bytes | None:
    """Return the bytes of fragments that follow each other up to the last; None where one is missing."""
    end = 0
    while (one := fragments.get(end)) is not None:
        end += len(one.data)
        if one.is_last:
            return b"".join(fragments[start].data for start in sorted(fragments) if start < end)
        if not one.data:
            return None
    return None


def _datagram(whole: bytes, received_ns: int, sender: bytes, offset: int, captured: int) -> Datagram | None:
    if len(whole) < 8:
        return None
    port, size = struct.unpack_from(">2xHH", whole)
    return Datagram(received_ns, sender, port, whole[8 : size or None], offset, captured)
