"""Options that exclude or need each other are refused, with both names and what to do."""

from pathlib import Path

import pytest

from mapper.cli.options import refuse_several, refuse_with, refuse_without
from mapper.core.errors import ConfigError
from tests.support.command_line import mapper


def test_options_that_are_not_given_are_not_refused():
    nothing = {"--a": None, "--b": False, "--c": []}
    refuse_several({**nothing, "--d": 0})
    refuse_with("--e", nothing)
    refuse_without("--e", nothing)


@pytest.mark.parametrize(
    ("value", "shown"), [(0, "--a 0"), (True, "--a"), ([2.5, 1.0], "--a 2.5"), (Path("x"), "--a x")]
)
def test_the_first_option_that_is_given_is_named_with_its_value(value, shown):
    options = {"--none": None, "--a": value, "--z": 1}
    with pytest.raises(ConfigError, match=rf"^{shown}: has no meaning with --e; use --f$"):
        refuse_with("--e", options, remedy="use --f")
    with pytest.raises(ConfigError, match=rf"^{shown}: has no meaning without --e$"):
        refuse_without("--e", options)
    with pytest.raises(ConfigError, match=r"^--none, --a and --z: choose one$"):
        refuse_several(options)


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["build", "LOG", "--onto", "RUN", "--fresh"], "--fresh: has no meaning with --onto; leave it out"),
        (["diff", "A", "B", "--place", "auto", "--poses", "P"], "--place and --poses: choose one"),
        (["diff", "A", "B", "--place", "built", "--tolerance-m", 50], "tolerance_m is 50 m; want 0 to 1"),
        (["doctor", "RUN", "--accept", "slice.pgm", "--warm"], "RUN RUN: has no meaning with --warm"),
        (["edit", "RUN", "--log", "LOG"], "has no meaning without --erase, --keep, --keepout, --undo"),
        (["eval", "RUN", "--tolerance", 0], "--tolerance 0: has no meaning without --map"),
        (["export", "RUN", "--as", "grid", "--level", 1], "--level 1: has no meaning with --as grid"),
        (["loops", "RUN", "--log", "LOG"], "--log LOG: has no meaning without --add or --remove"),
        (
            ["plan", "RUN", "--from", 0, 0, 1, "--to", 1, 1, 1, "--3d", "--layer", "slice"],
            "--layer slice: has no meaning with --3d",
        ),
    ],
)
def test_no_option_is_ignored(words, expected, desk_run):
    words = [desk_run.path if word in ("RUN", "A", "B") else word for word in words]
    result = mapper(*words, status=1)
    expected = expected.replace("RUN RUN", f"RUN {desk_run.path}")
    assert expected in result.stderr
    assert (
        "mapper: doctor: " in mapper("doctor", desk_run.path, "--bundle", status=2).stderr
    )  # which wants a value
