"""Calibration files beside a log: our TOML, and the YAML of ROS, OpenCV and ORB-SLAM."""

import math
import re
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from mapper.core.errors import DataError, SourceError
from mapper.core.frames import NO_DISTORTION, PinholeCamera
from mapper.runtime.regular_files import read_text
from mapper.sources.calibration import Calibration

FILE_NAMES = (
    "calibration.toml",
    "calibration.yaml",
    "calibration.yml",
    "camera.yaml",
    "camera.yml",
    "camera_info.yaml",
    "camera_info.yml",
)

_Numbers = Mapping[str, Sequence[float]]


def read_calibration(path: Path) -> Calibration:
    """Read intrinsics from TOML, or from the YAML of ROS's camera_info, OpenCV or ORB-SLAM.

    TOML keys: fx_px fy_px cx_px cy_px, and optionally width_px height_px, distortion (k1 k2 p1 p2 k3) and
    depth_factor (image units per metre).

    Raises:
        SourceError: The file cannot be read, lacks a number, or (TOML) has a key of another meaning.
    """
    text = read_text(path, error=SourceError)
    try:
        if path.suffix == ".toml":
            numbers = _toml_numbers(tomllib.loads(text))
            unknown = sorted(set(numbers) - _KEYS)
            if unknown:
                raise DataError(f"{unknown[0]}: unknown key; known are {', '.join(sorted(_KEYS))}")
        else:
            numbers = _yaml_numbers(text)
        return _interpret(numbers, f"{path}")
    except (ValueError, RecursionError) as error:  # RecursionError: of brackets within brackets
        raise SourceError(f"{path}: not valid {path.suffix[1:].upper()}: {error}") from None
    except (DataError, OverflowError) as error:  # an integer that is too large for a float
        raise SourceError(f"{path}: {error}") from None


def calibration_text(camera: PinholeCamera, *, depth_units_per_m: float) -> str:
    """Return the text of a ``calibration.toml``."""
    values = {
        "width_px": camera.width_px,
        "height_px": camera.height_px,
        "fx_px": float(camera.fx_px),
        "fy_px": float(camera.fy_px),
        "cx_px": float(camera.cx_px),
        "cy_px": float(camera.cy_px),
        "distortion": [float(k) for k in camera.distortion],
        "depth_factor": float(depth_units_per_m),
    }
    return "".join(f"{key} = {value!r}\n" for key, value in values.items())


# What each number is called: by us, by ROS, by OpenCV and by ORB-SLAM ("Camera.fx" counts as "fx").
_NAMES = {
    "fx": ("fx_px", "fx"),
    "fy": ("fy_px", "fy"),
    "cx": ("cx_px", "cx"),
    "cy": ("cy_px", "cy"),
    "width": ("width_px", "width", "image_width"),
    "height": ("height_px", "height", "image_height"),
    "depth_factor": ("depth_factor", "depthmapfactor"),
    "matrix": ("camera_matrix", "k"),
    "distortion": ("distortion", "distortion_coefficients", "d"),
    "k1": ("k1",),
    "k2": ("k2",),
    "p1": ("p1",),
    "p2": ("p2",),
    "k3": ("k3",),
}
_UNITS_PER_M = (1e-3, 1e7)  # of a depth image: kilometres to tenths of a micrometre
_KEYS = {name for names in _NAMES.values() for name in names}


def _interpret(numbers: _Numbers, origin: str) -> Calibration:
    found = {meaning: numbers[name] for meaning, names in _NAMES.items() for name in names if name in numbers}
    for meaning, values in found.items():
        if not all(map(math.isfinite, values)):
            raise DataError(f"{meaning}: {', '.join(f'{value:g}' for value in values)} is not finite")
    if len(K := found.get("matrix", ())) == 9:
        found = {"fx": K[0:1], "cx": K[2:3], "fy": K[4:5], "cy": K[5:6], **found}
    one = {meaning: values[0] for meaning, values in found.items() if len(values) == 1}
    missing = [meaning for meaning in ("fx", "fy", "cx", "cy") if meaning not in one]
    if missing:
        raise DataError(f"no number {missing[0]}_px; want fx_px, fy_px, cx_px and cy_px")
    distortion = found.get("distortion") or [one.get(name, 0.0) for name in ("k1", "k2", "p1", "p2", "k3")]
    if any(distortion[5:]):
        raise DataError(f"{len(distortion)} distortion coefficients; only k1, k2, p1, p2, k3 are supported")
    k1, k2, p1, p2, k3 = (*distortion[:5], *NO_DISTORTION)[:5]
    low, high = _UNITS_PER_M
    if not low <= one.get("depth_factor", 1.0) <= high:
        raise DataError(f"depth_factor {one['depth_factor']:g}, want {low:g} to {high:g} units per metre")
    size = (int(one["width"]), int(one["height"])) if {"width", "height"} <= one.keys() else None
    return Calibration(
        origin,
        *(one["fx"], one["fy"], one["cx"], one["cy"]),
        distortion=(k1, k2, p1, p2, k3),
        size_px=size,
        depth_units_per_m=one.get("depth_factor"),
    )


def _toml_numbers(table: Mapping[str, Any]) -> dict[str, Sequence[float]]:
    numbers: dict[str, Sequence[float]] = {}
    for key, value in table.items():
        if isinstance(value, dict):
            numbers |= _toml_numbers(value)
            continue
        values = value if isinstance(value, list) else [value]
        if not all(isinstance(v, int | float) for v in values):
            raise DataError(f"{key} = {value!r} is not a number or a list of numbers")
        numbers[key.lower()] = [float(v) for v in values]
    return numbers


_YAML_ENTRY = re.compile(
    r"^[ \t]*(?:\w+\.)?(?P<key>\w+)[ \t]*:[ \t]*(?P<value>\[[^\]]*\]|(?:\n[ \t]*-[ \t][^\n]*)+|[^\n#]*)",
    re.MULTILINE,
)


def _yaml_numbers(text: str) -> dict[str, Sequence[float]]:
    """Take the numbers of "key: 1.0", "key: [1.0, …]", "- 1.0" lines, and a matrix's nested "data: […]"."""
    if model := re.search(r"equidistant|fisheye|kannalabrandt", text, re.IGNORECASE):
        raise DataError(f"{model[0]} lens; only Brown–Conrady (plumb_bob) distortion is supported")
    numbers: dict[str, Sequence[float]] = {}
    parent = ""
    for entry in _YAML_ENTRY.finditer(text):
        key, value = entry["key"].lower(), entry["value"].strip()
        if not value or value.startswith("!!"):
            parent = key
            continue
        words = re.split(r"[\s,]+", re.sub(r"^\s*-\s", " ", value.strip("[]"), flags=re.MULTILINE).strip())
        try:
            numbers[parent if key == "data" else key] = [float(word) for word in words]
        except ValueError:
            continue  # text: a name, a frame, a lens model
    return numbers
