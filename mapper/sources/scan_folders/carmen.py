"""Text logs of CARMEN (.log, .clf): a robot's 2D laser and its wheel odometry, a message a line.

The lines are those that the header of a log names: ``FLASER`` and ``RLASER`` of the front and the rear laser,
``ROBOTLASER1`` and ``RAWLASER1`` of later versions, ``ODOM``, ``TRUEPOS`` of its simulator, ``PARAM``.
"""

import re
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mapper.core.errors import DataError, SourceError
from mapper.core.frames import Scan
from mapper.core.geometry import Array, Transform, inverse, planar_motion
from mapper.core.timebase import ns_from_seconds_text
from mapper.core.trajectory import Trajectory
from mapper.runtime.regular_files import HEAD_BYTES, read_text
from mapper.sources.base import FrameRef, Log
from mapper.sources.config import SourceConfig
from mapper.sources.laser_scan import MOST_RAD, beam_points, planar_scan, rolling
from mapper.sources.text import time_order

_ENDINGS = (".log", ".clf", ".txt")
_MESSAGE = re.compile(rb"^(?:[FR]LASER|(?:ROBOT|RAW)LASER\d|ODOM|PARAM) ", re.MULTILINE)
_NAMES = re.compile(r"(?:[FR]LASER|(?:ROBOT|RAW)LASER\d)$")
_OFFSET = {"FLASER": ("robot_frontlaser_offset", 0.0), "RLASER": ("robot_rearlaser_offset", np.pi)}
_FAR_M = 80.0
"""SICK's LMS 200 measures up to 80 m; larger readings are its codes for none."""
_LAST_DIGIT_M = 0.005
_MOST_DIGITS = 6
_SAME_M = 0.02
"""Of mountings by two lines: stamps and poses have few digits."""


@dataclass(frozen=True, slots=True, eq=False)
class _Line:
    """A laser's line.

    Attributes:
        number: In the file, from 1.
        stamp_ns: By ``ipc_timestamp``.
        ranges_m: (N,) readings.
        first_rad: Direction of the first beam.
        step_rad: From each beam to the next.
        max_m: Largest range; a reading as large is none.
        laser: x, y and yaw that the line gives the laser.
        robot: The same of the robot; of FLASER and RLASER by wheel odometry. None where the line has none.
    """

    number: int
    stamp_ns: int
    ranges_m: Array
    first_rad: float
    step_rad: float
    max_m: float
    laser: Array | None
    robot: Array | None


def recognise(path: Path) -> bool:
    """Return whether a file is named as a log and begins with CARMEN's messages."""
    if path.suffix.lower() not in _ENDINGS or not path.is_file():
        return False
    with path.open("rb") as file:
        return _MESSAGE.search(file.read(HEAD_BYTES)) is not None


def read_log(path: Path, config: SourceConfig) -> Log:  # noqa: ARG001
    """Return the log of the laser that has most lines; the body is the robot, x forward.

    Raises:
        SourceError: It cannot be read, or has no line of a laser that can.
    """
    lines: dict[str, list[_Line]] = defaultdict(list)
    odometry: list[tuple[int, Array]] = []
    truth: list[tuple[int, Array]] = []
    parameters: dict[str, str] = {}
    damaged: list[str] = []
    for number, text in enumerate(read_text(path, error=SourceError).splitlines(), start=1):
        words = text.split()
        name = words[0] if words else ""
        try:
            if _NAMES.match(name):
                lines[name].append(_laser_line(number, words))
            elif name == "ODOM":
                odometry.append((_stamp(words, 7), _numbers(words[1:4])))
            elif name == "TRUEPOS":
                truth.append((_stamp(words, 7), _numbers(words[1:4])))
            elif name == "PARAM" and len(words) > 2:
                parameters[words[1]] = words[2]
        except DataError as error:
            damaged.append(f"line {number}, {name}: {error}")
    notes = [] if not damaged else [f"{len(damaged)} lines are damaged and left out; the first: {damaged[0]}"]
    if not lines:
        raise SourceError(
            f"{path}: no line of a laser that can be read{': ' + damaged[0] if damaged else ''}"
        )
    name = max(lines, key=lambda one: len(lines[one]))
    if len(lines) > 1:
        others = ", ".join(f"{len(lines[one])} of {one}" for one in sorted(lines) if one != name)
        notes.append(f"scans of {name} are mapped; those of other lasers are not used: {others}")
    order, order_notes = time_order(np.array([line.stamp_ns for line in lines[name]]), what="scans")
    scans = [lines[name][k] for k in order]
    T_robot_laser, mounting_notes = _mounting(name, scans, parameters)
    if name in _OFFSET or not odometry:
        odometry = [(line.stamp_ns, line.robot) for line in scans if line.robot is not None]
    wheels, wheel_notes = _trajectory(odometry, what="wheel odometry")
    wheels, still_notes = rolling(wheels)
    true_poses, truth_notes = _trajectory(truth, what="TRUEPOS")
    limit_m = _limit_m(parameters)
    return Log(
        path=path,
        name=path.resolve().stem,
        kind="carmen",
        sensor="lidar-2d",
        stamps_ns=np.array([line.stamp_ns for line in scans]),
        entry_at=lambda index: FrameRef(
            scans[index].stamp_ns, lambda _: _scan_of(scans[index], T_robot_laser, limit_m)
        ),
        truth=true_poses,
        wheels=wheels,
        notes=[*notes, *order_notes, *mounting_notes, *wheel_notes, *still_notes, *truth_notes],
    )


def _scan_of(line: _Line, T_robot_laser: Transform, limit_m: float) -> Scan:
    # A reading of the largest range is none, whatever the digits that are written.
    limits_m = 0.0, min(line.max_m - _LAST_DIGIT_M, limit_m)
    points, _ = beam_points(
        line.ranges_m, first_rad=line.first_rad, step_rad=line.step_rad, limits_m=limits_m
    )
    return planar_scan(line.stamp_ns, points, T_robot_laser)


def _laser_line(number: int, words: Sequence[str]) -> _Line:
    """Return the parts of a laser's line.

    Raises:
        DataError: It has fewer words than its own counts say, or one is no number.
    """
    if words[0] in _OFFSET:
        ranges_m, end = _counted(words, 1)
        first_rad, step_rad = _guessed_beams(len(ranges_m))
        laser, robot = _numbers(words[end : end + 3]), _numbers(words[end + 3 : end + 6])
        return _Line(number, _stamp(words, end + 6), ranges_m, first_rad, step_rad, np.inf, laser, robot)
    count = _count(words, 8)
    first_rad, _, step_rad, max_m = _numbers(words[2:6])
    if abs(step_rad) * count > MOST_RAD:
        raise DataError(f"{words[8]} beams in steps of {step_rad:g} rad are more than two turns")
    ranges_m, end = _counted(words, 8)
    _, end = _counted(words, end)
    if words[0].startswith("RAW"):
        return _Line(number, _stamp(words, end), ranges_m, first_rad, step_rad, max_m, None, None)
    laser, robot = _numbers(words[end : end + 3]), _numbers(words[end + 3 : end + 6])
    return _Line(number, _stamp(words, end + 11), ranges_m, first_rad, step_rad, max_m, laser, robot)


def _counted(words: Sequence[str], at: int) -> tuple[Array, int]:
    """Return the numbers that a count announces, and the index of the word after them."""
    count = _count(words, at)
    end = at + 1 + count
    if end > len(words):
        raise DataError(f"{count} readings are announced, and {len(words) - at - 1} words follow")
    return _numbers(words[at + 1 : end], finite=False), end


def _count(words: Sequence[str], at: int) -> int:
    text = words[at] if at < len(words) else ""
    if not text.isdecimal() or len(text) > _MOST_DIGITS:
        raise DataError(f"{text!r} is no number of readings")
    return int(text)


def _guessed_beams(count: int) -> tuple[float, float]:
    """Return the first direction and the step of a SICK's beams by their number: 180° in steps of 1° or 0.5°.

    With 180 or 360 beams the last step is left out.
    """
    steps = count if count % 2 == 0 else count - 1
    return -0.5 * np.pi, np.pi / max(steps, 1)


def _numbers(words: Sequence[str], *, finite: bool = True) -> Array:
    try:
        numbers = np.array(words, dtype=np.float64)
    except ValueError:
        wrong = next(
            (word for word in words if not re.fullmatch(r"[-+.\deE]+|[-+]?(?i:nan|inf)", word)), words[0]
        )
        raise DataError(f"{wrong!r} is no number") from None
    if finite and (len(numbers) < 3 or not np.isfinite(numbers).all()):
        raise DataError(f"want three finite numbers, not {' '.join(words) or 'the end of the line'}")
    return numbers


def _stamp(words: Sequence[str], at: int) -> int:
    if at >= len(words):
        raise DataError(f"it ends after {len(words)} words, before its ipc_timestamp")
    return ns_from_seconds_text(words[at])


def _mounting(
    name: str, scans: Sequence[_Line], parameters: Mapping[str, str]
) -> tuple[Transform, list[str]]:
    """Return T_robot_laser by its PARAM, else by the lines' two poses if it stays the same, and notes."""
    parameter, yaw = _OFFSET.get(name, ("", 0.0))
    if parameter in parameters:
        offset_m = float(_numbers([parameters[parameter], "0", "0"])[0])
        return planar_motion(offset_m if yaw == 0.0 else -abs(offset_m), 0.0, yaw), []
    both = [(line.robot, line.laser) for line in scans if line.robot is not None and line.laser is not None]
    if both:
        T = np.array([inverse(planar_motion(*robot)) @ planar_motion(*laser) for robot, laser in both])
        typical = int(np.argsort(T[:, 0, 3])[len(T) // 2])
        is_same = np.linalg.norm((T - T[typical])[:, :2, 3], axis=1) < _SAME_M
        if is_same.mean() > 0.5:
            return T[typical], []
    at = "at the robot's origin" + (", looking back" if yaw else "")
    notes = [f"where the laser is mounted is not stated: taken {at}"]
    if both:
        notes.append("the lines' poses were corrected by another program; those of the odometry are used")
    return planar_motion(0.0, 0.0, yaw), notes


def _trajectory(poses: Sequence[tuple[int, Array]], *, what: str) -> tuple[Trajectory | None, list[str]]:
    if not poses:
        return None, []
    stamps_ns = np.array([stamp_ns for stamp_ns, _ in poses])
    order, notes = time_order(stamps_ns, what=what)
    return Trajectory(stamps_ns[order], np.array([planar_motion(*poses[k][1]) for k in order])), notes


def _limit_m(parameters: Mapping[str, str]) -> float:
    """Return the largest range that is no code for none: by PARAM, or that of the SICK that FLASER is for."""
    limit_m = _FAR_M
    for name, text in parameters.items():
        if name.endswith("laser_max"):
            limit_m = min(limit_m, float(_numbers([text, "0", "0"])[0]) - _LAST_DIGIT_M)
    return limit_m
