"""Files of a sweep: the table for programs, and the page for people."""

from collections.abc import Mapping, Sequence
from html import escape

import numpy as np

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
from mapper.export.figures import TEXT, box_panels, caption, draw_boxes, png_of
from mapper.export.html import bullets, document, image, section, table
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
        section("Versions", table(["", "version"], versions().items())),
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
    compared = f"<table><thead>{_head(variants)}</thead><tbody>{''.join(rows)}</tbody></table>"
    hint = "Median over the seeds, and the range. " if _has_range(groups) else ""
    hint += _BOLD[quantity.needs_coverage] if quantity.best else ""
    charts = ""
    if quantity.key in _DRAWN:
        charts = "".join(_chart(log, of_log, quantity) for log, of_log in groups.items())
    return f'<p class="hint">{hint}</p><div class="scroll">{compared}</div>{charts}'


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
    """Return a picture with a dot for every build and a box for all of a variant; empty if it would be."""
    values = {", ".join(variant): group.values(quantity.key) for variant, group in of_log.items()}
    if not any(value > 0.0 for known in values.values() for value in known):
        return ""
    figure, (axes,) = box_panels(log, 1, list(values))
    dots = [(value, row) for row, known in enumerate(values.values(), 1) for value in known]
    axes.plot(*zip(*dots, strict=True), "o", color=TEXT, markersize=4, zorder=3)
    draw_boxes(axes, {label: np.array(known) for label, known in values.items()})
    caption(axes, x=quantity.title)
    return image(png_of(figure), f"{log}, {quantity.title}")


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
    builds = f"<table class='wide'><thead><tr>{head}</tr></thead><tbody>{''.join(rows)}</tbody></table>"
    return f'<div class="scroll">{builds}</div>'


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
    return table(["", "name", "settings"], rows)


def _settings_text(variant: ConfigurationConfig, file: str = "") -> str:
    return ", ".join([*([file] if file else []), *variant.set]) or "defaults"
