"""What the command line tells numba, and what it asks of it."""

from mapper.cli.environment import has_compiled_code


def test_compiled_code_is_found_where_numba_keeps_it(tmp_path, monkeypatch):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    assert not has_compiled_code()
    (tmp_path / "mapper_0123").mkdir()
    (tmp_path / "mapper_0123" / "kernels.cast_rays-155.py311.nbi").touch()
    assert has_compiled_code()
