"""Folders that appear whole or not at all."""

import fcntl
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from mapper.errors import RunError

MARK = "manifest.json"
"""The file by which a folder is known to be ours, and so may be replaced when asked to."""


def partial_of(out: Path) -> Path:
    """Return where a folder is built before it is whole: a sibling, so that one rename finishes it."""
    return out.with_name(f"{out.name}.partial")


@contextmanager
def staged(
    out: Path, *, overwrite: bool = False, keeps: Callable[[Path], bool] = lambda _: False
) -> Iterator[Path]:
    """Yield ``OUT.partial`` to fill; on success it takes OUT's place, on failure it stays for inspection.

    Args:
        out: Folder to create.
        overwrite: Replace a folder of ours that is there; it stays untouched until the new one is whole.
        keeps: Tells whether what an earlier process left in ``OUT.partial`` is still of use.

    Raises:
        RunError: OUT exists and may not be replaced, or another process is filling ``OUT.partial``.
    """
    out = out.resolve()
    _refuse_to_lose(out, overwrite=overwrite)
    partial = partial_of(out)
    if partial.exists() and not _is_ours(partial):
        raise RunError(f"{partial}: is in the way and no unfinished run; move it or choose another --out")
    try:
        partial.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RunError(f"{partial}: cannot be created: {error.strerror}") from None
    with locked(partial):
        if not keeps(partial):
            _empty(partial)
        yield partial
        _swap(partial, out)


@contextmanager
def resumed(out: Path, *, mark: str) -> Iterator[Path]:
    """Yield OUT to go on filling: a new folder, or one that an earlier session left unfinished or whole.

    Args:
        out: The folder.
        mark: Name of the file by which such a folder is known; the caller writes it first of all.

    Raises:
        RunError: OUT holds something else, cannot be made, or another process is filling it.
    """
    out = out.resolve()
    if out.exists() and not (out.is_dir() and ((out / mark).is_file() or not any(out.iterdir()))):
        raise RunError(f"{out}: holds something else (no {mark}); choose another --out")
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RunError(f"{out}: cannot be created: {error.strerror}") from None
    with locked(out):
        yield out


def _refuse_to_lose(out: Path, *, overwrite: bool) -> None:
    if not out.exists():
        return
    if not overwrite:
        raise RunError(f"{out}: exists already; choose another --out, or pass --overwrite to replace it")
    if not _is_ours(out):
        raise RunError(f"{out}: is not a run folder (no {MARK}), so --overwrite will not replace it")


def _is_ours(folder: Path) -> bool:
    return folder.is_dir() and ((folder / MARK).is_file() or not any(folder.iterdir()))


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Hold the folder's lock, which the system releases even when the process is killed."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise RunError(
                f"{folder}: another process is filling it; wait, or choose another --out"
            ) from None
        yield
    finally:
        os.close(handle)


def _empty(folder: Path) -> None:
    for child in folder.iterdir():
        if child.is_dir() and not child.is_symlink():
            shutil.rmtree(child)
        else:
            child.unlink()


def _swap(partial: Path, out: Path) -> None:
    if not out.exists():
        partial.rename(out)
        return
    old = out.with_name(f".{out.name}.{os.getpid()}.old")
    out.rename(old)
    try:
        partial.rename(out)
    except OSError:
        old.rename(out)
        raise
    shutil.rmtree(old)
