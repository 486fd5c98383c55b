"""Tables of a sweep: a record for every build, and medians over the seeds."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from statistics import median

from mapper.evaluators.study.table import MISSING, Column, Record, Value, decimals, percent, text_table
from mapper.evaluators.sweep.plan import RUNS, BuildName, Plan
from mapper.runtime.resumable_jobs import JobResult

_WHOLE = 0.995
COVERED_ALIKE = 0.95
"""Errors are compared of the variants that cover at least this share of what the best covers."""

Variant = tuple[str, str]
"""Names of a method and of a configuration."""


@dataclass(frozen=True, slots=True)
class Quantity:
    """Quantity that methods are compared by.

    Attributes:
        key: Key in the records.
        title: Title with the unit.
        shown: Turns a number into text.
        best: Function that picks the value to mark, if any is.
        needs_coverage: It compares only among variants that cover alike: one that leaves out hard frames
            has smaller errors.
    """

    key: str
    title: str
    shown: Callable[[float], str]
    best: Callable[[Sequence[float]], float] | None = None
    needs_coverage: bool = False


QUANTITIES = (
    Quantity("ate_m", "ATE RMSE m", decimals(4), min, needs_coverage=True),
    Quantity("rpe_1s_m", "RPE 1 s m", decimals(4), min, needs_coverage=True),
    Quantity("coverage_ratio", "coverage %", percent(0), max),
    Quantity("loops", "loops", decimals(0)),
    Quantity("frames_per_s", "frames/s", decimals(1), max),
    Quantity("peak_memory_mb", "peak MB", decimals(0), min),
)


@dataclass(frozen=True, slots=True)
class Group:
    """The builds of one log by one method and configuration, which differ by their seed.

    Attributes:
        records: Records of the builds that finished.
        failures: Number of builds that did not.
    """

    records: tuple[Record, ...] = ()
    failures: int = 0

    def values(self, key: str) -> list[float]:
        """Return the known values of a quantity, in order."""
        return sorted(float(value) for record in self.records if (value := record.get(key)) is not None)

    def text(self, quantity: Quantity) -> str:
        """Return the median, with the range if it shows, the coverage if it is not whole, and failures."""
        values = self.values(quantity.key)
        if not values:
            return MISSING
        text, least, most = map(quantity.shown, (median(values), values[0], values[-1]))
        if least != most:
            text += f" ({least}–{most})"
        if quantity.needs_coverage and self.coverage < _WHOLE:
            text += f" at {100.0 * self.coverage:.0f} %"
        if self.failures:
            text += f", {self.failures} failed"
        return text

    @property
    def coverage(self) -> float:
        """Return the median share of the frames that have a pose."""
        values = self.values("coverage_ratio")
        return median(values) if values else 0.0


def sweep_records(plan: Plan, results: Mapping[BuildName, JobResult]) -> list[Record]:
    """Return a record for every build, finished or not; all have the same names."""
    rows = [_row(plan, build, results.get(build)) for build in plan.entries]
    names = dict.fromkeys(name for row in rows for name in row)
    return [{name: row.get(name) for name in names} for row in rows]


def _row(plan: Plan, build: BuildName, result: JobResult | None) -> dict[str, Value]:
    row: dict[str, Value] = asdict(build)
    if result is None:
        return row | {"status": "does not apply", "reason": str(plan.entries[build])}
    if result.failure:
        return row | {"status": "failed", "reason": result.failure}
    kept = None if plan.config.keep == "nothing" else f"{RUNS}/{result.key}"
    (measured,) = result.records
    return row | {"status": "finished", "reason": None, **measured, "cell_s": result.seconds, "run": kept}


def grouped(records: Sequence[Record]) -> dict[str, dict[Variant, Group]]:
    """Return the builds that differ by their seed alone together, by log and by what they were built with."""
    groups: dict[str, dict[Variant, Group]] = {}
    for record in records:
        of_log = groups.setdefault(str(record["log"]), {})
        variant = str(record["method"]), str(record["configuration"])
        group = of_log.get(variant, Group())
        if record["status"] == "finished":
            group = replace(group, records=(*group.records, record))
        elif record["status"] == "failed":
            group = replace(group, failures=group.failures + 1)
        of_log[variant] = group
    return groups


def best_of(groups: Mapping[Variant, Group], quantity: Quantity) -> set[Variant]:
    """Return the variants with the best median of one log, as it is shown; none if there is no choice.

    Errors are compared only of those that cover about as much of the log as any.
    """
    if quantity.best is None:
        return set()
    enough = COVERED_ALIKE * max(group.coverage for group in groups.values()) * quantity.needs_coverage
    medians = {
        variant: median(values)
        for variant, group in groups.items()
        if (values := group.values(quantity.key)) and group.coverage >= enough
    }
    if len(medians) < 2:
        return set()
    best = quantity.shown(quantity.best(list(medians.values())))
    return {variant for variant, value in medians.items() if quantity.shown(value) == best}


def summary_text(records: Sequence[Record]) -> str:
    """Return a line for every log, method and configuration, and one for every kind of failure."""
    groups = grouped(records)
    columns = [Column("label", "log, method, configuration")]
    columns += [Column(quantity.key, quantity.title) for quantity in QUANTITIES]
    lines = [
        {"label": BuildName(log, *variant).label}
        | {quantity.key: group.text(quantity) for quantity in QUANTITIES}
        for log, of_log in groups.items()
        for variant, group in of_log.items()
        if group.records
    ]
    return "\n".join([*([text_table(columns, lines)] if lines else []), *failures_of(records)])


def failures_of(records: Sequence[Record]) -> list[str]:
    """Return the builds that failed or do not apply, with the reason; a line for all that have the same."""
    alike: dict[tuple[Value, ...], list[str]] = {}
    for record in records:
        if record["status"] != "finished":
            kind = tuple(record[name] for name in ("status", "log", "method", "reason"))
            seed = "" if record["seed"] is None else f", seed {record['seed']}"
            alike.setdefault(kind, []).append(f"{record['configuration']}{seed}")
    return [
        f"{status}: {log}, {method} ({'; '.join(which)}): {reason}"
        for (status, log, method, reason), which in alike.items()
    ]
