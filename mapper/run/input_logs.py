"""Logs that a run was made from: recognised by a fingerprint, opened again, compared with what they were."""

import hashlib
import os
from collections.abc import Iterator
from itertools import zip_longest
from pathlib import Path

from mapper.core.errors import RunError
from mapper.core.units import MIB
from mapper.run.manifest import Manifest
from mapper.run.manifest_logs import Input, InputLog
from mapper.sources import open_source
from mapper.sources.base import Log
from mapper.sources.config import SourceConfig
from mapper.sources.multi_session_log import chained, sessions_of

_TEXT_SUFFIXES = frozenset({".txt", ".csv", ".json", ".toml", ".yaml", ".yml", ".tum", ".log"})


def fingerprint(path: Path) -> str:
    """Return ``sha256:…`` over the names and sizes of a log's files and the content of its lists.

    A single-file log, and the text files of a folder (lists, truth, calibration), count with their first
    and last MiB; images count with name and size. Modification times do not, so a copy is recognised.
    """
    digest = hashlib.sha256()
    if path.is_file():
        _hash_file(digest, path, name=path.name, content=True)
    else:
        for name, file in _files(path):
            _hash_file(digest, file, name=name, content=file.suffix in _TEXT_SUFFIXES)
    return f"sha256:{digest.hexdigest()}"


def _hash_file(digest: "hashlib._Hash", file: Path, *, name: str, content: bool) -> None:
    size = file.stat().st_size
    digest.update(f"{name}\0{size}\0".encode())
    if not content:
        return
    with file.open("rb") as stream:
        digest.update(stream.read(MIB))
        if size > MIB:
            stream.seek(max(size - MIB, MIB))
            digest.update(stream.read(MIB))


def _files(folder: Path) -> Iterator[tuple[str, Path]]:
    for parent, folders, names in os.walk(folder):
        folders.sort()
        for name in sorted(names):
            file = Path(parent) / name
            if file.is_file():  # a dangling link is listed but has no size
                yield str(file.relative_to(folder)), file


def open_inputs(manifest: Manifest, config: SourceConfig, *, run: Path) -> Log:
    """Return the log that a run was made from, with the same frames selected and all that was appended.

    Their gyroscopes are calibrated as by the build.

    Args:
        manifest: Names the logs.
        config: Settings of the first log.
        run: The run's folder, for errors.

    Raises:
        RunError: A log is no longer there, or is not what it was.
        SourceError: It cannot be opened.
    """
    known = manifest.input
    source = manifest.with_body_rates(_open(known, config, run))
    for log in known.appended:
        later = _open(log, log.source, run)
        later = later if log.gyroscope is None else log.gyroscope.applied_to(later)
        source = chained(source, later, shift_ns=log.shift_ns)
    refuse_another_log(known, source, run=run)
    return source


def _open(log: InputLog, config: SourceConfig, run: Path) -> Log:
    path = Path(log.path)
    if not path.exists():
        raise RunError(f"{path}: the log of {run} is no longer there; give its new place with --log")
    return open_source(path, config)


def refuse_another_log(known: Input, source: Log, *, run: Path) -> None:
    """Refuse a log that is not the one that a run was made from.

    Raises:
        RunError: Its fingerprint differs, or that of a log that was appended.
    """
    logs = (known, *known.appended)
    for path, log in zip_longest(paths_of(source), logs):
        if path is None or log is None:
            raise RunError(
                f"{source.path}: {run} was made from {len(logs)} logs; open them with Run.open_log"
            )
        if fingerprint(path) != log.fingerprint:
            raise RunError(f"{path}: changed since {run} was built from it; build it again")


def paths_of(source: Log) -> list[Path]:
    """Return the paths of the logs that a log is made of."""
    return [session.log.path for session in sessions_of(source)]
