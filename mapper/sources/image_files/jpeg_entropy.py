"""Check of the entropy-coded data of baseline JPEGs: their Huffman codes are read, no pixels are made.

libjpeg-turbo takes codes of no table, blocks of more than 64 coefficients, sums that leave the range of
pixels, and some bytes that are left over, without a warning. No encoder writes these (ITU-T T.81, Annex F).
Read are sequential Huffman-coded JPEGs of 8 bits (SOF0, SOF1) with any sampling, restart intervals and number
of scans. Progressive, arithmetic and lossless ones are left to the decoder.

Damage that leaves as many codes, all of them possible, cannot be told, as a JPEG has no checksum. Mostly a
coefficient has changed then, and what follows is brighter, darker or of another colour by a constant.
"""

import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from mapper.core.errors import DataError
from mapper.sources.image_files.jpeg_kernels import (
    ENDS_EARLY,
    LONG_RUN,
    LONGEST_CODE,
    NO_RESTART,
    TOO_LARGE,
    UNKNOWN_CODE,
    UNREAD,
    WHOLE,
    read_scan,
)

_SOI, _EOI, _SOS, _DQT, _DHT, _DRI, _TEM = 0xD8, 0xD9, 0xDA, 0xDB, 0xC4, 0xDD, 0x01
_SEQUENTIAL = (0xC0, 0xC1)
_FRAMES = frozenset({*range(0xC0, 0xD0)} - {_DHT, 0xC8, 0xCC})  # C8 is reserved, CC sets arithmetic coding
_RST0, _RST7 = 0xD0, 0xD7

_LARGEST_DC = 1024
"""DC coefficient of a block of 64 samples of -128, before quantisation: 8 for each grey level of the mean."""
_DC_SLACK = 8
"""A grey level more, for encoders that do not compute exactly. AC coefficients have no such limit: where
contrast is full, those of a fast DCT exceed the range of samples by two thirds."""

_WORDS = {
    UNKNOWN_CODE: "a code that is in no table",
    LONG_RUN: "a block of more than 64 coefficients",
    TOO_LARGE: "a block brighter or darker than 8 bits can be",
    ENDS_EARLY: "its coded data end early",
    UNREAD: "coded data are left over",
    NO_RESTART: "a restart marker is missing",
}


class _HuffmanTable(NamedTuple):
    """Codes of each length, 1 … 16, and the symbols in their order, as a DHT segment has them."""

    counts: bytes
    symbols: bytes


class _Component(NamedTuple):
    horizontal: int
    vertical: int
    quantisation: int


@dataclass
class _Headers:
    """State that the segments before a scan have set."""

    height_px: int = 0
    width_px: int = 0
    components: dict[int, _Component] = field(default_factory=dict)
    dc_steps: dict[int, int] = field(default_factory=dict)
    huffman: dict[int, _HuffmanTable] = field(default_factory=dict)
    restart_interval: int = 0


def check_entropy(data: bytes) -> None:
    """Refuse a JPEG, whose headers the decoder has accepted, if its entropy-coded data are no encoder's.

    Pure and thread-safe; other threads run meanwhile. JPEGs of other kinds than this module reads pass.

    Raises:
        DataError: They are damaged; says how, and where.
    """
    headers = _Headers(huffman=dict(STANDARD_TABLES))
    at = 2
    try:
        while (found := _next_marker(data, at)) is not None:
            marker, at = found
            if marker == _EOI or (marker in _FRAMES and marker not in _SEQUENTIAL):
                return
            if marker in (_SOI, _TEM) or _RST0 <= marker <= _RST7:
                continue
            (length,) = struct.unpack_from(">H", data, at)
            body, at = data[at + 2 : at + length], at + length
            if at > len(data):
                return
            if marker == _SOS:
                at = _check_scan(data, at, body, headers)
            elif not _set_headers(headers, marker, body):
                return
    except (IndexError, KeyError, ValueError, struct.error):
        return  # headers that mean something to the decoder alone


def _next_marker(data: bytes, at: int) -> tuple[int, int] | None:
    """Return the next marker from a place on, and the place behind it."""
    while (at := data.find(b"\xff", at)) >= 0 and at + 1 < len(data):
        at += 1
        if data[at] not in (0x00, 0xFF):
            return data[at], at + 1
    return None


def _set_headers(headers: _Headers, marker: int, body: bytes) -> bool:
    """Take a segment's settings over; False if the file is none that this module reads."""
    if marker in _SEQUENTIAL:
        bits, headers.height_px, headers.width_px, count = struct.unpack_from(">BHHB", body)
        for number, sampling, table in struct.iter_unpack("3B", body[6 : 6 + 3 * count]):
            headers.components[number] = _Component(sampling >> 4, sampling & 15, table)
            if not (1 <= sampling >> 4 <= 4 and 1 <= sampling & 15 <= 4):
                return False
        return bits == 8 and min(headers.height_px, headers.width_px) > 0
    if marker == _DQT:
        headers.dc_steps |= dict(_dc_steps(body))
    elif marker == _DHT:
        headers.huffman |= dict(_huffman_tables(body))
    elif marker == _DRI:
        (headers.restart_interval,) = struct.unpack_from(">H", body)
    return True


def _dc_steps(body: bytes) -> Iterator[tuple[int, int]]:
    """Yield (number, quantisation step of the DC coefficient) of a DQT segment's tables."""
    at = 0
    while at < len(body):
        layout = ">64H" if body[at] >> 4 else ">64B"
        yield body[at] & 15, struct.unpack_from(layout, body, at + 1)[0]
        at += 1 + struct.calcsize(layout)


def _huffman_tables(body: bytes) -> Iterator[tuple[int, _HuffmanTable]]:
    """Yield (number, table) of a DHT segment; numbers from 16 on are those of AC coefficients."""
    at = 0
    while at < len(body):
        (counts,) = struct.unpack_from(f"{LONGEST_CODE}s", body, at + 1)
        end = at + 1 + LONGEST_CODE + sum(counts)
        yield body[at], _HuffmanTable(counts, body[at + 1 + LONGEST_CODE : end])
        at = end


def _check_scan(data: bytes, at: int, body: bytes, headers: _Headers) -> int:
    """Check the scan that starts at a place, after the header ``body``, and return where it ends."""
    parts = [(body[1 + 2 * i], body[2 + 2 * i]) for i in range(body[0])]
    components = [headers.components[number] for number, _ in parts]
    blocks = [component.horizontal * component.vertical for component in components]
    rows, columns = _mcu_grid(headers, components)
    tables = [headers.huffman[key] for _, table in parts for key in (table >> 4, (table & 15) | 16)]
    steps = [headers.dc_steps[component.quantisation] for component in components]
    fault, mcu, at = read_scan(
        np.frombuffer(data, np.uint8),
        at,
        rows * columns,
        headers.restart_interval,
        np.repeat(np.arange(len(parts)), blocks if len(parts) > 1 else 1),
        np.stack([np.frombuffer(table.counts, np.uint8) for table in tables]),
        np.stack([np.frombuffer(table.symbols.ljust(256, b"\0")[:256], np.uint8) for table in tables]),
        np.array([(_LARGEST_DC + _DC_SLACK) // max(step, 1) + 1 for step in steps]),
    )
    if fault != WHOLE:
        mcu = min(mcu, rows * columns - 1)
        x, y = mcu % columns * headers.width_px // columns, mcu // columns * headers.height_px // rows
        raise DataError(f"damaged JPEG: {_WORDS[fault]}, near pixel ({x}, {y})")
    return int(at)


def _mcu_grid(headers: _Headers, components: list[_Component]) -> tuple[int, int]:
    """Return rows and columns of a scan's minimum coded units; a component by itself is coded by blocks."""
    of_all = headers.components.values()
    horizontal = max(component.horizontal for component in of_all)
    vertical = max(component.vertical for component in of_all)
    if len(components) > 1:
        return _ceil(headers.height_px, 8 * vertical), _ceil(headers.width_px, 8 * horizontal)
    height = _ceil(headers.height_px * components[0].vertical, vertical)
    width = _ceil(headers.width_px * components[0].horizontal, horizontal)
    return _ceil(height, 8), _ceil(width, 8)


def _ceil(value: int, divisor: int) -> int:
    return -(-value // divisor)


_DC_SYMBOLS = bytes(range(12))
STANDARD_TABLES: Mapping[int, _HuffmanTable] = {
    0x00: _HuffmanTable(bytes.fromhex("00010501010101010100000000000000"), _DC_SYMBOLS),
    0x01: _HuffmanTable(bytes.fromhex("00030101010101010101010000000000"), _DC_SYMBOLS),
    0x10: _HuffmanTable(
        bytes.fromhex("0002010303020403050504040000017d"),
        bytes.fromhex(
            "01020300041105122131410613516107227114328191a1082342b1c11552d1f02433627282090a161718191a"
            "25262728292a3435363738393a434445464748494a535455565758595a636465666768696a73747576777879"
            "7a838485868788898a92939495969798999aa2a3a4a5a6a7a8a9aab2b3b4b5b6b7b8b9bac2c3c4c5c6c7c8c9"
            "cad2d3d4d5d6d7d8d9dae1e2e3e4e5e6e7e8e9eaf1f2f3f4f5f6f7f8f9fa"
        ),
    ),
    0x11: _HuffmanTable(
        bytes.fromhex("00020102040403040705040400010277"),
        bytes.fromhex(
            "000102031104052131061241510761711322328108144291a1b1c109233352f0156272d10a162434e125f117"
            "18191a262728292a35363738393a434445464748494a535455565758595a636465666768696a737475767778"
            "797a82838485868788898a92939495969798999aa2a3a4a5a6a7a8a9aab2b3b4b5b6b7b8b9bac2c3c4c5c6c7"
            "c8c9cad2d3d4d5d6d7d8d9dae2e3e4e5e6e7e8e9eaf2f3f4f5f6f7f8f9fa"
        ),
    ),
}
"""Tables of the specification (Annex K.3), which cameras' Motion JPEGs leave out."""
