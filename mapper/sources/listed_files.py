"""Files that a log lists: regular ones, within its folder."""

import os
import re
from collections.abc import Collection, Iterable, Sequence
from pathlib import Path, PurePath

from mapper.core.errors import SourceError, listed

_SENSOR_FILES = [
    re.compile(
        rf"(?:^|[^a-z])(?:{words}).*\.(?:txt|csv|tsv|json|ya?ml|xml|toml|log|np[yz]|tum|bag|mcap|db3)$", re.I
    )
    for words in (
        "ground.?truth|gt(?![a-z])|pose|traj",
        "imu|accel|gyro",
        "gnss|gps|oxts|navsat",
        "odom|wheel|encoder",
        "calib|intrinsic|cam.?info|camera",
    )
]
"""Names of files of each kind that a sensor or a calibration wrote; one of a kind is enough."""


def within(folder: Path, name: str, *, where: str) -> Path:
    """Return the path of a file that a list in a log's folder names.

    Args:
        folder: Folder that the names are relative to.
        name: Relative to it, or absolute and in it; the backslashes of Windows may separate its parts.
        where: Place of the name, for the message.

    Raises:
        SourceError: The name leads out of the folder, or is none.
    """
    path = PurePath(name.replace("\\", "/"))
    if path.is_absolute():
        homes = (folder.absolute(), folder.resolve())
        path = next((path.relative_to(home) for home in homes if path.is_relative_to(home)), path)
    if path.is_absolute() or ".." in path.parts or "\0" in name:
        raise SourceError(
            f"{where}: {name!r} leads out of the log's folder; want the name of a file within it"
        )
    return folder / path


def only_one(path: Path, found: Sequence[Path], what: str) -> Path:
    """Return the only log in a folder.

    Args:
        path: The folder.
        found: The logs in it.
        what: What they are, e.g. "sequences".

    Raises:
        SourceError: There are several.
    """
    if len(found) == 1:
        return found[0]
    names = listed([str(one.relative_to(path)) for one in found])
    raise SourceError(f"{path}: holds {len(found)} {what}; open one of {names}")


def present(paths: Iterable[Path]) -> list[bool]:
    """Return which files exist, listing each folder once: a stat per file is slow on network disks.

    What is neither a regular file nor a link to one does not.
    """
    listings: dict[Path, frozenset[str]] = {}
    found = []
    for path in paths:
        if path.parent not in listings:
            listings[path.parent] = frozenset(
                entry.name for entry in _entries(path.parent) if _is_regular(entry)
            )
        found.append(path.name in listings[path.parent])
    return found


def refuse_links_out(paths: Iterable[Path], *, log: Path) -> None:
    """Refuse files that are links out of their log: what is made of it could hold any file of the machine.

    A log's folder may be a link itself, and so may the folders in it, to wherever its files are kept.

    Args:
        paths: Files in the log's folder and in folders of it.
        log: The log's folder.

    Raises:
        SourceError: A file is a link to what lies neither in the log nor in the file's own folder.
    """
    names: dict[Path, set[str]] = {}
    for path in paths:
        names.setdefault(path.parent, set()).add(path.name)
    for folder, wanted in names.items():
        homes = [os.path.realpath(home) + os.sep for home in (log, folder)]
        for entry in _entries(folder):
            if entry.is_symlink() and entry.name in wanted:
                target = os.path.realpath(entry.path)
                if not target.startswith(tuple(homes)):
                    raise SourceError(
                        f"{entry.path}: a link to {target}, out of the log; copy the file, or let its folder "
                        "be the link"
                    )


def unused_note(folder: Path, read: Collection[Path]) -> list[str]:
    """Return a note on the sensors' files in a log's folder of whose kind none was read, by their names."""
    kinds = [kind for kind in _SENSOR_FILES if not any(kind.search(path.name) for path in read)]
    names = sorted(entry.name for entry in _entries(folder) if folder / entry.name not in read)
    unused = [name for name in names if any(kind.search(name) for kind in kinds)]
    if not unused:
        return []
    return [
        f"files that are not used: {listed(unused)}; truth is read from the file that "
        "source.truth_file names (of scans) or groundtruth.txt, an IMU from imu.csv or accelerometer.txt, "
        "wheels from wheels.txt or encoders.txt, GNSS fixes from gnss.txt, the camera from calibration.toml"
    ]


def _entries(folder: Path) -> list[os.DirEntry[str]]:
    try:
        with os.scandir(folder) as entries:
            return list(entries)
    except (OSError, ValueError):  # there is none, or its name cannot be one
        return []


def _is_regular(entry: os.DirEntry[str]) -> bool:
    try:
        return entry.is_file()
    except OSError:  # a link that cannot be followed
        return False
