"""GNSS fixes from the sentences of a receiver (NMEA 0183)."""

from collections.abc import Iterable
from datetime import date, time
from typing import Any

import numpy as np

from mapper.core.timebase import NS_PER_S
from mapper.sensing.gnss import NO_FIX, GnssFixes

_STATUS = {1: 0, 2: 2, 3: 0, 4: 2, 5: 2, 9: 1}
"""Status by the quality that GGA states: GPS, differential, PPS, RTK, RTK with floating ambiguities, SBAS."""
_DAY_NS, _EPOCH = 86_400 * NS_PER_S, date(1970, 1, 1)


def fixes_from_sentences(
    name: str, sentences: Iterable[tuple[int | None, str]]
) -> tuple[GnssFixes | None, list[str]]:
    """Return the fixes of GGA sentences, with the accuracies of GST; None if there are none, and notes.

    Args:
        name: Topic or file.
        sentences: Each with the time when it was received, nanoseconds; with None the times are UTC, by GGA
            and the first date of RMC or ZDA.
    """
    import pynmea2

    places: list[tuple[int | None, Any]] = []
    sigmas: dict[time, tuple[float, float, float]] = {}
    day: date | None = None
    damaged = 0
    for stamp_ns, sentence in sentences:
        try:
            message = pynmea2.parse(sentence[max(sentence.find("$"), 0) :].strip(), check=True)
        except pynmea2.ParseError:
            damaged += bool(sentence.strip()) and not sentence.startswith("#")
            continue
        match getattr(message, "sentence_type", ""):
            case "GGA" if message.timestamp is not None:
                places.append((stamp_ns, message))
            case "GST" if message.timestamp is not None:
                three = (message.std_dev_longitude, message.std_dev_latitude, message.std_dev_altitude)
                sigmas[message.timestamp] = (_number(three[0]), _number(three[1]), _number(three[2]))
            case "RMC":
                day = day or message.datestamp
            case "ZDA" if message.day and message.month and message.year:
                day = day or date(int(message.year), int(message.month), int(message.day))
    notes = [f"{name}: {damaged} damaged sentences are left out"] * (damaged > 0)
    if not places:
        return None, notes
    stamps_ns = [stamp_ns for stamp_ns, _ in places if stamp_ns is not None]
    if not stamps_ns and day is None:
        return None, [*notes, f"{name}: GNSS fixes are not used, as no RMC or ZDA sentence has their date"]
    if not stamps_ns and day is not None:
        stamps_ns = _utc_ns(day, [message.timestamp for _, message in places])
    if any(not _is_stated(message.geo_sep) for _, message in places):
        notes.append(f"{name}: heights are above sea level, as the receiver states no height of the geoid")
    variances = np.square([sigmas.get(message.timestamp, (np.nan,) * 3) for _, message in places])
    fixes = GnssFixes(
        name,
        np.array(stamps_ns, np.int64),
        np.array([_geodetic(message) for _, message in places]),
        variances[:, :, None] * np.eye(3),
        np.array([_status(message) for _, message in places], np.int8),
    )
    return fixes, notes


def _geodetic(message: Any) -> tuple[float, float, float]:
    height_m = _number(message.altitude) + (_number(message.geo_sep) if _is_stated(message.geo_sep) else 0.0)
    if not (message.lat and message.lon):
        return np.nan, np.nan, np.nan
    return message.latitude, message.longitude, height_m


def _status(message: Any) -> int:
    return _STATUS.get(int(message.gps_qual or 0), NO_FIX) if message.lat and message.lon else NO_FIX


def _utc_ns(day: date, times: list[time]) -> list[int]:
    """Return times of a day, and of those after it where they begin again, since 1970."""
    stamps_ns: list[int] = []
    for clock in times:
        seconds = 3600 * clock.hour + 60 * clock.minute + clock.second
        stamp_ns = (day - _EPOCH).days * _DAY_NS + seconds * NS_PER_S + clock.microsecond * 1000
        while stamps_ns and stamp_ns < stamps_ns[-1] - _DAY_NS // 2:
            stamp_ns += _DAY_NS
        stamps_ns.append(stamp_ns)
    return stamps_ns


def _number(value: Any) -> float:
    try:
        return float(value)
    except (TypeError, ValueError):
        return np.nan


def _is_stated(value: Any) -> bool:
    return bool(np.isfinite(_number(value)))
