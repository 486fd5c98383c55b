"""Files of `mapper reproduce`: the tables as Markdown, CSV and LaTeX, plots, and a page of them."""

import base64
import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from html import escape
from pathlib import Path

from mapper.evaluators.papers.layout import (
    as_printed,
    compared,
    compares,
    counted,
    everything,
    failures,
    headline,
)
from mapper.evaluators.papers.model import RULE, PaperTable, Reproduction
from mapper.evaluators.papers.plots import write_plots
from mapper.evaluators.tables.table import (
    Table,
    csv_text,
    indented,
    latex_table,
    latex_text,
    markdown_list,
    shown_cells,
)
from mapper.export.html import bullets, document, section, table
from mapper.runtime.atomic import write_text

MARKDOWN, CSV, LATEX, PAGE = "tables.md", "tables.csv", "tables.tex", "index.html"
_FAILURES_SHOWN = 8


def write_reproduction(folder: Path, reproduction: Reproduction) -> None:
    """Write the tables as Markdown, CSV and LaTeX, the plots, and one page with both; each file is atomic.

    Args:
        folder: Existing folder.
        reproduction: Measured tables.
    """
    write_text(folder / MARKDOWN, _markdown(reproduction))
    if records := everything(reproduction):
        write_text(folder / CSV, csv_text(records))
    write_text(folder / LATEX, _latex(reproduction))
    plots = write_plots(folder, reproduction)
    write_text(folder / PAGE, _page(folder, reproduction, plots))


def tables_text(reproduction: Reproduction) -> str:
    """Return every table for a terminal, with what must be known to read it indented below."""
    parts = []
    for each in _filled(reproduction):
        missing = failures(each)
        notes = [*_remarks(each), *missing[:_FAILURES_SHOWN]]
        if len(missing) > _FAILURES_SHOWN:
            notes.append(f"{len(missing) - _FAILURES_SHOWN} more failed; see {MARKDOWN}")
        parts += [headline(each), _shown(each, notes, with_spread=False).text(), ""]
    return "\n".join([*parts, *indented(_closing(reproduction))])


def _filled(reproduction: Reproduction) -> list[PaperTable]:
    return [each for each in reproduction.tables if each.cells]


def _shown(each: PaperTable, notes: Sequence[str], *, with_spread: bool = True) -> Table:
    table = compared(each) if compares(each) else as_printed(each, with_spread=with_spread)
    return replace(table, title=headline(each), notes=notes)


def _remarks(each: PaperTable) -> list[str]:
    """Return what must be known to read a table, its verdicts counted first."""
    return [*([counted(each)] if compares(each) else []), *each.notes]


def _everything_known(each: PaperTable) -> list[str]:
    return [each.source, *_remarks(each), *failures(each)]


def _closing(reproduction: Reproduction) -> list[str]:
    """Return what holds for all tables, a sentence each."""
    seeds = reproduction.seeds
    return [
        *reproduction.notes,
        *([f"ours: the median of {seeds} seeds"] if seeds > 1 else []),
        *([f"not at hand: {', '.join(reproduction.missing)}"] if reproduction.missing else []),
        RULE,
    ]


def _markdown(reproduction: Reproduction) -> str:
    tables = [_shown(each, _everything_known(each)).markdown() for each in _filled(reproduction)]
    notes = ["## Notes", markdown_list(_closing(reproduction))]
    return "\n\n".join([f"# {reproduction.paper}", *tables, *notes]) + "\n"


def _latex(reproduction: Reproduction) -> str:
    """Return the tables in their printed layout, each to be put into a paper."""
    parts = ["% \\usepackage{booktabs}, then \\input this file, or copy the table you want."]
    for each in _filled(reproduction):
        caption = latex_text(f"{headline(each)}. Printed: {each.source}.")
        printed = as_printed(each, with_spread=True)
        parts.append(
            "\\begin{table}\n\\centering\\scriptsize\\setlength{\\tabcolsep}{3pt}\n"
            f"\\caption{{{caption}}}\n{latex_table(printed.columns, printed.records)}\n\\end{{table}}"
        )
    return "\n\n".join(parts) + "\n"


def _page(folder: Path, reproduction: Reproduction, plots: Mapping[str, Path]) -> str:
    main = [_section(each, plots.get(each.name)) for each in _filled(reproduction)]
    of_tables = {each.name for each in reproduction.tables}
    main += [section(name, _image(path)) for name, path in plots.items() if name not in of_tables]
    if reproduction.pictures:  # they can be many, so they stay beside the page
        links = (
            f'<li><a href="{escape(os.path.relpath(path, folder))}">{escape(path.stem)}</a></li>'
            for path in reproduction.pictures
        )
        main.append(section("Pictures", f"<ul>{''.join(links)}</ul>"))
    main.append(section("Notes", bullets(_closing(reproduction))))
    title = reproduction.paper
    return document(f"{title} – mapper reproduce", header=f"<h1>{escape(title)}</h1>", main=main)


def _section(each: PaperTable, plot: Path | None) -> str:
    shown = _shown(each, _everything_known(each))
    head = [column.title for column in shown.columns]
    body = table(head, shown_cells(shown.columns, shown.records)) + bullets(shown.notes)
    return section(shown.title, body + (_image(plot) if plot else ""))


def _image(path: Path) -> str:
    data = base64.b64encode(path.read_bytes()).decode()
    return f'<p><img alt="{escape(path.stem)}" src="data:image/png;base64,{data}"></p>'
