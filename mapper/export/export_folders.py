"""Folders that an export writes whole, each with a manifest by which a later export knows that it may go."""

import json
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path

from mapper.run.map_folder import MapFolder
from mapper.runtime.atomic import MANIFEST_NAME, FolderKind, atomic_folder, write_text


@contextmanager
def export_folder(run: MapFolder, path: Path, kind: str, *, files: Collection[str]) -> Iterator[Path]:
    """Yield the folder to fill; on success it takes the place of an earlier one of its kind.

    Args:
        run: The run or map that is exported.
        path: Folder to make.
        kind: The exporter's name.
        files: Names, or patterns of names, that may be in it.

    Raises:
        RunError: PATH holds something else.
    """
    known = FolderKind(f"an export as {kind}", manifest_keys=frozenset({kind, "run"}), files=frozenset(files))
    with atomic_folder(path, known, overwrite=True) as folder:
        write_text(folder / MANIFEST_NAME, json.dumps({kind: 1, "run": str(run.path.resolve())}) + "\n")
        yield folder
