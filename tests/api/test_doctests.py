"""The examples in the docstrings of the public functions give what they say."""

import doctest
import io

import pytest

import mapper

WITH_EXAMPLES = [name for name in mapper.__all__ if ">>>" in (getattr(mapper, name).__doc__ or "")]


@pytest.mark.parametrize("name", WITH_EXAMPLES)
def test_examples_of(name, desk_log, desk_run, tmp_path):
    names = {
        "mapper": mapper,
        "load_config": mapper.load_config,
        "log_folder": desk_log,
        "new_folder": tmp_path / "run",
        "run": desk_run,
    }
    (test,) = doctest.DocTestFinder(recurse=False).find(getattr(mapper, name), name, globs=names)
    assert test.examples
    told = io.StringIO()
    doctest.DocTestRunner().run(test, out=told.write)
    assert told.getvalue() == ""


def test_functions_tell_arguments_errors_and_an_example():
    for name in ("build", "evaluate", "load_config", "open_log", "register"):
        text = getattr(mapper, name).__doc__
        assert all(part in text for part in ("Args:", "Raises:", "Example:")), name
