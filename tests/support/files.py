"""Content of a folder, to see whether it has changed."""

import hashlib
from pathlib import Path


def files_of(folder: Path) -> dict[str, bytes]:
    """Return the bytes of every file of a folder without subfolders, by name."""
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def digest_of(folder: Path) -> str:
    """Return a SHA-256 of the names and bytes of all files below a folder."""
    digest = hashlib.sha256()
    for path in sorted(path for path in folder.rglob("*") if path.is_file()):
        digest.update(f"{path.relative_to(folder)}\0{path.stat().st_size}\0".encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()
