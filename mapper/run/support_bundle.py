"""Support bundle: what a report of a fault needs, and nothing that was measured."""

import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from zipfile import ZIP_DEFLATED, ZipFile, ZipInfo

from mapper.core.errors import MapperError, RunError
from mapper.run import files
from mapper.runtime.atomic import atomic_file
from mapper.runtime.doctor import Finding
from mapper.runtime.regular_files import read_text
from mapper.sources.config import SourceConfig
from mapper.sources.inspection import inspect_log

_OF_RUN = (files.MANIFEST, files.CONFIG, files.FRAMES, files.FRAME_MS, files.LOOPS, files.EDITS)
"""Settings, versions, outcomes and times: no image, no point, no trajectory."""


def write_bundle(path: Path, findings: Sequence[Finding], run: Path | None) -> list[str]:
    """Write a zip file of a machine's findings, of a run's records, and of what its log looks like.

    Args:
        path: The file; it replaces an earlier one.
        findings: Checks of the machine and its libraries.
        run: Run folder, if the report is about one; one that failed ends in ``.partial``.

    Returns:
        Names of the files in it.

    Raises:
        RunError: There is no manifest in the folder.
        WriteError: It cannot be written.
    """
    if run is not None and not (run / files.MANIFEST).is_file():
        raise RunError(f"{run}: no {files.MANIFEST} in it; want a run, or the .partial of one that failed")
    texts = {"doctor.json": _json([asdict(finding) for finding in findings])}
    if run is not None:
        for name in _OF_RUN:
            if (run / name).is_file():
                texts[name] = read_text(run / name)
        texts["inspect.json"] = _json(_inspected(run))
    with atomic_file(path) as part, ZipFile(part, "w", ZIP_DEFLATED) as bundle:
        for name, text in texts.items():
            bundle.writestr(ZipInfo(name), text, ZIP_DEFLATED)
    return [*texts]


def _inspected(run: Path) -> object:
    """Return what ``mapper inspect`` says of the log of a run, finished or not, or why it says nothing."""
    try:
        log = json.loads(read_text(run / files.MANIFEST))["input"]["path"]
        settings = json.loads(read_text(run / files.CONFIG)).get("source", {})
        return asdict(inspect_log(Path(log), SourceConfig.model_validate(settings)))
    except (MapperError, KeyError, TypeError, ValueError, AttributeError) as error:
        return {"error": f"{error}"}


def _json(tree: object) -> str:
    return json.dumps(tree, indent=2, default=str, ensure_ascii=False)
