"""Files of a sweep: the table for programs, and the page for people."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from statistics import median

from mapper.evaluators.study.engine import versions
from mapper.evaluators.study.table import MISSING, Record, Value, csv_text, write_parquet
from mapper.evaluators.sweep.plan import BuildName, ConfigurationConfig, Plan
from mapper.evaluators.sweep.tables import (
    COVERED_ALIKE,
    QUANTITIES,
    Group,
    Quantity,
    Variant,
    best_of,
    failures_of,
    grouped,
    sweep_records,
)
from mapper.export.html import bullets, document, section
from mapper.run.files import SUMMARY
from mapper.runtime.atomic import write_text
from mapper.runtime.resumable_jobs import JobResult

FILES = CSV, PARQUET, PAGE = "results.csv", "results.parquet", "summary.html"


def write_sweep(plan: Plan, results: Mapping[BuildName, JobResult], *, title: str) -> list[Record]:
    """Write a sweep's table and its page, and return the table.

    Args:
        plan: The builds, and the folder of their results.
        results: Results of the builds.
        title: Title of the page.
    """
    records = sweep_records(plan, results)
    write_text(plan.out / CSV, csv_text(records))
    write_parquet(plan.out / PARQUET, records)
    write_text(plan.out / PAGE, page_of(plan, records, title=title))
    return records


_DRAWN = ("ate_m", "frames_per_s")
_ELSEWHERE = frozenset({"run", "reason", "mapper_version"})
_BOLD = {
    False: "The best of a log is bold.",
    True: f"The best of a log is bold, of those that track at least {COVERED_ALIKE:.0%} of the frames that "
    "any tracks.",
}

Groups = Mapping[str, Mapping[Variant, Group]]


def page_of(plan: Plan, records: Sequence[Record], *, title: str) -> str:
    """Return the page's HTML, which loads nothing; it links to the pictures of the builds beside it."""
    groups = grouped(records)
    bad = failures_of(records)
    sections = [
        *(section(quantity.title, _compared(groups, quantity)) for quantity in QUANTITIES),
        section("Failed and left out", bullets(bad) if bad else "<p>Nothing.</p>"),
        section("Builds", _builds(records)),
        section("Methods and configurations", _settings(plan)),
        section("Versions", _table(["", "version"], versions().items())),
    ]
    counts = [f"{sum(r['status'] == status for r in records)} {status}" for status in _statuses(records)]
    header = f"<h1>{escape(title)}</h1><div>{escape(', '.join(counts))}</div>"
    return document(f"{title} – mapper sweep", header=header, main=sections)


def _statuses(records: Sequence[Record]) -> list[str]:
    return list(dict.fromkeys(str(record["status"]) for record in records))


def _compared(groups: Groups, quantity: Quantity) -> str:
    variants = list(next(iter(groups.values())))
    rows = []
    for log, of_log in groups.items():
        best = best_of(of_log, quantity)
        cells = "".join(
            _cell(of_log[variant].text(quantity), is_best=variant in best) for variant in variants
        )
        rows.append(f"<tr><th>{escape(log)}</th>{cells}</tr>")
    table = f"<table><thead>{_head(variants)}</thead><tbody>{''.join(rows)}</tbody></table>"
    hint = "Median over the seeds, and the range. " if _has_range(groups) else ""
    hint += _BOLD[quantity.needs_coverage] if quantity.best else ""
    charts = ""
    if quantity.key in _DRAWN:
        figures = "".join(_chart(log, of_log, quantity) for log, of_log in groups.items())
        charts = f'<div class="columns">{figures}</div>'
    return f'<p class="hint">{hint}</p><div class="scroll">{table}</div>{charts}'


def _has_range(groups: Groups) -> bool:
    return any(len(group.records) > 1 for of_log in groups.values() for group in of_log.values())


def _head(variants: Sequence[Variant]) -> str:
    methods = list(dict.fromkeys(method for method, _ in variants))
    wide = len(variants) // len(methods)
    above = "".join(f'<th colspan="{wide}">{escape(method)}</th>' for method in methods)
    below = "".join(f"<th>{escape(configuration)}</th>" for _, configuration in variants)
    return f"<tr><th></th>{above}</tr><tr><th>log</th>{below}</tr>"


def _cell(text: str, *, is_best: bool = False) -> str:
    shown = f"<b>{escape(text)}</b>" if is_best else escape(text)
    return f"<td>{shown}</td>"


def _chart(log: str, of_log: Mapping[Variant, Group], quantity: Quantity) -> str:
    methods = list(dict.fromkeys(method for method, _ in of_log))
    lines = [
        Line(
            f"{method}, {configuration}",
            methods.index(method),
            group.values(quantity.key),
            group.text(quantity),
        )
        for (method, configuration), group in of_log.items()
    ]
    caption = f"{escape(log)}, {escape(quantity.title)}"
    return f"<figure><figcaption>{caption}</figcaption>{dot_chart(lines)}</figure>"


def _table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    top = "".join(f"<th>{escape(text)}</th>" for text in head)
    body = "".join(f"<tr>{''.join(map(_cell, row))}</tr>" for row in rows)
    return f'<div class="scroll"><table><thead><tr>{top}</tr></thead><tbody>{body}</tbody></table></div>'


def _builds(records: Sequence[Record]) -> str:
    names = [name for name in records[0] if name not in _ELSEWHERE]
    has_links = any(record.get("run") for record in records)
    head = "".join(f"<th>{escape(name)}</th>" for name in names) + "<th>kept</th>" * has_links
    rows = []
    for record in records:
        cells = "".join(_cell(_shown(record[name])) for name in names)
        if has_links:
            run = record["run"]
            cells += f'<td><a href="{escape(str(run))}/{SUMMARY}">picture</a></td>' if run else "<td></td>"
        rows.append(f"<tr>{cells}</tr>")
    table = f"<table class='wide'><thead><tr>{head}</tr></thead><tbody>{''.join(rows)}</tbody></table>"
    return f'<div class="scroll">{table}</div>'


def _shown(value: Value) -> str:
    if value is None:
        return MISSING
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _settings(plan: Plan) -> str:
    config = plan.config
    rows = [
        ("method", method.name, _settings_text(method, str(method.config or ""))) for method in config.method
    ]
    rows += [("configuration", one.name, _settings_text(one)) for one in config.configuration]
    if config.seeds:
        rows.append(("seeds", "", ", ".join(map(str, config.seeds))))
    return _table(["", "name", "settings"], rows)


def _settings_text(variant: ConfigurationConfig, file: str = "") -> str:
    return ", ".join([*([file] if file else []), *variant.set]) or "defaults"


_WIDTH, _ROW, _LABELS, _BELOW, _EDGE = 620, 20, 230, 24, 24
_COLOURS = 6
_FEWEST_TICKS, _MOST_TICKS = 3, 8


@dataclass(frozen=True, slots=True)
class Line:
    """One line of the chart: the builds by one method and configuration.

    Attributes:
        label: Text at its left.
        colour: Number of its colour.
        values: Sorted; none if there is nothing to draw.
        text: Value in words.
    """

    label: str
    colour: int
    values: Sequence[float]
    text: str


def dot_chart(lines: Sequence[Line]) -> str:
    """Return a chart with a dot at each line's median and a bar over its range, on a logarithmic scale.

    Values that are not positive are drawn at the left edge.
    """
    positive = [value for line in lines for value in line.values if value > 0.0]
    if not positive:
        return "<p>nothing to draw</p>"
    low, high = _widened(min(positive), max(positive))
    bottom = _ROW * len(lines)

    def x(value: float) -> float:
        ratio = math.log(max(value, low) / low) / math.log(high / low)
        return _LABELS + ratio * (_WIDTH - _LABELS - _EDGE)

    marks = [
        f'<line class="grid" x1="{x(tick):.1f}" x2="{x(tick):.1f}" y1="0" y2="{bottom}"/>'
        f'<text x="{x(tick):.1f}" y="{bottom + 15}" text-anchor="middle">{tick:g}</text>'
        for tick in _ticks(low, high)
    ]
    for row, line in enumerate(lines):
        y = _ROW * (row + 0.5)
        marks.append(f'<text x="{_LABELS - 8}" y="{y + 4}" text-anchor="end">{escape(line.label)}</text>')
        if not line.values:
            marks.append(f'<text x="{_LABELS + 4}" y="{y + 4}">{escape(line.text)}</text>')
            continue
        colour = f"var(--run{line.colour % _COLOURS})"
        marks.append(
            f"<g><title>{escape(f'{line.label}: {line.text}')}</title>"
            f'<line x1="{x(line.values[0]):.1f}" x2="{x(line.values[-1]):.1f}" y1="{y}" y2="{y}"'
            f' stroke="{colour}" stroke-width="3" stroke-opacity="0.45"/>'
            f'<circle cx="{x(median(line.values)):.1f}" cy="{y}" r="4.5" fill="{colour}"/></g>'
        )
    return f'<svg viewBox="0 0 {_WIDTH} {bottom + _BELOW}" role="img">{"".join(marks)}</svg>'


def _widened(low: float, high: float) -> tuple[float, float]:
    """Return limits with room beside the values, and at least a factor of two apart."""
    room = max(1.1, math.sqrt(2.0 * low / high) if high < 2.0 * low else 1.1)
    return low / room, high * room


def _ticks(low: float, high: float) -> list[float]:
    powers = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    fine = [m * 10.0**power for power in powers for m in (1, 2, 5) if low <= m * 10.0**power <= high]
    if len(fine) < _FEWEST_TICKS:
        rough = (high - low) / (_FEWEST_TICKS + 1)
        scale = 10.0 ** math.floor(math.log10(rough))
        step = scale * min(m for m in (1, 2, 5, 10) if m * scale >= rough)
        return [n * step for n in range(math.ceil(low / step), math.floor(high / step) + 1)]
    if len(fine) <= _MOST_TICKS:
        return fine
    coarse = [10.0**power for power in powers if low <= 10.0**power <= high]
    return coarse[:: math.ceil(len(coarse) / _MOST_TICKS)]
