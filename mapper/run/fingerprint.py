"""Fingerprint of a log: a hash of names, sizes and lists, without reading every image."""

import hashlib
import os
from collections.abc import Iterator
from pathlib import Path

_TEXT_SUFFIXES = frozenset({".txt", ".csv", ".json", ".toml", ".yaml", ".yml", ".tum", ".log"})
_SAMPLE_BYTES = 1 << 20


def fingerprint(path: Path) -> str:
    """Return ``sha256:…`` over the names and sizes of a log's files and the content of its lists.

    A single-file log, and the text files of a folder (lists, truth, calibration), count with their first
    and last MiB; images count with name and size. Modification times do not, so a copy is recognised.
    """
    digest = hashlib.sha256()
    if path.is_file():
        _add(digest, path, name=path.name, content=True)
    else:
        for name, file in _files(path):
            _add(digest, file, name=name, content=file.suffix in _TEXT_SUFFIXES)
    return f"sha256:{digest.hexdigest()}"


def _add(digest: "hashlib._Hash", file: Path, *, name: str, content: bool) -> None:
    size = file.stat().st_size
    digest.update(f"{name}\0{size}\0".encode())
    if not content:
        return
    with file.open("rb") as stream:
        digest.update(stream.read(_SAMPLE_BYTES))
        if size > _SAMPLE_BYTES:
            stream.seek(max(size - _SAMPLE_BYTES, _SAMPLE_BYTES))
            digest.update(stream.read(_SAMPLE_BYTES))


def _files(folder: Path) -> Iterator[tuple[str, Path]]:
    for parent, folders, names in os.walk(folder):
        folders.sort()
        for name in sorted(names):
            file = Path(parent) / name
            if file.is_file():  # a dangling link is listed but has no size
                yield str(file.relative_to(folder)), file
