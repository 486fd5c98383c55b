"""Captures of an Ouster's packets (.pcap, .pcapng), as ouster-cli, tcpdump and Wireshark write them."""

from collections.abc import Iterator, Sequence
from contextlib import suppress
from ipaddress import ip_address
from pathlib import Path

from mapper.core.errors import FrameError, SourceError
from mapper.sources.base import Log
from mapper.sources.captures import ENDINGS, captured, first_datagrams, read_datagram
from mapper.sources.config import SourceConfig
from mapper.sources.ouster_packets import is_imu, packet_sizes
from mapper.sources.ros.messages import OUSTER_PACKETS
from mapper.sources.ros.ouster_recording import OusterRecording
from mapper.sources.ros.reader import RecordingReader
from mapper.sources.ros.recording import Place, Recorded, Topic
from mapper.sources.ros.source import recording_log


def recognise(path: Path) -> bool:
    """Return whether a path is a capture whose first datagrams have the sizes of an Ouster's."""
    if path.suffix.lower() not in ENDINGS or not path.is_file():
        return False
    sizes = packet_sizes()
    with suppress(SourceError):
        return any(len(one.payload) in sizes for one in first_datagrams(path))
    return False


def read_log(path: Path, config: SourceConfig) -> Log:
    """Return the log of a capture, with the sensor's inertial readings.

    Raises:
        SourceError: The sensor's metadata are not beside it, or nothing in it can be mapped.
    """
    return recording_log(RecordingReader(OusterRecording(CaptureRecording(path))), config)


class CaptureRecording:
    """Capture as a recording, each sender and port a topic; see :class:`Recording`.

    A message's place is that of its first fragment, with the number of packets captured until its last.
    """

    kind = "ouster-pcap"
    notes: Sequence[str] = ()

    def __init__(self, path: Path) -> None:
        """Keep the path; packets are read when they are asked for."""
        self.path = path

    def messages(self) -> Iterator[Recorded]:
        """Yield every datagram that may be an Ouster's, in the order of the file."""
        type_, least_bytes = min(OUSTER_PACKETS), min(packet_sizes())
        topics: dict[tuple[bytes, int], Topic] = {}
        for _, one in captured(self.path):
            if one is None or not (len(one.payload) >= least_bytes or is_imu(memoryview(one.payload))):
                continue
            key = one.sender, one.port
            if key not in topics:
                topics[key] = Topic(f"{ip_address(one.sender)}:{one.port}", type_, "udp")
            yield Recorded(
                topics[key], one.received_ns, Place(0, one.offset, one.captured), memoryview(one.payload)
            )

    def read(self, place: Place) -> memoryview:
        """Return a datagram's payload; safe in any thread.

        Raises:
            FrameError: The file has changed.
        """
        payload = read_datagram(self.path, place.offset, place.length)
        if payload is None:
            raise FrameError(f"{self.path}: the packet at byte {place.offset} is not there any more")
        return memoryview(payload)
