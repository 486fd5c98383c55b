"""What `mapper reproduce` leaves: the tables for people, programs and papers, plots, and a page of it all."""

import base64
import os
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from textwrap import fill

from evaluators.papers.layout import as_printed, compared, compares, counted, everything, failures, headline
from evaluators.papers.model import RULE, PaperTable, Reproduction
from evaluators.papers.plots import write_plots
from evaluators.tables.table import (
    Column,
    Record,
    csv_text,
    latex_table,
    latex_text,
    markdown_table,
    shown_cells,
    text_table,
)
from mapper.export.html import bullets, document, section, table
from mapper.runtime.atomic import write_text

MARKDOWN, CSV, LATEX, PAGE = "tables.md", "tables.csv", "tables.tex", "index.html"
_LINE_WIDTH = 110
_FAILURES_SHOWN = 8


def write_reproduction(folder: Path, reproduction: Reproduction) -> None:
    """Write the tables as Markdown, CSV and LaTeX, the plots, and one page with both; each file is atomic.

    Args:
        folder: Existing folder.
        reproduction: What was measured.
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
        parts += [headline(each), text_table(*_laid_out(each, with_spread=False))]
        missing = failures(each)
        more = [f"{len(missing) - _FAILURES_SHOWN} more failed; see {MARKDOWN}"]
        parts += _indented([*_remarks(each), *missing[:_FAILURES_SHOWN]])
        parts += [*_indented(more if len(missing) > _FAILURES_SHOWN else []), ""]
    return "\n".join([*parts, *_indented(_closing(reproduction))])


def _filled(reproduction: Reproduction) -> list[PaperTable]:
    return [each for each in reproduction.tables if each.cells]


def _laid_out(each: PaperTable, *, with_spread: bool) -> tuple[list[Column], list[Record]]:
    return compared(each) if compares(each) else as_printed(each, with_spread=with_spread)


def _remarks(each: PaperTable) -> list[str]:
    """Return what must be known to read a table, its verdicts counted first."""
    return [*([counted(each)] if compares(each) else []), *each.notes]


def _closing(reproduction: Reproduction) -> list[str]:
    """Return what holds for all tables, a sentence each."""
    seeds = reproduction.seeds
    return [
        *reproduction.notes,
        *([f"ours: the median of {seeds} seeds"] if seeds > 1 else []),
        *([f"not at hand: {', '.join(reproduction.missing)}"] if reproduction.missing else []),
        RULE,
    ]


def _indented(notes: Sequence[str]) -> list[str]:
    return [fill(note, _LINE_WIDTH, initial_indent="  ", subsequent_indent="    ") for note in notes]


def _markdown(reproduction: Reproduction) -> str:
    parts = [f"# {reproduction.paper}"]
    for each in _filled(reproduction):
        parts += [f"## {headline(each)}", markdown_table(*_laid_out(each, with_spread=True))]
        parts += _listed([each.source, *_remarks(each), *failures(each)])
    return "\n\n".join([*parts, "## Notes", *_listed(_closing(reproduction))]) + "\n"


def _listed(lines: Sequence[str]) -> list[str]:
    return ["\n".join(f"- {line}" for line in lines)] if lines else []


def _latex(reproduction: Reproduction) -> str:
    """Return the tables in their printed layout, each to be put into a paper."""
    parts = ["% \\usepackage{booktabs}, then \\input this file, or copy the table you want."]
    for each in _filled(reproduction):
        caption = latex_text(f"{headline(each)}. Printed: {each.source}.")
        parts.append(
            "\\begin{table}\n\\centering\\scriptsize\\setlength{\\tabcolsep}{3pt}\n"
            f"\\caption{{{caption}}}\n{latex_table(*as_printed(each, with_spread=True))}\n\\end{{table}}"
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
    columns, records = _laid_out(each, with_spread=True)
    shown = table([column.title for column in columns], shown_cells(columns, records))
    told = bullets([each.source, *_remarks(each), *failures(each)])
    return section(headline(each), shown + told + (_image(plot) if plot else ""))


def _image(path: Path) -> str:
    data = base64.b64encode(path.read_bytes()).decode()
    return f'<p><img alt="{escape(path.stem)}" src="data:image/png;base64,{data}"></p>'
