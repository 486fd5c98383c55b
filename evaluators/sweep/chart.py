"""Chart of one quantity of a log's builds, as SVG that takes its colours from the page."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from statistics import median

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
    """Return a few round numbers between two limits."""
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
