"""Doubt: a reason why the pose of a frame may be wrong."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal, get_args

from mapper.core.errors import DataError

_BETWEEN = "; "

DoubtKind = Literal["disagreement", "elsewhere", "jump", "repeated image", "unconfirmed", "unobservable"]
"""Kinds of doubt.

disagreement: too few measurements agree with the pose, or many agree with another one.
elsewhere: surfaces lie elsewhere than an earlier view shows them.
jump: the motion differs from the predicted one by far more than in the rest of the log.
repeated image: the image is that of an earlier frame, so that nothing shows the pose.
unconfirmed: the pose rests on one view after a gap, or lies beyond every constraint to a map.
unobservable: the measurements show some motion too little.
"""


@dataclass(frozen=True, slots=True)
class Doubt:
    """Reason why the pose of a frame may be wrong.

    Attributes:
        kind: What the reason is; doubts of one kind are counted together.
        text: The reason with its figures, a phrase for the user.
    """

    kind: DoubtKind
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

    What older runs have of other kinds, or of none, is read as disagreement.

    Raises:
        ValueError: There are more of one than of the other.
    """
    if not text:
        return ()
    named: dict[str, DoubtKind] = {kind: kind for kind in get_args(DoubtKind)}
    pairs = zip((kinds or text).split(_BETWEEN), text.split(_BETWEEN), strict=True)
    return tuple(Doubt(named.get(kind, "disagreement"), reason) for kind, reason in pairs)
