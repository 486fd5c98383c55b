"""Numbers of a camera in the files of other programs that are no tables of names and numbers."""

import re
from collections.abc import Mapping, Sequence
from io import BytesIO
from pathlib import Path
from typing import Any
from zipfile import ZipFile

import numpy as np
from numpy.typing import NDArray

from mapper.core.errors import DataError
from mapper.core.frames import NO_DISTORTION
from mapper.core.units import MIB
from mapper.runtime.regular_files import read_regular
from mapper.sources.cloud_files.parsing import load_array, refusing_damage

Numbers = Mapping[str, Sequence[float]]

INFO_KEY = "m_calibrationColorIntrinsic"
COLMAP = re.compile(
    r"^\d+\s+(?P<model>(?:SIMPLE_)?(?:PINHOLE|RADIAL)|(?:FULL_)?OPENCV|[A-Z_]+)\s+(?P<size>\d+\s+\d+)"
    r"(?P<numbers>(?:\s+[-+\d.eE]+){3,12})\s*$",
    re.MULTILINE,
)
_COLMAP_MODELS = {
    "SIMPLE_PINHOLE": "f cx cy",
    "PINHOLE": "fx fy cx cy",
    "SIMPLE_RADIAL": "f cx cy k1",
    "RADIAL": "f cx cy k1 k2",
    "OPENCV": "fx fy cx cy k1 k2 p1 p2",
    "OPENCV_FISHEYE": "fx fy cx cy k1 k2 k3 k4",
    "FULL_OPENCV": "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6",
}
"""Parameters of COLMAP's models whose lenses OpenCV has; https://colmap.github.io/cameras.html."""
_XML_ENTRY = re.compile(
    r"<(?P<key>\w+)(?:\s[^>]*)?>\s*(?:(?:<\w+>[^<]*</\w+>\s*)*<data>(?P<data>[^<]*)</data>|(?P<one>[^<]+))"
)
_MOST_BYTES, _MOST_ARRAY_BYTES = 16 * MIB, 1024
"""Size of a file with the views of a calibration, and of an array of up to 14 coefficients."""


def colmap_numbers(text: str) -> tuple[Numbers, str]:
    """Take the only camera of COLMAP's cameras.txt, whose first pixel's centre is at 0.5, 0.5; and its model.

    Raises:
        DataError: There are several cameras, or its lens is of another model.
    """
    found = {camera.group("model", "size", "numbers") for camera in COLMAP.finditer(text)}
    if len(found) > 1:
        raise DataError(f"{len(found)} different cameras; keep the colour camera's line alone")
    ((model, size, parameters),) = found
    names, values = _COLMAP_MODELS.get(model, "").split(), [float(word) for word in parameters.split()]
    if len(names) != len(values):
        raise DataError(f"{model} with {len(values)} parameters; known are {', '.join(_COLMAP_MODELS)}")
    of = dict(zip(names, values, strict=True))
    width_px, height_px = map(float, size.split())
    is_fisheye = model == "OPENCV_FISHEYE"
    order = ("k1", "k2", "k3", "k4") if is_fisheye else ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
    numbers = {
        "fx": of.get("fx", of.get("f", 0.0)),
        "fy": of.get("fy", of.get("f", 0.0)),
        "cx": of["cx"] - 0.5,
        "cy": of["cy"] - 0.5,
        "width": width_px,
        "height": height_px,
    }
    distortion = [of.get(name, 0.0) for name in order]
    return {**{name: [value] for name, value in numbers.items()}, "d": distortion}, "equidistant" * is_fisheye


def yaml_of_xml(text: str) -> str:
    """Return the matrices and numbers of OpenCV's XML (cv::FileStorage) as lines of YAML."""
    found = ((one["key"], one["data"], one["one"]) for one in _XML_ENTRY.finditer(text))
    return "\n".join(
        f"{key}: {f'[{data.strip()}]' if one is None else one.strip()}" for key, data, one in found
    )


def array_numbers(path: Path) -> dict[str, Sequence[float]]:
    """Take a matrix or fx fy cx cy of a .npy, or the arrays of a .npz by their names.

    Raises:
        OSError: The file cannot be read.
        DataError: It is damaged, or larger than such a file is.
        FrameError: The same, of an array in it.
    """
    data = BytesIO(read_regular(path, most_bytes=_MOST_BYTES))
    if path.suffix == ".npy":
        return matrix_numbers(np.asarray(load_array(data, path)))
    numbers: dict[str, Sequence[float]] = {}
    with refusing_damage(path, what="npz"), ZipFile(data) as arrays:
        for one in arrays.infolist():
            if one.file_size <= _MOST_ARRAY_BYTES:
                array = load_array(BytesIO(arrays.read(one)), path)
                numbers[Path(one.filename).stem.lower()] = (
                    array.astype(float).ravel().tolist() if array.dtype.kind in "fiu" else []
                )
    return numbers


def matrix_numbers(rows: NDArray[Any]) -> dict[str, Sequence[float]]:
    """Take a matrix of 3×3, 3×4 or 4×4 numbers, or fx fy cx cy and distortion coefficients.

    Raises:
        DataError: They are neither.
    """
    if rows.dtype.kind in "fiu" and rows.shape in ((3, 3), (3, 4), (4, 4)):
        return {"camera_matrix": rows[:3, :3].ravel().tolist()}
    if rows.dtype.kind in "fiu" and rows.size == rows.shape[-1] and 4 <= rows.size <= 4 + len(NO_DISTORTION):
        fx_fy_cx_cy, distortion = np.split(rows.ravel(), [4])
        return {"intrinsics": fx_fy_cx_cy.tolist(), "d": distortion.tolist() or list(NO_DISTORTION)}
    raise DataError("want a 3×3 matrix, or a line of fx fy cx cy; a calibration.toml beside it goes first")


def text_numbers(text: str) -> Numbers:
    """Take the same of text; matrices may be in brackets, as NumPy and MATLAB print them.

    Raises:
        DataError: As ``matrix_numbers``.
        ValueError: A word is no number.
    """
    text = text.replace(";", "\n").replace("[", " ").replace("]", " ")
    lines = [line.split("#")[0].replace(",", " ").split() for line in text.splitlines()]
    rows = [[float(word) for word in words] for words in lines if words]
    is_even = len({len(row) for row in rows}) == 1
    return matrix_numbers(np.array(rows) if is_even else np.empty(0))


def info_numbers(text: str) -> Numbers:
    """Take BundleFusion's 4×4 matrix, sizes and depth units of lines "m_name = numbers"."""
    pairs = (line.partition("=") for line in text.splitlines())
    words = {name.strip(): value.split() for name, _, value in pairs}
    names = {"m_colorWidth": "width", "m_colorHeight": "height", "m_depthShift": "depth_factor"}
    numbers = {ours: [float(word) for word in words[name]] for name, ours in names.items() if name in words}
    K = [float(word) for word in words.get(INFO_KEY, [])]
    return {**numbers, "camera_matrix": [*K[0:3], *K[4:7], *K[8:11]]}
