"""Paths of results that a caller does not name: after the log or run, with a number if that is taken."""

import os
from collections import Counter
from collections.abc import Sequence
from itertools import count
from pathlib import Path

from mapper.core.errors import RunError
from mapper.runtime.atomic import locked, partial_of

RUNS, LOGS, MAPS, DIFFS = Path("runs"), Path("logs"), Path("maps"), Path("diffs")
_MOST_NAMED = 3
_LONGEST_NAME_BYTES = 255 - len(".partial")
"""Longest name on Linux's file systems, less what is added to it while a folder is filled."""


def place_of(out: Path | None, usual: Path, *, overwrite: bool = False) -> Path:
    """Return where a result goes: as given, else the usual place, or with ``-2`` and so on while it is taken.

    With ``overwrite`` the usual place is replaced.
    """
    if out is not None:
        return out
    if overwrite or not _is_taken(usual):
        return usual
    numbered = (usual.with_name(f"{usual.stem}-{number}{usual.suffix}") for number in count(2))
    return next(path for path in numbered if not _is_taken(path))


def result_path(path: Path) -> Path:
    """Return a path that something may be written to, without ``..`` and with a name of its own.

    Raises:
        RunError: It is the root folder, or one of its names is too long for a file system.
    """
    if not path.name or ".." in path.parts:
        path = path.resolve()
    if not path.name:
        raise RunError(f"{path}: has no name of its own; name a file or folder in it")
    if longest := next((part for part in path.parts if len(os.fsencode(part)) > _LONGEST_NAME_BYTES), None):
        raise RunError(
            f"{longest}: a name of {len(os.fsencode(longest))} bytes, at most "
            f"{_LONGEST_NAME_BYTES} can be written; choose a shorter one"
        )
    return path


def name_of(path: Path) -> str:
    """Return the name of a log or run by its path, without a file's ending."""
    name = path.name if path.name not in ("", "..") else path.resolve().name
    return Path(name).stem if path.is_file() else name or "log"


def joined_names(paths: Sequence[Path]) -> str:
    """Return one name for several runs: the same paths always have the same."""
    names = [name_of(path) for path in paths[:_MOST_NAMED]]
    more = [f"{len(paths) - _MOST_NAMED}-more"] if len(paths) > _MOST_NAMED else []
    return "+".join([*names, *more])


def distinct_names(runs: Sequence[Path]) -> list[str]:
    """Return the folders' names, or their paths as given where names are not unique."""
    short = [run.resolve().name for run in runs]
    seen = Counter(short)
    return [str(run) if seen[name] > 1 else name for run, name in zip(runs, short, strict=True)]


def _is_taken(path: Path) -> bool:
    if path.exists() or path.is_symlink():
        return True
    partial = partial_of(path.resolve())
    if not partial.is_dir() or partial.is_symlink():
        return False
    try:
        with locked(partial):
            return False
    except RunError:
        return True
