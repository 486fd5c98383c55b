"""Rules of the Dockerfile, after hadolint's; no Docker is needed."""

import json
import re
import tomllib

import pytest

from tests.support.paths import ROOT

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
KNOWN = {"ARG", "CMD", "COPY", "ENTRYPOINT", "ENV", "FROM", "HEALTHCHECK", "LABEL", "RUN", "USER", "WORKDIR"}


def instructions(text):
    """Return (keyword, arguments) of each instruction, continued lines joined."""
    lines = [line for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]
    joined = re.sub(r"\\\n\s*", "", "\n".join(lines))
    return [(line.split(maxsplit=1)[0], line.split(maxsplit=1)[1]) for line in joined.splitlines()]


def faults(text):
    """Return what is wrong with a Dockerfile."""
    found, user, folder = [], "root", "/"
    for keyword, rest in instructions(text):
        if keyword not in KNOWN:
            found.append(f"{keyword}: unknown, or better done otherwise (ADD: COPY)")
        if keyword == "FROM":
            user, folder = "root", "/"
            image = rest.split()[0]
            if ":" not in image or image.endswith(":latest"):
                found.append(f"FROM {image}: want a tag of a version")
        if keyword == "USER":
            user = rest.split(":")[0]
        if keyword == "WORKDIR":
            folder = rest
            if not rest.startswith("/"):
                found.append(f"WORKDIR {rest}: want an absolute path")
        if keyword in {"CMD", "ENTRYPOINT"} and not _is_list(rest):
            found.append(f"{keyword} {rest}: want a JSON list, so that signals reach the program")
        if keyword == "RUN":
            if re.search(r"\bpip (install|wheel)\b", rest) and "--no-cache-dir" not in rest:
                found.append("pip without --no-cache-dir")
            if "apt-get install" in rest and not {"--no-install-recommends", "-y"} <= set(rest.split()):
                found.append("apt-get install without -y --no-install-recommends")
            if "apt-get update" in rest and "rm -rf /var/lib/apt/lists" not in rest:
                found.append("apt-get update leaves its lists in the image")
            if re.search(r"\bsudo\b|\bcd /", rest):
                found.append("sudo, or cd where WORKDIR would do")
        if keyword == "COPY" and rest.endswith(" .") and folder == "/":
            found.append("COPY into the root folder")
    if user in {"root", "0"}:
        found.append("the last user is root")
    return found


def _is_list(text):
    try:
        return isinstance(json.loads(text), list)
    except ValueError:
        return False


def test_the_dockerfile_keeps_the_rules():
    assert faults((ROOT / "Dockerfile").read_text()) == []


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("FROM python\nUSER me", "want a tag"),
        ("FROM python:latest\nUSER me", "want a tag"),
        ("FROM python:3.12", "last user is root"),
        ("FROM python:3.12\nUSER me\nFROM python:3.12", "last user is root"),
        ("FROM a:1\nUSER me\nWORKDIR data", "absolute"),
        ("FROM a:1\nUSER me\nCMD mapper", "JSON list"),
        ("FROM a:1\nUSER me\nRUN x \\\n && pip install x", "no-cache-dir"),
        ("FROM a:1\nUSER me\nRUN apt-get install x", "no-install-recommends"),
        ("FROM a:1\nUSER me\nRUN apt-get update", "lists"),
        ("FROM a:1\nUSER me\nADD http://x y", "ADD"),
        ("FROM a:1\nUSER me\nCOPY . .", "root folder"),
    ],
)
def test_a_breach_is_found(text, fault):
    assert any(fault in one for one in faults(text)), faults(text)


def test_the_image_has_a_python_that_the_project_allows():
    (version,) = set(re.findall(r"FROM python:(3\.\d+)", (ROOT / "Dockerfile").read_text()))
    assert f"Programming Language :: Python :: {version}" in PROJECT["project"]["classifiers"]


def test_the_builder_gets_all_that_the_wheel_is_made_of():
    sent = {line[1:] for line in (ROOT / ".dockerignore").read_text().splitlines() if line.startswith("!")}
    packages = {name.rstrip("*") for name in PROJECT["tool"]["setuptools"]["packages"]["find"]["include"]}
    packages |= {path.resolve().name for path in (ROOT / "mapper").iterdir() if path.is_symlink()}
    files = {PROJECT["project"]["readme"], *PROJECT["project"]["license-files"]}
    assert sent == packages | files | {"pyproject.toml"}
