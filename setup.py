"""Compiles the kernels into the wheel, so that the first build of a log need not.

All else is in pyproject.toml. The environment variable MAPPER_KERNELS=0 leaves them out.
"""

import os
import subprocess
import sys
import tomllib
from pathlib import Path

from setuptools import setup
from setuptools.command.build_py import build_py

WITH_KERNELS = os.environ.get("MAPPER_KERNELS", "1") != "0"
PROJECT = tomllib.loads(Path(__file__).with_name("pyproject.toml").read_text(encoding="utf-8"))["project"]
COMPILE = "from mapper.cli.main import main; main()"


class BuildWithKernels(build_py):
    """Copies the modules, then compiles their kernels beside the copies; numba checks them by content."""

    def run(self) -> None:
        """Copy and compile; what cannot be compiled here is compiled by the first build of a log."""
        super().run()
        if self.editable_mode:
            return
        # setuptools leaves build/lib to the next build: numba notices that a kernel's own module has changed
        # since, but not one whose kernels it calls.
        for file in Path(self.build_lib).rglob("*.nb[ic]"):
            file.unlink()
        if not WITH_KERNELS:
            return
        environment = dict(os.environ)
        environment.pop("NUMBA_CACHE_DIR", None)
        ran = subprocess.run(
            [sys.executable, "-c", COMPILE, "doctor", "--warm"], cwd=self.build_lib, env=environment
        )
        if ran.returncode:
            self.warn("the kernels could not be compiled; the first build of a log will do it, or say why")


setup(
    cmdclass={"build_py": BuildWithKernels},
    setup_requires=PROJECT["dependencies"] if WITH_KERNELS else [],
)
