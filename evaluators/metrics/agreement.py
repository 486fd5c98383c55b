"""Agreement of views: how far a trajectory's poses are from the motions that views of one place show.

It needs no truth. Frames are compared in pairs, also far apart in the log, while odometry compares neighbours
and loop closure some keyframes, so that drift and bent maps show. Frames that err alike agree.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, pairwise
from typing import Any, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from mapper.core.deskew import Twist, twist_at
from mapper.core.errors import DataError
from mapper.core.geometry import Array, Transform, apply, inverse, stride_for
from mapper.core.running_median import SIGMAS_PER_MAD
from mapper.core.timebase import NS_PER_S, Stamps
from mapper.core.trajectory import Trajectory
from mapper.evaluators.metrics.metric import Metric
from mapper.features.frame_view import ImageView
from mapper.loops.config import ImageVerificationConfig
from mapper.loops.image_verification import ImageVerifier
from mapper.mapping.placed_frames import PlacedFrame, placed_frames
from mapper.odometry.config import LocalMapConfig
from mapper.odometry.factory import build_frame_odometry
from mapper.registration.pair_refinement import plane_rows
from mapper.registration.surfaces import Prepared, prepared
from mapper.runtime.ordered_map import ordered_map
from mapper.runtime.progress import SILENT, Progress
from mapper.sources.base import Log

View = TypeVar("View")

_MOMENTS, _LATER_NS = 24, NS_PER_S
"""Moments, spread over the log; at each one frame is compared, and one a second later."""
_READOUTS_S = (0.0, 0.02, -0.02)
"""Global shutter, and rolling shutters that read from the top and from the bottom. Without them runs of
fr1_xyz, read in 17 ms, were ranked the wrong way round; with 17 and with 20 ms they are ranked rightly."""
_VOXEL_M, _PAIR_DISTANCE_M = 0.3, 1.0
_MIN_OVERLAP, _MIN_PAIRS = 0.3, 100
_POINTS = 3000
_UNSEEN = 1e-4
"""Eigenvalue, relative to the largest, of motions that no surface shows."""
_LEAST_SPREAD_M = 1e-6
_RESAMPLES, _PERCENTILES = 400, (2.5, 97.5)


@dataclass(frozen=True, slots=True, eq=False)
class Disagreements:
    """Distances between a trajectory's poses and the motions that pairs of views show.

    Attributes:
        stamps_ns: (P, 2) int64 stamps of the two views.
        moments: (P, 2) numbers of the moments of the log that they are of; those of one moment err alike.
        distances_m: (P,).
    """

    stamps_ns: Stamps
    moments: NDArray[np.intp]
    distances_m: Array

    @property
    def rms_m(self) -> float:
        """Their root mean square, metres."""
        return float(np.sqrt((self.distances_m**2).mean()))


class CommonViews:
    """Frames of a log, in pairs of which many show one place, by which trajectories are judged."""

    def __init__(self, source: Log) -> None:
        """Choose the frames; they are read when they are needed.

        Args:
            source: The log.
        """
        self._source = source
        self._moment_of = _moments(source.stamps_ns)
        self._views: _Views[Any] = _ImageViews() if source.sensor == "rgbd" else _ScanViews()

    def disagreements(self, trajectory: Trajectory, *, progress: Progress = SILENT) -> Disagreements:
        """Return how far pairs of views of one place are from where a trajectory puts them.

        Two images: the distance between the camera's position relative to the other's and that which paired
        features show, as a loop is measured. Two scans: the root mean square of the part of their distances
        from point to plane (Chen & Medioni 1992) that one rigid motion, to first order, would take away.

        Args:
            trajectory: T_world_body of the log's frames.
            progress: Receives stages, counts and notes.

        Raises:
            DataError: No two of the frames that are compared show one place.
            FrameError: A frame cannot be read.
        """
        placed = placed_frames(self._source, trajectory)
        frames = [frame for frame in placed if frame.entry.stamp_ns in self._moment_of]
        pairs = list(combinations(range(len(frames)), 2))
        stamps_ns, distances_m = [], []
        with progress.stage("agree") as report:
            seen = self._views.describe(frames)
            for done, (i, j) in enumerate(pairs, start=1):
                report(done, len(pairs))
                T_i_j = inverse(frames[i].T_world_body) @ frames[j].T_world_body
                distance_m = self._views.distance_m(seen[i], seen[j], T_i_j)
                if distance_m is not None:
                    stamps_ns.append((frames[i].entry.stamp_ns, frames[j].entry.stamp_ns))
                    distances_m.append(distance_m)
        if not distances_m:
            raise DataError(f"agreement: of {len(frames)} frames spread over the log no two show one place")
        moments = [[self._moment_of[stamp_ns] for stamp_ns in pair] for pair in stamps_ns]
        return Disagreements(np.array(stamps_ns), np.array(moments), np.array(distances_m))


def agreement_metrics(disagreements: Disagreements) -> list[Metric]:
    """Return the root mean square of the disagreements and its interval of 95 %.

    The interval is the bootstrap's over moments (Efron & Tibshirani 1993), as pairs of one moment err alike.
    """
    squares_m2 = disagreements.distances_m**2
    low_m, high_m = np.sqrt(_interval(squares_m2, disagreements.moments)).tolist()
    return [
        Metric("views that show one place", len(squares_m2), "pairs"),
        Metric("disagreement of views RMS", disagreements.rms_m, "m"),
        Metric("disagreement of views, interval from", low_m, "m", "95 %"),
        Metric("disagreement of views, interval to", high_m, "m", "95 %"),
    ]


def comparison_metrics(disagreements: Disagreements, other: Disagreements) -> list[Metric]:
    """Return by how much less one trajectory disagrees than another of the same log, and how sure that is.

    Pairs of views that both have poses for are compared one by one. Where the interval of 95 % of the mean
    difference holds 0, neither is better as far as the log shows.

    Raises:
        DataError: No pair of views was compared in both.
    """
    of_other = dict(zip(map(tuple, other.stamps_ns.tolist()), other.distances_m.tolist(), strict=True))
    pairs = list(map(tuple, disagreements.stamps_ns.tolist()))
    common = np.array([pair in of_other for pair in pairs])
    if not common.any():
        raise DataError("agreement: the two runs have no views in common; were they built from one log?")
    others_m = np.array([of_other[pair] for pair in pairs if pair in of_other])
    less_m = others_m - disagreements.distances_m[common]
    low_m, high_m = _interval(less_m, disagreements.moments[common]).tolist()
    return [
        Metric("views compared in both runs", len(less_m), "pairs"),
        Metric("disagreement of views less by", float(less_m.mean()), "m", "mean"),
        Metric("disagreement of views less by, interval from", low_m, "m", "95 %"),
        Metric("disagreement of views less by, interval to", high_m, "m", "95 %"),
    ]


def which_is_better(compared: Sequence[Metric], name: str, other: str) -> str:
    """Return a sentence on which of two runs is better by ``comparison_metrics``, or that it is not known."""
    _, mean, low, high = (metric.value for metric in compared)
    if low <= 0.0 <= high:
        return f"{name} and {other} cannot be told apart by the views of the log"
    better, worse = (name, other) if mean > 0.0 else (other, name)
    return f"{better} agrees with the views of the log better than {worse}, by {abs(mean):.2g} m in the mean"


def _interval(values: Array, moments: NDArray[np.intp]) -> Array:
    """Return the (2,) limits of the mean of values of pairs of moments."""
    count = int(moments.max()) + 1
    drawn = np.random.default_rng(0).integers(count, size=(_RESAMPLES, count))
    times = np.apply_along_axis(np.bincount, 1, drawn, minlength=count)
    weights = times[:, moments[:, 0]] * times[:, moments[:, 1]]
    weights = weights[weights.any(axis=1)]
    means = (weights * values).sum(axis=1) / weights.sum(axis=1)
    limits: Array = np.percentile(means, _PERCENTILES)
    return limits


def _moments(stamps_ns: Stamps) -> dict[int, int]:
    """Return the moments of frames that are spread over a log, and of those a second later, by stamp."""
    firsts = np.unique(np.linspace(0, len(stamps_ns) - 1, min(_MOMENTS, len(stamps_ns))).astype(np.intp))
    laters = np.searchsorted(stamps_ns, stamps_ns[firsts] + _LATER_NS)
    moment_of = {int(stamps_ns[later]): k for k, later in enumerate(laters) if later < len(stamps_ns)}
    return moment_of | {int(stamps_ns[first]): k for k, first in enumerate(firsts)}


class _Views(Protocol[View]):
    """Views of one kind."""

    def describe(self, frames: Sequence[PlacedFrame], /) -> list[View]:
        """Return what is compared of each frame."""
        ...

    def distance_m(self, i: View, j: View, T_i_j: Transform, /) -> float | None:
        """Return how far apart two views put their relative pose; None where they do not show one place."""
        ...


class _ImageViews:
    """Images, compared by their features; what they show hardly depends on the poses and is kept."""

    def __init__(self) -> None:
        self._verifier = ImageVerifier(ImageVerificationConfig())
        self._by_readout = {s: build_frame_odometry(LocalMapConfig(readout_s=s)) for s in _READOUTS_S}
        self._readout_s: float | None = None
        self._views: dict[int, ImageView] = {}
        self._motions: dict[tuple[int, int], Transform | None] = {}

    def describe(self, frames: Sequence[PlacedFrame], /) -> list[ImageView]:
        new = [frame for frame in frames if frame.entry.stamp_ns not in self._views]
        observed = list(ordered_map(lambda frame: self._by_readout[0.0].read(frame.entry), new))
        twists = [twist_at(frame.trajectory, frame.index) for frame in new]
        if self._readout_s is None:
            views = {s: self._seen(observed, twists, s) for s in _READOUTS_S}
            self._readout_s = self._best_readout_s(views)
            found = views[self._readout_s]
        else:
            found = self._seen(observed, twists, self._readout_s)
        self._views |= {view.stamp_ns: view for view in found}
        return [self._views[frame.entry.stamp_ns] for frame in frames]

    def distance_m(self, i: ImageView, j: ImageView, T_i_j: Transform, /) -> float | None:
        pair = i.stamp_ns, j.stamp_ns
        if pair not in self._motions:
            self._motions[pair] = self._verifier.verify(i, j).T_i_j
        measured = self._motions[pair]
        return None if measured is None else float(np.linalg.norm((T_i_j - measured)[:3, 3]))

    def _seen(self, observed: Sequence[Any], twists: Sequence[Twist], readout_s: float) -> list[ImageView]:
        """Return the views of images whose rows are read in some time."""
        odometry = self._by_readout[readout_s]
        views = (odometry.view(one, twist) for one, twist in zip(observed, twists, strict=True))
        return [self._verifier.describe(view) for view in views]

    def _best_readout_s(self, views: Mapping[float, Sequence[ImageView]]) -> float:
        """Return the readout time by which consecutive images fit each other best."""
        residuals_px = []
        for seen in views.values():
            verified = (self._verifier.verify(i, j) for i, j in pairwise(seen))
            residuals_px.append([np.nan if one.reason else one.residual_px for one in verified])
        by_readout = np.array(residuals_px, np.float64)
        known = ~np.isnan(by_readout).any(axis=0)
        return list(views)[int(by_readout[:, known].sum(axis=1).argmin())]


class _ScanViews:
    """Scans, compared by their surfaces."""

    def describe(self, frames: Sequence[PlacedFrame], /) -> list[Prepared]:
        def prepare(frame: PlacedFrame) -> Prepared:
            scan = frame.scan_of(frame.entry.scan())
            return prepared(scan.points_body, voxel_m=_VOXEL_M, is_planar=scan.is_planar)

        return list(ordered_map(prepare, frames))

    def distance_m(self, i: Prepared, j: Prepared, T_i_j: Transform, /) -> float | None:
        if min(_overlap(i, j, T_i_j), _overlap(j, i, inverse(T_i_j))) < _MIN_OVERLAP:
            return None
        points = j.points[:: stride_for(len(j.points), _POINTS)]
        partners, distances_m = i.nearest(apply(T_i_j, points))
        near = distances_m <= _PAIR_DISTANCE_M
        rows, residuals_m = plane_rows(i, points[near], T_i_j, partners[near])
        has_normal = rows.any(axis=1)
        rows, residuals_m = rows[has_normal], residuals_m[has_normal]
        if len(rows) < _MIN_PAIRS:
            return None
        spread_m = max(2.0 * SIGMAS_PER_MAD * float(np.median(np.abs(residuals_m))), _LEAST_SPREAD_M)
        weights = 1.0 / (1.0 + (residuals_m / spread_m) ** 2)  # Cauchy's
        weighted = rows * weights[:, np.newaxis]
        values, motions = np.linalg.eigh(np.einsum("ni,nj->ij", weighted, rows))
        gradient = motions.T @ np.einsum("ni,n->i", weighted, residuals_m)
        shown = values > _UNSEEN * values[-1]
        return float(np.sqrt((gradient[shown] ** 2 / values[shown]).sum() / weights.sum()))


def _overlap(target: Prepared, source: Prepared, T_target_source: Transform) -> float:
    points = source.points[:: stride_for(len(source.points), _POINTS // 10)]
    _, distances_m = target.nearest(apply(T_target_source, points))
    return float((distances_m <= _PAIR_DISTANCE_M).mean())
