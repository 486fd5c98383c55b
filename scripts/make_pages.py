"""The pages as the site has them, in build/pages: any generator of Markdown sites takes them from there.

A line such as ``<!-- generated: settings -->`` in a page and the paragraph below it are replaced by the
reference. README.md is the first page. Files of the repository that pages link to are copied as text, so that
the site is complete without a network.
"""

import os
import re
import shutil
import sys
from collections.abc import Iterator
from itertools import groupby
from pathlib import Path, PurePosixPath
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
PAGES = ROOT / "build" / "pages"
_GENERATED = re.compile(r"^<!-- generated: (\w+) -->\n\n(?:[^\n#].*\n)+", re.MULTILINE)
_LINK = re.compile(r"(?<!\!)\[((?:[^\[\]]|\[[^\]]*\])*)\]\(([^)\s]+)\)")
_NAMES = {"rgbd": "RGB-D", "lidar": "LiDAR"}


def make_pages(out: Path = PAGES) -> None:
    """Write all pages, with what they show and link to."""
    shutil.rmtree(out, ignore_errors=True)
    shutil.copytree(ROOT / "docs", out)
    (out / "index.md").write_text(_moved((ROOT / "README.md").read_text(encoding="utf-8")), encoding="utf-8")
    for page in sorted(out.glob("*.md")):
        text = _GENERATED.sub(
            lambda found: "\n".join(_REFERENCES[found[1]]()), page.read_text(encoding="utf-8")
        )
        for target in _outside(text):
            copy = out / _copy_of(target)
            copy.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(ROOT / target, copy)
        page.write_text(_relinked(text), encoding="utf-8")


def _moved(readme: str) -> str:
    """Return README.md as a page of docs/: links to pages lose the folder, others leave it."""

    def link(found: re.Match[str]) -> str:
        target = found[2]
        if "://" in target or target.startswith("#"):
            return found[0]
        inside = target.removeprefix("docs/")
        return f"{found[1]}({inside if inside != target else f'../{target}'})"

    return re.sub(r"(\!?\[[^\]]*\])\(([^)\s]+)\)", link, readme)


def _target(link: str) -> str | None:
    """Return the path in the repository of a file outside of docs/ that a link of a page leads to, if any."""
    path = link.partition("#")[0]
    if "://" in link or not path:
        return None
    full = os.path.normpath(PurePosixPath("docs") / path)
    return None if full.startswith("docs/") else full


def _outside(markdown: str) -> Iterator[str]:
    for _, link in _LINK.findall(markdown):
        target = _target(link)
        if target is not None and (ROOT / target).is_file():
            yield target


def _copy_of(target: str) -> str:
    return f"source/{target}.txt"


def _relinked(markdown: str) -> str:
    def link(found: re.Match[str]) -> str:
        target = _target(found[2])
        if target is None:
            return found[0]
        if target == "README.md":
            return f"[{found[1]}](index.md)"
        if (ROOT / target).is_file():
            return f"[{found[1]}]({_copy_of(target)})"
        return found[1] if (ROOT / target).is_dir() else found[0]

    return _LINK.sub(link, markdown)


def _settings() -> Iterator[str]:
    from mapper.config.describe import settings

    of_lidar = {(one.key, one.needs): one for one in settings("lidar")}
    yield "“LiDAR: …” is the default for LiDAR logs where it differs. Each kind of a method has its table."
    described = list(settings())
    for part, members in groupby(described, key=lambda one: one.key.split(".")[0]):
        listed = list(members)
        yield f"\n### {part}\n"
        if listed[0].is_table:
            yield f"{_cell(listed[0].doc)}\n"
        tables = {one.key: one.doc for one in listed if one.is_table}
        rows = [one for one in listed if not one.is_table or one.type != "table"]
        for (parent, needs), group in groupby(rows, key=lambda one: (one.key.rpartition(".")[0], one.needs)):
            if needs or parent != part:
                where = ", ".join(
                    f"`{key}` = {' or '.join(f'`{v}`' for v in values)}" for key, values in needs
                )
                about = "" if parent in (part, "") else f"`{parent}` {_cell(tables.get(parent, ''))}"
                yield f"\n{about}{' ' if about else ''}{f'With {where}:' if where else ''}\n"
            yield "\n| setting | default | values | meaning |\n| --- | --- | --- | --- |"
            for one in group:
                other = of_lidar.get((one.key, one.needs))
                default = f"`{one.default_text}`"
                if other is not None and other.default != one.default and not one.is_table:
                    default += f"<br>LiDAR: `{other.default_text}`"
                values = ", ".join(f"`{choice}`" for choice in one.choices) or one.type
                unit = f", {one.unit}" if one.unit else ""
                yield f"| `{one.key}` | {default} | {values}{unit} | {_cell(one.doc)} |"


def _commands() -> Iterator[str]:
    import click
    import typer

    from mapper.cli.main import app

    mapper: Any = typer.main.get_command(app)
    program = click.Context(click.Command("mapper"), info_name="mapper")
    verbs = [(name, verb) for name, verb in mapper.commands.items() if not verb.hidden]
    for panel in dict.fromkeys(getattr(verb, "rich_help_panel", "") for _, verb in verbs):
        yield f"\n## {panel.capitalize()}\n"
        for name, verb in verbs:
            if getattr(verb, "rich_help_panel", "") == panel:
                yield from _command(name, verb, program)


def _command(name: str, verb: Any, parent: Any) -> Iterator[str]:
    context = verb.make_context(name, [], parent=parent, resilient_parsing=True)
    yield f"\n### {context.command_path}\n\n{_prose(verb.help or '')}\n"
    yield f"```text\n{verb.get_usage(context).removeprefix('Usage: ')}\n```\n"
    rows = [row for parameter in verb.params if (row := _parameter(parameter, context))]
    if rows:
        yield "| argument or option | meaning |\n| --- | --- |"
        yield from rows
    for below, sub_verb in getattr(verb, "commands", {}).items():
        yield from _command(below, sub_verb, context)


def _parameter(parameter: Any, context: Any) -> str | None:
    record = parameter.get_help_record(context)
    if record is None or parameter.name == "help":
        return None
    name, about = record
    return f"| `{' '.join(name.split())}` | {_cell(about)} |"


def _prose(docstring: str) -> str:
    paragraphs = [" ".join(part.split()) for part in docstring.replace("\b", "").split("\n\n")]
    return "\n\n".join(
        re.sub(r"(Example: |, or(?: just)?: |, then: )(mapper [^,]*)", r"\1`\2`", part)
        if part.startswith("Example")
        else _escaped(part)
        for part in paragraphs
    )


def _cell(text: str) -> str:
    return _escaped(" ".join(text.split())).replace("|", "\\|")


def _escaped(text: str) -> str:
    parts = re.split(r"(`[^`]*`)", text)
    return "".join(part if part.startswith("`") else re.sub(r"([*_<\[\]])", r"\\\1", part) for part in parts)


def _api() -> Iterator[str]:
    import mapper

    for name in sorted(getattr(mapper, "__all__", []), key=str.lower):
        yield f"::: mapper.{name}\n"


_REFERENCES = {"api": _api, "settings": _settings, "commands": _commands}


if __name__ == "__main__":
    make_pages(*map(Path, sys.argv[1:2]))
