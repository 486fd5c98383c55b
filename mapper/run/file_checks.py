"""Checks of all files of a finished run or localised log, for ``mapper doctor RUN``."""

from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import partial
from pathlib import Path

from mapper.run import files
from mapper.run.digests import THREADS, fault_of
from mapper.run.folder import Run, open_run
from mapper.run.manifest import FileDigest, LocalisedManifest, is_localised_log, read_manifest_of
from mapper.runtime.atomic import is_temporary
from mapper.runtime.doctor import Finding
from mapper.runtime.ordered_map import ordered_map
from mapper.runtime.progress import SILENT, Progress


def check_run(folder: Path, *, progress: Progress = SILENT) -> list[Finding]:
    """Compare every file of a run or a localised log with its size and SHA-256 in the manifest.

    Args:
        folder: The run, or the localised log.
        progress: Receives how many files were checked.

    Raises:
        RunError: There is no finished run, or its manifest or its settings are damaged.
    """
    others: Iterable[Finding] = ()
    if is_localised_log(folder):
        localised = read_manifest_of(folder / files.MANIFEST, LocalisedManifest)
        digests = localised.files
        found = _hashed(folder, digests, lambda _: f"restore it, or localise again in {localised.map}")
    else:
        run = open_run(folder)
        digests, others = run.manifest.files, _unrecorded(run)
        remedy = partial(files.remedy_for, folder=folder)
        found = _hashed(folder, digests, remedy)
    findings = []
    with progress.stage("check") as report:
        for done, finding in enumerate(found, start=1):
            findings.append(finding)
            report(done, len(digests))
    return [*findings, *others]


def _hashed(
    folder: Path, digests: Mapping[str, FileDigest], remedy: Callable[[str], str]
) -> Iterator[Finding]:
    def check(name: str) -> Finding:
        path, wanted = folder / name, digests[name]
        if fault := fault_of(path, wanted):
            is_gone = name in files.DISPENSABLE and not path.exists()  # a run is whole without it
            return Finding(name, "warning" if is_gone else "failed", fault, remedy(name))
        return Finding(name, "well", f"{wanted.size_bytes} bytes, SHA-256 {wanted.sha256[:12]}…")

    return ordered_map(check, sorted(digests), workers=THREADS)


def _unrecorded(run: Run) -> Iterator[Finding]:
    """Yield what lies in the run without a digest, but for a user's own files."""
    for path in run.files():
        if is_temporary(path.name):
            yield Finding(path.name, "warning", "left by a process that was killed", f"delete {path}")
        elif path.name in files.RUN.files - {files.MANIFEST, *run.manifest.files}:
            remedy = files.remedy_for(path.name, run.path)
            yield Finding(
                path.name, "warning", "has no digest: its writer was killed, or it is a copy", remedy
            )
