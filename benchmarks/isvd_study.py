"""Effect on ISVD's error of choices that Somlyai's thesis leaves open: one experiment per choice.

    python benchmarks/isvd_study.py LOG… [--draws 10] [--only ratio tolerance] [--cache FOLDER]

Each log with truth is tracked as in configs/thesis/MP4.toml, then with one thing changed at a time. Features
are detected once per detector, matched once, and kept in the cache, so a draw of RANSAC costs seconds.
Printed per log and choice: the median ATE over the draws, its range, and the change against the first row.
"""

import argparse
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
from isvd_choices import EXPERIMENTS, Choice
from isvd_features import FrameFeatures, Prepared, prepare
from numba import njit
from numpy.typing import NDArray

from mapper.core.geometry import Array, Transform, mean_rotation, transform
from mapper.core.trajectory import Trajectory
from mapper.evaluators.papers.measurements import ate_rmse_m
from mapper.features.matching import homography_inliers

_ROS_INTRINSICS = (525.0, 525.0, 319.5, 239.5)
"""Intrinsics that TUM's own script for point clouds uses for all Kinects."""


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


def _points(seen: FrameFeatures, intrinsics: tuple[float, ...], choice: Choice) -> Array:
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
