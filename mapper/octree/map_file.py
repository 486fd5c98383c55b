"""Map files (``.octree``): all of a map, compressed and checked; the same map gives the same bytes.

Layout: that of ``runtime.checked_file`` with a header in JSON and a body compressed by Zstandard. The body
holds, little-endian, one after the other: Morton codes of the blocks as differences (int64), masks of
their known voxels (64 bytes per block) and those voxels' log-odds (float32); then, if the map has attributes,
the same two for voxels that have any, and these voxels' red, green and blue sums, colour weights, hits
(uint32) and last stamps (int64).
"""

import json
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from tempfile import TemporaryFile
from typing import TYPE_CHECKING, Any

import numpy as np
import zstandard
from numpy.typing import NDArray
from pydantic import ValidationError

from mapper.core.config import drop_unknown
from mapper.core.errors import MapFileError
from mapper.octree.attributes import AttributeLayer
from mapper.octree.config import OctreeConfig
from mapper.octree.keys import BLOCK_VOXELS, PACKED_BYTES
from mapper.octree.sparse_grid import BLOCK_BYTES, BLOCKS_AT_ONCE, BlockStore, check_memory, find_slots
from mapper.runtime.atomic import writing
from mapper.runtime.checked_file import CheckedFormat

if TYPE_CHECKING:
    from mapper.octree.map import OctreeMap

MAGIC = b"\x89mapper-octree\r\n"

_FORMAT = CheckedFormat(MAGIC, version=1, remedy="update mapper", error=MapFileError)
_COUNTS = ("blocks", "voxels", "attribute_blocks", "attribute_voxels")
_ATTRIBUTE_BYTES = BLOCK_VOXELS * 28
"""Memory of a block's attributes: three sums of colour, their weight, hits and a stamp per voxel."""


def write_map(path: Path, octree: "OctreeMap") -> None:
    """Write a map with its sensor model and all attributes; atomic.

    Beside the map, this takes a tenth of its memory and 100 MB; attributes are copied as a whole.
    """
    values = octree.blocks.table.values
    slots = octree.blocks.sorted_slots()
    chunks = [slots[first : first + BLOCKS_AT_ONCE] for first in range(0, len(slots), BLOCKS_AT_ONCE)]
    bits = [_bits(~np.isnan(values[some])) for some in chunks]
    counts = [len(slots), int(sum(np.bitwise_count(some).sum(dtype=np.int64) for some in bits)), 0, 0]
    attributes: list[NDArray[Any]] = []
    if octree.attributes is not None:
        attributes, counts[2:] = _attribute_columns(octree, octree.attributes)

    def columns() -> Iterator[NDArray[Any]]:
        yield _steps(octree.blocks.codes[slots])
        yield from bits
        for some in chunks:
            held = values[some]
            yield held[~np.isnan(held)]
        yield from attributes

    config = octree.config.model_dump(mode="json", exclude={"max_memory_mb"})
    header = {"config": config, **dict(zip(_COUNTS, counts, strict=True))}
    head = json.dumps(header, sort_keys=True, separators=(",", ":")).encode()
    with ExitStack() as stack:
        stack.enter_context(writing(path))
        path.parent.mkdir(parents=True, exist_ok=True)
        body = stack.enter_context(TemporaryFile(dir=path.parent))
        compressor = zstandard.ZstdCompressor()
        with compressor.stream_writer(body, size=sum(_sizes(counts)), closefd=False) as stream:
            for column in columns():
                stream.write(column.astype(column.dtype.newbyteorder("<"), copy=False).data)
        _FORMAT.write_from(path, head, body)


def _attribute_columns(
    octree: "OctreeMap", layer: AttributeLayer
) -> tuple[list[NDArray[Any]], tuple[int, int]]:
    slots, arrays = layer.slots, layer.arrays
    rows = arrays.rows[slots]
    held = (arrays.hits[rows] > 0) | (arrays.color_weights[rows] > 0)
    sums = arrays.color_sums[rows][held]
    columns: list[NDArray[Any]] = [_steps(octree.blocks.codes[slots]), _bits(held)]
    columns += [np.ascontiguousarray(sums[:, channel]) for channel in range(3)]
    columns += [array[rows][held] for array in (arrays.color_weights, arrays.hits, arrays.last_seen_ns)]
    return columns, (len(slots), int(np.count_nonzero(held)))


def _steps(codes: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return steps between (B,) block codes."""
    return np.diff(codes, prepend=np.int64(0))


def _bits(held: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Return the (B, 64) bits of a (B, 512) mask of blocks' voxels."""
    return np.packbits(held, axis=1, bitorder="little")


def _columns(counts: Sequence[int]) -> list[tuple[int, str]]:
    """Return the length and type of the arrays that a body holds."""
    blocks, voxels, attribute_blocks, attribute_voxels = counts
    return [
        *((blocks, "<i8"), (blocks * PACKED_BYTES, "u1"), (voxels, "<f4")),
        *((attribute_blocks, "<i8"), (attribute_blocks * PACKED_BYTES, "u1")),
        *[(attribute_voxels, "<u4")] * 5,
        (attribute_voxels, "<i8"),
    ]


def _sizes(counts: Sequence[int]) -> list[int]:
    """Return the bytes of the arrays that a body holds."""
    return [count * np.dtype(kind).itemsize for count, kind in _columns(counts)]


def parse_map(path: Path, data: bytes) -> tuple[OctreeConfig, list[NDArray[Any]]]:
    """Return the settings and the arrays of a file that begins with ``MAGIC``; their order is the module's.

    Args:
        path: Path of the file, for errors.
        data: All of its bytes.

    Raises:
        MapFileError: The file is of another version, truncated or damaged.
        MapSizeError: The map would not fit into memory.
    """
    head, body = _FORMAT.split(path, data)
    counts, config = _parse_header(path, head)
    plain_bytes = sum(_sizes(counts))
    check_memory(counts[0] * BLOCK_BYTES + counts[2] * _ATTRIBUTE_BYTES + plain_bytes, f"the map in {path}")
    plain = _decompress(path, body, plain_bytes)
    columns: list[NDArray[Any]] = []
    at = 0
    for count, kind in _columns(counts):
        columns.append(np.frombuffer(plain, kind, count=count, offset=at))
        at += columns[-1].nbytes
    return config, columns


def _parse_header(path: Path, head: bytes) -> tuple[list[int], OctreeConfig]:
    try:
        header = json.loads(head)
        counts = [header[name] for name in _COUNTS]
        drop_unknown(OctreeConfig, header["config"])
        config = OctreeConfig.model_validate(header["config"])
    except (ValueError, KeyError, TypeError, ValidationError, RecursionError):
        raise MapFileError(f"{path}: its header does not describe a map; it is damaged") from None
    blocks, voxels, attribute_blocks, attribute_voxels = counts
    if not (
        all(isinstance(count, int) and count >= 0 for count in counts)
        and voxels <= blocks * BLOCK_VOXELS
        and attribute_voxels <= attribute_blocks * BLOCK_VOXELS
        and attribute_blocks <= blocks
    ):
        raise MapFileError(f"{path}: its header has counts {counts}; it is damaged")
    return counts, config


def _decompress(path: Path, body: memoryview, size: int) -> bytes:
    try:
        if zstandard.frame_content_size(body) != size:
            raise MapFileError(f"{path}: its body is not the {size} bytes that its header describes")
        return zstandard.ZstdDecompressor().decompress(body)
    except zstandard.ZstdError as error:
        raise MapFileError(f"{path}: cannot be decompressed: {error}; it is damaged") from None


def _unpack(path: Path, steps: NDArray[np.int64], bits: NDArray[np.uint8], count: int) -> NDArray[np.bool_]:
    held = np.unpackbits(bits.reshape(len(steps), PACKED_BYTES), axis=1, bitorder="little").view(np.bool_)
    if np.count_nonzero(held) != count or (steps[1:] <= 0).any():
        raise MapFileError(f"{path}: its voxels are not {count} in rising blocks; it is damaged")
    return held


def voxels_of(
    path: Path, columns: Sequence[NDArray[Any]]
) -> tuple[NDArray[np.int64], NDArray[np.bool_], NDArray[np.float32]]:
    """Return the arguments of :meth:`OctreeMap.restore_blocks`.

    Args:
        path: Path of the file, for errors.
        columns: Columns from ``parse_map``.

    Raises:
        MapFileError: The arrays contradict each other.
    """
    steps, bits, values = columns[:3]
    return np.cumsum(steps), _unpack(path, steps, bits, len(values)), values


def restore_attributes(
    path: Path, columns: Sequence[NDArray[Any]], blocks: BlockStore, layer: AttributeLayer
) -> None:
    """Fill the attributes of a map that has its voxels, from the arrays of a file.

    Args:
        path: Path of the file, for errors.
        columns: Columns from ``parse_map``.
        blocks: The map's.
        layer: The map's attributes, still empty.

    Raises:
        MapFileError: The arrays contradict each other or the map.
    """
    steps, bits, red, green, blue, weights, hits, last_seen_ns = columns[3:]
    held = _unpack(path, steps, bits, len(hits))
    slots = np.empty(len(steps), np.int64)
    if find_slots(blocks.table, np.cumsum(steps), slots):
        raise MapFileError(f"{path}: has attributes of blocks that it does not have; it is damaged")
    rows = layer.claim(slots)
    held_blocks, voxels = np.nonzero(held)
    index = rows[held_blocks], voxels
    layer.arrays.color_sums[index] = np.column_stack([red, green, blue])
    layer.arrays.color_weights[index] = weights
    layer.arrays.hits[index] = hits
    layer.arrays.last_seen_ns[index] = last_seen_ns
