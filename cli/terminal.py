"""Text for a terminal: control characters in names of files, topics and logs are shown escaped."""

import re
from typing import Any, TextIO

_CONTROLS = re.compile(
    "[\x00-\x08\x0b-\x1f\x7f-\x9f"  # all but tab and line feed: escape sequences begin with one of these
    "\u061c\u200e\u200f\u202a-\u202e\u2066-\u2069"  # those that change the direction of writing
    "\u2028\u2029\ud800-\udfff]"  # line separators; bytes of names that are no UTF-8
)


def escaped(text: str, *, one_line: bool = False) -> str:
    r"""Return the text with control characters as ``\x1b``; with ``one_line`` line feeds as ``\n``, too."""
    text = _CONTROLS.sub(lambda found: found[0].encode("unicode_escape").decode("ascii"), text)
    return text.replace("\n", "\\n") if one_line else text


class EscapingStream:
    """Text stream that escapes what is written to it; everything else is the wrapped stream's."""

    def __init__(self, stream: TextIO) -> None:
        self.raw = stream

    def write(self, text: str) -> int:
        """Write the text, escaped."""
        self.raw.write(escaped(text))
        return len(text)

    def writelines(self, lines: Any) -> None:
        """Write the lines, escaped."""
        for line in lines:
            self.write(line)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.raw, name)
