import re

import pytest

from mapper.pipeline import warm_up
from mapper.simulation.config import SynthConfig
from tests.support.command_line import invoke


@pytest.mark.parametrize("job", [warm_up._build_rgbd, warm_up._build_rolling_shutter])
def test_a_log_of_images_is_built_and_exported(tmp_path, monkeypatch, job):
    """Of fewer pixels than set-up has; the log of scans is built in test_platforms.py."""
    small = SynthConfig(duration_s=0.5, width_px=160, height_px=120, texture_px_per_m=64)
    monkeypatch.setattr(warm_up, "_CAMERA", small)
    job(tmp_path / "log")
    assert (tmp_path / "log_run" / "map.octree").exists()


def test_the_verb_compiles_and_says_how_many_there_are(monkeypatch):
    monkeypatch.setattr(warm_up, "compile_kernels", lambda **_: None)
    assert re.search(r"numba cache +\d+ compiled kernels kept in ", invoke("doctor", "--warm").stdout)
    assert invoke("doctor", "run", "--warm").exit_code == 1
