import re

from mapper.pipeline import warm_up
from mapper.run.folder import open_run
from tests.support.command_line import invoke


def test_depth_of_a_camera_of_its_own_takes_part_in_poses(tmp_path):
    """The log of scans is built in test_platforms.py."""
    warm_up._build_rgbd(tmp_path / "log")
    run = open_run(tmp_path / "log_run")
    assert any("depth" in record.diagnostics.method for record in run.records)
    assert run.open_log()[0].is_depth_moved


def test_the_verb_compiles_and_says_how_many_there_are(monkeypatch):
    monkeypatch.setattr(warm_up, "compile_kernels", lambda **_: None)
    assert re.search(r"numba cache +\d+ compiled kernels kept in ", invoke("doctor", "--warm").stdout)
    assert invoke("doctor", "run", "--warm").exit_code == 1
