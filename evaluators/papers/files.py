"""Files of `mapper reproduce`: the tables as Markdown, CSV and LaTeX, plots, and a page of them."""

import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from html import escape
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Any

import numpy as np

from mapper.core.geometry import Array
from mapper.evaluators.metrics.trajectory_errors import associate
from mapper.evaluators.papers.model import (
    RULE,
    PaperCell,
    PaperPath,
    PaperTable,
    Reproduction,
    as_printed,
    compared,
    compares,
    counted,
    everything,
    failures,
    file_name,
    headline,
)
from mapper.evaluators.pictures.errors import add_color_bar, draw_path
from mapper.evaluators.study.table import (
    Table,
    csv_text,
    indented,
    latex_table,
    latex_text,
    markdown_list,
    shown_cells,
)
from mapper.export.figures import (
    ESTIMATE,
    LINE,
    TEXT,
    TRUTH,
    WIDE_IN,
    box_panels,
    caption,
    draw_boxes,
    hex_of,
    panels,
    save,
)
from mapper.export.html import bullets, document, image, section
from mapper.export.html import table as html_table
from mapper.runtime.atomic import write_text
from mapper.sources.trajectory_files import read_tum

if TYPE_CHECKING:
    from matplotlib.axes import Axes

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
    return [*([counted(each)] if compares(each) else []), *each.notes]


def _everything_known(each: PaperTable) -> list[str]:
    return [each.source, *_remarks(each), *failures(each)]


def _closing(reproduction: Reproduction) -> list[str]:
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
    main += [
        section(name, image(path.read_bytes(), path.stem))
        for name, path in plots.items()
        if name not in of_tables
    ]
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
    body = html_table(head, shown_cells(shown.columns, shown.records)) + bullets(shown.notes)
    return section(shown.title, body + (image(plot.read_bytes(), plot.stem) if plot else ""))


TRAJECTORIES, SCENES = "trajectories.png", "scenes.png"
_NUMBER = re.compile(r"\d+")
_LEGEND: dict[str, Any] = {"fontsize": 7, "framealpha": 0.9, "edgecolor": LINE}


def write_plots(folder: Path, reproduction: Reproduction) -> dict[str, Path]:
    """Draw a paper's tables that have curves or boxes, and its paths, a PNG file each.

    Args:
        folder: Existing folder.
        reproduction: Measured tables.

    Returns:
        The files, by the table that they show or by what they are.
    """
    drawn: dict[str, Path] = {}
    for table in reproduction.tables:
        if not compares(table) or not _by_row(table):
            continue
        path = folder / f"{file_name(table.name)}.png"
        if table.axis:
            _write_curves(path, table)
        elif table.unit:
            _write_boxes(path, table)
        else:
            continue
        drawn[table.name] = path
    scenes = [table for table in reproduction.tables if table.cells and not compares(table)]
    alike = [table for table in scenes if _columns(table) == _columns(scenes[0])]
    if len(alike) > 1:
        drawn["Scenes"] = folder / SCENES
        _write_scenes(folder / SCENES, alike, title=reproduction.paper)
    if reproduction.paths:
        drawn["Paths"] = folder / TRAJECTORIES
        _write_paths(folder / TRAJECTORIES, reproduction.paths)
    return drawn


def _write_curves(path: Path, table: PaperTable) -> None:
    """Draw each row's figures over what the columns count; a column without a number is a level."""
    rows = _by_row(table)
    figure, panes = panels(_title(table), len(rows), width_in=WIDE_IN)
    for axes, (row, cells) in zip(panes, rows.items(), strict=True):
        printed = {cell.column: [cell.published] for cell in cells if cell.published is not None}
        ours = {cell.column: cell.ours for cell in cells if cell.ours}
        _draw_curve(axes, printed, color=hex_of(TRUTH), label="printed")
        _draw_curve(axes, ours, color=hex_of(ESTIMATE), label="ours")
        caption(axes, title=row, x=table.axis, y=f"{table.metric}, {table.unit}")
        axes.set_ylim(bottom=0.0)
        axes.grid(color=LINE, linewidth=0.4)
        axes.legend(**_LEGEND)
    save(figure, path)


def _draw_curve(axes: "Axes", figures: Mapping[str, Sequence[float]], *, color: str, label: str) -> None:
    """Draw the medians as a line, and what lies between lowest and highest as a band."""
    counted = {int(count[0]): some for name, some in figures.items() if (count := _NUMBER.search(name))}
    low, middle, high = ([of(some) for some in counted.values()] for of in (min, median, max))
    axes.plot(list(counted), middle, ".-", color=color, linewidth=1.3, label=label)
    axes.fill_between(list(counted), low, high, color=color, alpha=0.18, linewidth=0.0)
    for name in figures:
        if not _NUMBER.search(name):
            level = median(figures[name])
            axes.axhline(level, color=color, linewidth=0.9, linestyle="dashed", label=f"{label}, {name}")


def _write_boxes(path: Path, table: PaperTable) -> None:
    """Draw each row's figures over the seeds, a box for each column, with the printed one as a mark."""
    rows = _by_row(table)
    figure, panes = box_panels(_title(table), len(rows), _columns(table))
    for axes, (row, cells) in zip(panes, rows.items(), strict=True):
        printed = {k: cell.published for k, cell in enumerate(cells, 1) if cell.published is not None}
        axes.plot(list(printed.values()), list(printed), "D", color=hex_of(TRUTH), zorder=3, label="printed")
        ours = [(figure, k) for k, cell in enumerate(cells, 1) for figure in cell.ours]
        axes.plot(*zip(*ours, strict=True), "o", color=TEXT, markersize=4, zorder=3, label="ours, each seed")
        draw_boxes(axes, {cell.column: np.array(cell.ours) for cell in cells})
        axes.set_xscale("linear")
        axes.set_xlim(left=0.0)
        caption(axes, title=row, x=f"{table.metric}, {table.unit}")
        axes.legend(**_LEGEND)
    save(figure, path)


def _write_scenes(path: Path, tables: Sequence[PaperTable], *, title: str) -> None:
    columns = _columns(tables[0])
    figure, panes = box_panels(title, len(columns), [_short(table) for table in tables])
    for axes, column in zip(panes, columns, strict=True):
        draw_boxes(axes, {_short(table): _figures_of(table, column) for table in tables})
        caption(axes, title=column)
    save(figure, path)


def _figures_of(table: PaperTable, column: str) -> Array:
    cells = [cell for cell in table.cells if cell.column == column]
    figures = [cell.published if cell.median is None else cell.median for cell in cells]
    return np.array([figure for figure in figures if figure])  # the scale is logarithmic


def _short(table: PaperTable) -> str:
    return table.name.partition(", ")[2] or "printed"


def _write_paths(path: Path, paths: Sequence[PaperPath]) -> None:
    matched = [associate(read_tum(each.estimate), read_tum(each.truth)) for each in paths]
    errors_m = [pairs.position_errors_m for pairs in matched]
    most_m: dict[str, float] = {}
    for each, errors in zip(paths, errors_m, strict=True):
        most_m[each.row] = max(most_m.get(each.row, 0.0), float(errors.max()))
    title = "Paths over the truth, coloured by their error"
    figure, panes = panels(title, len(paths), width_in=WIDE_IN)
    for axes, each, pairs, errors in zip(panes, paths, matched, errors_m, strict=True):
        add_color_bar(axes, draw_path(axes, pairs, errors, most_m=most_m[each.row]))
        caption(axes, title=f"{each.row}, {each.method}: ATE {each.ate_m:.4f} m")
    save(figure, path)


def _title(table: PaperTable) -> str:
    return f"{table.name}: {table.metric}, {table.unit}"


def _by_row(table: PaperTable) -> dict[str, list[PaperCell]]:
    rows: dict[str, list[PaperCell]] = {}
    for cell in table.cells:
        rows.setdefault(cell.row, []).append(cell)
    return {row: cells for row, cells in rows.items() if any(cell.ours for cell in cells)}


def _columns(table: PaperTable) -> list[str]:
    return list(dict.fromkeys(cell.column for cell in table.cells))
