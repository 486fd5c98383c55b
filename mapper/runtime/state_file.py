"""State of a computation as arrays, numbers and text, from which a copy continues it to the same bits.

A state is a tree in JSON and the bytes of its arrays. Objects are written as the name of their class and
their attributes; what is read makes objects of this package's classes alone, and calls nothing but their own
``__setstate__``, so that a file of somebody else can do nothing but fail. Arrays keep their memory layout, as
sums in another order would round otherwise, and objects that were one are one again. What cannot or need not
be written is referred to: parts that exist before the computation begins, by name, and data that never
changes, by where a journal has it.
"""

import io
import json
import struct
from collections import OrderedDict, deque
from collections.abc import Callable, Iterable, Mapping
from importlib import import_module
from pathlib import Path
from typing import Any, BinaryIO, Protocol

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel

from mapper.core.errors import DataError
from mapper.runtime.archived import Archivable, Archived, reference_of

_HEAD = struct.Struct("<8sQ")
_MAGIC = b"mapstat2"
_PACKAGES = tuple(
    f"mapper.{name}."
    for name in (
        "core",
        "features",
        "graph",
        "loops",
        "mapping",
        "odometry",
        "pipeline",
        "places",
        "registration",
        "run",
        "runtime.archived",
        "sensing",
        "sources",
    )
)
"""Packages whose classes a state may hold."""


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
        fixed: Parts that are not written, by name; ``load`` is given their equals.
        archive: Returns where data is kept that there is an ``Archived`` of; None makes it a part of the
            state.

    Raises:
        DataError: A part of it cannot be written, as an object of a compiled library.
    """
    encoder = _Encoder(fixed or {}, archive, whole=state)
    text = json.dumps(encoder.encode(state), separators=(",", ":")).encode()
    file.write(_HEAD.pack(_MAGIC, len(text)))
    file.write(text)
    for data in encoder.arrays:
        file.write(data)


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


def load(
    file: BinaryIO,
    *,
    fixed: Mapping[str, object] | None = None,
    archived: Callable[[int], Archived[Any]] | None = None,
) -> Any:
    """Return the state that ``dump`` was given.

    Args:
        file: Its bytes.
        fixed: The parts that were not written, by name.
        archived: Returns the reference to the data that is kept at a place.

    Raises:
        DataError: The bytes are no state, or one of another version.
    """
    try:
        magic, length = _HEAD.unpack(file.read(_HEAD.size))
        if magic != _MAGIC:
            raise DataError("a state that cannot be read: it begins with other bytes")
        text = file.read(length)
        return _Decoder(file.read(), fixed or {}, archived).decode(json.loads(text))
    except DataError:
        raise
    except Exception as error:  # any class may refuse what another version of it wrote
        raise DataError(f"a state that cannot be read: {type(error).__name__}: {error}") from None


def loads(
    data: bytes,
    *,
    fixed: Mapping[str, object] | None = None,
    archived: Callable[[int], Archived[Any]] | None = None,
) -> Any:
    """Return the state that ``dumps`` was given; see ``load``."""
    return load(io.BytesIO(data), fixed=fixed, archived=archived)


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


class _Encoder:
    """Encoder of one state: each object is written once, and referred to by its number afterwards."""

    def __init__(
        self, fixed: Mapping[str, object], archive: Callable[[Archived[Any]], int] | None, *, whole: object
    ) -> None:
        self.arrays: list[bytes] = []
        self._end = 0
        self._fixed = {id(part): name for name, part in fixed.items()}
        self._archive = archive
        self._whole = whole
        self._numbers: dict[int, int] = {}
        self._kept: list[object] = []  # what has a number lives until the end, so that no other has its id

    def encode(self, part: Any) -> Any:
        if part is None or type(part) in (bool, int, float, str):
            return part
        if (name := self._fixed.get(id(part))) is not None:
            return {"fixed": name}
        if (number := self._numbers.get(id(part))) is not None:
            return {"same": number}
        if self._archive is not None:
            if isinstance(part, Archived):
                return {"archived": self._archive(part)}
            if isinstance(part, Archivable) and part is not self._whole:
                reference = reference_of(part)
                if reference is not None:
                    return {"data": self._archive(reference)}
        if type(part) is tuple:
            return {"tuple": self._all(part)}
        if isinstance(part, np.generic):
            return {"scalar": [np.lib.format.dtype_to_descr(part.dtype), part.tobytes().hex()]}
        if isinstance(part, Path):
            return {"path": str(part)}
        if isinstance(part, BaseModel):
            return {"model": [_name_of(part), part.model_dump(mode="json")]}
        if isinstance(part, tuple):
            return {"named": [_name_of(part), self._all(part)]}
        self._numbers[id(part)] = len(self._numbers)
        self._kept.append(part)
        match part:
            case np.ndarray():
                return {"array": self._array(part)}
            case bytes():
                return {"bytes": self._bytes(part)}
            case list():
                return {"list": self._all(part)}
            case OrderedDict():
                return {"ordered": self._pairs(part)}
            case dict():
                return {"dict": self._pairs(part)}
            case deque():
                return {"deque": [part.maxlen, self._all(part)]}
            case set() | frozenset():
                return {"set": self._all(sorted(part))}
            case Archived():
                return {"held": self.encode(part.data)}
        return {"object": [_name_of(part), self.encode(part.__getstate__())]}

    def _all(self, parts: Iterable[Any]) -> list[Any]:
        return [self.encode(part) for part in parts]

    def _pairs(self, part: Mapping[Any, Any]) -> list[Any]:
        return [[self.encode(key), self.encode(value)] for key, value in part.items()]

    def _bytes(self, data: bytes) -> list[int]:
        begin, self._end = self._end, self._end + len(data)
        self.arrays.append(data)
        return [begin, self._end]

    def _array(self, array: NDArray[Any]) -> list[Any]:
        """Return where an array's bytes are, and how it lies in them: with gaps if it has gaps in memory."""
        if array.dtype.hasobject:
            raise DataError("a state that cannot be written: an array of objects")
        if array.flags.c_contiguous:
            extent, first = array, 0
        elif array.flags.f_contiguous:
            extent, first = array.T, 0
        else:
            low, high = np.lib.array_utils.byte_bounds(array)
            extent = np.zeros(high - low, np.uint8)
            first = int(array.__array_interface__["data"][0]) - low
            _strided(extent, first, array.shape, array.strides, array.dtype)[...] = array
        layout = [np.lib.format.dtype_to_descr(array.dtype), array.shape, array.strides, first]
        return [self._bytes(extent.tobytes()), *layout, bool(array.flags.writeable)]


class _Decoder:
    def __init__(
        self, data: bytes, fixed: Mapping[str, object], archived: Callable[[int], Archived[Any]] | None
    ) -> None:
        self._data = memoryview(data)
        self._fixed = fixed
        self._archived = archived
        self._objects: list[Any] = []

    def decode(self, node: Any) -> Any:
        if not isinstance(node, dict):
            return node
        ((kind, value),) = node.items()
        match kind:
            case "fixed":
                if value not in self._fixed:
                    raise DataError(f"a state with a part {value!r} that is not there")
                return self._fixed[value]
            case "same":
                return self._objects[value]
            case "archived" | "data":
                if self._archived is None:
                    raise DataError("a state that refers to an archive")
                reference = self._archived(value)
                return reference if kind == "archived" else reference.data
            case "tuple":
                return tuple(map(self.decode, value))
            case "scalar":
                dtype = np.lib.format.descr_to_dtype(value[0])
                return np.frombuffer(bytes.fromhex(value[1]), dtype)[0]
            case "path":
                return Path(value)
            case "model":
                return _class_of(value[0], BaseModel).model_validate(value[1])
            case "named":
                return tuple.__new__(_class_of(value[0], tuple), map(self.decode, value[1]))
        return self._object(kind, value)

    def _object(self, kind: str, value: Any) -> Any:
        """Return what has a number: it is known by it before its parts are decoded."""
        match kind:
            case "array":
                return self._known(self._array(*value))
            case "bytes":
                return self._known(bytes(self._data[value[0] : value[1]]))
            case "list":
                items = self._known([])
                items.extend(map(self.decode, value))
                return items
            case "dict" | "ordered":
                made: dict[Any, Any] = self._known({} if kind == "dict" else OrderedDict())
                made.update((self.decode(key), self.decode(one)) for key, one in value)
                return made
            case "deque":
                queue = self._known(deque(maxlen=value[0]))
                queue.extend(map(self.decode, value[1]))
                return queue
            case "set":
                return self._known({self.decode(one) for one in value})
            case "held":
                place = len(self._objects)
                self._objects.append(None)
                self._objects[place] = Archived(self.decode(value))
                return self._objects[place]
            case "object":
                made_of = _class_of(value[0], object)
                instance = self._known(object.__new__(made_of))
                _set_state(instance, self.decode(value[1]))
                return instance
        raise DataError(f"a state with {kind!r}, which is no part of one")

    def _known(self, made: Any) -> Any:
        self._objects.append(made)
        return made

    def _array(
        self, place: list[int], descr: Any, shape: Any, strides: Any, first: int, is_writeable: bool
    ) -> NDArray[Any]:
        extent = np.frombuffer(self._data[place[0] : place[1]], np.uint8).copy()
        if isinstance(descr, list):
            descr = [tuple(map(_tuples, column)) for column in descr]
        array = _strided(extent, first, tuple(shape), tuple(strides), np.lib.format.descr_to_dtype(descr))
        array.flags.writeable = is_writeable
        return array


def _tuples(part: Any) -> Any:
    return tuple(part) if isinstance(part, list) else part


def _strided(
    extent: NDArray[np.uint8],
    first: int,
    shape: tuple[int, ...],
    strides: tuple[int, ...],
    dtype: np.dtype[Any],
) -> NDArray[Any]:
    """Return an array that lies in bytes as another lay in memory."""
    if dtype.hasobject:
        raise DataError("a state with an array of objects, which is no part of one")
    if not extent.size and 0 not in shape:  # NumPy checks no size of an empty buffer
        raise DataError(f"a state with an array of shape {shape} without its bytes")
    return np.ndarray(shape, dtype, extent.data, first, strides)


def _name_of(part: object) -> str:
    kind = type(part)
    name = f"{kind.__module__}.{kind.__qualname__}"
    if not name.startswith(_PACKAGES) or "<" in name:
        raise DataError(f"a state that cannot be written: {name}")
    return name


def _class_of(name: str, base: type) -> Any:
    """Return a class of this package's data by its name."""
    module, _, own = name.rpartition(".")
    if not name.startswith(_PACKAGES):
        raise DataError(f"a state with {name}, which is no part of one")
    found = vars(import_module(module)).get(own)
    if not isinstance(found, type) or not issubclass(found, base) or found.__module__ != module:
        raise DataError(f"a state with {name}, which is no part of one")
    return found


def _set_state(instance: Any, state: Any) -> None:
    """Give an object its attributes, as ``object.__getstate__`` or its class has listed them."""
    if hasattr(type(instance), "__setstate__"):
        instance.__setstate__(state)
        return
    own, slots = state if isinstance(state, tuple) else (state, None)
    for attributes in (own, slots):
        for name, value in (attributes or {}).items():
            object.__setattr__(instance, name, value)
