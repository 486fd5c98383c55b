"""Single clouds, and folders of them in any of the formats of ``cloud_files.ENDINGS``."""

import re
from collections.abc import Sequence
from pathlib import Path

from mapper.core.errors import SourceError
from mapper.runtime.atomic import MANIFEST_NAME
from mapper.sources.base import Log
from mapper.sources.cloud_files.pcd import viewpoint_note
from mapper.sources.config import SourceConfig
from mapper.sources.listed_files import only_one
from mapper.sources.scan_folders.scan_folder import (
    clouds_in,
    first_of,
    is_cloud_name,
    most_clouds,
    scan_log,
)
from mapper.sources.scan_stamps import stamps_list
from mapper.sources.trajectory_files import has_poses

_TRUTH_FILES = ("groundtruth.txt", "poses.txt")
_LIKE_TRUTH = re.compile(r"ground.?truth|(?<![a-z])gt(?![a-z])|global_pose", re.IGNORECASE)


def recognise(path: Path) -> bool:
    """Return whether a path is a cloud, a folder with two clouds or more, or holds such folders."""
    return (path.is_file() and is_cloud_name(path)) or bool(_folders(path))


def read_log(path: Path, config: SourceConfig) -> Log:
    """Return the log of a folder of clouds, or of the only such folder in a folder.

    Raises:
        SourceError: It is a single cloud, there are several folders, no cloud matches the pattern, or a text
            file is malformed.
        DataError: A line of poses is malformed.
    """
    if path.is_file():
        raise SourceError(
            f"{path}: one cloud is no log; open the folder of its scans, "
            "or align it to another: mapper register SOURCE TARGET"
        )
    readable: list[tuple[Path, list[Path], list[str]]] = []
    refused: list[str] = []
    for folder in _folders(path):
        try:
            readable.append((folder, *clouds_in(folder, config.pattern)))
        except SourceError as error:
            refused.append(str(error))
    if not readable:
        raise SourceError(refused[0])
    only_one(path, [folder for folder, _, _ in readable], "folders of clouds")
    folder, files, notes = readable[0]
    if not files:
        raise SourceError(f"{folder}: no cloud matches source.pattern={config.pattern}")
    if files[-1].suffix == ".pcd":
        notes = [*notes, *viewpoint_note(files[-1])]
    log, _ = scan_log(
        path,
        files,
        kind="clouds",
        stamps_file=stamps_list((folder, path)),
        truth_file=_truth_file((folder, path)),
        config=config,
        notes=[*notes, *refused],
    )
    return log


def _truth_file(folders: Sequence[Path]) -> Path | None:
    """Return the file of true poses: by its usual name, or by its columns where it is called truth."""
    if (usual := first_of(folders, _TRUTH_FILES)) is not None:
        return usual
    named = (path for folder in folders for path in sorted(folder.iterdir()) if _LIKE_TRUTH.search(path.stem))
    texts = (path for path in named if path.suffix.lower() in (".csv", ".txt", ".tum") and path.is_file())
    return next(filter(has_poses, texts), None)


def _folders(path: Path) -> list[Path]:
    if _has_two(path):
        return [path]
    return sorted(folder for folder in path.glob("*") if folder.is_dir() and _has_two(folder))


def _has_two(folder: Path) -> bool:
    return (
        most_clouds(folder) >= 2 and not (folder / MANIFEST_NAME).is_file()
    )  # of a run, whose clouds are maps
