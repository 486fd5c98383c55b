"""The colours that every picture, page and viewer file shares, as (R, G, B) bytes.

Lines and marks are distinct for people who cannot tell red from green: Okabe & Ito (2008).
"""

from mapper.graph.model import Origin

Rgb = tuple[int, int, int]

_VERMILLION: Rgb = (213, 94, 0)
_BLUE: Rgb = (0, 114, 178)
_SKY: Rgb = (86, 180, 233)
_GREEN: Rgb = (0, 158, 115)
_ORANGE: Rgb = (230, 159, 0)
_PURPLE: Rgb = (204, 121, 167)

INK: Rgb = (30, 33, 41)
PAPER: Rgb = (255, 255, 255)
BACKDROP: Rgb = (22, 24, 30)
"""Behind clouds."""

ESTIMATE: Rgb = _VERMILLION
DOUBTFUL: Rgb = (240, 205, 20)
TRUTH: Rgb = _BLUE
START: Rgb = _GREEN
END: Rgb = INK
END_ON_DARK: Rgb = (242, 244, 248)
PLAN: Rgb = (124, 58, 196)
ACCEPTED: Rgb = _PURPLE
REJECTED: Rgb = (150, 156, 166)
FACTORS: dict[Origin, Rgb] = {
    "odometry": (140, 146, 158),
    "loop": ACCEPTED,
    "wheel": _ORANGE,
}
APPEARED: Rgb = _BLUE
VANISHED: Rgb = _VERMILLION
NOT_SEEN_AGAIN: Rgb = REJECTED
UNKNOWN_CELL: Rgb = (214, 218, 224)
FREE_CELL: Rgb = PAPER
OCCUPIED_CELL: Rgb = (35, 41, 54)

RUNS: tuple[Rgb, ...] = (ESTIMATE, _SKY, _GREEN, (150, 120, 220), _ORANGE, (140, 110, 70))
"""Colours of runs that are shown together."""
