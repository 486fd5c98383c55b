"""Calibration files beside a log: our TOML, and those of ROS, OpenCV, ORB-SLAM, Kalibr, Open3D and others."""

import json
import math
import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from mapper.core.config import toml_text
from mapper.core.errors import DataError, FrameError, SourceError
from mapper.core.frames import NO_DISTORTION, PinholeCamera
from mapper.runtime.regular_files import HEAD_BYTES, parse_toml, read_text
from mapper.sources.calibration import Calibration, DepthCamera, Distortion
from mapper.sources.calibration_parsers import (
    COLMAP,
    INFO_KEY,
    Numbers,
    array_numbers,
    colmap_numbers,
    info_numbers,
    text_numbers,
    yaml_of_xml,
)
from mapper.sources.lens import COEFFICIENTS_TEXT, Lens
from mapper.sources.text import pose_from_numbers

_FILE_NAMES = (
    "calibration.toml",
    "calibration.yaml",
    "calibration.yml",
    "camera.yaml",
    "camera.yml",
    "camera_info.yaml",
    "camera_info.yml",
    "*camchain*.yaml",  # Kalibr
    "camera_intrinsic.json",  # Open3D's recorders, of a RealSense and of an Azure Kinect
    "intrinsic.json",
    "cam_params.json",  # Replica, as rendered for NICE-SLAM
    "camera-intrinsics.txt",  # 3DMatch
    "camera_intrinsics.txt",
    "intrinsics.txt",
    "intrinsics.K.txt",
    "intrinsic.txt",
    "calibration.txt",  # ETH3D
    "K.txt",
    "intrinsic/intrinsic_color.txt",  # ScanNet
    "intrinsic_color.txt",
    "cameras.txt",  # COLMAP
    "sparse/cameras.txt",
    "sparse/0/cameras.txt",
    "*calib*.np[yz]",
    "*camera*.np[yz]",
    "*intrinsic*.np[yz]",
    "K.npy",
    "calib/*.yaml",  # RTAB-Map's export
    "*_calib/*.yaml",
    "info.txt",  # BundleFusion
    "_info.txt",
    "cam.info.txt",
    "sensors.yaml",  # OpenLORIS
    "transforms.json",  # nerfstudio, instant-ngp
    "metadata.json",  # Record3D
)
"""Globs in a log's folder, the first that is there counts."""

_BY_CONTENT = (".yaml", ".yml", ".json", ".xml")
_LIKE_CALIBRATION = re.compile(
    "calib|intrinsic|cam(?:era)?(?![a-z]|.*(?:pose|extrinsic|traj))", re.IGNORECASE
)


def calibration_files(folder: Path) -> tuple[list[Path], bool]:
    """Return the files of intrinsics beside a log, by names or else contents, and whether the first counts.

    It does not where there are several of unknown names.
    """
    named = [path for name in _FILE_NAMES for path in sorted(folder.glob(name)) if path.is_file()]
    found = [path for path in named if not path.name.endswith(_MAY_BE_OTHER) or _has_camera(path)]
    if found:
        return list(dict.fromkeys(found)), True
    others = [path for path in sorted(folder.glob("*")) if _may_have_camera(path) and path.is_file()]
    found = [path for path in others if "depth" not in path.name.lower() and _has_camera(path)]
    return found, len(found) == 1


def _may_have_camera(path: Path) -> bool:
    """Return whether a file is looked into for intrinsics: text only where its name says that it has some."""
    return path.suffix in _BY_CONTENT or (path.suffix == ".txt" and bool(_LIKE_CALIBRATION.search(path.stem)))


def read_calibration(path: Path) -> Calibration:
    """Read intrinsics from TOML, JSON, YAML, OpenCV's XML, COLMAP's list, or a matrix or fx fy cx cy alone.

    These may be in text, or in .npy and .npz.

    TOML keys: fx_px fy_px cx_px cy_px, and optionally width_px height_px, distortion (k1 k2 p1 p2 k3, also k4
    k5 k6 and more as OpenCV orders them, or a fisheye's k1 k2 k3 k4), distortion_model ("equidistant"),
    depth_factor (image units per metre) and, where depth is not registered to colour, depth_intrinsics_px
    (fx fy cx cy), depth_distortion and depth_in_color (x y z qx qy qz qw).

    Raises:
        SourceError: The file cannot be read, lacks a number, or (TOML) has a key of another meaning.
    """
    is_array = path.suffix in (".npy", ".npz")
    text = "" if is_array else read_text(path, error=SourceError)
    numbers: Numbers
    model = ""
    try:
        if is_array:
            numbers = array_numbers(path)
        elif path.suffix == ".toml":
            table = dict(parse_toml(text))
            model = _lens_model(f"{table.pop('distortion_model', '')}")
            numbers = _toml_numbers(table)
            unknown = sorted(set(numbers) - _KEYS)
            if unknown:
                raise DataError(f"{unknown[0]}: unknown key; known are {', '.join(sorted(_KEYS))}")
        elif path.suffix == ".json":
            numbers, model = _json_numbers(json.loads(text))
        elif path.suffix == ".txt" and INFO_KEY in text:
            numbers = info_numbers(text)
        elif path.suffix == ".txt" and COLMAP.search(text):
            numbers, model = colmap_numbers(text)
        elif path.suffix == ".txt" and not _KEY_AND_NUMBER.search(text):
            numbers = text_numbers(text)
        elif path.suffix == ".xml":
            numbers, model = _yaml_numbers(yaml_of_xml(text))
        else:
            numbers, model = _yaml_numbers(text.replace("=", ":") if path.suffix == ".txt" else text)
        return _interpret(numbers, model, f"{path}")
    except (ValueError, RecursionError) as error:  # RecursionError: of brackets within brackets
        raise SourceError(f"{path}: not valid {path.suffix[1:].upper()}: {error}") from None
    except (DataError, OverflowError) as error:  # an integer that is too large for a float
        raise SourceError(f"{path}: {error}") from None
    except FrameError as error:
        raise SourceError(str(error)) from None
    except OSError as error:
        raise SourceError(f"{path}: cannot be read: {error.strerror}") from None


def read_yaml(text: str, where: str) -> Calibration:
    """Return the intrinsics in the YAML text of one camera, as ROS, OpenCV, EuRoC and Kalibr write it.

    Raises:
        SourceError: It lacks a number, or the lens is unknown; the message begins with ``where``.
    """
    try:
        return _interpret(*_yaml_numbers(text), where)
    except (DataError, OverflowError) as error:
        raise SourceError(f"{where}: {error}") from None


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
    return f"{toml_text(values)}\n"


# What each number is called: by us, ROS, OpenCV, Kalibr, librealsense, ORB-SLAM ("Camera.fx" counts as "fx").
_NAMES = {
    "fx": ("fx_px", "fx", "fl_x"),
    "fy": ("fy_px", "fy", "fl_y"),
    "cx": ("cx_px", "cx", "ppx"),
    "cy": ("cy_px", "cy", "ppy"),
    "width": ("width_px", "width", "image_width", "w"),
    "height": ("height_px", "height", "image_height", "h"),
    "size": ("resolution",),
    "depth_factor": ("depth_factor", "depthmapfactor"),
    "scale_of_depth": ("depth_scale",),
    "matrix": ("intrinsic_matrix", "mtx", "cameramatrix", "camera_matrix", "k"),
    "intrinsics": ("intrinsics",),
    "distortion": (
        "dist",
        "distcoeffs",
        "dist_coeffs",
        "distortion",
        "distortion_coefficients",
        "distortion_coeffs",
        "coeffs",
        "d",
    ),
    "k1": ("k1",),
    "k2": ("k2",),
    "p1": ("p1",),
    "p2": ("p2",),
    "k3": ("k3",),
    "k4": ("k4",),
    "depth_intrinsics": ("depth_intrinsics_px",),
    "depth_distortion": ("depth_distortion",),
    "depth_in_color": ("depth_in_color",),
}
_UNITS_PER_M = (1e-3, 1e7)  # of a depth image: kilometres to tenths of a micrometre
_KEYS = {name for names in _NAMES.values() for name in names}


def _interpret(numbers: Numbers, model: str, origin: str) -> Calibration:
    found = {meaning: numbers[name] for meaning, names in _NAMES.items() for name in names if name in numbers}
    for meaning, values in found.items():
        if not all(map(math.isfinite, values)):
            raise DataError(f"{meaning}: {', '.join(f'{value:g}' for value in values)} is not finite")
    if len(K := found.get("matrix", ())) == 9:
        found = {"fx": K[0:1], "cx": K[2:3], "fy": K[4:5], "cy": K[5:6], **found}
    for several, names in (("intrinsics", ("fx", "fy", "cx", "cy")), ("size", ("width", "height"))):
        if len(values := found.get(several, ())) == len(names):
            if several == "intrinsics" and _is_by_axis(*values):
                names = ("fx", "cx", "fy", "cy")
            found = {**{name: [value] for name, value in zip(names, values, strict=True)}, **found}
    one = {meaning: values[0] for meaning, values in found.items() if len(values) == 1}
    missing = [meaning for meaning in ("fx", "fy", "cx", "cy") if meaning not in one]
    if missing:
        raise DataError(f"no number {missing[0]}_px; want fx_px, fy_px, cx_px and cy_px")
    coefficients = ["k1", "k2", "k3", "k4"] if model else ["k1", "k2", "p1", "p2", "k3"]
    distortion, lens = _distortion(
        found.get("distortion") or [one.get(name, 0.0) for name in coefficients], model
    )
    if scale := one.get("scale_of_depth"):  # metres per unit of librealsense, units per metre of Open3D
        one.setdefault("depth_factor", 1.0 / scale if scale < 1.0 else scale)
    low, high = _UNITS_PER_M
    if not low <= one.get("depth_factor", 1.0) <= high:
        raise DataError(f"depth_factor {one['depth_factor']:g}, want {low:g} to {high:g} units per metre")
    size = (int(one["width"]), int(one["height"])) if {"width", "height"} <= one.keys() else None
    return Calibration(
        origin,
        *(one["fx"], one["fy"], one["cx"], one["cy"]),
        distortion=distortion,
        lens=lens,
        size_px=size,
        depth_units_per_m=one.get("depth_factor"),
        depth=_depth_camera(found, origin),
    )


def _distortion(coefficients: Sequence[float], model: str) -> tuple[Distortion, Lens | None]:
    """Return k1 k2 p1 p2 k3, or none of these and a lens of another kind."""
    if model or any(coefficients[5:]):
        lens = Lens(model or "rational_polynomial", coefficients)
        if not lens.is_known:
            raise DataError(f"{len(coefficients)} distortion coefficients; want {COEFFICIENTS_TEXT}")
        return NO_DISTORTION, lens
    k1, k2, p1, p2, k3 = (*coefficients[:5], *NO_DISTORTION)[:5]
    return (k1, k2, p1, p2, k3), None


def _depth_camera(found: Numbers, origin: str) -> DepthCamera | None:
    if not any(name.startswith("depth_") and name != "depth_factor" for name in found):
        return None
    intrinsics, pose = found.get("depth_intrinsics", ()), found.get("depth_in_color", ())
    distortion, lens = _distortion(found.get("depth_distortion", ()), "")
    T_color_depth = pose_from_numbers(np.array(pose)) if len(pose) == 7 else None
    if len(intrinsics) != 4 or (pose and T_color_depth is None):
        raise DataError(
            "want depth_intrinsics_px = [fx, fy, cx, cy] and, if known, depth_in_color = "
            "[x, y, z, qx, qy, qz, qw]"
        )
    fx, fy, cx, cy = intrinsics
    calibration = Calibration(f"{origin}: depth", fx, fy, cx, cy, distortion=distortion, lens=lens)
    return DepthCamera(calibration, T_color_depth, origin if pose else f"depth has its own camera ({origin})")


def _is_by_axis(first: float, second: float, third: float, _: float) -> bool:
    """Return whether four intrinsics are OpenLORIS' fx cx fy cy: the focal lengths of a camera are alike."""
    return abs(third - first) < abs(abs(second) - abs(first))


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


_ANY_LINE = re.IGNORECASE | re.MULTILINE
_BARE_NUMBERS, _BARE_COUNTS = re.compile(r"[-+\d.eE\s,;]+"), (4, 9, 16)
"""Text of numbers alone, and how many there are in fx fy cx cy and in matrices of 3×3 and 4×4."""
_MAY_BE_OTHER = ("info.txt", "cameras.txt", "metadata.json", "transforms.json")
_POLYNOMIAL_LENS = re.compile(r"radtan|plumb_bob|rational_polynomial", re.IGNORECASE)
_OTHER_LENS = re.compile(
    r"equidistant|fisheye|kannala_?brandt|(?:^|:)\s*\"?(?P<unknown>omni|mei|eucm|ds|fov|atan)\"?\s*$",
    _ANY_LINE,
)
_KEY_AND_NUMBER = re.compile(
    r"(?:<camera_?matrix\b|<intrinsic_?matrix\b|<mtx\b)|(?:fl?_?x(?:_px)?|camera_?matrix|mtx|intrinsics?(?:_matrix)?(?=\"?\s*:\s*\[\s*[\d.]+\s*,)|"
    r"\bk(?=\"?\s*[:=]\s*(?:[\[-]|\S+[ ,]+\S)))\"?\s*[:=]",
    re.IGNORECASE,
)
_COLOUR_SECTION = re.compile(r"^\w*(?:color|colour|rgb)\w*:[ \t]*\n(?:[ \t]+.*\n?|\s*\n)+", _ANY_LINE)
_YAML_ENTRY = re.compile(
    r"^[ \t]*(?:\w+\.)?(?P<key>\w+)[ \t]*:[ \t]*(?P<value>\[[^\]]*\]|(?:\n[ \t]*-[ \t][^\n]*)+|[^\n#]*)",
    re.MULTILINE,
)


def _lens_model(text: str) -> str:
    """Return the model of a lens in a text that is not Brown–Conrady's; empty without one.

    Raises:
        DataError: It is one that is not known, or there are two.
    """
    text = re.sub("#.*", "", text)
    found = _OTHER_LENS.search(text)
    if found is None:
        return ""
    if found["unknown"]:
        raise DataError(f"{found['unknown']} lens; known are plumb_bob, rational_polynomial and equidistant")
    if other := _POLYNOMIAL_LENS.search(text):
        raise DataError(f"lenses of two models, {other[0]} and {found[0]}; keep the colour camera's alone")
    return "equidistant"


def _yaml_numbers(text: str) -> tuple[dict[str, Sequence[float]], str]:
    """Take the numbers of "key: 1.0", "key: [1.0, …]", "- 1.0" lines, and a matrix's nested "data: […]".

    Of several sections only that of the colour camera is read, where one is called so. With them comes the
    lens' model if it is not Brown–Conrady's.

    Raises:
        DataError: The lens is of an unknown model, or a number stands for two cameras.
    """
    if len(sections := _COLOUR_SECTION.findall(text)) == 1:
        text = sections[0]
    model = _lens_model(text)
    numbers: dict[str, Sequence[float]] = {}
    parent = ""
    for entry in _YAML_ENTRY.finditer(text):
        key, value = entry["key"].lower(), entry["value"].strip()
        if not value or value.startswith("!!"):
            parent = key
            continue
        words = re.split(r"[\s,]+", re.sub(r"^\s*-\s", " ", value.strip("[]"), flags=re.MULTILINE).strip())
        try:
            found = [float(word) for word in words]
        except ValueError:
            continue  # text: a name, a frame, a lens model
        key = parent if key == "data" else key
        if key in _KEYS and numbers.setdefault(key, found) != found:
            raise DataError(f"{key} is there twice; keep the colour camera's alone")
        numbers[key] = found
    return numbers, model


def _json_numbers(table: Any) -> tuple[Numbers, str]:
    """Take the matrix of Open3D and Record3D, column by column, or the numbers of Replica and nerfstudio."""
    camera = table.get("camera", table) if isinstance(table, dict) else None
    for name in ("color", "colour", "rgb") if camera is table else ():  # of a recorder by librealsense
        camera = {**table, **table[name]} if isinstance(table.get(name), dict) else camera
    if not isinstance(camera, dict):
        raise DataError("no table of numbers")
    model = "equidistant" if camera.get("is_fisheye") else _lens_model(f"{camera.get('camera_model', '')}")
    frames = camera.get("frames")
    first = frames[0] if isinstance(frames, list) and frames and isinstance(frames[0], dict) else {}
    flat = {key: _flat(value) for key, value in {**first, **camera}.items()}
    numbers = _toml_numbers({key: v for key, v in flat.items() if _is_numeric(v)})
    if len(K := numbers.get("intrinsic_matrix", numbers.get("k", ()))) == 9:
        is_by_column = not (K[2] or K[5])
        numbers["k"] = np.reshape(K, (3, 3)).T.ravel().tolist() if is_by_column else K
    if "inverse" in f"{camera.get('model', '')}".lower() and any(numbers.get("coeffs", ())):
        raise DataError(f"{camera['model']} lens; known are plumb_bob, rational_polynomial and equidistant")
    if camera is not table and "scale" in numbers:
        numbers["depth_factor"] = numbers["scale"]
    return numbers, model


def _flat(value: Any) -> Any:
    """Return the numbers of a matrix in rows, or of OpenCV's, in one list; anything else as it is."""
    if isinstance(value, dict) and f"{value.get('type_id', '')}".startswith("opencv"):
        value = value.get("data")
    if isinstance(value, list) and value and all(isinstance(row, list) for row in value):
        return [one for row in value for one in row]
    return value


def _is_numeric(value: Any) -> bool:
    values = value if isinstance(value, list) else [value]
    return all(isinstance(one, int | float) for one in values)


def _has_camera(path: Path) -> bool:
    with suppress(OSError), path.open("rb") as file:
        head = file.read(HEAD_BYTES).decode(errors="replace")
        if path.suffix == ".txt" and _BARE_NUMBERS.fullmatch(head):
            return len(re.findall(r"[^\s,;]+", head)) in _BARE_COUNTS
        return any(found.search(head) for found in (_KEY_AND_NUMBER, COLMAP, re.compile(INFO_KEY)))
    return False
