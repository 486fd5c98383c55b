"""Errors and warnings that a user can act on.

Library code raises or warns; only ``cli`` turns them into one line and, for an error, an exit status.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from numpy.typing import NDArray

LINE_WIDTH = 110
"""Characters of a line that is printed."""
_LONGEST = 800


def listed(names: Sequence[str], *, most: int = 8) -> str:
    """Return the first of some names for a message, and how many others there are."""
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")


class MapperError(Exception):
    """Base of all errors: the message names the thing, the value, the limit and the remedy.

    Values of damaged files may be of any length; the middle of a message that is longer than a few lines on a
    terminal is left out.
    """

    def __str__(self) -> str:
        message = super().__str__()
        if len(message) <= _LONGEST:
            return message
        return f"{message[: _LONGEST // 2]} … {message[-_LONGEST // 4 :]}"


class ConfigError(MapperError):
    """A configuration file or an override that the model refuses."""


class DataError(MapperError):
    """Invalid data: of a wrong shape, not finite, or out of order."""


class SourceError(MapperError):
    """A log that cannot be opened or read."""


class FrameError(SourceError):
    """One frame that cannot be read; the rest of the log may still be readable."""


class TrackingError(MapperError):
    """A log of which too little could be tracked for a map."""


class UntrustedError(MapperError):
    """A result that is whole, but not as good as was asked for: not trusted, or beyond a limit."""


class GraphError(MapperError):
    """A pose graph that is inconsistent or cannot be solved."""


class LoopError(MapperError):
    """A loop that cannot be added or removed, or two sessions that no loop connects."""


class MapSizeError(MapperError):
    """A map or a scan that would not fit into memory, refused before it is allocated."""


class MapFileError(MapperError):
    """A map file that is truncated, foreign or damaged."""


class VocabularyError(MapperError):
    """A vocabulary that is missing or damaged, or of other descriptors."""


class RegistrationError(MapperError):
    """A registration whose result is not accepted."""


class PlanError(MapperError):
    """A path that does not exist, or whose start or goal has too little clearance."""


class DependencyError(MapperError):
    """A library of an optional part that is not installed or cannot be loaded."""


class ViewerError(MapperError):
    """A viewer that cannot be started or reached."""


class RunError(MapperError):
    """A run folder that is missing, unfinished or already exists."""


class WriteError(MapperError):
    """A file or folder that cannot be written, as when the disk is full."""


class Terminated(KeyboardInterrupt):
    """The process was told to end by SIGTERM; work ends as it does at Ctrl-C."""


class MapperWarning(UserWarning):
    """A warning that a user should read; ``cli`` prints it as one line."""


def expect_shape(
    array: "NDArray[Any]", want: str, name: str, *, error: type[MapperError] = DataError
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
