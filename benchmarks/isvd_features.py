"""Features of a log, matched with those of earlier frames, for benchmarks/isvd_study.py."""

import pickle
from collections.abc import Iterator
from dataclasses import dataclass, fields
from functools import cache
from pathlib import Path

import numpy as np
from numba import njit
from numpy.typing import NDArray

from mapper.config.loading import load_source_config
from mapper.core.errors import FrameError
from mapper.core.frames import RgbdFrame
from mapper.core.geometry import Array
from mapper.core.trajectory import Trajectory
from mapper.evaluators.study.versions import digest
from mapper.features.config import DetectorConfig
from mapper.features.factory import build_detector
from mapper.sensing.depth_filter import dif
from mapper.sources import open_source
from mapper.sources.base import Log

_MOST_PREVIOUS = 6


@dataclass(frozen=True, slots=True, eq=False)
class FrameFeatures:
    """Features of a frame: pixels, depths by every lookup, and data for matching."""

    stamp_ns: int
    pixels: NDArray[np.float32]
    undistorted: Array
    angle_rad: NDArray[np.float32]
    octave: NDArray[np.int32]
    depth_m: dict[str, Array]


@dataclass(frozen=True, slots=True, eq=False)
class Candidates:
    """Best partners, in an earlier frame, of a frame's features, with what filters them.

    Attributes:
        pairs: (M, 2) features of the frame and of the earlier one.
        ratio: (M,) distance relative to that to the feature's second best in the earlier frame.
        ratio_back: (M,) relative to that of the partner to its second best in the frame.
        mutual: (M,) whether each is the other's best.
    """

    pairs: NDArray[np.intp]
    ratio: NDArray[np.float32]
    ratio_back: NDArray[np.float32]
    mutual: NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class Prepared:
    """A log with one detector's features, matched."""

    frames: list[FrameFeatures]
    matches: dict[tuple[int, int], Candidates]
    intrinsics: tuple[float, float, float, float]
    truth: Trajectory


@cache
def prepare(path: Path, detector: DetectorConfig, folder: Path | None) -> Prepared:
    """Return a log's features and matches, from the cache if they are there."""
    kind = (detector.model_dump(), [each.name for each in fields(Candidates)])
    name = f"{path.resolve().name}.{digest(kind, digits=12)}.pickle"
    if folder is not None and (folder / name).exists():
        found: Prepared = pickle.loads((folder / name).read_bytes())
        return found
    prepared = _prepare(path, detector)
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(pickle.dumps(prepared))
    return prepared


def _prepare(path: Path, detector: DetectorConfig) -> Prepared:
    log = open_source(path, load_source_config(None, []))
    if log.truth is None:
        raise SystemExit(f"{path}: no truth")
    frames, matches = [], {}
    descriptors: list[NDArray[np.float32]] = []
    intrinsics = (0.0, 0.0, 0.0, 0.0)
    for frame in _frames(log):
        camera = frame.camera
        intrinsics = (camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px)
        features = build_detector(detector).detect(frame.gray)
        frames.append(
            FrameFeatures(
                frame.stamp_ns,
                features.pixels,
                camera.undistort(features.pixels),
                features.angle_rad,
                features.octave,
                _depths_m(frame.depth_m, features.pixels),
            )
        )
        descriptors.append(_as_numbers(features.descriptors))
        n = len(frames) - 1
        for k in range(1, min(n, _MOST_PREVIOUS) + 1):
            matches[n, k] = _candidates(descriptors[n], descriptors[n - k])
            if k == _MOST_PREVIOUS:
                descriptors[n - k] = np.empty((0, 0), np.float32)  # no longer needed
    return Prepared(frames, matches, intrinsics, log.truth)


def _frames(log: Log) -> Iterator[RgbdFrame]:
    for entry in log.entries():
        try:
            frame = entry.load(colour=False)
        except FrameError:
            continue  # as a build does
        if isinstance(frame, RgbdFrame):
            yield frame


def _as_numbers(descriptors: NDArray[np.uint8] | NDArray[np.float32]) -> NDArray[np.float32]:
    """Return descriptors whose squared Euclidean distances order as the detector's own distances."""
    if descriptors.dtype == np.uint8:
        return np.unpackbits(descriptors, axis=1).astype(np.float32)
    return np.asarray(descriptors, np.float32)


def _candidates(now: NDArray[np.float32], then: NDArray[np.float32]) -> Candidates:
    if len(now) == 0 or len(then) < 2:
        none = np.empty(0, np.float32)
        return Candidates(np.empty((0, 2), np.intp), none, none, np.empty(0, np.bool_))
    squares_now, squares_then = (np.einsum("ij,ij->i", each, each) for each in (now, then))
    partner, back, ratio, ratio_back = _two_best(now @ then.T, squares_now, squares_then)
    pairs = np.column_stack([np.arange(len(now)), partner])
    return Candidates(pairs, ratio, ratio_back, back[partner] == np.arange(len(now)))


@njit(cache=True, nogil=True)
def _two_best(products, squares_now, squares_then):  # type: ignore[no-untyped-def]
    """Return each row's best column, each column's best row, and the distance of each row to its best column.

    The distance is relative to the row's second best column, and to the column's second best row.
    """
    rows, columns = products.shape
    partner, back = np.zeros(rows, np.intp), np.zeros(columns, np.intp)
    column_best = np.full(columns, np.inf, np.float32)
    column_second = np.full(columns, np.inf, np.float32)
    smallest, ratio = np.empty(rows, np.float32), np.empty(rows, np.float32)
    ratio_back = np.empty(rows, np.float32)
    for i in range(rows):
        best, second = np.float32(np.inf), np.float32(np.inf)
        for j in range(columns):
            value = squares_now[i] + squares_then[j] - np.float32(2.0) * products[i, j]
            if value < second:
                if value < best:
                    best, second, partner[i] = value, best, j
                else:
                    second = value
            if value < column_best[j]:
                column_best[j], column_second[j], back[j] = value, column_best[j], i
            elif value < column_second[j]:
                column_second[j] = value
        smallest[i] = max(best, np.float32(0.0))
        ratio[i] = np.sqrt(smallest[i] / max(second, np.float32(1e-12)))
    for i in range(rows):
        ratio_back[i] = np.sqrt(smallest[i] / max(column_second[partner[i]], np.float32(1e-12)))
    return partner, back, ratio, ratio_back


def _depths_m(depth_m: NDArray[np.float32], pixels: NDArray[np.float32]) -> dict[str, Array]:
    """Return depths by every kind of lookup; NaN is none."""
    height, width = depth_m.shape

    def read(image: NDArray[np.float32], x: NDArray[np.intp], y: NDArray[np.intp]) -> Array:
        z = image[y.clip(0, height - 1), x.clip(0, width - 1)].astype(np.float64)
        z[z <= 0.0] = np.nan
        return z

    whole = np.floor(pixels).astype(np.intp)
    nearest = np.rint(pixels).astype(np.intp)
    u, v = (pixels - whole).T.astype(np.float64)
    corners = np.array([read(depth_m, whole[:, 0] + i, whole[:, 1] + j) for j in (0, 1) for i in (0, 1)])
    shares = np.array([(1 - u) * (1 - v), u * (1 - v), (1 - u) * v, u * v])
    bilinear = (shares * corners).sum(0)
    apart = np.nanmax(corners, 0, initial=-np.inf) - np.nanmin(corners, 0, initial=np.inf) > 0.03 * bilinear
    plain = read(depth_m, *nearest.T)
    smooth = np.where(np.isnan(bilinear) | apart, np.nan, bilinear)
    return {
        "nearest": plain,
        "floor": read(depth_m, *whole.T),
        "bilinear": np.where(np.isnan(smooth), plain, smooth),
        "bilinear or none": smooth,
        "dif": read(dif(depth_m), *nearest.T),
    }
