"""Text for a terminal: control characters in names of files, topics and logs are shown escaped."""

import os
import re
import sys
from typing import Any, TextIO

_CONTROLS = re.compile(
    "[\x00-\x08\x0b-\x1f\x7f-\x9f"  # all but tab and line feed: escape sequences begin with one of these
    "\u061c\u200e\u200f\u202a-\u202e\u2066-\u2069"  # those that change the direction of writing
    "\u2028\u2029\ud800-\udfff]"  # line separators; bytes of names that are no UTF-8
)
_STYLES = {"bold": "\x1b[1m", "name": "\x1b[36m", "good": "\x1b[32m", "doubt": "\x1b[33m", "bad": "\x1b[31m"}
_RESET = "\x1b[0m"
_STATES = {
    "trusted": "good",
    "yes": "good",
    "ok": "good",
    "doubtful": "doubt",
    "warn": "doubt",
    "broken in parts": "bad",
    "FAIL": "bad",
}
_STATE = re.compile(rf"^((?:verdict|trusted) +)?({'|'.join(_STATES)})(?= |$)", re.MULTILINE)
_HEADING = re.compile(r"^\S.*:$|^(?:Usage|Example):|^(?:map|look|judge|edit|study|tools)(?= )", re.MULTILINE)
_OPTION = re.compile(r"(?<=^  )-[\w-]+(?:, --?[\w-]+)*", re.MULTILINE)
_VERB = re.compile(r"^((?:map|look|judge|edit|study|tools) +| {8})([a-z]+(?:-[a-z]+)*)(?=  )", re.MULTILINE)


def escaped(text: str, *, one_line: bool = False) -> str:
    r"""Return the text with control characters as ``\x1b``; with ``one_line`` line feeds as ``\n``, too."""
    text = _CONTROLS.sub(lambda found: found[0].encode("unicode_escape").decode("ascii"), text)
    return text.replace("\n", "\\n") if one_line else text


class EscapingStream:
    """Text stream that escapes what is written to it; everything else is the wrapped stream's."""

    def __init__(self, stream: TextIO) -> None:
        self.raw = stream

    def write(self, text: str) -> int:
        """Write the text, escaped; the end of all colours, which colorama writes at exit, as it is."""
        self.raw.write(text if text == _RESET else escaped(text))
        return len(text)

    def writelines(self, lines: Any) -> None:
        """Write the lines, escaped."""
        for line in lines:
            self.write(line)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.raw, name)


def print_text(text: str) -> None:
    """Print an answer; on a terminal the verdict is coloured, unless ``NO_COLOR`` is set."""
    _print(text, _coloured_state)


def print_help(text: str) -> None:
    """Print a verb's help; on a terminal headings and names are coloured, unless ``NO_COLOR`` is set."""
    _print(text, _coloured_help)


def _print(text: str, coloured: Any) -> None:
    if not has_colours(sys.stdout):
        print(text)
        return
    # What is printed to standard output is escaped, so the escape sequences of colours go past it.
    stream = getattr(sys.stdout, "raw", sys.stdout)
    stream.write(f"{coloured(escaped(text))}\n")


def has_colours(stream: TextIO) -> bool:
    """Return whether colours may be written: to a terminal that supports them, without ``NO_COLOR``."""
    return stream.isatty() and not os.environ.get("NO_COLOR") and os.environ.get("TERM", "dumb") != "dumb"


def _styled(text: str, style: str) -> str:
    return f"{_STYLES[style]}{text}{_RESET}"


def _coloured_state(text: str) -> str:
    return _STATE.sub(lambda found: (found[1] or "") + _styled(found[2], _STATES[found[2]]), text)


def _coloured_help(text: str) -> str:
    text = _VERB.sub(lambda found: found[1] + _styled(found[2], "name"), text)
    text = _OPTION.sub(lambda found: _styled(found[0], "name"), text)
    return _HEADING.sub(lambda found: _styled(found[0], "bold"), text)
