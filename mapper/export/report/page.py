"""HTML of the report: words and tables; ``page.js`` draws the curves and plans."""

import json
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from html import escape
from importlib import resources
from itertools import starmap
from pathlib import Path
from typing import Any, get_args

from mapper.core.config import flattened
from mapper.export.html import document, section
from mapper.export.report.data import (
    Chapter,
    Question,
    drawn,
    map_sizes,
    refuse_same_names,
    residual_unit,
    views_uri,
)
from mapper.export.report.map_page import (
    json_element,
    map_html,
    map_scripts,
    map_style,
    maps_of,
    pictures_of,
)
from mapper.loops.closure import accepted_loops
from mapper.runtime.atomic import write_text

_CURVES = (
    ("error", "Distance from the truth", "m"),
    ("features", "Features of each frame", ""),
    ("matches", "Matches of each frame", ""),
    ("inliers", "Inliers of each frame", ""),
    ("ms", "Time to track each frame", "ms"),
)
_NOTHING = re.compile(r"(–|0|0 .*)$")
_MOST_POINTS = 500_000  # the page of the map alone has more
_HINT = '<p class="hint">Drag to zoom in, double-click to see all again.</p>'


def write_report(path: Path, chapters: Sequence[Chapter]) -> None:
    """Write one page about some runs, whole or not at all; it loads nothing from anywhere.

    Raises:
        ConfigError: No runs, or two of one name.
        MapperError: A file of a run cannot be read.
    """
    refuse_same_names(chapters)
    write_text(path, page_of(chapters))


def page_of(chapters: Sequence[Chapter]) -> str:
    """Return the page's HTML."""
    ours = resources.files("mapper.export.report")
    title = " · ".join(chapter.name for chapter in chapters)
    return document(
        f"{title} – mapper report",
        header=_header(chapters),
        main=[
            section("Verdict", _columns(starmap(_verdict, enumerate(chapters)))),
            section("Map", map_html(_names(chapters), pictures_of(chapters))),
            section(
                "Plans and views",
                _HINT + _columns(one for of in (_plan, _view) for one in starmap(of, enumerate(chapters))),
            ),
            section("Numbers", _numbers(chapters)),
            section("Over time", _curves(chapters)),
            *_loop_sections(chapters),
            _columns(
                section(title, _table(["", *_names(chapters)], _side_by_side(chapters, of)))
                for title, of in (("Map sizes", map_sizes), ("Versions", _versions))
            ),
            section("Configuration", _settings(chapters)),
        ],
        scripts=[
            json_element("data", [drawn(chapter) for chapter in chapters]),
            *map_scripts(maps_of(chapters, most_points=_MOST_POINTS)),
            f"<script>\n{(ours / 'page.js').read_text(encoding='utf-8')}</script>",
        ],
        styles=[map_style()],
    )


def _header(chapters: Sequence[Chapter]) -> str:
    boxes = "".join(
        f'<label class="run run{i % 6}"><input type="checkbox" data-run="{i}" checked> {escape(chapter.name)}'
        f" <small>{escape(chapter.run.manifest.input.title)}, {chapter.run.verdict.state}</small></label>"
        for i, chapter in enumerate(chapters)
    )
    return f'<h1>mapper report</h1><div class="runs">{boxes}</div>'


def _columns(cells: Iterable[str]) -> str:
    return f'<div class="columns">{"".join(cells)}</div>'


def _table(head: Iterable[str], rows: Iterable[Sequence[str]], *, css: str = "beside") -> str:
    """Return a table whose columns after the first belong to one run each."""
    top = "".join(_cell("th", text, i) for i, text in enumerate(head))
    body = "".join(f"<tr{_differs(row)}>{_cells(row)}</tr>" for row in rows)
    table = f'<table class="{css}"><thead><tr>{top}</tr></thead><tbody>{body}</tbody></table>'
    return f'<div class="scroll" tabindex="0">{table}</div>'


def _cells(row: Sequence[str]) -> str:
    return "".join(_cell("td" if i else "th", text, i) for i, text in enumerate(row))


def _cell(tag: str, text: str, column: int) -> str:
    run = f' data-of="{column - 1}"' if column else ""
    tag = tag if text else "td"  # a corner is no headline
    return f"<{tag}{run}>{escape(text)}</{tag}>"


def _differs(row: Sequence[str]) -> str:
    return ' class="differs"' if len(set(row[1:])) > 1 else ""


def _names(chapters: Sequence[Chapter]) -> list[str]:
    return [chapter.name for chapter in chapters]


def _numbers(chapters: Sequence[Chapter]) -> str:
    """Return the numbers by what a person asks, and below them all others."""
    tables = "".join(
        f"<div><h3>{question}</h3>{_table(['', *_names(chapters)], rows)}</div>"
        for question in get_args(Question)
        if question and (rows := _figures(chapters, question))
    )
    others = _table(["", *_names(chapters)], _figures(chapters, ""))
    return f'<div class="columns">{tables}</div><details><summary>More numbers</summary>{others}</details>'


def _figures(chapters: Sequence[Chapter], question: Question) -> list[list[str]]:
    """Return the rows that answer a question, without those in which every run has nothing."""
    rows = _side_by_side(
        chapters, lambda chapter: {f.name: f.value for f in chapter.figures if f.question == question}
    )
    return [row for row in rows if not all(_NOTHING.match(value) for value in row[1:])]


def _side_by_side(chapters: Sequence[Chapter], of: Any) -> list[list[str]]:
    """Return a row for each name that any run has a value of."""
    columns: list[Mapping[str, str]] = [of(chapter) for chapter in chapters]
    names = dict.fromkeys(name for column in columns for name in column)
    return [[name, *(column.get(name, "–") for column in columns)] for name in names]


def _versions(chapter: Chapter) -> dict[str, str]:
    manifest = chapter.run.manifest
    return {
        "mapper": manifest.mapper_version,
        "Python": manifest.python_version,
        "platform": manifest.platform,
        **manifest.libraries,
    }


def _settings(chapters: Sequence[Chapter]) -> str:
    def texts(chapter: Chapter) -> dict[str, str]:
        values = flattened(chapter.run.config.model_dump(mode="json"))
        return {name: json.dumps(value, ensure_ascii=False) for name, value in values.items()}

    rows = sorted(_side_by_side(chapters, texts))
    only = " checked" if any(_differs(row) for row in rows) else ""
    return (
        '<div class="controls"><input type="search" id="setting" placeholder="find a setting" '
        'aria-label="find a setting"> <label><input type="checkbox" id="differing"'
        f"{only}> only what differs</label></div>"
        + _table(["", *_names(chapters)], rows, css="beside settings")
    )


def _plan(number: int, chapter: Chapter) -> str:
    return f'<figure class="plan" data-of="{number}"><figcaption>{escape(chapter.name)}</figcaption></figure>'


def _view(number: int, chapter: Chapter) -> str:
    name, uri = escape(chapter.name), views_uri(chapter.run)
    picture = f'<img src="{uri}" alt="{name} from above and from the side">' if uri else "<p>no picture</p>"
    return f'<figure class="view" data-of="{number}"><figcaption>{name}</figcaption>{picture}</figure>'


def _curves(chapters: Sequence[Chapter]) -> str:
    """Return the places of the curves; residuals of different units are no one curve's."""
    units = sorted({residual_unit(chapter.results) for chapter in chapters} - {""})
    curves = [*_CURVES, *(("residual", "Residual of each frame", unit) for unit in units)]
    return _HINT + _columns(
        f'<figure class="curve" data-curve="{key}" data-unit="{escape(unit)}">'
        f"<figcaption>{title}</figcaption></figure>"
        for key, title, unit in curves
    )


def _verdict(number: int, chapter: Chapter) -> str:
    """Return why a run is not trusted, and below it what is worth knowing."""
    verdict = chapter.run.verdict
    notes = [warning.text for warning in chapter.run.manifest.warnings if warning.weight == "note"]
    items = "".join(
        f'<li class="{kind}">{escape(text)}</li>'
        for kind, texts in (("heavy", verdict.sentences), ("note", notes))
        for text in texts
    )
    listed = f"<ul>{items}</ul>" if items else ""
    title = f"{escape(chapter.name)}: {verdict.state}"
    return f'<div class="verdict" data-of="{number}"><h3>{title}</h3>{listed}</div>'


def _loop_sections(chapters: Sequence[Chapter]) -> Iterator[str]:
    if any(chapter.results.loops for chapter in chapters):
        yield section("Loops", "".join(starmap(_loops, enumerate(chapters))))


def _loops(number: int, chapter: Chapter) -> str:
    loops = chapter.results.loops
    title = f"{escape(chapter.name)}: {len(accepted_loops(loops))} of {len(loops)} candidates hold"
    return f'<div class="loops" data-of="{number}"><h3>{title}</h3></div>'
