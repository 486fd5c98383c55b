"""Checks of every library: installed, new enough, and correct on a tiny job."""

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import metadata

from mapper.doctor.finding import Finding
from mapper.doctor.machine import processors
from mapper.doctor.system_libraries import apt_line
from mapper.runtime.extras import DISTRIBUTION, install_line

_TIMEOUT_S = 60.0
REQUIREMENT = re.compile(r"(?P<name>[\w.-]+)(\[[\w,]*\])?(>=(?P<least>[\d.]+))?")
_EXTRA = re.compile(r"""extra == ['"](?P<name>[\w-]+)['"]""")
_MISSING_OBJECT = re.compile(r"(?P<object>lib[\w.+-]+\.so[\w.]*): cannot open shared object file")


@dataclass(frozen=True, slots=True)
class Requirement:
    """A library that this package names.

    Attributes:
        least: Its least version.
        extra: The extra that brings it; None if all need it.
    """

    least: str = "0"
    extra: str | None = None


_ANY = Requirement()


def requirements() -> dict[str, Requirement]:
    """Return every library that this package needs or can use, by its name in pip.

    There are none where the package is not installed.
    """
    found: dict[str, Requirement] = {}
    try:
        lines = metadata.requires(DISTRIBUTION) or ()
    except metadata.PackageNotFoundError:
        return found
    for line in lines:
        match, extra = REQUIREMENT.match(line), _EXTRA.search(line)
        if match is None or (extra is not None and extra["name"] in {"all", "dev"}):
            continue
        found.setdefault(match["name"], Requirement(match["least"] or "0", extra and extra["name"]))
    return found


def check_library(name: str, wanted: Requirement = _ANY) -> Finding:
    """Return whether a library is installed, of at least a version, and passes its self-test."""
    least = wanted.least
    mend = f"pip install '{name}>={least}'"
    try:
        version = metadata.version(name)
    except metadata.PackageNotFoundError:
        if wanted.extra is not None:
            return Finding(name, "well", f"optional, not installed: {install_line(wanted.extra)}")
        return Finding(name, "failed", "not installed", mend)
    if _numbers(version) < _numbers(least):
        return Finding(name, "failed", f"{version}, want at least {least}", mend)
    return tried(
        name,
        version,
        [sys.executable, "-m", "mapper.doctor.self_tests", name],
        again=f"pip install --force-reinstall --no-cache-dir '{name}=={version}'",
    )


def tried(
    name: str, version: str, command: Sequence[str], *, again: str, timeout_s: float | None = None
) -> Finding:
    """Run a self-test in a process of its own, and return how it ended.

    Args:
        name: Name of the library.
        version: Version of the library.
        command: Ends with status 0 if the library works.
        again: Command that reinstalls the library.
        timeout_s: Longer is a failure; None: a minute, and more where processes wait for processors.
    """
    if timeout_s is None:
        timeout_s = usual_timeout_s()
    began = time.monotonic()
    try:
        ended = subprocess.run(command, capture_output=True, text=True, timeout=timeout_s, check=False)
    except subprocess.TimeoutExpired:
        return Finding(
            name,
            "failed",
            f"{version}, self-test still busy after {timeout_s:.0f} s",
            f"try again; then {again}",
        )
    if ended.returncode == 0:
        return Finding(name, "well", f"{version}, self-test passed in {time.monotonic() - began:.1f} s")
    if ended.returncode < 0:
        killer = signal.Signals(-ended.returncode)
        return Finding(name, "failed", f"{version}, self-test ended by {killer.name}", _after(killer, again))
    said = (ended.stderr.strip().splitlines() or [f"exit status {ended.returncode}"])[-1]
    missing = _MISSING_OBJECT.search(said)
    remedy = again if missing is None else apt_line([missing["object"]])
    return Finding(name, "failed", f"{version}, {said}", remedy)


def usual_timeout_s() -> float:
    """Return how long a self-test may take: a minute, times the processes that share a processor."""
    if not hasattr(os, "getloadavg"):
        return _TIMEOUT_S
    return _TIMEOUT_S * max(1.0, os.getloadavg()[0] / processors())


def _after(killer: signal.Signals, again: str) -> str:
    if killer is signal.SIGILL:
        return "this processor lacks instructions that the wheel uses: build the library from source"
    if killer is signal.SIGKILL:
        return "was there memory enough? see dmesg; then try again"
    return again


def _numbers(version: str) -> list[int]:
    return [int(number) for number in re.findall(r"\d+", version)[:3]]
