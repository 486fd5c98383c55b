"""Errors of a method's path over a whole log."""

from dataclasses import dataclass, field, replace

import numpy as np

from mapper.core.errors import DataError
from mapper.core.geometry import Array, path_length
from mapper.core.timebase import MAX_TRUTH_GAP_NS, NS_PER_S, Stamps, nearest
from mapper.core.trajectory import Trajectory
from mapper.evaluators.metrics.trajectory_errors import DeltaUnit, Matched, align, associate, ate, step_errors

_STRETCHES = (0.1, 0.2, 0.3, 0.4, 0.5)  # of the true path's length
_MIN_POSES = 3  # to lay one path over another


@dataclass(frozen=True, slots=True)
class Step:
    """The step of the relative errors, the same for every method.

    Attributes:
        delta: Length of the step.
        unit: Unit of the length.
    """

    delta: float
    unit: DeltaUnit

    @property
    def text(self) -> str:
        """Words for "RPE over …", e.g. "1 s"."""
        return "1 frame" if self.unit == "frames" else f"{self.delta:g} {self.unit}"


ONE_SECOND, ONE_FRAME = Step(1.0, "s"), Step(1.0, "frames")


@dataclass(frozen=True, slots=True)
class PathErrors:
    """Errors of a path against the truth; None is not known.

    Attributes:
        ate_m: Root mean square distance of the positions from the true ones.
        rpe_m: Root mean square error of the translation over a step; None where no two poses are one apart.
        rpe_rad: Root mean square error of the rotation over a step, likewise.
        drift_ratio: Mean error of the translation over a stretch of the path, as a share of its length. The
            stretches are a tenth to a half of the path (Geiger et al. 2012 take 100 to 800 m); None where
            no two poses are that distance apart.
    """

    ate_m: float | None = None
    rpe_m: float | None = None
    rpe_rad: float | None = None
    drift_ratio: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class OdometryRun:
    """One method on a whole log.

    Attributes:
        method: Its name.
        frames: Frames that it was given.
        failures: Frames that it could not place, or registrations that did not converge.
        seconds: CPU time, without what is common to all methods.
        trajectory: T_world_body, aligned with the truth where there is one.
        matched: The poses that have a true one, aligned with it; None without truth or with too few.
        errors: Errors of these poses; unknown without truth or with too few of them.
        steps_m: (S,) errors of the translation over one step; empty where no two poses are one apart.
        broke: Why the method did not come to the end of the log; empty when it did.
        disagreement_m: How far its poses are from what views of one place show, root mean square; None where
            there is a truth or it is not known.
    """

    method: str
    frames: int
    failures: int
    seconds: float
    trajectory: Trajectory
    matched: Matched | None = None
    errors: PathErrors = PathErrors()
    steps_m: Array = field(default_factory=lambda: np.empty(0))
    broke: str = ""
    disagreement_m: float | None = None

    @property
    def coverage(self) -> float:
        """Share of the frames that have a pose."""
        return len(self.trajectory) / self.frames if self.frames else 0.0

    @property
    def frames_per_s(self) -> float:
        """Frames per second of CPU time of the method alone."""
        return self.frames / self.seconds if self.seconds > 0.0 else 0.0


def step_for(stamps_ns: Stamps) -> Step:
    """Return one second, or one frame where no two of the frames are a second apart, give or take a tenth."""
    elapsed_s = (stamps_ns - stamps_ns[0]) / NS_PER_S
    later = np.searchsorted(elapsed_s, elapsed_s + 0.9)
    known = later < len(elapsed_s)
    has_pair = (elapsed_s[later[known]] - elapsed_s[known] <= 1.1).any()
    return ONE_SECOND if has_pair else ONE_FRAME


def assess_run(run: OdometryRun, truth: Trajectory | None, step: Step) -> OdometryRun:
    """Return a run with its path aligned with the truth, and its errors; as it is where few poses have one.

    Args:
        run: Run with a trajectory in any frame.
        truth: T_world_body.
        step: Step of the relative errors.
    """
    if truth is None or not len(run.trajectory):
        return run
    _, gap_ns = nearest(truth.stamps_ns, run.trajectory.stamps_ns)
    if (gap_ns <= MAX_TRUTH_GAP_NS).sum() < _MIN_POSES:
        return run
    matched = associate(run.trajectory, truth, max_gap_s=MAX_TRUTH_GAP_NS / NS_PER_S)
    similarity = align(matched, "se3")
    matched = similarity.moved(matched)
    return replace(
        run,
        trajectory=run.trajectory.moved(similarity.T_truth_map),
        matched=matched,
        errors=path_errors(matched, step),
        steps_m=_step_errors(matched, step.delta, step.unit)[0],
    )


def path_errors(matched: Matched, step: Step) -> PathErrors:
    """Return the errors of a path aligned with the truth, the relative ones over a step."""
    steps_m, steps_rad = _step_errors(matched, step.delta, step.unit)
    return PathErrors(
        ate_m=ate(matched).rmse,
        rpe_m=_rms(steps_m),
        rpe_rad=_rms(steps_rad),
        drift_ratio=_drift_ratio(matched),
    )


def _drift_ratio(matched: Matched) -> float | None:
    path_m = path_length(matched.T_truth_body[:, :3, 3])
    stretches = [(share * path_m, _step_errors(matched, share * path_m, "m")[0]) for share in _STRETCHES]
    ratios = [errors_m.mean() / length_m for length_m, errors_m in stretches if len(errors_m)]
    return float(np.mean(ratios)) if ratios else None


def _step_errors(matched: Matched, delta: float, unit: DeltaUnit) -> tuple[Array, Array]:
    try:
        return step_errors(matched, delta=delta, unit=unit)
    except DataError:
        return np.empty(0), np.empty(0)


def _rms(errors: Array) -> float | None:
    return float(np.sqrt(np.mean(errors**2))) if len(errors) else None
