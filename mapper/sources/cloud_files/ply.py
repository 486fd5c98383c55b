"""PLY: the vertices of Stanford's polygon files (Turk 1994), ascii and binary."""

import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from mapper.runtime.regular_files import HEAD_BYTES
from mapper.sources.cloud_files.parsing import HEADER_LINES, Columns, parse_rows, refusing_damage

_NAMES = {
    "i1": ("char", "int8"),
    "u1": ("uchar", "uint8"),
    "i2": ("short", "int16"),
    "u2": ("ushort", "uint16"),
    "i4": ("int", "int32"),
    "u4": ("uint", "uint32"),
    "f4": ("float", "float32"),
    "f8": ("double", "float64"),
}
_TYPES = {name: kind for kind, names in _NAMES.items() for name in names}
_BYTE_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}


@dataclass(slots=True)
class _Element:
    name: str
    count: int
    fields: list[tuple[str, str]] = field(default_factory=list)
    has_lists: bool = False

    def dtype(self, byte_order: str) -> np.dtype[np.void]:
        """Return the layout of one of these; byte orders are numpy's."""
        if self.has_lists:
            raise ValueError(f"element {self.name} has lists; want vertices without, and before any other")
        return np.dtype([(name, byte_order + kind) for name, kind in self.fields])


def read_ply(path: Path) -> Columns:
    """Read the scalar properties of the vertices; faces and whatever else follows them are left alone.

    Raises:
        FrameError: It is malformed or cut, or its vertices have lists or come after an element that has.
    """
    with path.open("rb") as stream, refusing_damage(path, what="PLY"):
        encoding, elements = _read_header(stream)
        vertices = _read_vertices(stream, encoding, elements)
    return {name: vertices[name] for name in vertices.dtype.names or ()}


def _read_header(stream: BinaryIO) -> tuple[str, list[_Element]]:
    """Return how the elements are encoded, and the elements in the file's order."""
    if _words(stream) != ["ply"]:
        raise ValueError("the first line is not 'ply'")
    encoding, elements = "", list[_Element]()
    for _ in range(HEADER_LINES):
        match _words(stream):
            case ["end_header"] if encoding:
                return encoding, elements
            case ["format", named, "1.0"] if named in _BYTE_ORDERS:
                encoding = named
            case ["element", name, count] if count.isdecimal():
                elements.append(_Element(name, int(count)))
            case ["property", "list", _, _, _] if elements:
                elements[-1].has_lists = True
            case ["property", kind, name] if elements and kind in _TYPES:
                elements[-1].fields.append((name, _TYPES[kind]))
            case [] | ["comment" | "obj_info", *_]:
                pass
            case words:
                raise ValueError(f"header line {' '.join(words)!r}")
    raise ValueError("the header does not end")


def _words(stream: BinaryIO) -> list[str]:
    return stream.readline(HEAD_BYTES).decode("ascii", errors="replace").split()


def _read_vertices(stream: BinaryIO, encoding: str, elements: Sequence[_Element]) -> NDArray[np.void]:
    index = next((i for i, element in enumerate(elements) if element.name == "vertex"), None)
    if index is None:
        raise ValueError("no element is called vertex")
    before, vertex = elements[:index], elements[index]
    byte_order = _BYTE_ORDERS[encoding]
    dtype = vertex.dtype(byte_order)
    if encoding == "ascii":
        skipped = sum(element.count for element in before)
        vertices = parse_rows(islice(stream, skipped, skipped + vertex.count), dtype)
        _refuse_fewer(vertex.count, len(vertices))
        return vertices
    stream.seek(sum(element.count * element.dtype(byte_order).itemsize for element in before), os.SEEK_CUR)
    left = os.fstat(stream.fileno()).st_size - stream.tell()
    _refuse_fewer(vertex.count, max(left, 0) // max(dtype.itemsize, 1))
    vertices = np.frombuffer(stream.read(vertex.count * dtype.itemsize), dtype)
    return vertices.astype(dtype.newbyteorder("="))


def _refuse_fewer(want: int, found: int) -> None:
    if found < want:
        raise ValueError(f"{found} vertices, but the header says {want}; was the file cut?")
