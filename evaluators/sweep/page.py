"""Page of a sweep: the compared quantities first, everything that was measured below."""

from collections.abc import Iterable, Mapping, Sequence
from html import escape

from mapper.evaluators.study.versions import versions
from mapper.evaluators.sweep.chart import Line, dot_chart
from mapper.evaluators.sweep.config import ConfigurationConfig
from mapper.evaluators.sweep.plan import Plan
from mapper.evaluators.sweep.tables import (
    COVERED_ALIKE,
    QUANTITIES,
    Group,
    Quantity,
    Variant,
    best_of,
    failures_of,
    grouped,
)
from mapper.evaluators.tables.table import MISSING, Record, Value
from mapper.export.html import bullets, document, section
from mapper.run.files import SUMMARY

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
    """Return a row for each log and a column for each kind of build, and a drawing of it."""
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
    """Return two rows: methods, each over its configurations."""
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
    """Return a table; its cells are plain text."""
    top = "".join(f"<th>{escape(text)}</th>" for text in head)
    body = "".join(f"<tr>{''.join(map(_cell, row))}</tr>" for row in rows)
    return f'<div class="scroll"><table><thead><tr>{top}</tr></thead><tbody>{body}</tbody></table></div>'


def _builds(records: Sequence[Record]) -> str:
    """Return everything that was measured, a row for each build, with a link to its picture."""
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
