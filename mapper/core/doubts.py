"""Doubt: a reason why the pose of a frame may be wrong."""

from collections.abc import Iterable
from dataclasses import dataclass

from mapper.core.errors import DataError

_BETWEEN = "; "


@dataclass(frozen=True, slots=True)
class Doubt:
    """Reason why the pose of a frame may be wrong.

    Attributes:
        kind: Name of the reason, without figures, e.g. "jump": doubts of one kind are counted together.
        text: The reason with its figures, a phrase for the user.
    """

    kind: str
    text: str

    def __post_init__(self) -> None:
        if _BETWEEN in self.kind + self.text:
            raise DataError(f"doubt {self}: has {_BETWEEN!r} in it, which separates doubts in files")


def doubts_text(doubts: Iterable[Doubt]) -> str:
    """Return the doubts about a frame as the text of one cell."""
    return _BETWEEN.join(doubt.text for doubt in doubts)


def kinds_text(doubts: Iterable[Doubt]) -> str:
    """Return the kinds of the doubts about a frame as the text of one cell."""
    return _BETWEEN.join(doubt.kind for doubt in doubts)


def doubts_of(text: str, kinds: str) -> tuple[Doubt, ...]:
    """Return the doubts of a frame from the cells of their texts and kinds.

    Older runs have no kinds, so that each text is of its own kind.

    Raises:
        ValueError: There are more of one than of the other.
    """
    if not text:
        return ()
    pairs = zip((kinds or text).split(_BETWEEN), text.split(_BETWEEN), strict=True)
    return tuple(Doubt(*pair) for pair in pairs)
