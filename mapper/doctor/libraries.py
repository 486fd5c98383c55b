"""Checks of every library: installed, new enough, and importable in a process of its own."""

import re
import subprocess
import sys
from dataclasses import dataclass
from importlib import metadata

from mapper.doctor.machine import Finding, apt_line, machine_findings, processors
from mapper.runtime.extras import DISTRIBUTION, install_line
from mapper.runtime.ordered_map import ordered_map
from mapper.runtime.progress import SILENT, Progress

_REQUIREMENT = re.compile(r"(?P<name>[\w.-]+)(\[[\w,]*\])?(>=(?P<least>[\d.]+))?")
_EXTRA = re.compile(r"""extra == ['"](?P<name>[\w-]+)['"]""")
_MISSING_OBJECT = re.compile(r"(?P<object>lib[\w.+-]+\.so[\w.]*): cannot open shared object file")
MODULES = {
    "foxglove-sdk": "foxglove",
    "opencv-contrib-python-headless": "cv2",
    "protobuf": "google.protobuf",
    "rerun-sdk": "rerun",
}
"""Names in ``import`` of libraries that have another one in pip."""
_TIMEOUT_S = 120.0  # Open3D takes 10 s on an idle machine


@dataclass(frozen=True, slots=True)
class Requirement:
    """A library that this package names.

    Attributes:
        name: Its name in pip.
        least: Its least version.
        extra: The extra that brings it; None if all need it.
    """

    name: str
    least: str = "0"
    extra: str | None = None


def examine(*, progress: Progress = SILENT) -> list[Finding]:
    """Check the machine, then import every library in a process of its own, one per processor at a time."""
    findings, wanted = machine_findings(), requirements()
    with progress.stage("try") as report:
        for done, finding in enumerate(ordered_map(check_library, wanted, workers=processors()), start=1):
            findings.append(finding)
            report(done, len(wanted))
    return findings


def requirements() -> list[Requirement]:
    """Return every library that this package needs or can use; none where the package is not installed."""
    found: dict[str, Requirement] = {}
    try:
        lines = metadata.requires(DISTRIBUTION) or ()
    except metadata.PackageNotFoundError:
        return []
    for line in lines:
        match, extra = _REQUIREMENT.match(line), _EXTRA.search(line)
        if match is None or (extra is not None and extra["name"] in {"all", "dev"}):
            continue
        name = match["name"]
        found.setdefault(name, Requirement(name, match["least"] or "0", extra and extra["name"]))
    return list(found.values())


def check_library(wanted: Requirement) -> Finding:
    """Return whether a library is installed, of at least a version, and can be imported."""
    name, again = wanted.name, f"pip install '{wanted.name}>={wanted.least}'"
    try:
        version = metadata.version(name)
    except metadata.PackageNotFoundError:
        if wanted.extra is not None:
            return Finding(name, "well", f"optional, not installed: {install_line(wanted.extra)}")
        return Finding(name, "failed", "not installed", again)
    if _numbers(version) < _numbers(wanted.least):
        return Finding(name, "failed", f"{version}, want at least {wanted.least}", again)
    again = f"pip install --force-reinstall --no-cache-dir '{name}=={version}'"
    module = MODULES.get(name, name.replace("-", "_"))
    command = [sys.executable, "-c", f"import {module}"]
    try:
        ended = subprocess.run(command, capture_output=True, text=True, timeout=_TIMEOUT_S, check=False)
    except subprocess.TimeoutExpired:
        return Finding(name, "failed", f"{version}, not imported after {_TIMEOUT_S:.0f} s", again)
    if ended.returncode == 0:
        return Finding(name, "well", version)
    said = (ended.stderr.strip().splitlines() or [f"exit status {ended.returncode}"])[-1]
    missing = _MISSING_OBJECT.search(said)
    return Finding(
        name, "failed", f"{version}, {said}", again if missing is None else apt_line([missing["object"]])
    )


def _numbers(version: str) -> list[int]:
    return [int(number) for number in re.findall(r"\d+", version)[:3]]
