"""The figures that the three papers print, and the thesis's ISVD columns measured again beside them."""

import json
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import Any

from evaluators.trajectory import align, associate, ate
from mapper.config.odometry import IsvdConfig, IsvdOdometryConfig, MatchConfig
from mapper.errors import DataError
from mapper.geometry import Points
from mapper.odometry.isvd import IsvdObservation, IsvdOdometry, find_shared_points
from mapper.sources.base import FrameSource
from mapper.trajectory import Trajectory, trajectory_from

TABLE_5_1, TABLE_5_2 = "isvd_iterations", "isvd_previous_frames"
_UNTRIMMED = IsvdConfig(min_pairs=20, agreement_mm=5000.0, min_agreement_ratio=0.0)
"""Fixed numbers of iterations: nothing stops early, and even the first plain fit is accepted."""


@dataclass(frozen=True, slots=True)
class Comparison:
    """One cell of a published table and ours.

    Attributes:
        table: Where it is printed.
        setting: Row or column head, e.g. "7 iterations" or "MP 4".
        published_m: ATE RMSE in metres as printed.
        ours_m: ATE RMSE in metres, SE(3)-aligned, of the frames that were placed.
        lost: Frames that were not placed.
    """

    table: str
    setting: str
    published_m: float
    ours_m: float
    lost: int


@cache
def published() -> dict[str, Any]:
    """Return the papers' tables by name; every table carries its ``source``."""
    tables: dict[str, Any] = json.loads(files("evaluators").joinpath("published.json").read_text("utf-8"))
    return tables


def isvd_tables(source: FrameSource, *, log_name: str, config: IsvdOdometryConfig) -> Iterator[Comparison]:
    """Yield the cells of Tables 5.1 and 5.2 for one log, each with our measurement.

    Frames are observed once and matched once per pair; only what differs between the cells is done again.

    Args:
        source: A log with ground truth.
        log_name: How the thesis calls it, e.g. "fr1/xyz".
        config: The thesis's settings; "auto" and the MP cells use its registration as it is.

    Raises:
        DataError: The log has no truth, or the thesis has no column of that name.
    """
    if source.truth is None:
        raise DataError(f"{source.path}: no ground truth, so there is no ATE to compare with the thesis's")
    odometry = IsvdOdometry(config)
    observations = [odometry.observe(entry.load(colour=False)) for entry in source.entries()]
    shared = _Remembered()
    for table, setting, printed_m, variant in _cells(log_name, config):
        estimate = _tracked(observations, variant, shared)
        matched = associate(estimate, source.truth)
        ours_m = ate(align(matched, "se3").moved(matched)).rmse
        yield Comparison(table, setting, printed_m, ours_m, len(observations) - len(estimate))


def _cells(log_name: str, config: IsvdOdometryConfig) -> Iterator[tuple[str, str, float, IsvdOdometryConfig]]:
    iterations, previous = published()[TABLE_5_1], published()[TABLE_5_2]
    if log_name not in iterations["columns"] or log_name not in previous["rows"]:
        raise DataError(
            f"{log_name!r} is not in both tables; Table 5.1 has {', '.join(iterations['columns'])}"
        )
    column = iterations["columns"].index(log_name)
    for count, row in iterations["rows"].items():
        registration = config.registration
        if count != "auto":
            registration = _UNTRIMMED.model_copy(update={"max_iterations": int(count)})
        setting = "auto" if count == "auto" else f"{count} iterations"
        variant = config.model_copy(update={"registration": registration})
        yield iterations["source"], setting, row[column], variant
    for head, printed_m in zip(previous["columns"], previous["rows"][log_name], strict=True):
        variant = config.model_copy(update={"previous_frames": int(head.removeprefix("MP"))})
        yield previous["source"], head, printed_m, variant


class _Remembered:
    """``find_shared_points`` that matches a pair of frames once."""

    def __init__(self) -> None:
        self._found: dict[tuple[int, int, MatchConfig], tuple[Points, Points, int]] = {}

    def __call__(
        self, target: IsvdObservation, source: IsvdObservation, match: MatchConfig
    ) -> tuple[Points, Points, int]:
        key = (target.stamp_ns, source.stamp_ns, match)
        if key not in self._found:
            self._found[key] = find_shared_points(target, source, match)
        return self._found[key]


def _tracked(
    observations: list[IsvdObservation], config: IsvdOdometryConfig, shared: _Remembered
) -> Trajectory:
    odometry = IsvdOdometry(config, shared_points=shared)
    tracks = [odometry.track(observation) for observation in observations]
    return trajectory_from((track.stamp_ns, track.T_world_body) for track in tracks if track.node is not None)
