"""Effect on ISVD's error of choices that Somlyai's thesis leaves open: one experiment per choice.

    python benchmarks/isvd_study.py LOG… [--draws 10] [--only ratio tolerance] [--cache FOLDER]

Each log with truth is tracked as in configs/thesis/MP4.toml, then with one thing changed at a time. Features
are detected once per detector, matched once, and kept in the cache, so a draw of RANSAC costs seconds.
Printed per log and choice: the median ATE over the draws, its range, and the change against the first row.
"""

import argparse
import pickle
from collections.abc import Iterator
from dataclasses import dataclass, field, fields, replace
from functools import cache
from pathlib import Path
from typing import Literal

import numpy as np
from numba import njit
from numpy.typing import NDArray

from mapper.config.loading import load_source_config
from mapper.core.errors import FrameError
from mapper.core.frames import RgbdFrame
from mapper.core.geometry import Array, Transform, mean_rotation, transform
from mapper.core.trajectory import Trajectory
from mapper.evaluators.papers.measurements import ate_rmse_m
from mapper.evaluators.study.versions import digest
from mapper.features.config import DetectorConfig, OrbConfig, SiftConfig, SurfConfig
from mapper.features.factory import build_detector
from mapper.features.matching import homography_inliers
from mapper.sensing.depth_filter import dif
from mapper.sources import open_source
from mapper.sources.base import Log

_MOST_PREVIOUS = 6
_ROS_INTRINSICS = (525.0, 525.0, 319.5, 239.5)
"""What TUM's own script for point clouds uses for all Kinects."""


@dataclass(frozen=True, slots=True)
class Choice:
    """One setting of everything that is studied; the defaults are those of configs/thesis/MP4.toml."""

    detector: DetectorConfig = field(default_factory=lambda: SurfConfig(max_features=5000))
    first_features: int = 0
    """Use only so many of the strongest; 0 is all."""
    ratio: float = 0.9
    ratio_of: Literal["new frame", "earlier frame"] = "new frame"
    """Whose features have to be distinct from the other frame's second best."""
    cross_check: bool = True
    vote: bool = False
    """Keep matches whose change of size and angle most others share, as Emgu CV's example does."""
    left_out: float = 0.0
    """Leave out this share of the matches, at random: tells how much of an error is chance."""
    tolerance_px: float = 4.0
    iterations: int = 2000
    filter: Literal["homography", "none"] = "homography"
    depth: Literal["nearest", "floor", "bilinear", "bilinear or none", "dif"] = "nearest"
    ray: Literal["feature", "pixel"] = "pixel"
    """A feature's point lies on its own ray, or is the point of the pixel that it lies in."""
    max_depth_m: float = 5.0
    intrinsics: Literal["log", "ros"] = "log"
    undistort: bool = False
    alpha_mm: float = 1200.0
    beta: float = -2.6
    max_iterations: int = 25
    min_pairs: int = 100
    min_error_mm: float = 0.0
    last_fit: Literal["before", "after"] = "before"
    """Whether the motion is that of the last iteration, or fitted again to what it left."""
    returning: bool = False
    """Dropped pairs may come back: every iteration tests all pairs."""
    fit_weight: Literal["none", "1/z2", "1/z4"] = "none"
    quality: Literal["all pairs", "kept pairs"] = "all pairs"
    """Pairs over which eq. 4.1's W is averaged: those of the last fit, or those within its threshold."""
    previous: int = 4
    average: Literal["weighted", "mean", "nearest"] = "weighted"
    rotation: Literal["nearest", "mean", "last"] = "mean"
    averaged: Literal["position", "column"] = "position"
    """Average the frame's positions, or the last columns of the inverse poses, which take points to it."""


EXPERIMENTS: dict[str, list[tuple[str, dict[str, object]]]] = {
    "detector": [
        ("SIFT", {"detector": SiftConfig()}),
        ("ORB", {"detector": OrbConfig()}),
        ("SURF, 300 features", {"first_features": 300}),
        ("SURF, 500 features", {"first_features": 500}),
        ("SURF, 1000 features", {"detector": SurfConfig()}),
        ("SURF, threshold 100", {"detector": SurfConfig(max_features=5000, threshold=100.0)}),
        ("SURF, threshold 2000", {"detector": SurfConfig(max_features=5000, threshold=2000.0)}),
    ],
    "ratio": [(f"ratio {value}", {"ratio": value}) for value in (0.6, 0.7, 0.8, 1.0)],
    "ratio's side": [("ratio of the earlier frame", {"ratio_of": "earlier frame"})],
    "cross-check": [
        ("no cross-check", {"cross_check": False}),
        ("no cross-check, ratio 0.8", {"cross_check": False, "ratio": 0.8}),
        ("Emgu's votes", {"cross_check": False, "ratio": 0.8, "vote": True}),
    ],
    "tolerance": [
        (f"homography {value} px", {"tolerance_px": value}) for value in (1.0, 2.0, 3.0, 6.0, 10.0)
    ],
    "homography": [
        ("no homography", {"filter": "none"}),
        ("homography, 100 samples", {"iterations": 100}),
        ("homography, 10 samples", {"iterations": 10}),
    ],
    "depth": [
        (f"depth {value}", {"depth": value, "ray": "feature"}) for value in ("bilinear", "bilinear or none")
    ],
    "points": [
        ("points on features' rays", {"ray": "feature"}),
        ("truncated pixels", {"depth": "floor"}),
    ],
    "DIF": [("depth after DIF", {"depth": "dif"})],
    "max depth": [(f"depth ≤ {value} m", {"max_depth_m": value}) for value in (3.0, 4.0, 10.0)],
    "intrinsics": [
        ("ROS's 525 px", {"intrinsics": "ros"}),
        ("undistorted", {"undistort": True}),
    ],
    "power law": [
        ("α 600 mm", {"alpha_mm": 600.0}),
        ("α 2400 mm", {"alpha_mm": 2400.0}),
        ("β -2.0", {"beta": -2.0}),
        ("β -3.2", {"beta": -3.2}),
    ],
    "stop": [
        *[(f"≥ {value} pairs", {"min_pairs": value}) for value in (10, 20, 50, 150, 200)],
        *[(f"th ≥ {value} mm", {"min_error_mm": value}) for value in (5.0, 10.0, 20.0)],
        ("fitted again at the end", {"last_fit": "after"}),
        ("dropped pairs may return", {"returning": True}),
    ],
    "fit": [(f"weights {value}", {"fit_weight": value}) for value in ("1/z2", "1/z4")],
    "composition": [
        ("W of kept pairs", {"quality": "kept pairs"}),
        ("plain mean", {"average": "mean"}),
        ("nearest only", {"average": "nearest"}),
        ("nearest frame's rotation", {"rotation": "nearest"}),
        ("farthest frame's rotation", {"rotation": "last"}),
        ("mean of inverse poses", {"averaged": "column"}),
    ],
    "chance": [(f"{share:.0%} of matches left out", {"left_out": share}) for share in (0.01, 0.05)],
    "MP": [(f"MP {value}", {"previous": value}) for value in (1, 2, 3, 6)],
    "iterations": [
        (f"{value} iterations", {"max_iterations": value}) for value in (1, 3, 4, 5, 7, 9, 11, 13, 15, 20)
    ],
}


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """Features of a frame: pixels, depths by every lookup, and what matching needs."""

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

    frames: list[Seen]
    matches: dict[tuple[int, int], Candidates]
    intrinsics: tuple[float, float, float, float]
    truth: Trajectory


def main() -> None:
    """Print a table per log."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("logs", nargs="+", type=Path, metavar="LOG")
    parser.add_argument("--draws", type=int, default=10)
    parser.add_argument("--only", nargs="+", choices=sorted(EXPERIMENTS), default=list(EXPERIMENTS))
    parser.add_argument("--base", nargs="*", default=[], metavar="FIELD=VALUE", help="other first row")
    parser.add_argument("--cache", type=Path, metavar="FOLDER", help="features and matches are kept here")
    arguments = parser.parse_args()
    base = _with(Choice(), arguments.base)
    rows = [("as in MP4.toml" if base == Choice() else " ".join(arguments.base), base)]
    for name in arguments.only:
        rows += [(text, replace(base, **changes)) for text, changes in EXPERIMENTS[name]]  # type: ignore[arg-type]
    for path in arguments.logs:
        print(f"\n{path.name}, {arguments.draws} draws: ATE m, median (least … most), change", flush=True)
        first = None
        for text, choice in rows:
            prepared = prepare(path, choice.detector, arguments.cache)
            errors_m = errors_of(prepared, choice, range(arguments.draws))
            middle = float(np.median(errors_m))
            first = first or middle
            print(
                f"  {text:28} {middle:.4f} ({errors_m.min():.4f} … {errors_m.max():.4f}) "
                f"{100 * (middle / first - 1):+5.0f} %",
                flush=True,
            )


def _with(choice: Choice, overrides: list[str]) -> Choice:
    """Return a choice with fields given as text."""
    kinds = {each.name: type(getattr(choice, each.name)) for each in fields(choice)}
    changes: dict[str, object] = {}
    for override in overrides:
        name, _, value = override.partition("=")
        changes[name] = value == "True" if kinds[name] is bool else kinds[name](value)
    return replace(choice, **changes)  # type: ignore[arg-type]


def errors_of(prepared: Prepared, choice: Choice, seeds: range) -> Array:
    """Return the ATE of every draw of RANSAC, metres."""
    return np.array([ate_rmse_m(track(prepared, choice, seed), prepared.truth) for seed in seeds])


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
            Seen(
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


def track(prepared: Prepared, choice: Choice, seed: int) -> Trajectory:
    """Return the poses by ISVD (Somlyai, PhD thesis, alg. 7)."""
    points = [_points(seen, prepared.intrinsics, choice) for seen in prepared.frames]
    T_world = [np.eye(4)]
    for n in range(1, len(points)):
        poses, weights = [], []
        for k in range(1, min(n, choice.previous) + 1):
            pairs = _matched(prepared, n, k, choice, seed)
            target, source = points[n - k][pairs[:, 1]], points[n][pairs[:, 0]]
            measured = np.isfinite(target[:, 2]) & np.isfinite(source[:, 2])
            if measured.sum() < 20:
                continue
            T, weight = _fit(target[measured], source[measured], choice)
            poses.append(T_world[n - k] @ T)
            weights.append(weight)
        T_world.append(_combined(poses, weights, choice) if poses else T_world[-1])
    stamps_ns = np.array([seen.stamp_ns for seen in prepared.frames], np.int64)
    return Trajectory(stamps_ns, np.array(T_world))


def _points(seen: Seen, intrinsics: tuple[float, ...], choice: Choice) -> Array:
    pixels = seen.undistorted if choice.undistort else seen.pixels.astype(np.float64)
    if choice.ray == "pixel":
        pixels = np.floor(pixels) if choice.depth == "floor" else np.rint(pixels)
    fx, fy, cx, cy = _ROS_INTRINSICS if choice.intrinsics == "ros" else intrinsics
    z = seen.depth_m[choice.depth].copy()
    z[z > choice.max_depth_m] = np.nan
    points = np.column_stack([(pixels - [cx, cy]) / [fx, fy] * z[:, None], z])
    if choice.first_features:
        points[choice.first_features :] = np.nan
    return points


def _matched(prepared: Prepared, n: int, k: int, choice: Choice, seed: int) -> NDArray[np.intp]:
    candidates, now, then = prepared.matches[n, k], prepared.frames[n], prepared.frames[n - k]
    ratio = candidates.ratio if choice.ratio_of == "new frame" else candidates.ratio_back
    used = ratio < choice.ratio
    if choice.cross_check:
        used &= candidates.mutual
    if choice.first_features:
        used &= (candidates.pairs < choice.first_features).all(1)
    pairs = candidates.pairs[used]
    if choice.vote and len(pairs):
        turn = (now.angle_rad[pairs[:, 0]] - then.angle_rad[pairs[:, 1]]) % (2 * np.pi)
        sizes = now.octave[pairs[:, 0]] - then.octave[pairs[:, 1]]
        bins = (turn * 20 / (2 * np.pi)).astype(int) % 20 + 100 * sizes
        _, inverse_of, counts = np.unique(bins, return_inverse=True, return_counts=True)
        pairs = pairs[(counts >= 0.5 * counts.max())[inverse_of]]
    if choice.left_out:
        drawn = np.random.default_rng((seed, n, k)).random(len(pairs))
        pairs = pairs[drawn >= choice.left_out]
    if choice.filter == "homography":
        pairs = pairs[
            homography_inliers(
                then.pixels[pairs[:, 1]],
                now.pixels[pairs[:, 0]],
                tolerance_px=choice.tolerance_px,
                iterations=choice.iterations,
                seed=seed,
            )
        ]
    return pairs


def _fit(target: Array, source: Array, choice: Choice) -> tuple[Transform, float]:
    """Return ISVD's motion and its quality W."""
    z = np.maximum(target[:, 2], source[:, 2])
    weights = {"none": np.ones(len(z)), "1/z2": z**-2.0, "1/z4": z**-4.0}[choice.fit_weight]
    steps = np.arange(1, choice.max_iterations + 1)
    thresholds_m = choice.alpha_mm * steps**choice.beta / 1e3
    R, t, weight = _trim(
        target,
        source,
        weights,
        thresholds_m,
        choice.min_error_mm / 1e3,
        max(min(choice.min_pairs, len(target) // 2), 3),
        choice.returning,
        choice.last_fit == "after",
        choice.quality == "kept pairs",
    )
    return transform(R, t), weight


@njit(cache=True, nogil=True)
def _rigid(target, source, weights):  # type: ignore[no-untyped-def]
    total = weights.sum()
    a, b = np.zeros(3), np.zeros(3)
    for i in range(len(weights)):
        a += weights[i] * target[i]
        b += weights[i] * source[i]
    a, b = a / total, b / total
    H = np.zeros((3, 3))
    for i in range(len(weights)):
        for r in range(3):
            for c in range(3):
                H[r, c] += weights[i] * (target[i, r] - a[r]) * (source[i, c] - b[c])
    U, _, Vt = np.linalg.svd(H)
    S = np.eye(3)
    S[2, 2] = np.sign(np.linalg.det(U) * np.linalg.det(Vt))
    R = U @ S @ Vt
    return R, a - R @ b


@njit(cache=True, nogil=True)
def _trim(target, source, weights, thresholds_m, min_error_m, enough, returning, after, of_kept):  # type: ignore[no-untyped-def]
    used = np.arange(len(target))
    for threshold_m in thresholds_m:
        R, t = _rigid(target[used], source[used], weights[used])
        tested = np.arange(len(target)) if returning else used
        misses = target[tested] - source[tested] @ R.T - t
        near = np.sqrt((misses**2).sum(1)) <= threshold_m
        kept = tested[near]
        fitted = used
        if threshold_m < min_error_m or len(kept) < enough:
            break
        used = kept
    if after and len(used) >= 3:
        R, t = _rigid(target[used], source[used], weights[used])
    counted = used if of_kept else fitted
    misses = np.abs(target[counted] - source[counted] @ R.T - t).sum(1)
    return R, t, 1.0 / max(misses.mean(), 1e-12)


def _combined(poses: list[Transform], weights: list[float], choice: Choice) -> Transform:
    """Return the pose by its candidates, the nearest earlier frame first."""
    shares = np.array(weights if choice.average == "weighted" else [1.0] * len(poses))
    if choice.average == "nearest":
        shares[1:] = 0.0
    stacked = np.array(poses)
    R = {"nearest": stacked[0, :3, :3], "last": stacked[-1, :3, :3]}.get(choice.rotation)
    if R is None:
        R = mean_rotation(stacked[:, :3, :3], shares)
    positions = stacked[:, :3, 3]
    if choice.averaged == "column":
        columns = -np.einsum("nji,nj->ni", stacked[:, :3, :3], positions)
        positions = -columns @ R.T
    return transform(R, shares @ positions / shares.sum())


if __name__ == "__main__":
    main()
