"""Shapes that arrays must have."""

from typing import Any

from numpy.typing import NDArray

from mapper.core.errors import DataError, MapperError


def expect_shape(
    array: NDArray[Any], want: str, name: str, *, error: type[MapperError] = DataError
) -> dict[str, int]:
    """Return the lengths of an array's named axes, if it has the shape that is wanted.

    Args:
        array: The array.
        want: Its shape: numbers and names of axes, separated by commas, as in "N,3" or "H,W,3".
        name: What the message calls the array, as "octree: points_world".
        error: Class of the error.

    Raises:
        error: The number of axes or a fixed length is another, or two axes of one name differ.
    """
    axes = [axis.strip() for axis in want.split(",")]
    lengths: dict[str, int] = {}
    if array.ndim == len(axes) and all(
        length == (int(axis) if axis.isdigit() else lengths.setdefault(axis, length))
        for axis, length in zip(axes, array.shape, strict=True)
    ):
        return lengths
    raise error(f"{name} {array.shape}, want ({', '.join(axes)})")
