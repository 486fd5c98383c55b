"""Metric: one measured number with its name and unit, and tables of them."""

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from mapper.core.errors import DataError

_DEGREES = {"rad": "°", "rad/m": "°/m"}


@dataclass(frozen=True, slots=True)
class Metric:
    """One measured number.

    Attributes:
        quantity: Name of what is measured: "ATE RMSE".
        value: A finite number; what could not be measured is not a metric.
        unit: "m", "rad", "s", or what was counted: "pairs", "frames".
        condition: What the value depends on: "SE(3)-aligned".
    """

    quantity: str
    value: float
    unit: str
    condition: str = ""

    def __post_init__(self) -> None:
        if not self.quantity or not self.unit:
            raise DataError(
                f"metric {self.name!r} of {self.value}: needs a name and a unit, not {self.unit!r}"
            )
        if not math.isfinite(self.value):
            raise DataError(f"metric {self.name!r} is {self.value}; leave out what could not be measured")

    @property
    def name(self) -> str:
        """Name for a reader, with the condition: "ATE RMSE, SE(3)-aligned"."""
        return f"{self.quantity}, {self.condition}" if self.condition else self.quantity


def records_of(metrics: Iterable[Metric]) -> list[dict[str, str | float]]:
    """Return each metric's name, value and unit for other programs: every digit, angles in radians."""
    return [{"name": metric.name, "value": metric.value, "unit": metric.unit} for metric in metrics]


def exceeded(records: Iterable[Mapping[str, Any]], limits: Mapping[str, float]) -> list[str]:
    """Return a sentence for each metric that exceeds a limit.

    Args:
        records: Metrics as of :func:`records_of`.
        limits: Largest values by the beginnings of the metrics' names; of angles in degrees.

    Raises:
        DataError: No metric begins like that.
    """
    known = list(records)
    sentences = []
    for beginning, limit in limits.items():
        named = [record for record in known if record["name"].startswith(beginning)]
        if not named:
            names = ", ".join(record["name"] for record in known)
            raise DataError(f"{beginning}={limit:g}: no metric begins like that; there are {names}")
        for record in named:
            value, unit = _as_shown(record["value"], record["unit"])
            if value > limit:
                sentences.append(f"{record['name']} is {value:.6g} {unit}, more than {limit:g}")
    return sentences


def text_table(metrics: Sequence[Metric]) -> str:
    """Return aligned lines of name, value and unit for a terminal; angles in degrees."""
    rows = [shown(metric) for metric in metrics]
    name_width = max((len(name) for name, _, _ in rows), default=0)
    value_width = max((len(value) for _, value, _ in rows), default=0)
    return "\n".join(f"{name:<{name_width}}  {value:>{value_width}} {unit}" for name, value, unit in rows)


def markdown_table(metrics: Sequence[Metric]) -> str:
    """Return a Markdown table for a report; angles in degrees."""
    lines = ["| metric | value | unit |", "| --- | ---: | --- |"]
    lines += [f"| {name} | {value} | {unit} |" for name, value, unit in map(shown, metrics)]
    return "\n".join(lines)


def json_text(metrics: Sequence[Metric]) -> str:
    """Return a JSON list for other programs: every digit, angles in radians."""
    return json.dumps(records_of(metrics), indent=2, ensure_ascii=False)


def shown(metric: Metric, *, digits: int = 6) -> tuple[str, str, str]:
    """Return a metric's name, value and unit as they are shown."""
    value, unit = _as_shown(metric.value, metric.unit)
    return metric.name, str(value) if isinstance(value, int) else f"{value:.{digits}g}", unit


def _as_shown(value: float, unit: str) -> tuple[float, str]:
    """Return a value with its unit for people: angles in degrees, here alone."""
    return (math.degrees(value), _DEGREES[unit]) if unit in _DEGREES else (value, unit)
