"""Files and folders that are written whole or not at all."""

import ctypes
import errno
import json
import os
import secrets
import shutil
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path

from mapper.core.errors import RunError, SourceError, WriteError, listed

MANIFEST_NAME = "manifest.json"
"""File that identifies a folder of ours."""

_TEMPORARY = ".*.part*"
_MARK = ".mapper.part"
"""File that says of a folder without a manifest that it is ours and not whole."""
_DISK_ERRORS = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO}
_NO_FOLLOW = getattr(os, "O_NOFOLLOW", 0)
_FOLDER = getattr(os, "O_DIRECTORY", None)
"""None on Windows, which cannot open a folder."""
_AT_FDCWD, _RENAME_EXCHANGE = -100, 2  # linux/fcntl.h, linux/fs.h


@dataclass(frozen=True, slots=True)
class FolderKind:
    """Kind of folder that a verb writes, by which one that may be replaced is known.

    Attributes:
        name: Name in messages, as in "a run".
        manifest_keys: Keys that its ``manifest.json`` has.
        files: Names, or patterns of names, that may be in it.
        kind: Value of the manifest's ``kind``; None if it has none.
    """

    name: str
    manifest_keys: frozenset[str]
    files: frozenset[str]
    kind: str | None = None

    def wrote(self, folder: Path) -> bool:
        """Return whether the folder is empty, or has a manifest of this kind."""
        if not folder.is_dir() or folder.is_symlink():
            return False
        if not (folder / MANIFEST_NAME).is_file():
            return all(is_temporary(child.name) for child in folder.iterdir())
        try:
            manifest = json.loads((folder / MANIFEST_NAME).read_bytes())
        except (OSError, ValueError, RecursionError):
            return False
        if not isinstance(manifest, dict) or manifest.get("kind") != self.kind:
            return False
        return self.manifest_keys <= manifest.keys()

    def foreign_files(self, folder: Path) -> list[str]:
        """Return the names in a folder that no verb gave, sorted."""
        known = (*self.files, MANIFEST_NAME, _TEMPORARY)
        names = sorted(child.name for child in folder.iterdir())
        return [name for name in names if not any(fnmatchcase(name, pattern) for pattern in known)]


def is_temporary(name: str) -> bool:
    """Return whether a file's name is one of ``atomic_file``'s, which a process that is killed leaves."""
    return fnmatchcase(name, _TEMPORARY)


@contextmanager
def writing(path: Path, part: Path | None = None) -> Iterator[None]:
    """Name the file or folder that is being written in what the system says about it.

    Args:
        path: Its final name, for errors.
        part: Its name while it is not whole, if that is another.

    Raises:
        WriteError: It cannot be written, as when the disk is full.
    """
    try:
        yield
    except OSError as error:
        if (refusal := _write_error(path, part or path, error)) is None:
            raise
        raise refusal from None


def _write_error(path: Path, part: Path, error: OSError) -> WriteError | None:
    """Return the error of a write to a path; None for an error of something else.

    Errors of writes to an open file have no file name, and those of NumPy no error number either.
    """
    named = error.filename2 or error.filename
    if isinstance(named, str | os.PathLike):
        if not Path(named).is_relative_to(part) and not path.is_relative_to(named):
            return None
    elif error.errno is not None and error.errno not in _DISK_ERRORS:
        return None
    if error.errno == errno.EFBIG:
        return WriteError(f"{path}: cannot be written: {error.strerror}; raise the limit (ulimit -f)")
    reason = error.strerror or " ".join(str(error).split())
    return WriteError(f"{path}: cannot be written: {reason}; is there space and permission?")


@contextmanager
def atomic_file(path: Path) -> Iterator[Path]:
    """Yield a temporary sibling to write; on success it takes ``path``'s place, on failure it is removed.

    Raises:
        WriteError: It cannot be written, as when the disk is full.
    """
    # The ending stays last: writers such as OpenCV's choose the format by it.
    part = path.with_name(f".{path.stem[:100]}.{secrets.token_hex(8)}.part{path.suffix}")
    with writing(path, part):
        path.parent.mkdir(parents=True, exist_ok=True)
        flags = os.O_CREAT | os.O_EXCL | _NO_FOLLOW | os.O_WRONLY
        os.close(os.open(part, flags, 0o666))
        try:
            yield part
            part.replace(path)
        finally:
            part.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Write UTF-8 text atomically."""
    with atomic_file(path) as part:
        part.write_text(text, encoding="utf-8")


def write_json(path: Path, tree: object, *, indent: int = 2) -> None:
    """Write JSON atomically."""
    write_text(path, json.dumps(tree, indent=indent, ensure_ascii=False) + "\n")


def write_bytes(path: Path, data: bytes) -> None:
    """Write bytes atomically."""
    with atomic_file(path) as part:
        part.write_bytes(data)


def flush_to_disk(path: Path) -> None:
    """Wait until a file or a folder's list of names is on the disk, so that it survives a power cut."""
    if _FOLDER is None and path.is_dir():
        return
    handle = os.open(path, os.O_RDONLY)
    try:
        with writing(path):
            os.fsync(handle)
    except OSError as error:
        if error.errno != errno.EINVAL:  # as of /proc's files, which are on no disk
            raise
    finally:
        os.close(handle)


def partial_of(out: Path) -> Path:
    """Return where a folder is built before it is whole: a sibling, so that one rename finishes it.

    Raises:
        RunError: The path has no name, as the root folder has none.
    """
    if not out.name:
        raise RunError(f"{out}: has no name of its own; choose another --out")
    return out.with_name(f"{out.name}.partial")


@contextmanager
def atomic_folder(
    out: Path,
    kind: FolderKind,
    *,
    overwrite: bool = False,
    takes_over: bool = False,
    keeps: Callable[[Path], Collection[str]] = lambda _: (),
) -> Iterator[Path]:
    """Yield ``OUT.partial`` to fill; on success it takes OUT's place, on failure it stays for inspection.

    Args:
        out: Folder to create.
        kind: Kind of the folder; only such a folder is replaced, and only if nothing else is in it.
        overwrite: Replace a folder that is there; it stays untouched until the new one is whole.
        takes_over: The caller copies what else is in the folder that is replaced.
        keeps: Returns the names of what an earlier process left in ``OUT.partial`` that stays; what else is
            in it is deleted.

    Raises:
        RunError: OUT exists and may not be replaced, or another process is filling ``OUT.partial``.
        WriteError: It cannot be written, as when the disk is full.
    """
    out = out.resolve()
    _refuse_to_lose(out, kind, overwrite=overwrite, takes_over=takes_over)
    partial = partial_of(out)
    if (partial.exists() or partial.is_symlink()) and not (_is_marked(partial) or kind.wrote(partial)):
        raise RunError(f"{partial}: is in the way and not {kind.name}; move it or choose another --out")
    with _filled(partial, named=partial, keeps=keeps):
        yield partial
        put_in_place(partial, out)
        (out / _MARK).unlink(missing_ok=True)


@contextmanager
def _filled(
    partial: Path, *, named: Path, keeps: Callable[[Path], Collection[str]] = lambda _: ()
) -> Iterator[None]:
    """Hold a folder that is to be filled, marked as ours, without what an earlier process left in it.

    Raises:
        RunError: It cannot be made, or another process is filling it.
        WriteError: It cannot be written.
    """
    try:
        partial.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RunError(f"{partial}: cannot be created: {error.strerror}") from None
    with locked(partial), writing(named, partial):
        _empty(partial, except_for=keeps(partial))
        (partial / _MARK).touch()
        yield


def _is_marked(partial: Path) -> bool:
    return partial.is_dir() and not partial.is_symlink() and (partial / _MARK).is_file()


@contextmanager
def resumable_folder(out: Path, *, mark: str) -> Iterator[Path]:
    """Yield OUT to fill: a new folder, or one that an earlier session left unfinished or whole.

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
    with locked(out), writing(out):
        yield out


def refuse_existing(path: Path, *, overwrite: bool, option: str = "--out") -> None:
    """Refuse to write where something is already.

    Raises:
        RunError: It is there, and is not to be replaced.
    """
    if path.exists() and not overwrite:
        raise RunError(f"{path}: exists already; choose another {option}, or pass --overwrite to replace it")


def _refuse_to_lose(out: Path, kind: FolderKind, *, overwrite: bool, takes_over: bool) -> None:
    if not out.exists():
        return
    refuse_existing(out, overwrite=overwrite)
    if not kind.wrote(out):
        raise RunError(f"{out}: is not {kind.name}, so --overwrite will not replace it; choose another --out")
    if not takes_over and (foreign := kind.foreign_files(out)):
        raise RunError(
            f"{out}: holds files that are not of {kind.name}: {listed(foreign)}; move them, or choose "
            "another --out"
        )


@contextmanager
def locked(folder: Path, *, wait: bool = False) -> Iterator[None]:
    """Hold the folder's lock, which the system releases even when the process is killed.

    Windows has no locks of folders: nothing is held there.

    Args:
        folder: An existing folder, no symbolic link.
        wait: Wait for another process, which holds it for a moment only; else refuse.

    Raises:
        RunError: Another process holds it, or has put another folder in its place.
    """
    busy = RunError(f"{folder}: another process is filling it; wait, or choose another --out")
    if _FOLDER is None:
        yield
        return
    import fcntl

    handle = os.open(folder, os.O_RDONLY | _FOLDER | _NO_FOLLOW)
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
        except BlockingIOError:
            raise busy from None
        if not _is_at(handle, folder):
            raise busy
        yield
    finally:
        os.close(handle)


def _is_at(handle: int, folder: Path) -> bool:
    try:
        there = folder.lstat()
    except FileNotFoundError:
        return False
    return os.path.samestat(os.fstat(handle), there)


def _empty(folder: Path, *, except_for: Collection[str]) -> None:
    for child in folder.iterdir():
        if child.name in except_for:
            continue
        if child.is_dir() and not child.is_symlink():
            shutil.rmtree(child)
        else:
            child.unlink()


def put_in_place(partial: Path, out: Path) -> None:
    """Put a folder in the place of another one beside it, which is deleted, or where there is none.

    Raises:
        WriteError: The other one cannot be replaced.
    """
    if not out.exists():
        partial.rename(out)
        flush_to_disk(out.parent)
        return
    with locked(out, wait=True):
        try:
            _exchange(partial, out)
        except OSError as error:  # as where OUT is a mount point
            raise WriteError(
                f"{out}: cannot be replaced: {error.strerror}; choose another --out, or move it away"
            ) from None
        flush_to_disk(out.parent)
        shutil.rmtree(partial)


def _exchange(partial: Path, out: Path) -> None:
    """Exchange two names: at every instant, and after a power cut, OUT is the old folder or the new one."""
    rename = None if _FOLDER is None else getattr(ctypes.CDLL(None, use_errno=True), "renameat2", None)
    names = os.fsencode(partial), os.fsencode(out)
    if rename is not None and not rename(_AT_FDCWD, names[0], _AT_FDCWD, names[1], _RENAME_EXCHANGE):
        return
    # Not every file system can: here OUT is missing for an instant.
    old = out.with_name(f".{out.name}.{secrets.token_hex(8)}.old")
    out.rename(old)
    try:
        partial.rename(out)
    except OSError:
        old.rename(out)
        raise
    old.rename(partial)


@contextmanager
def new_folder(out: Path) -> Iterator[Path]:
    """Yield a folder to fill; it takes ``out``'s place when it is complete, and is gone if it never is.

    What a process that was killed left of it is replaced.

    Raises:
        SourceError: ``out`` is there and not empty, or something else is where it is filled.
        RunError: Another process is filling it.
        WriteError: It cannot be written, as when the disk is full.
    """
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise SourceError(f"{out}: exists already; give a folder that does not, or remove it")
    out = out.resolve()
    partial = partial_of(out)
    if (partial.exists() or partial.is_symlink()) and not _is_marked(partial):
        raise SourceError(f"{partial}: is in the way; move it or choose another folder")
    with _filled(partial, named=out):
        try:
            yield partial
            partial.rename(out)
            (out / _MARK).unlink()
        finally:
            shutil.rmtree(partial, ignore_errors=True)
