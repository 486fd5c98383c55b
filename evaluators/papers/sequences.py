"""Search for a paper's sequences in a folder, by any of their usual names."""

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from mapper.core.errors import ConfigError, SourceError

_RECORDINGS = frozenset({".bag", ".mcap", ".mbag"})
_WRAPPING = re.compile(r"^(rgbd_dataset_|tum_)+")
_ALSO = {"fr3_long_office_household": "fr3_long_office", "trajectory1": "poznan_trajectory1"}
LOOKED_FOR = (
    "folders and recordings (.bag, .mcap, .mbag) called as TUM calls them, rgbd_dataset_freiburg1_xyz, "
    "or freiburg1_xyz, fr1_xyz, tum_fr1_xyz"
)


@dataclass(frozen=True, slots=True)
class Found:
    """Sequences of a paper that are at hand.

    Attributes:
        logs: The log of each, in the paper's order.
        missing: The others, in the paper's order.
        notes: Sentences on what was ambiguous.
    """

    logs: Mapping[str, Path]
    missing: tuple[str, ...]
    notes: tuple[str, ...]


def find_sequences(folder: Path, names: Sequence[str], given: Mapping[str, Path]) -> Found:
    """Find a paper's sequences in a folder, which may be one of them itself, and in the folders in it.

    Args:
        folder: Folder that is searched.
        names: Names in the paper, e.g. "fr1/xyz".
        given: Paths of logs of other names; these come first.

    Raises:
        SourceError: The folder is missing, or none of the sequences is there.
        ConfigError: A given name is none of the paper's, or nothing is there.
    """
    for name, path in given.items():
        if name not in names:
            raise ConfigError(f"--log {name}={path}: no sequence of the paper; it has {', '.join(names)}")
        if not path.exists():
            raise ConfigError(f"--log {name}={path}: no such file or folder")
    if not folder.exists():
        raise SourceError(f"{folder}: no such file or folder")
    name_of = {_key(name): name for name in names}
    found: dict[str, Path] = dict(given)
    notes = []
    for path in _logs(folder, frozenset(name_of)):
        name = name_of[_key(_stem(path))]
        if name in given:
            continue
        if name in found:
            notes.append(f"{name} is there twice: {found[name]} is used, not {path}")
        found.setdefault(name, path)
    if not found:
        raise SourceError(
            f"{folder}: none of the sequences is there ({', '.join(names)}); looked for {LOOKED_FOR}; "
            f"a log of another name: --log {names[0]}=PATH"
        )
    return Found(
        {name: found[name] for name in names if name in found},
        tuple(name for name in names if name not in found),
        tuple(notes),
    )


def slug(name: str) -> str:
    """Return a sequence's name as a part of a file's: "fr1/xyz" becomes "fr1_xyz"."""
    return re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_")


def _logs(folder: Path, keys: Iterable[str]) -> Iterator[Path]:
    """Yield the logs named like a sequence: the folder itself, or its children and theirs."""
    if _key(_stem(folder.resolve())) in keys:
        yield folder
    elif folder.is_dir():
        for child in sorted(folder.iterdir()):
            if _is_log_of(child, keys):
                yield child
            elif child.is_dir():
                yield from (inner for inner in sorted(child.iterdir()) if _is_log_of(inner, keys))


def _is_log_of(path: Path, keys: Iterable[str]) -> bool:
    return (path.is_dir() or path.suffix.lower() in _RECORDINGS) and _key(_stem(path)) in keys


def _stem(path: Path) -> str:
    return path.stem if path.suffix.lower() in _RECORDINGS else path.name


def _key(name: str) -> str:
    """Return the part that all names of a sequence have in common: "fr1_xyz"."""
    key = _WRAPPING.sub("", slug(name.replace("ń", "n")))
    key = re.sub(r"^(?:freiburg|fr)_?(\d)_?", r"fr\1_", key)
    return _ALSO.get(key, key)
