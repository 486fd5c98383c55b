"""Identity of a build: all that its result depends on. Only the same build is resumed."""

import hashlib
import json
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

from mapper.config.build import BuildConfig
from mapper.core.config import flattened
from mapper.core.errors import RunError, listed
from mapper.core.trajectory import Trajectory
from mapper.run import files
from mapper.run.input_logs import fingerprint
from mapper.run.manifest import Manifest, library_versions
from mapper.runtime.atomic import MANIFEST_NAME, write_json
from mapper.sources.base import Log

IDENTITY = "identity.json"
"""File of a folder of checkpoints, written first."""
_WITHOUT_EFFECT = {"octree": {"max_memory_mb"}}
"""Settings without effect on the result: a build that ran out of memory is resumed with another limit."""


def identity_of(source: Log, config: BuildConfig, poses: Trajectory | None) -> dict[str, Any]:
    """Return all that the result of a build depends on: log, settings and their files, poses, versions."""
    manifest = Manifest.model_fields
    return {
        "log": str(source.path.resolve()),
        "fingerprint": fingerprint(source.path),
        "config": json.loads(config.model_dump_json(exclude=_WITHOUT_EFFECT)),
        "poses": "" if poses is None else _digest(poses.stamps_ns.tobytes() + poses.T_world_body.tobytes()),
        "files": {
            name: _digest(path.read_bytes())
            for name, path in flattened(config.model_dump()).items()
            if isinstance(path, Path) and path.is_file()
        },
        "versions": {
            "mapper": manifest["mapper_version"].default,
            "mapper's code": _code_digest(),
            "Python": manifest["python_version"].default,
            "platform": manifest["platform"].default,
            **library_versions(),
        },
    }


def _digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()[:12]


@cache
def _code_digest() -> str:
    """Return a digest of the package's code: a state fits the classes that wrote it."""
    root, digest = Path(__file__).parents[1], hashlib.sha256()
    for path in sorted(root.rglob("*.py")):
        digest.update(f"{path.relative_to(root)}\0".encode() + path.read_bytes())
    return digest.hexdigest()[:12]


def write_identity(path: Path, identity: Mapping[str, Any]) -> None:
    """Write what the result of a build depends on, with a digest of it; atomic."""
    write_json(path, {**identity, "digest": _digest_of(identity)}, indent=1)


def _read_identity(path: Path) -> dict[str, Any]:
    """Return what was written.

    Raises:
        ValueError: It is torn or damaged.
        OSError: It cannot be read.
    """
    known: dict[str, Any] = json.loads(path.read_bytes())
    if not isinstance(known, dict) or known.pop("digest", None) != _digest_of(known):
        raise ValueError(f"{path}: damaged")
    return known


def _digest_of(identity: Mapping[str, Any]) -> str:
    return _digest(json.dumps(identity).encode())


def kept_from_before(partial: Path, identity: Mapping[str, Any], *, fresh: bool) -> tuple[str, ...]:
    """Return the names of the files from which a build can be resumed in a folder that was left.

    Raises:
        RunError: The folder has checkpoints of another build.
    """
    if fresh or not (partial / files.CHECKPOINTS).is_dir():
        return ()
    try:
        known = _read_identity(partial / files.CHECKPOINTS / IDENTITY)
    except (OSError, ValueError):
        return ()  # it was killed before anything else was written, or is damaged
    if differences := _differences(known, identity):
        raise RunError(
            f"{partial}: an unfinished build with {listed(differences, most=3)}; finish it with the "
            "arguments it had, or begin anew with --fresh"
        )
    return (MANIFEST_NAME, files.CHECKPOINTS, files.SCAN_UPDATES)


def _differences(known: Mapping[str, Any], wanted: Mapping[str, Any]) -> list[str]:
    if known["fingerprint"] != wanted["fingerprint"]:
        return [f"another log ({known['log']}, or as it was before it changed)"]
    if known["poses"] != wanted["poses"]:
        return ["other poses"]
    settings, versions = (
        [
            f"{name}{mark}{before.get(name)}, not {now.get(name)}"
            for name in sorted({*before, *now})
            if before.get(name) != now.get(name)
        ]
        for before, now, mark in (
            (flattened(known["config"]), flattened(wanted["config"]), "="),
            (known["versions"], wanted["versions"], " "),
        )
    )
    changed = known["files"].items() ^ wanted["files"].items() if not settings else set()
    return [
        *settings,
        *(f"another file of {name}" for name in sorted({name for name, _ in changed})),
        *versions,
    ]
