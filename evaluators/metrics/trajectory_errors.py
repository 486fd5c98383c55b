"""Errors of an estimated trajectory: ATE and RPE as the TUM benchmark defines them."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from mapper.core.errors import DataError
from mapper.core.geometry import (
    Array,
    Points,
    Transform,
    angle_between,
    distances_along,
    fit_rigid,
    length_and_angle,
    rotation_exp,
    transform,
)
from mapper.core.timebase import NS_PER_S, Stamps, nearest
from mapper.core.trajectory import Trajectory, start_to_end

AlignmentKind = Literal["none", "yaw", "se3", "sim3"]
DeltaUnit = Literal["frames", "m", "s"]

_DELTA_TOLERANCE_RATIO = 0.1
_LEVER_STEPS, _LEAST_TURN = 20, 0.1
"""Rounds of the fit of a point on the body, and the share of the largest turns from which others count."""


@dataclass(frozen=True, slots=True, eq=False)
class Matched:
    """Poses of one body at the same moments, as estimated and as they truly were.

    Attributes:
        stamps_ns: (N,) int64, the estimate's stamps.
        T_map_body: (N, 4, 4) estimated poses, in the estimate's own world.
        T_truth_body: (N, 4, 4) true poses, in the truth's world.
    """

    stamps_ns: Stamps
    T_map_body: Array
    T_truth_body: Array

    def __len__(self) -> int:
        return len(self.stamps_ns)

    @property
    def position_errors_m(self) -> Array:
        """(N,) distances from the true positions."""
        return _lengths(self.T_map_body[:, :3, 3] - self.T_truth_body[:, :3, 3])

    @property
    def rotation_errors_rad(self) -> Array:
        """(N,) angles to the true rotations."""
        pairs = zip(self.T_map_body, self.T_truth_body, strict=True)
        return np.array([angle_between(estimated[:3, :3], true[:3, :3]) for estimated, true in pairs])


@dataclass(frozen=True, slots=True, eq=False)
class Similarity:
    """The motion and scale that align an estimate with the truth: ``truth ≈ scale · R · map + t``."""

    T_truth_map: Transform
    scale: float = 1.0

    def moved(self, matched: Matched) -> Matched:
        """Return the same pairs with the estimate aligned with the truth."""
        T_map_body = matched.T_map_body.copy()
        T_map_body[:, :3, 3] *= self.scale
        return Matched(matched.stamps_ns, self.T_truth_map @ T_map_body, matched.T_truth_body)


@dataclass(frozen=True, slots=True)
class Statistics:
    """A set of errors in six numbers, all in the errors' unit; ``std`` divides by N."""

    rmse: float
    mean: float
    median: float
    std: float
    min: float
    max: float


@dataclass(frozen=True, slots=True)
class RelativeErrors:
    """Relative pose errors.

    Attributes:
        translation_m: Errors of the relative translation.
        rotation_rad: Angles of the relative rotation's error.
        pairs: Number of pairs of poses that were compared.
    """

    translation_m: Statistics
    rotation_rad: Statistics
    pairs: int


def associate(
    estimate: Trajectory,
    truth: Trajectory,
    *,
    max_gap_s: float = 0.02,
    names: tuple[str, str] = ("the estimate", "the truth"),
) -> Matched:
    """Return the poses that belong together in time.

    Every pose of the shorter trajectory (the estimate, if both are as long) takes the pose of the other
    that is nearest in time, the earlier one of two equally near; so a pose of the longer one may
    serve twice. This is how evo reads the rule of the TUM benchmark (Sturm et al. 2012).

    Raises:
        DataError: No pair lies within ``max_gap_s``; the message has the smallest gap.
    """
    if not len(estimate) or not len(truth):
        empty = names[0] if not len(estimate) else names[1]
        raise DataError(f"{empty} has no poses, so there is nothing to compare")
    estimate_is_longer = len(estimate) > len(truth)
    short, long = (truth, estimate) if estimate_is_longer else (estimate, truth)
    partner, gap_ns = nearest(long.stamps_ns, short.stamps_ns)
    in_short = np.flatnonzero(gap_ns <= round(max_gap_s * NS_PER_S))
    in_long = partner[in_short]
    if not len(in_short):
        raise DataError(
            f"no stamps of {names[0]} and {names[1]} lie within {_duration_text(max_gap_s)}; "
            f"the closest pair is {_duration_text(int(gap_ns.min()) / NS_PER_S)} apart"
        )
    in_estimate, in_truth = (in_long, in_short) if estimate_is_longer else (in_short, in_long)
    return Matched(
        estimate.stamps_ns[in_estimate], estimate.T_world_body[in_estimate], truth.T_world_body[in_truth]
    )


def align(matched: Matched, kind: AlignmentKind) -> Similarity:
    """Return the motion that aligns the estimate with the truth at the least squared distance of positions.

    "none" moves nothing; "yaw" shifts, and turns about z (Zhang & Scaramuzza 2018), which is all that is open
    where z is up in both worlds; "se3" fits a rigid motion (Arun et al. 1987), "sim3" a scale as well
    (Umeyama 1991).

    Raises:
        DataError: Fewer than three pairs for a fit.
    """
    if kind == "none":
        return Similarity(np.eye(4))
    if len(matched) < 3:
        raise DataError(f"{len(matched)} matched poses: an alignment by {kind} needs 3; align by none")
    positions_truth, positions_map = matched.T_truth_body[:, :3, 3], matched.T_map_body[:, :3, 3]
    if kind == "yaw":
        return Similarity(_fit_yaw(positions_truth, positions_map))
    return Similarity(*fit_rigid(positions_truth, positions_map, with_scale=kind == "sim3"))


def _fit_yaw(target: Points, source: Points) -> Transform:
    target_mean, source_mean = target.mean(axis=0), source.mean(axis=0)
    covariance = (target - target_mean).T @ (source - source_mean)
    sine, cosine = covariance[1, 0] - covariance[0, 1], covariance[0, 0] + covariance[1, 1]
    R = rotation_exp(np.array([0.0, 0.0, np.arctan2(sine, cosine)]))
    return transform(R, target_mean - R @ source_mean)


def lever_arm(matched: Matched, kind: AlignmentKind) -> tuple[Points, float]:
    """Return the point of the body, (3,) metres, whose positions fit the true ones best, and their RMSE.

    Alignment and point are fitted in turns; turns that the body never makes leave the point undetermined
    along their axes, where it is taken as near as can be.
    """
    R_map_body = matched.T_map_body[:, :3, :3]
    lever = np.zeros(3)
    moved = matched
    for _ in range(_LEVER_STEPS):
        T_map_point = matched.T_map_body.copy()
        T_map_point[:, :3, 3] += R_map_body @ lever
        moved = Matched(matched.stamps_ns, T_map_point, matched.T_truth_body)
        moved = align(moved, kind).moved(moved)
        missing = (moved.T_truth_body - moved.T_map_body)[:, :3, 3]
        turned = moved.T_map_body[:, :3, :3]
        rows = (turned - turned.mean(axis=0)).reshape(-1, 3)
        step, *_ = np.linalg.lstsq(rows, (missing - missing.mean(axis=0)).ravel(), rcond=_LEAST_TURN)
        lever = lever + step
    return lever, ate(moved).rmse


def ate(matched: Matched) -> Statistics:
    """Return the absolute trajectory error in metres: distances between positions (Sturm et al. 2012, eq. 4).

    The pairs are compared as they are; lay the estimate over the truth first.
    """
    return statistics(matched.position_errors_m)


def ate_rmse_m(estimate: Trajectory, truth: Trajectory) -> float:
    """Return the RMSE of the absolute trajectory error in metres, SE(3)-aligned.

    Raises:
        DataError: Fewer than three stamps match.
    """
    matched = associate(estimate, truth)
    return ate(align(matched, "se3").moved(matched)).rmse


def rpe(matched: Matched, *, delta: float = 1.0, unit: DeltaUnit = "frames") -> RelativeErrors:
    """Return the relative pose error over steps of a fixed length (Sturm et al. 2012, eq. 2–3).

    Raises:
        DataError: As ``step_errors``.
    """
    translation_m, rotation_rad = step_errors(matched, delta=delta, unit=unit)
    return RelativeErrors(
        translation_m=statistics(translation_m),
        rotation_rad=statistics(rotation_rad),
        pairs=len(translation_m),
    )


def step_errors(matched: Matched, *, delta: float, unit: DeltaUnit) -> tuple[Array, Array]:
    """Return the relative pose errors over all steps of a fixed length, metres and radians, (N,) each.

    Every pose is compared with the one that lies nearest to ``delta`` ahead of it: in matched frames, in
    seconds, or in metres along the true path, so that every estimate is compared over the same pairs.
    Steps in metres or seconds that miss ``delta`` by more than a tenth are left out.

    Raises:
        DataError: ``delta`` is not positive, or no two poses are that far apart.
    """
    if not delta > 0.0:
        raise DataError(f"RPE over {delta} {unit}: the step must be > 0")
    i, j = _steps(progress_of(matched, unit), delta, 0.0 if unit == "frames" else _DELTA_TOLERANCE_RATIO)
    if not len(i):
        raise DataError(
            f"RPE over {delta:g} {unit}: no two of the {len(matched)} matched poses are that far apart"
        )
    return motion_errors(matched, i, j)


def motion_errors(matched: Matched, i: NDArray[np.intp], j: NDArray[np.intp]) -> tuple[Array, Array]:
    """Return how wrong the motions from poses i to poses j are, metres and radians, (N,) each."""
    T_true = _relative(matched.T_truth_body[i], matched.T_truth_body[j])
    T_estimated = _relative(matched.T_map_body[i], matched.T_map_body[j])
    T_error = _relative(T_true, T_estimated)
    return _lengths(T_error[:, :3, 3]), _angles_rad(T_error[:, :3, :3])


def start_end_offset(trajectory: Trajectory) -> tuple[float, float]:
    """Return metres and radians from the first pose to the last: the error of a log that ends where it began.

    Raises:
        DataError: The trajectory has no poses.
    """
    if not len(trajectory):
        raise DataError("start-to-end offset: the trajectory has no poses")
    return length_and_angle(start_to_end(trajectory))


def progress_of(matched: Matched, unit: DeltaUnit) -> Array:
    """Return (N,) how far along the log every pose is, in the unit; it never decreases.

    Metres are those of the true path, so that every estimate is compared over the same stretches.
    """
    if unit == "frames":
        return np.arange(len(matched), dtype=np.float64)
    if unit == "s":
        elapsed_s: Array = (matched.stamps_ns - matched.stamps_ns[0]) / NS_PER_S
        return elapsed_s
    return distances_along(matched.T_truth_body[:, :3, 3])


def _steps(
    progress: Array, delta: float, tolerance_ratio: float
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return indices i and j > i with ``progress[j]`` nearest to ``progress[i] + delta``."""
    i = np.arange(len(progress) - 1)
    wanted = progress[i] + delta
    right = np.clip(np.searchsorted(progress, wanted), i + 1, len(progress) - 1)
    left = np.maximum(right - 1, i + 1)
    j = np.where(wanted - progress[left] <= progress[right] - wanted, left, right)
    near = np.abs(progress[j] - wanted) <= tolerance_ratio * delta
    return i[near], j[near]


def _relative(T_a_i: Array, T_a_j: Array) -> Array:
    """Return (N, 4, 4) T_i_j of two stacks of poses."""
    T_i_a = np.zeros_like(T_a_i)
    R_i_a = np.swapaxes(T_a_i[:, :3, :3], 1, 2)
    T_i_a[:, :3, :3] = R_i_a
    T_i_a[:, :3, 3] = -np.einsum("nij,nj->ni", R_i_a, T_a_i[:, :3, 3])
    T_i_a[:, 3, 3] = 1.0
    return T_i_a @ T_a_j


def _angles_rad(R: Array) -> Array:
    """Return (N,) rotation angles; the arctangent keeps the digits that an arccosine loses near 0."""
    twice_sine = _lengths(
        np.column_stack([R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]])
    )
    angles: Array = np.arctan2(twice_sine, np.trace(R, axis1=1, axis2=2) - 1.0)
    return angles


def _lengths(vectors: Array) -> Array:
    lengths: Array = np.linalg.norm(vectors, axis=1)
    return lengths


def statistics(errors: Array) -> Statistics:
    """Return the statistics of (N ≥ 1,) errors."""
    return Statistics(
        rmse=float(np.sqrt(np.mean(errors**2))),
        mean=float(errors.mean()),
        median=float(np.median(errors)),
        std=float(errors.std()),
        min=float(errors.min()),
        max=float(errors.max()),
    )


def _duration_text(seconds: float) -> str:
    return f"{seconds:.3g} s" if seconds >= 1.0 else f"{1e3 * seconds:.3g} ms"
