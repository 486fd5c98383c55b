"""Map files (``.octree``): all of a map, compressed and checked; the same map gives the same bytes.

Layout: that of ``runtime.checked_file`` with a header in JSON and a body compressed by Zstandard. The body
holds, little-endian, one after the other: Morton codes of the blocks as differences (int64), masks of
their known voxels (64 bytes per block) and those voxels' log-odds (float32); then, if the map has attributes,
the same two for voxels that have any, and these voxels' red, green and blue sums, colour weights, hits
(uint32) and last stamps (int64).
"""

import json
from pathlib import Path
from typing import Any

import numpy as np
import zstandard
from numpy.typing import NDArray
from pydantic import ValidationError

from mapper.core.config import drop_unknown
from mapper.core.errors import MapFileError
from mapper.octree.attributes import AttributeLayer
from mapper.octree.blocks import BLOCK_BYTES, check_memory, find_slots
from mapper.octree.config import OctreeConfig
from mapper.octree.keys import BLOCK_VOXELS
from mapper.octree.map import OctreeMap
from mapper.runtime.checked_file import CheckedFormat

MAGIC = b"\x89mapper-octree\r\n"

_FORMAT = CheckedFormat(MAGIC, version=1, remedy="update mapper", error=MapFileError)
_LEVEL = 3  # Zstandard's default
_MASK_BYTES = BLOCK_VOXELS // 8
_COUNTS = ("blocks", "voxels", "attribute_blocks", "attribute_voxels")
_ATTRIBUTE_BYTES = BLOCK_VOXELS * 28
"""Memory of a block's attributes: three sums of colour, their weight, hits and a stamp per voxel."""


def write_map(path: Path, octree: OctreeMap) -> None:
    """Write a map with its sensor model and all attributes; atomic."""
    slots = octree.blocks.sorted_slots()
    values = octree.blocks.table.values[slots]
    known = ~np.isnan(values)
    columns: list[NDArray[Any]] = [*_block_columns(octree.blocks.codes[slots], known), values[known]]
    counts = [len(slots), int(np.count_nonzero(known)), 0, 0]
    if octree.attributes is not None:
        attribute_columns, counts[2:] = _attribute_columns(octree, octree.attributes)
        columns += attribute_columns
    header = {"config": octree.config.model_dump(mode="json"), **dict(zip(_COUNTS, counts, strict=True))}
    head = json.dumps(header, sort_keys=True, separators=(",", ":")).encode()
    plain = b"".join(
        column.astype(column.dtype.newbyteorder("<"), copy=False).tobytes() for column in columns
    )
    _FORMAT.write(path, head, zstandard.ZstdCompressor(level=_LEVEL).compress(plain))


def _attribute_columns(
    octree: OctreeMap, layer: AttributeLayer
) -> tuple[list[NDArray[Any]], tuple[int, int]]:
    slots, arrays = layer.slots, layer.arrays
    rows = arrays.rows[slots]
    held = (arrays.hits[rows] > 0) | (arrays.color_weights[rows] > 0)
    sums = arrays.color_sums[rows][held]
    columns: list[NDArray[Any]] = [*_block_columns(octree.blocks.codes[slots], held)]
    columns += [np.ascontiguousarray(sums[:, channel]) for channel in range(3)]
    columns += [array[rows][held] for array in (arrays.color_weights, arrays.hits, arrays.last_seen_ns)]
    return columns, (len(slots), int(np.count_nonzero(held)))


def _block_columns(
    codes: NDArray[np.int64], held: NDArray[np.bool_]
) -> tuple[NDArray[np.int64], NDArray[np.uint8]]:
    """Return steps between (B,) block codes, and the (B, 64) bits of a (B, 512) mask of their voxels."""
    return np.diff(codes, prepend=np.int64(0)), np.packbits(held, axis=1, bitorder="little")


def parse_map(path: Path, data: bytes, config: OctreeConfig | None) -> OctreeMap:
    """Return the map of a file's bytes, which begin with ``MAGIC``.

    Args:
        path: Path of the file, for errors.
        data: All of its bytes.
        config: Sensor model, in place of the file's, for scans inserted later; the resolution is the file's.

    Raises:
        MapFileError: The file is of another version, truncated or damaged.
        MapSizeError: The map would not fit into memory.
    """
    head, body = _FORMAT.split(path, data)
    counts, own_config = _parse_header(path, head)
    blocks, voxels, attribute_blocks, attribute_voxels = counts
    sizes = [
        *((blocks, "<i8"), (blocks * _MASK_BYTES, "u1"), (voxels, "<f4")),
        *((attribute_blocks, "<i8"), (attribute_blocks * _MASK_BYTES, "u1")),
        *[(attribute_voxels, "<u4")] * 5,
        (attribute_voxels, "<i8"),
    ]
    plain_bytes = sum(count * np.dtype(kind).itemsize for count, kind in sizes)
    check_memory(
        blocks * BLOCK_BYTES + attribute_blocks * _ATTRIBUTE_BYTES + plain_bytes, f"the map in {path}"
    )
    plain = _decompressed(path, body, plain_bytes)
    columns: list[NDArray[Any]] = []
    at = 0
    for count, kind in sizes:
        columns.append(np.frombuffer(plain, kind, count=count, offset=at))
        at += columns[-1].nbytes
    if config is None:
        config = own_config
    else:
        kept = {"resolution_m": own_config.resolution_m, "attributes": own_config.attributes}
        config = config.model_copy(update=kept)
    octree = OctreeMap(config)
    _fill(path, octree, *columns[:3])
    if octree.attributes is not None:
        _fill_attributes(path, octree, octree.attributes, columns[3:])
    return octree


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


def _decompressed(path: Path, body: memoryview, size: int) -> bytes:
    try:
        if zstandard.frame_content_size(body) != size:
            raise MapFileError(f"{path}: its body is not the {size} bytes that its header describes")
        return zstandard.ZstdDecompressor().decompress(body)
    except zstandard.ZstdError as error:
        raise MapFileError(f"{path}: cannot be decompressed: {error}; it is damaged") from None


def _held(path: Path, steps: NDArray[np.int64], bits: NDArray[np.uint8], count: int) -> NDArray[np.bool_]:
    held = np.unpackbits(bits.reshape(len(steps), _MASK_BYTES), axis=1, bitorder="little").view(np.bool_)
    if np.count_nonzero(held) != count or (steps[1:] <= 0).any():
        raise MapFileError(f"{path}: its voxels are not {count} in rising blocks; it is damaged")
    return held


def _fill(
    path: Path,
    octree: OctreeMap,
    steps: NDArray[np.int64],
    bits: NDArray[np.uint8],
    values: NDArray[np.float32],
) -> None:
    known = _held(path, steps, bits, len(values))
    octree.restore_blocks(np.cumsum(steps), known, values)


def _fill_attributes(
    path: Path, octree: OctreeMap, layer: AttributeLayer, columns: list[NDArray[Any]]
) -> None:
    steps, bits, red, green, blue, weights, hits, last_seen_ns = columns
    held = _held(path, steps, bits, len(hits))
    slots = np.empty(len(steps), np.int64)
    if find_slots(octree.blocks.table, np.cumsum(steps), slots):
        raise MapFileError(f"{path}: has attributes of blocks that it does not have; it is damaged")
    rows = layer.claim(slots)
    blocks, voxels = np.nonzero(held)
    index = rows[blocks], voxels
    layer.arrays.color_sums[index] = np.column_stack([red, green, blue])
    layer.arrays.color_weights[index] = weights
    layer.arrays.hits[index] = hits
    layer.arrays.last_seen_ns[index] = last_seen_ns
