import re

import pytest

from mapper.pipeline import warm_up
from mapper.pipeline.warm_up import _build_lidar, _build_rgbd
from tests.support.command_line import invoke


@pytest.mark.slow
@pytest.mark.parametrize(("job", "runs"), [(_build_rgbd, 2), (_build_lidar, 1)])
def test_each_sensor_s_log_is_built(tmp_path, job, runs):
    job(tmp_path / "log")
    assert len(list(tmp_path.glob("*/map.octree"))) == runs


def test_the_verb_compiles_and_says_how_many_there_are(monkeypatch):
    monkeypatch.setattr(warm_up, "compile_kernels", lambda **_: None)
    assert re.search(r"numba cache +\d+ compiled kernels kept in ", invoke("doctor", "--warm").stdout)
    assert invoke("doctor", "run", "--warm").exit_code == 1
