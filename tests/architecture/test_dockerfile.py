"""The Dockerfile keeps hadolint's rules and fits the project; no Docker is needed."""

import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from tests.support.paths import ROOT

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())


@pytest.fixture
def hadolint():
    beside_python = str(Path(sys.executable).parent)
    found = shutil.which("hadolint", path=beside_python) or shutil.which("hadolint")
    if found is None:
        pytest.skip("hadolint is not installed; the extra dev brings it")

    def check(text):
        done = subprocess.run([found, "-"], input=text, capture_output=True, text=True, check=False)
        return done.stdout + done.stderr

    return check


def test_the_dockerfile_keeps_the_rules(hadolint):
    text = (ROOT / "Dockerfile").read_text()
    assert hadolint(text) == ""
    assert "DL3066" in hadolint(text.replace("USER 1000", "USER mapper"))


def test_nothing_runs_as_root():
    stage = (ROOT / "Dockerfile").read_text().rpartition("FROM ")[2]
    assert re.findall(r"^USER (\S+)$", stage, re.MULTILINE) == ["1000"]


def test_the_image_has_a_python_that_the_project_allows():
    (version,) = set(re.findall(r"FROM python:(3\.\d+)", (ROOT / "Dockerfile").read_text()))
    assert f"Programming Language :: Python :: {version}" in PROJECT["project"]["classifiers"]


def test_the_builder_gets_all_that_the_wheel_is_made_of():
    sent = {line[1:] for line in (ROOT / ".dockerignore").read_text().splitlines() if line.startswith("!")}
    packages = {name.rstrip("*") for name in PROJECT["tool"]["setuptools"]["packages"]["find"]["include"]}
    packages |= {path.resolve().name for path in (ROOT / "mapper").iterdir() if path.is_symlink()}
    files = {PROJECT["project"]["readme"], *PROJECT["project"]["license-files"]}
    assert sent == packages | files | {"pyproject.toml"}
