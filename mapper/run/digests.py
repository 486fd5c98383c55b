"""Size and SHA-256 of a run's files: recorded when they are written, compared when they are read."""

import hashlib
import os
import stat
from collections.abc import Callable, Iterable, Iterator, Mapping, Set
from contextlib import contextmanager, suppress
from pathlib import Path

from mapper.core.errors import RunError, WriteError
from mapper.core.units import MIB
from mapper.run import files
from mapper.run.manifest import FileDigest, read_manifest
from mapper.runtime.atomic import flush_to_disk, locked
from mapper.runtime.ordered_map import ordered_map

MOST_HASHED_BYTES = 128 * MIB
"""A larger file is compared by its size alone when it is read, as hashing would delay the reader by more than
0.1 s; ``mapper doctor RUN`` hashes every file."""
THREADS = 4


def digest_of(path: Path) -> FileDigest:
    """Return a file's size and SHA-256."""
    with path.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
        return FileDigest(size_bytes=os.fstat(file.fileno()).st_size, sha256=digest)


def digests_of(folder: Path, names: Iterable[str] | None = None) -> dict[str, FileDigest]:
    """Return the digests of a run's files, by name, after waiting until they are on the disk.

    Args:
        folder: The run.
        names: Names of the files; None takes all that a verb may have written. Missing files are left out,
            and the manifest, which will hold the digests.
    """
    wanted = set(files.RUN.files if names is None else names) - {files.MANIFEST}
    there = sorted(name for name in wanted if (folder / name).is_file())

    def work(name: str) -> FileDigest:
        flush_to_disk(folder / name)
        return digest_of(folder / name)

    return dict(zip(there, ordered_map(work, there, workers=THREADS), strict=True))


@contextmanager
def changing(folder: Path, names: Iterable[str]) -> Iterator[None]:
    """Let a verb write files into a finished run while inside, and put their digests into its manifest.

    They have none meanwhile, so that a process that is killed leaves no digest of a file that is gone.
    """
    names = set(names)
    _replace_digests(folder, names, dict)
    try:
        yield
    except BaseException:
        with suppress(WriteError):  # the first error is the one to report
            _replace_digests(folder, names, lambda: digests_of(folder, names))
        raise
    _replace_digests(folder, names, lambda: digests_of(folder, names))


def _replace_digests(folder: Path, names: Set[str], new: Callable[[], Mapping[str, FileDigest]]) -> None:
    folder = folder.resolve()
    with locked(folder, wait=True):
        path = folder / files.MANIFEST
        manifest = read_manifest(path)
        if not manifest.files:
            return
        kept = {name: digest for name, digest in manifest.files.items() if name not in names}
        changed = dict(sorted({**kept, **new()}.items()))
        if changed != manifest.files:
            manifest.model_copy(update={"files": changed}).save(path)


def checked(folder: Path, name: str, digests: Mapping[str, FileDigest]) -> Path:
    """Return the path of a run's file after comparing it with its digest; without one it is not compared.

    Raises:
        RunError: It is missing, or is not as it was written, or is no regular file.
    """
    if name in digests:
        path = folder / name
        if fault := fault_of(path, digests[name], most_hashed_bytes=MOST_HASHED_BYTES):
            raise RunError(f"{path}: {fault}; {files.remedy_for(name, folder)}")
    return regular(folder / name)


def regular(path: Path) -> Path:
    """Return the path of something in a run's folder, which may be missing, or a folder of the user's.

    Raises:
        RunError: It is a pipe or a device, of which nothing may ever come.
    """
    if path.exists() and not path.is_file() and not path.is_dir():
        raise RunError(f"{path}: no regular file")
    return path


def fault_of(path: Path, wanted: FileDigest, *, most_hashed_bytes: int | None = None) -> str:
    """Return how a file differs from its digest; empty if it does not.

    Args:
        path: The file.
        wanted: Its digest when it was written.
        most_hashed_bytes: A larger file is compared by its size alone; None hashes any.
    """
    try:
        status = path.stat()
        if not stat.S_ISREG(status.st_mode):
            return "is no regular file"
        size_bytes = status.st_size
        if size_bytes != wanted.size_bytes:
            return f"has {size_bytes} bytes, was written with {wanted.size_bytes}"
        if most_hashed_bytes is not None and size_bytes > most_hashed_bytes:
            return ""
        found = digest_of(path)
    except FileNotFoundError:
        return f"is missing, was written with {wanted.size_bytes} bytes"
    except OSError as error:
        return f"cannot be read: {error.strerror}"
    if found.sha256 != wanted.sha256:
        return f"has SHA-256 {found.sha256[:12]}…, was written with {wanted.sha256[:12]}…"
    return ""
