"""Pickling of the state of a computation, so that a copy continues it to the same bits.

Arrays keep their memory layout, as sums in another order would round otherwise, and objects that
were one are one again. What cannot or need not be written is referred to: parts that exist before the
computation begins, by name, and data that never changes, by where a journal has it.
"""

import io
import pickle
from collections import deque
from collections.abc import Callable, Mapping
from types import FunctionType
from typing import Any, BinaryIO, Protocol

import numpy as np
from numpy.typing import NDArray

from mapper.core.errors import DataError
from mapper.runtime.archived import Archivable, Archived, reference_of

_MODULES = ("mapper.", "numpy.", "collections.", "functools.", "pathlib.", "builtins.")
_ALWAYS_WRITTEN = frozenset(
    {type(None), bool, int, float, str, bytes, tuple, list, dict, np.ndarray, np.dtype}
)
_BUILTINS = frozenset({"set", "frozenset", "bytearray", "complex", "range", "slice", "object"})


class Writes(Protocol):
    """Writable file: takes bytes."""

    def write(self, data: Any, /) -> object:
        """Take some bytes."""
        ...


def dump(
    state: object,
    file: Writes,
    *,
    fixed: Mapping[str, object] | None = None,
    archive: Callable[[Archived[Any]], int] | None = None,
) -> None:
    """Write a state.

    Args:
        state: Object that is written.
        file: Takes its bytes.
        fixed: Parts that are not written, by name; ``loads`` is given their equals.
        archive: Returns where data is kept that there is an ``Archived`` of; None makes it a part of the
            state.

    Raises:
        DataError: A part of it cannot be written, as an object of a compiled library.
    """
    try:
        names = {id(part): name for name, part in (fixed or {}).items()}
        _Pickler(file, names, archive, state).dump(state)
    except (pickle.PicklingError, TypeError, AttributeError) as error:
        raise DataError(f"a state that cannot be written: {error}") from None


def dumps(
    state: object,
    *,
    fixed: Mapping[str, object] | None = None,
    archive: Callable[[Archived[Any]], int] | None = None,
) -> bytes:
    """Return the bytes of a state; see ``dump``."""
    file = io.BytesIO()
    dump(state, file, fixed=fixed, archive=archive)
    return file.getvalue()


def loads(
    data: bytes,
    *,
    fixed: Mapping[str, object] | None = None,
    archived: Callable[[int], Archived[Any]] | None = None,
) -> Any:
    """Return the state that ``dumps`` was given; see ``load``."""
    return load(io.BytesIO(data), fixed=fixed, archived=archived)


def load(
    file: BinaryIO,
    *,
    fixed: Mapping[str, object] | None = None,
    archived: Callable[[int], Archived[Any]] | None = None,
) -> Any:
    """Return the state that ``dump`` was given.

    Args:
        file: Its bytes; only classes and functions of mapper and of the libraries of arrays are loaded.
        fixed: The parts that were not written, by name.
        archived: Returns the reference to the data that is kept at a place.

    Raises:
        DataError: The bytes are no state, or one of another version.
    """
    try:
        return _Unpickler(file, fixed or {}, archived).load()
    except DataError:
        raise
    except Exception as error:  # any class may refuse what another version of it wrote
        raise DataError(f"a state that cannot be read: {type(error).__name__}: {error}") from None


def fixed_parts(root: object, kinds: tuple[type, ...]) -> dict[str, object]:
    """Return the parts of some kinds that an object of ours is made of, by the attributes that lead there."""
    found: dict[str, object] = {}
    seen: set[int] = set()
    queue = deque([("", root)])
    while queue:
        path, part = queue.popleft()
        if id(part) in seen:
            continue
        seen.add(id(part))
        if isinstance(part, kinds):
            found[path] = part
        elif type(part).__module__.startswith("mapper.") and hasattr(part, "__dict__"):
            queue.extend((f"{path}.{name}", value) for name, value in vars(part).items())
    return found


class _Pickler(pickle.Pickler):
    def __init__(
        self,
        file: Writes,
        fixed: Mapping[int, str],
        archive: Callable[[Archived[Any]], int] | None,
        whole: object,
    ) -> None:
        super().__init__(file, pickle.HIGHEST_PROTOCOL)
        self._fixed = fixed
        self._archive = archive
        self._whole = whole

    def persistent_id(self, obj: Any) -> str | int | tuple[int] | None:
        if type(obj) in _ALWAYS_WRITTEN:  # most objects are
            return None
        if (name := self._fixed.get(id(obj))) is not None:
            return name
        if self._archive is not None and isinstance(obj, Archived):
            return (self._archive(obj),)  # else the data itself
        if self._archive is not None and isinstance(obj, Archivable) and obj is not self._whole:
            reference = reference_of(obj)
            return None if reference is None else self._archive(reference)
        return None

    def reducer_override(self, obj: Any) -> Any:
        if type(obj) is not np.ndarray or obj.dtype.hasobject:
            return NotImplemented
        if obj.flags.c_contiguous or obj.flags.f_contiguous:
            return NotImplemented  # NumPy keeps these as they are
        low, high = np.lib.array_utils.byte_bounds(obj)
        extent = np.zeros(high - low, np.uint8)
        first = int(obj.__array_interface__["data"][0]) - low
        _strided(extent, first, obj.shape, obj.strides, obj.dtype)[...] = obj
        return _strided, (extent, first, obj.shape, obj.strides, obj.dtype, obj.flags.writeable)


def _strided(
    extent: NDArray[np.uint8],
    first: int,
    shape: tuple[int, ...],
    strides: tuple[int, ...],
    dtype: np.dtype[Any],
    writeable: bool = True,
) -> NDArray[Any]:
    """Return an array that lies in memory as another did, with gaps between its elements."""
    array: NDArray[Any] = np.ndarray(shape, dtype, extent.data, first, strides)
    array.flags.writeable = writeable
    return array


class _Unpickler(pickle.Unpickler):
    def __init__(
        self, file: BinaryIO, fixed: Mapping[str, object], archived: Callable[[int], Archived[Any]] | None
    ) -> None:
        super().__init__(file)
        self._fixed = fixed
        self._archived = archived

    def persistent_load(self, pid: Any) -> object:
        if isinstance(pid, int) and self._archived is not None:
            return self._archived(pid).data
        if isinstance(pid, tuple) and self._archived is not None:
            return self._archived(*pid)
        if pid in self._fixed:
            return self._fixed[pid]
        raise DataError(f"a state with a part {pid!r} that is not there")

    def find_class(self, module: str, name: str) -> Any:
        allowed = f"{module}.".startswith(_MODULES) and "." not in name
        if module == "builtins":
            allowed = name in _BUILTINS
        found = super().find_class(module, name) if allowed else None
        if not isinstance(found, type | FunctionType | type(np.dot)):
            raise DataError(f"a state with {module}.{name}, which is no part of one")
        if not f"{found.__module__}.".startswith(_MODULES):
            raise DataError(f"a state with {module}.{name}, which is no part of one")
        return found
