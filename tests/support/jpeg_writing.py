"""Writer of baseline JPEGs from quantised coefficients, to make files that no encoder at hand makes."""

import struct
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

END_OF_BLOCK, SIXTEEN_ZEROS = 0x00, 0xF0


def segments(data: bytes) -> list[tuple[int, bytes]]:
    """Return (marker, body) of the segments before the first scan's data, its header included."""
    found, at = [], 2
    while not found or found[-1][0] != 0xDA:
        marker, length = data[at + 1], struct.unpack_from(">H", data, at + 2)[0]
        found.append((marker, data[at + 4 : at + 2 + length]))
        at += 2 + length
    return found


def standard_tables() -> dict[int, bytes]:
    """Return the bodies of OpenCV's DHT segments by number; AC tables count from 16."""
    data = cv2.imencode(".jpg", np.zeros((16, 16, 3), np.uint8))[1].tobytes()
    return {body[0]: body for marker, body in segments(data) if marker == 0xC4}


def codes_of(table: bytes) -> dict[int, str]:
    """Return the codes of a DHT body by symbol, as text of bits."""
    codes, code, at = {}, 0, 17
    for length in range(1, 17):
        for symbol in table[at : at + table[length]]:
            codes[symbol] = f"{code:0{length}b}"
            code += 1
        at += table[length]
        code *= 2
    return codes


def value_bits(value: int) -> str:
    """Return the bits behind the code of a value (T.81, F.1.2.1)."""
    size = abs(value).bit_length()
    return f"{value if value > 0 else value + (1 << size) - 1:0{size}b}" if size else ""


@dataclass
class Coder:
    """Codes of blocks, with tables of DC and AC."""

    dc: dict[int, str]
    ac: dict[int, str]

    def block(self, difference: int, symbols: Iterable[tuple[int, int]] = (), *, ends: bool = True) -> str:
        """Return the bits of a block: DC's difference, then (zeros, value) of AC coefficients.

        A value of 0 stands for its symbol alone, as for sixteen zeros.
        """
        bits = self.dc[abs(difference).bit_length()] + value_bits(difference)
        for zeros, value in symbols:
            bits += self.ac[zeros << 4 | abs(value).bit_length()] + value_bits(value)
        return bits + (self.ac[END_OF_BLOCK] if ends else "")


def coder(number: int = 0) -> Coder:
    """Return the coder of the standard tables for luminance, 0, or chrominance, 1."""
    tables = standard_tables()
    return Coder(codes_of(tables[number]), codes_of(tables[16 + number]))


def stuffed(bits: str, fill: str = "1") -> bytes:
    """Return bits as coded data: the last byte filled, and a zero behind every 0xFF."""
    bits += fill * (-len(bits) % 8)
    data = bytes(int(bits[i : i + 8], 2) for i in range(0, len(bits), 8))
    return data.replace(b"\xff", b"\xff\x00")


def segment(marker: int, body: bytes) -> bytes:
    """Return a segment."""
    return bytes([0xFF, marker]) + struct.pack(">H", 2 + len(body)) + body


def scan(components: Sequence[tuple[int, int]], coded: bytes) -> bytes:
    """Return a scan of (component, its tables, as 0x11) and its data."""
    header = bytes([len(components)]) + b"".join(bytes(pair) for pair in components) + bytes([0, 63, 0])
    return segment(0xDA, header) + coded


def jpeg_file(
    size: tuple[int, int],
    samplings: Sequence[int],
    scans: Sequence[bytes],
    *,
    frame: int = 0xC0,
    tables: bool = True,
    interval: int = 0,
    step: int = 8,
    words: bool = False,
) -> bytes:
    """Return a JPEG of (width, height) whose components 1 … N have these sampling factors, as 0x22.

    Args:
        size: Width and height, pixels.
        samplings: Of every component.
        scans: As :func:`scan` makes them.
        frame: SOF marker.
        tables: Whether the standard Huffman tables are in it.
        interval: Units between restart markers.
        step: Of all coefficients.
        words: Whether steps are stored in 16 bits.
    """
    width, height = size
    parts = [
        segment(
            0xDB, bytes([0x10]) + struct.pack(">64H", *[step] * 64) if words else bytes([0] + [step] * 64)
        )
    ]
    of_components = b"".join(bytes([i, sampling, 0]) for i, sampling in enumerate(samplings, 1))
    parts.append(segment(frame, struct.pack(">BHHB", 8, height, width, len(samplings)) + of_components))
    if tables:
        parts += [segment(0xC4, body) for body in standard_tables().values()]
    if interval:
        parts.append(segment(0xDD, struct.pack(">H", interval)))
    return b"\xff\xd8" + b"".join(parts) + b"".join(scans) + b"\xff\xd9"
