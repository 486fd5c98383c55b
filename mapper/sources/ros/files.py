"""Recordings recognised by their names, and opened by the reader of their format."""

import re
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from mapper.core.errors import SourceError, listed
from mapper.runtime.regular_files import read_text
from mapper.sources.base import Log
from mapper.sources.config import SourceConfig
from mapper.sources.listed_files import refuse_links_out
from mapper.sources.ros.ouster_recording import OusterRecording
from mapper.sources.ros.reader import RecordingReader
from mapper.sources.ros.recording import Recording
from mapper.sources.ros.source import recording_log

_ENDINGS = (".mcap", ".bag", ".db3")
_MAGIC = {b"\x89MCAP0\r\n": ".mcap", b"#ROSBAG V2.0": ".bag", b"SQLite format 3\0": ".db3"}
_UNFINISHED = ".active"
"""What rosbag appends to the name while it records, and leaves where it is killed."""
_PACKED = ".zstd"
_NAMED = re.compile(r"^\s*-\s*([^:\n]+\.(?:mcap|db3)(?:\.zstd)?)\s*$", re.MULTILINE)
_PART = re.compile(r"_(\d{1,4})$")
_IN_FOLDERS = (".mcap", ".db3", _PACKED, ".bag")


def recognise(path: Path) -> bool:
    """Return whether a path is a recording by its name or bytes, or is a folder of the parts of one."""
    if path.is_dir():
        return bool(_parts(path))
    if not path.is_file():
        return False
    return path.suffix.lower() in (*_ENDINGS, _PACKED, _UNFINISHED) or bool(_ending_by_bytes(path))


def read_log(path: Path, config: SourceConfig) -> Log:
    """Return the log of a recording.

    Raises:
        SourceError: It is damaged beyond reading, or nothing in it can be mapped.
    """
    return recording_log(RecordingReader(open_recording(path)), config)


def open_recording(path: Path) -> Recording:
    """Open a file, or those files of a folder that can be read, one after the other.

    Raises:
        SourceError: The file, or every file of the folder, is not what its name says or cannot be read.
    """
    if not path.is_dir():
        return OusterRecording(_opened(path))
    from mapper.sources.ros.ros2_bag import JoinedRecording

    files = _parts(path)
    refuse_links_out(files, log=path)
    parts: list[Recording] = []
    lost: list[str] = []
    for part in files:
        try:
            parts.append(_opened(part))
        except SourceError as error:
            lost.append(str(error))
    if not parts:
        raise SourceError(lost[0])
    lost += [
        f"{name}: metadata.yaml names it, but it is not there"
        for name in _named_by_rosbag2(path)
        if not (path / name).exists()
    ]
    missing = [] if _named_by_rosbag2(path) else _missing_numbers(files)
    if missing:
        lost.append(f"no part {listed(missing)} between those of {files[0].name} and {files[-1].name}")
    others = [one.name for one in path.glob("*") if one.suffix in _ENDINGS and one not in files]
    lost += [f"{name}: another recording, which is not read; open it alone" for name in sorted(others)]
    return OusterRecording(JoinedRecording(path, sorted(parts, key=_begin_ns), lost=lost))


def _begin_ns(part: Recording) -> int:
    """Return when a recording begins: parts may be numbered in another order, or anew."""
    first = next(part.messages(), None)
    return 0 if first is None else first.log_ns


def _missing_numbers(files: Sequence[Path]) -> list[str]:
    """Return the numbers between those of LOG_0 and LOG_2 that no part has; times go in larger steps."""
    found = [_PART.search(path.name.partition(".")[0]) for path in files]
    numbers = {int(one[1]) for one in found if one is not None}
    missing = sorted({*range(min(numbers, default=0), max(numbers, default=0))} - numbers)
    return [str(one) for one in missing] if len(missing) < len(numbers) == len(files) else []


def _named_by_rosbag2(folder: Path) -> list[str]:
    """Return the files that a folder's metadata.yaml names."""
    with suppress(SourceError):
        text = read_text(folder / "metadata.yaml", error=SourceError)
        return [Path(name).name for name in _NAMED.findall(text)]
    return []


def _ending_by_bytes(path: Path) -> str:
    """Return the ending that a file's first bytes stand for; empty where they tell none."""
    with suppress(OSError), path.open("rb") as file:
        head = file.read(max(map(len, _MAGIC)))
        return next((ending for magic, ending in _MAGIC.items() if head.startswith(magic)), "")
    return ""


def _opened(path: Path) -> Recording:
    # Each reader loads a library that the others do not need.
    ending = _ending_by_bytes(path) or path.suffix.lower()
    if ending == ".mcap":
        from mapper.sources.ros.mcap_file import open_mcap

        return open_mcap(path)
    if ending in (".bag", _UNFINISHED):
        from mapper.sources.ros.ros1_bag import open_bag

        return open_bag(path)
    if ending == ".db3":
        from mapper.sources.ros.ros2_bag import DatabaseRecording

        return DatabaseRecording(path)
    if ending == _PACKED:
        raise SourceError(
            f"{path}: compressed as a whole, so no part can be read alone; unpack it first: zstd -d {path}"
        )
    raise SourceError(f"{path}: not a recording; known are {', '.join(_ENDINGS)}")


def _parts(folder: Path) -> list[Path]:
    """Return a folder's recordings in sequence, of the first kind that is there.

    Names of parts differ in their dates and numbers alone, or stand in metadata.yaml; other recordings lie
    side by side by chance, and are no parts.
    """
    from mapper.sources.ros.ros2_bag import in_sequence

    for ending in _IN_FOLDERS:
        endings = (ending, f"{ending}{_UNFINISHED}")
        parts = [path for path in folder.glob("*") if path.name.lower().endswith(endings) and path.is_file()]
        if len({re.sub(r"[\d_.-]+", "", path.name.lower().partition(ending)[0]) for path in parts}) > 1:
            named = _named_by_rosbag2(folder)
            parts = [path for path in parts if path.name in named]
        if parts:
            return in_sequence(parts)
    return []
