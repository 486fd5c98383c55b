"""Point cloud messages as scans: structured views of the payload, without missing returns."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapper.core.errors import DataError, FrameError
from mapper.core.frames import Scan
from mapper.core.geometry import Transform, apply
from mapper.core.units import MM_PER_M
from mapper.sources.cloud_files.raw import check_range, intensities_of, intensity_field
from mapper.sources.point_times import field_times_s, time_field, without_untimed
from mapper.sources.ros.messages import CloudMessage
from mapper.sources.valid_returns import FARTHEST_M, valid_returns

Field = tuple[str, int, str, int]
"""Name, offset in a point in bytes, numpy's name of the type with its byte order, and number of values."""

_SEPARATE_COLOURS = (("r", "g", "b"), ("red", "green", "blue"))
_PACKED_COLOURS = ("rgb", "rgba")
_LEAST_COORDINATE = 1e-9
"""Coordinates are larger, or 0; of bytes in the wrong order many are not."""
_LIVOX_FIELDS = {"tag", "line"}
_LIVOX_NOISE = 0b1111
"""Bits of a Livox point's tag that are not zero for noise: by its position (stray points between near and far
surfaces), and by its intensity (rain, fog, dust). The next two count returns (Livox SDK protocol, tag
information; of a Mid-360 they are a third kind of confidence)."""


def usable_fields(
    stated: Iterable[tuple[str, int, int, int]], types: Mapping[int, str], *, order: str, point_bytes: int
) -> tuple[list[Field], list[str]]:
    """Return the fields that hold a number of each point, every name once, and notes on the others.

    Args:
        stated: Name, offset in a point in bytes, number of the type, and number of values of each field.
        types: Numpy's names of the types, by their numbers.
        order: Byte order, ``<`` or ``>``.
        point_bytes: Distance from one point to the next.
    """
    fields: dict[str, Field] = {}
    notes: list[str] = []
    for stated_name, offset, number, count in stated:
        name = stated_name.strip("\0 ")
        name = name.lower() if name in ("X", "Y", "Z") else name
        kind = types.get(number)
        if kind is None:
            why = f"its type {number} is not known"
        elif count > 1:
            why = f"it has {count} values a point"
        elif name in fields:
            why = "an earlier one has the same name"
        elif (end := offset + np.dtype(kind).itemsize) > point_bytes:
            why = f"it ends at byte {end} of points of {point_bytes} bytes"
        else:
            fields[name] = (name, offset, order + kind, 1)
            continue
        notes.append(f"field {name} is left out: {why}")
    return list(fields.values()), notes


def structured(
    data: memoryview,
    fields: Sequence[Field],
    *,
    point_bytes: int,
    shape: tuple[int, int],
    row_bytes: int | None = None,
) -> NDArray[np.void]:
    """Return a view of a cloud's bytes as (N,) records; rows are copied only where they are padded.

    Args:
        data: The payload.
        fields: Fields of a point.
        point_bytes: Distance from one point to the next.
        shape: Number of rows, and of points in a row.
        row_bytes: Distance from one row to the next; None where they follow each other.

    Raises:
        DataError: The payload is shorter than the numbers say, or they contradict each other.
    """
    rows, columns = shape
    names, offsets, formats = [], [], []
    for name, offset, kind, count in fields:
        if name and name not in names:
            names.append(name)
            offsets.append(offset)
            formats.append(kind if count <= 1 else f"{count}{kind}")
    if len(data) == rows * columns * point_bytes:
        row_bytes = None  # whatever the message says: without padding there is one way to read it
    needed = (rows - 1) * (row_bytes or columns * point_bytes) + columns * point_bytes
    if len(data) < needed:
        raise DataError(
            f"a cloud of {rows}×{columns} points of {point_bytes} bytes needs {needed} bytes, but "
            f"{len(data)} are there"
        )
    ends = [at + np.dtype(kind).itemsize for at, kind in zip(offsets, formats, strict=True)]
    if (end := max(ends, default=1)) > point_bytes:
        raise DataError(
            f"a cloud of {rows}×{columns} points of {point_bytes} bytes, but fields up to byte {end}"
        )
    try:
        point = np.dtype({"names": names, "offsets": offsets, "formats": formats, "itemsize": point_bytes})
        strides = (row_bytes or columns * point_bytes, point_bytes)
        if point_bytes < 1 or (rows > 1 and strides[0] < columns * point_bytes):
            raise ValueError(f"rows of {row_bytes} bytes overlap")  # a copy of them could be of any size
        return np.ndarray(shape, point, buffer=data, strides=strides).reshape(-1)
    except (TypeError, ValueError) as error:
        raise DataError(
            f"a cloud of {rows}×{columns} points of {point_bytes} bytes in {len(data)} bytes: {error}"
        ) from None


def in_true_order(points: NDArray[np.void]) -> tuple[NDArray[np.void], list[str]]:
    """Return points whose bytes are in the order that makes coordinates of x, and a note on another one."""
    swapped = points.view(points.dtype.newbyteorder())
    if "x" not in (points.dtype.names or ()) or _plausible(swapped["x"]) <= _plausible(points["x"]):
        return points, []
    return swapped, ["is_bigendian is wrong: its bytes are in the other order"]


def _plausible(values: NDArray[Any]) -> float:
    """Return the share of numbers that may be coordinates, in metres or millimetres; 0 is none."""
    with np.errstate(invalid="ignore"):  # of the wrong order, they may be signalling NaN
        sizes = np.abs(values.astype(np.float64))
    return (
        float(((sizes > _LEAST_COORDINATE) & (sizes < FARTHEST_M * MM_PER_M)).mean()) if len(sizes) else 0.0
    )


def without_noise(points: NDArray[np.void]) -> tuple[NDArray[np.void], list[str]]:
    """Return points without those that a Livox tags as noise, and a note on these; others as they are."""
    if not set(points.dtype.names or ()) >= _LIVOX_FIELDS or points.dtype["tag"] != np.uint8:
        return points, []
    is_noise = points["tag"] & _LIVOX_NOISE != 0
    if not (count := int(is_noise.sum())):
        return points, []
    note = f"points tagged as noise (rain, dust, edges) are left out: {count} of {len(points)} of the first"
    return points[~is_noise], [note]


def scan_from(
    message: CloudMessage,
    *,
    T_body_frame: Transform,
    with_colours: bool,
    where: str,
    scale: float | None = None,
) -> Scan:
    """Return the valid points of a cloud, in the body frame.

    Drivers write missing returns as points that are not finite or at the sensor itself; points beyond the
    reach of every sensor are damage, and are counted.

    Args:
        message: The cloud.
        T_body_frame: Pose of the cloud's frame in the body's.
        with_colours: Take the points' colours and intensities too, if there are any.
        where: Name of the message in an error.
        scale: Metres per unit; None is 1, and refuses what looks like millimetres.

    Raises:
        FrameError: The points have no x, y and z, or are not metres around the sensor.
    """
    points = message.points
    names = points.dtype.names or ()
    if not {"x", "y", "z"} <= set(names):
        raise FrameError(f"{where}: points of {', '.join(names) or 'no fields'}; want x, y and z")
    coordinates = _coordinates(points) if scale is None else _coordinates(points) * np.float32(scale)
    points_body, rows, far = valid_returns(coordinates)
    try:
        check_range(points_body, where=where, is_scaled=scale is not None)
    except FrameError:  # of millimetres, what is left may be what lies to one side
        check_range(
            coordinates[np.isfinite(coordinates).all(axis=1)], where=where, is_scaled=scale is not None
        )
        raise
    if far > len(points_body) > 0:
        raise FrameError(
            f"{where}: {far} of {far + len(points_body)} returns are farther than {FARTHEST_M:g} m, which no "
            "sensor reaches; is is_bigendian right, and are they metres around the sensor?"
        )
    kept = slice(None) if rows is None else rows
    T_body_points = T_body_frame @ message.T_frame_points
    if not np.array_equal(T_body_points, np.eye(4)):
        points_body = apply(T_body_points, points_body.astype(np.float64)).astype(np.float32)
    times, intensity = time_field(names), intensity_field(names)
    scan = Scan(
        message.stamp_ns,
        points_body,
        origin_body=T_body_points[:3, 3],
        colors=_colours(points, names, kept) if with_colours else None,
        times_s=None if times is None else field_times_s(times, points[times][kept], message.stamp_ns),
        far_returns=far,
        intensities=intensities_of(points[intensity][kept]) if with_colours and intensity else None,
    )
    return without_untimed(scan)


def values_of_returns(points: NDArray[np.void], field: str) -> NDArray[Any]:
    """Return a field of the points that measured something."""
    if not {"x", "y", "z"} <= set(points.dtype.names or ()):
        return points[field]
    _, rows, _ = valid_returns(_coordinates(points))
    return points[field] if rows is None else points[field][rows]


def _coordinates(points: NDArray[np.void]) -> NDArray[np.float32]:
    """Return (N, 3) x, y and z: a view of the message where they follow each other as float32."""
    fields: Mapping[str, Any] = points.dtype.fields or {}
    offsets = [fields[name][1] for name in "xyz"]
    if np.diff(offsets).tolist() == [4, 4] and {fields[name][0] for name in "xyz"} == {np.dtype("<f4")}:
        triples = np.dtype(
            {"names": ["xyz"], "offsets": offsets[:1], "formats": ["3f4"], "itemsize": points.itemsize}
        )
        return points.view(triples)["xyz"]
    return np.column_stack([points[name].astype(np.float32) for name in "xyz"])


def _colours(
    points: NDArray[np.void], names: Sequence[str], kept: slice | NDArray[np.intp]
) -> NDArray[np.uint8] | None:
    """Return (N, 3) RGB of separate bytes, or of 0x00RRGGBB in four bytes that are called a float."""
    for separate in _SEPARATE_COLOURS:
        if set(separate) <= set(names) and all(points[name].dtype == np.uint8 for name in separate):
            return np.column_stack([points[name][kept] for name in separate])
    for packed in _PACKED_COLOURS:
        if packed in names and points[packed].dtype.itemsize == 4:
            bytes_of_four = np.ascontiguousarray(points[packed][kept])
            value = bytes_of_four.view(bytes_of_four.dtype.str[0] + "u4")
            return np.column_stack([value >> 16, value >> 8, value]).astype(np.uint8)
    return None
