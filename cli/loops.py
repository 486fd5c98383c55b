"""``mapper loops``: a run's loop closures listed, added and removed by hand."""

from collections.abc import Sequence
from itertools import islice
from typing import TYPE_CHECKING, Annotated, Any

import typer

from mapper.cli.answer import Answer, Output
from mapper.cli.groups import Verb
from mapper.cli.options import MovedLogs, RunFolder, refuse_without
from mapper.core.errors import ConfigError

if TYPE_CHECKING:
    from mapper.loops.closure import Discrepancy, LoopClosure

_COLUMNS = ("i", "j", "by", "similar", "matches", "inliers", "before", "after", "weight", "verdict")
_PAIR_OPTIONS = ("--add", "--remove")


class WithPairs(Verb):
    """Lets ``--add`` and ``--remove`` take two numbers each, as often as they are given."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Join the two words that follow each of these options to one."""
        words = iter(args)
        joined = [f"{word}={' '.join(islice(words, 2))}" if word in _PAIR_OPTIONS else word for word in words]
        return super().parse_args(ctx, joined)


def loops(
    run: RunFolder,
    list_: Annotated[
        bool, typer.Option("--list", help="Print every candidate; the default without other options.")
    ] = False,
    accepted: Annotated[bool, typer.Option("--accepted", help="Print only accepted loops.")] = False,
    add: Annotated[
        list[str] | None, typer.Option(metavar="I J", help="Add a loop between two nodes at the same place.")
    ] = None,
    remove: Annotated[list[str] | None, typer.Option(metavar="I J", help="Remove a loop.")] = None,
    log: MovedLogs = None,
    *,
    output: Output,
) -> Answer:
    """List a run's loop candidates, or add and remove loops by hand; then solve and fuse without tracking.

    Example: mapper loops runs/xyz, or: mapper loops runs/xyz --add 3 71 --remove 17 40
    """
    from mapper.run.folder import moved_log, open_run

    if not (add or remove):
        refuse_without("--add or --remove", {"--log": log})
    built, solved = open_run(run), None
    if add or remove:
        from mapper.cli.summary import summary_of
        from mapper.pipeline.edit import edit_loops

        if log:
            built = moved_log(built, *log)
        built = edit_loops(
            built.open_log(),
            built,
            add=[_pair("--add", text) for text in add or ()],
            remove=[_pair("--remove", text) for text in remove or ()],
            progress=output.progress(),
        )
        solved = summary_of(built)
    shown = [loop for loop in built.loops if loop.verdict == "accepted" or not accepted]
    if solved is None:
        return Answer({"run": built.path, "loops": shown}, loops_text(shown))
    if not (list_ or accepted):
        return solved
    document = {**solved.document, "candidates": shown}
    return Answer(document, f"{solved.text}\n{loops_text(shown)}", f"{solved.details}\n{loops_text(shown)}")


def loops_text(closures: "Sequence[LoopClosure]") -> str:
    """Return a table, a line per candidate; a rejected one says why."""
    rows = [_COLUMNS, *(_cells(closure) for closure in closures)]
    widths = [max(len(row[column]) for row in rows) for column in range(len(_COLUMNS) - 1)]
    lines = [
        "  ".join([*(f"{cell:>{width}}" for cell, width in zip(row[:-1], widths, strict=True)), row[-1]])
        for row in rows
    ]
    held = sum(closure.verdict == "accepted" for closure in closures)
    return "\n".join([*lines, f"{held} of {len(closures)} hold"])


def _cells(closure: "LoopClosure") -> tuple[str, ...]:
    return (
        str(closure.i),
        str(closure.j),
        closure.proposed_by,
        "" if closure.similarity is None else f"{closure.similarity:.2f}",
        str(closure.matches),
        str(closure.inliers),
        _miss_text(closure.before),
        _miss_text(closure.after),
        "" if closure.weight is None else f"{closure.weight:.2f}",
        closure.reason or closure.verdict,
    )


def _miss_text(miss: "Discrepancy | None") -> str:
    from math import degrees

    return "" if miss is None else f"{miss.translation_m:.3f} m {degrees(miss.rotation_rad):.2f}°"


def _pair(option: str, text: str) -> tuple[int, int]:
    try:
        i, j = (int(word) for word in text.split())
    except ValueError:
        raise ConfigError(f"{option} {text}: want two nodes' numbers; mapper loops RUN lists them") from None
    return i, j
