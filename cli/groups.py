"""Verbs and groups of verbs as Typer runs them: their help, and one line for a slip of the keyboard."""

import re
from collections.abc import Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import typer
from typer.core import TyperCommand, TyperGroup

from mapper.cli.answer import error_document, print_json
from mapper.cli.console import print_error, print_help
from mapper.core.errors import LINE_WIDTH

HELP = {"help_option_names": ["-h", "--help"], "max_content_width": LINE_WIDTH}
"""Settings of every context."""

PANELS = ("map", "look", "judge", "edit", "study", "tools")
"""Purposes of verbs, in the order of the help."""

_MISUSED = 2
_UsageError: type[Exception] = typer.BadParameter.__mro__[1]  # Typer gives it no public name


class Verb(TyperCommand):
    """A verb."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the words; an error knows whose they are also where an option lacks its value."""
        try:
            return list(super().parse_args(ctx, args))
        except _UsageError as error:
            error.ctx = error.ctx or ctx  # type: ignore[attr-defined]
            raise

    def get_help_option(self, ctx: Any) -> Any:
        """Return the option that prints the help, coloured on a terminal."""
        return _printing_help(super().get_help_option(ctx))


class VerbGroup(TyperGroup):
    """Verbs, listed by what they are for; a slip in the command line is one line with what to do."""

    def get_help_option(self, ctx: Any) -> Any:
        """Return the option that prints the help, coloured on a terminal."""
        return _printing_help(super().get_help_option(ctx))

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Print the help where no verb is given."""
        if not args and not ctx.resilient_parsing and not self.invoke_without_command:
            show_help(ctx)
            ctx.exit()
        return super().parse_args(ctx, args)

    def make_context(self, info_name: str | None, args: list[str], *more: Any, **options: Any) -> Any:
        """Read the options before the verb."""
        self.is_json = "--json" in args
        try:
            return super().make_context(info_name, args, *more, **options)
        except _UsageError as error:
            raise _refused(error, self) from None

    def invoke(self, ctx: Any) -> object:
        """Run the verb."""
        try:
            return super().invoke(ctx)
        except _UsageError as error:
            raise _refused(error, self) from None

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write the verbs before the options."""
        self.format_commands(ctx, formatter)
        TyperCommand.format_options(self, ctx, formatter)  # type: ignore[arg-type]

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write a line for each verb: what it is for, its name, what it does."""
        verbs = [self.commands[name] for name in self.list_commands(ctx)]
        width = max(len(str(verb.name)) for verb in verbs)
        before = ""
        formatter.write_paragraph()
        for verb in sorted(verbs, key=_rank):
            panel = PANELS[_rank(verb)] if _rank(verb) < len(PANELS) else ""
            title = panel if panel != before else ""
            formatter.write(f"{title:<8}{verb.name:<{width}}  {verb.get_short_help_str(100)}\n")
            before = panel


def _rank(verb: Any) -> int:
    panel = verb.rich_help_panel
    return PANELS.index(panel) if panel in PANELS else len(PANELS)


def show_help(ctx: Any) -> None:
    """Print the help of a verb or group."""
    print_help(ctx.get_help())


def _printing_help(option: Any) -> Any:
    def callback(ctx: Any, _option: Any, is_given: bool) -> None:
        if is_given and not ctx.resilient_parsing:
            show_help(ctx)
            ctx.exit()

    if option is not None:
        option.callback = callback
    return option


def _refused(error: Any, group: VerbGroup) -> typer.Exit:
    """Print what is wrong with a command line, and what to do, in one line."""
    below = error.ctx.command_path.split()[1:] if error.ctx else []  # below the program's own name
    path = " ".join(["mapper", *below])
    what = error.format_message().rstrip(".")
    if unknown := re.match(r"No such command '(.*?)'", what):
        known = _subgroup(group, below)
        what = f"{_no_verb(unknown[1], list(known.commands))}; {path} -h lists them all"
    elif extra := re.match(r"Got unexpected extra argument(?:s|\(s\))? \((.*)\)", what):
        what = f"{_too_many(extra[1].split(), path)}; {path} -h shows how"
    else:
        what = f"{what[:1].lower()}{' '.join(what[1:].split())}; {path} -h shows how"
    line = ": ".join(["mapper", *([" ".join(below)] if below else []), what])
    print_error(line)
    if group.is_json:
        print_json(error_document("UsageError", line.removeprefix("mapper: ")))
    return typer.Exit(_MISUSED)


def _subgroup(group: TyperGroup, names: Sequence[str]) -> TyperGroup:
    for name in names:
        below = group.commands.get(name)
        group = below if isinstance(below, TyperGroup) else group
    return group


def _no_verb(word: str, known: Sequence[str]) -> str:
    if near := get_close_matches(word, known, n=2):
        return f"no verb {word!r}; did you mean {' or '.join(near)}?"
    if Path(word).exists():
        return f"no verb {word!r}, but a file or folder: mapper inspect {word} shows what is in it"
    return f"no verb {word!r}"


def _too_many(words: Sequence[str], path: str) -> str:
    text = f"does not take {' '.join(words)} too"
    if path.endswith(" build"):
        text += "; want one log: build each, then mapper merge, or --onto RUN"
    return text
