"""Files and folders that are written whole or not at all."""

import fcntl
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from mapper.core.errors import RunError, SourceError

MANIFEST_NAME = "manifest.json"
"""File that marks a folder as one of ours, which ``--overwrite`` may replace."""


@contextmanager
def atomic_file(path: Path) -> Iterator[Path]:
    """Yield a temporary sibling to write; on success it takes ``path``'s place, on failure it is removed."""
    path.parent.mkdir(parents=True, exist_ok=True)
    # The ending stays last: writers such as OpenCV's choose the format by it.
    part = path.with_name(f".{path.stem}.{os.getpid()}.part{path.suffix}")
    try:
        yield part
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Write UTF-8 text atomically."""
    with atomic_file(path) as part:
        part.write_text(text, encoding="utf-8")


def write_bytes(path: Path, data: bytes) -> None:
    """Write bytes atomically."""
    with atomic_file(path) as part:
        part.write_bytes(data)


def partial_of(out: Path) -> Path:
    """Return where a folder is built before it is whole: a sibling, so that one rename finishes it."""
    return out.with_name(f"{out.name}.partial")


@contextmanager
def atomic_folder(
    out: Path, *, overwrite: bool = False, keeps: Callable[[Path], bool] = lambda _: False
) -> Iterator[Path]:
    """Yield ``OUT.partial`` to fill; on success it takes OUT's place, on failure it stays for inspection.

    Args:
        out: Folder to create.
        overwrite: Replace a folder of ours that is there; it stays untouched until the new one is whole.
        keeps: Returns whether the files that an earlier process left in ``OUT.partial`` can be kept.

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
def resumable_folder(out: Path, *, mark: str) -> Iterator[Path]:
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
        raise RunError(f"{out}: is not a run folder (no {MANIFEST_NAME}), so --overwrite will not replace it")


def _is_ours(folder: Path) -> bool:
    return folder.is_dir() and ((folder / MANIFEST_NAME).is_file() or not any(folder.iterdir()))


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


@contextmanager
def new_folder(out: Path) -> Iterator[Path]:
    """Yield a folder to fill; it takes ``out``'s place when it is complete, and is gone if it never is.

    Raises:
        SourceError: ``out`` is there and not empty, or cannot be written.
    """
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise SourceError(f"{out}: exists already; give a folder that does not, or remove it")
    out = out.resolve()
    partial = out.with_name(f"{out.name}.{os.getpid()}.partial")
    try:
        partial.mkdir(parents=True, exist_ok=True)
        yield partial
        partial.rename(out)
    except OSError as error:
        raise SourceError(
            f"{out}: cannot be written: {error.strerror}; is there space and permission?"
        ) from None
    finally:
        shutil.rmtree(partial, ignore_errors=True)
