"""GNSS fixes from the sentences of a receiver (NMEA 0183)."""

from collections.abc import Iterable
from datetime import date, time
from typing import Any, NamedTuple

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

    places: list[_Place] = []
    sigmas: dict[time, tuple[float, float, float]] = {}
    day: date | None = None
    damaged = 0
    for stamp_ns, sentence in sentences:
        try:
            message = pynmea2.parse(sentence[max(sentence.find("$"), 0) :].strip(), check=True)
            match getattr(message, "sentence_type", ""):
                case "GGA" if message.timestamp is not None:
                    places.append(_place(stamp_ns, message))
                case "GST" if message.timestamp is not None:
                    three = (message.std_dev_longitude, message.std_dev_latitude, message.std_dev_altitude)
                    sigmas[_clock(message)] = (_number(three[0]), _number(three[1]), _number(three[2]))
                case "RMC" | "ZDA":
                    day = day or _day(message)
        except (ValueError, OverflowError):
            damaged += bool(sentence.strip()) and not sentence.startswith("#")
    notes = [f"{name}: {damaged} damaged sentences are left out"] * (damaged > 0)
    if not places:
        return None, notes
    stamps_ns = [place.stamp_ns for place in places if place.stamp_ns is not None]
    if not stamps_ns and day is None:
        return None, [*notes, f"{name}: GNSS fixes are not used, as no RMC or ZDA sentence has their date"]
    if not stamps_ns and day is not None:
        stamps_ns = _utc_ns(day, [place.clock for place in places])
    if not all(place.has_geoid for place in places):
        notes.append(f"{name}: heights are above sea level, as the receiver states no height of the geoid")
    variances = np.square([sigmas.get(place.clock, (np.nan,) * 3) for place in places])
    fixes = GnssFixes(
        name,
        np.array(stamps_ns, np.int64),
        np.array([place.geodetic for place in places]),
        variances[:, :, None] * np.eye(3),
        np.array([place.status for place in places], np.int8),
    )
    return fixes, notes


class _Place(NamedTuple):
    """What a GGA sentence says, and when it was received."""

    stamp_ns: int | None
    clock: time
    geodetic: tuple[float, float, float]
    status: int
    has_geoid: bool


def _place(stamp_ns: int | None, message: Any) -> _Place:
    """Return the place of a GGA sentence; without coordinates it is no fix.

    Raises:
        ValueError: A field is malformed.
    """
    clock, geoid_m = _clock(message), _number(message.geo_sep)
    has_geoid = bool(np.isfinite(geoid_m))
    if not (message.lat and message.lon):
        return _Place(stamp_ns, clock, (np.nan, np.nan, np.nan), NO_FIX, has_geoid)
    if message.lat_dir not in ("N", "S") or message.lon_dir not in ("E", "W"):  # the library says 0°
        raise ValueError(f"{message.lat_dir!r}, {message.lon_dir!r} are no directions")
    height_m = _number(message.altitude) + (geoid_m if has_geoid else 0.0)
    status = _STATUS.get(int(message.gps_qual or 0), NO_FIX)
    return _Place(stamp_ns, clock, (message.latitude, message.longitude, height_m), status, has_geoid)


def _clock(message: Any) -> time:
    if not isinstance(message.timestamp, time):  # the library leaves what it cannot convert as it was
        raise ValueError(f"{message.timestamp!r} is no time")
    return message.timestamp


def _day(message: Any) -> date | None:
    """Return the date of an RMC or ZDA sentence; None if it has none yet.

    Raises:
        ValueError: It is malformed.
    """
    if message.sentence_type == "ZDA":
        fields = message.day, message.month, message.year
        return date(int(fields[2]), int(fields[1]), int(fields[0])) if all(fields) else None
    if not isinstance(message.datestamp, date | None):
        raise ValueError(f"{message.datestamp!r} is no date")
    return message.datestamp


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
