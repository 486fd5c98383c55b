"""What is suspicious about a run: every warning there is, found in one place from its results."""

import re
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby

import numpy as np

from mapper.core.errors import GraphError
from mapper.core.geometry import inverse, log
from mapper.core.timebase import NS_PER_S, Stamps
from mapper.graph.marginals import marginals_of
from mapper.graph.model import PoseGraph
from mapper.navigation.config import TraversableConfig
from mapper.run.frame_outcomes import DISCONNECTED, FrameRecord
from mapper.run.manifest import Manifest, RunWarning, Weight
from mapper.run.results import RunResults

FLOOR = "floor"
INPUT_KINDS = frozenset({"log", "depth", "frozen", "far returns", "conflict", FLOOR})
"""Kinds that are found while the log is read or fused; a finished run has them in its manifest alone."""

_ORDER: tuple[Weight, ...] = ("break", "doubt", "note")
_GAP_INTERVALS, _LEAST_GAP_S = 3.0, 0.5
_MAX_SKIPPED_SHARE = 0.1
_MAX_LOST_SHARE, _BROKEN_LOST_SHARE = 0.02, 0.25
_BROKEN_LOST_S, _BROKEN_LOST_FRAMES = 2.0, 3
_MAX_DOUBTFUL_SHARE, _FEW_FRAMES = 0.02, 2
_MAX_LOOP_M, _MAX_LOOP_SHARE, _MAX_LOOP_RAD = 0.3, 0.03, np.radians(10.0)
_LEAST_LOOPS_REFUSED, _MAX_REFUSED_SHARE = 4, 0.5
_MAX_WHEEL_CHI2, _LEAST_WHEEL_FACTORS = 9.0, 5
_MAX_SIGMA_M, _MAX_SIGMA_SHARE, _BROKEN_SIGMA_SHARE = 0.1, 0.1, 0.3
_MIN_COUNTED_DEPTH = 0.5
_MAX_STEP_M, _MAX_STEP_RAD = 0.2, np.radians(5.0)
_LEAST_AGREEMENT, _LEAST_SHARED_VOXELS = 0.15, 1000
_REASONS = 3


def find_warnings(results: RunResults, manifest: Manifest) -> list[RunWarning]:
    """Return all that is suspicious about a run, what weighs most first.

    What was found while the log was read is taken from the manifest, all else is worked out anew.
    docs/VERDICT.md lists the kinds and their limits.

    Args:
        results: Of the solved run.
        manifest: With the input's notes, the skipped frames and the levelling.
    """
    known = [warning for warning in manifest.warnings if warning.kind in INPUT_KINDS]
    told = {warning.sentence for warning in known}
    notes = [note for source in (manifest.input, *manifest.input.appended) for note in source.notes]
    timeline = _TimeLine.of(results, manifest)
    found = [
        *known,
        *(RunWarning(kind="log", sentence=note) for note in notes if note not in told),
        *_skipped(results.records, manifest),
        *_gaps(timeline),
        *_lost(results.records, timeline),
        *_doubtful(results.records, timeline),
        *_loops(results),
        *_levelling(manifest),
        *_depth_reach(manifest),
        *_wheels(results),
        *_uncertainty(results),
        *_wide_steps(results, timeline),
    ]
    return sorted(found, key=lambda warning: _ORDER.index(warning.weight))


def merge_warnings(name: str, *, agreement: float | None, shared_voxels: int) -> list[RunWarning]:
    """Return a warning if a run's walls are not where those of the runs merged before it are.

    Args:
        name: Of the run.
        agreement: Of the shared voxels that are occupied in either, the share that is in both.
        shared_voxels: Known in both.
    """
    if agreement is None or shared_voxels < _LEAST_SHARED_VOXELS or agreement >= _LEAST_AGREEMENT:
        return []
    return [
        RunWarning(
            kind="merge",
            sentence=f"{name}: {agreement:.0%} of its walls are where those of the runs before it are, of "
            f"{shared_voxels} voxels known in both (at least {_LEAST_AGREEMENT:.0%} is usual): "
            "are the runs of one world?",
            suggestion="--place truth, or --poses FILE",
            weight="doubt",
        )
    ]


def localisation_warnings(results: RunResults, manifest: Manifest) -> list[RunWarning]:
    """Return all that is suspicious about a log that was localised in a map, what weighs most first.

    Args:
        results: Of the localised log; a frame without a known pose in the map is lost.
        manifest: With the input's notes and the skipped frames.
    """
    timeline, records = _TimeLine.of(results, manifest), results.records
    found = [
        *(warning for warning in manifest.warnings if warning.kind in INPUT_KINDS),
        *_skipped(records, manifest),
        *_gaps(timeline),
        *_not_localised(records, timeline),
        *_doubtful(records, timeline),
    ]
    return sorted(found, key=lambda warning: _ORDER.index(warning.weight))


def _not_localised(records: Sequence[FrameRecord], timeline: "_TimeLine") -> Iterator[RunWarning]:
    is_lost = [record.outcome == "lost" for record in records]
    if not any(is_lost):
        return
    share = sum(is_lost) / len(records)
    first, last = max(_runs_of(is_lost), key=lambda run: timeline.duration_s(*run))
    yield RunWarning(
        kind="not localised",
        sentence=f"{sum(is_lost)} of {len(records)} frames are not localised, {share:.1%}, for "
        f"{timeline.duration_s(first, last):.1f} s at the longest: lost, or in a part of the path in which "
        f"too little of the map was recognised (at most {_MAX_LOST_SHARE:.0%} is harmless)",
        suggestion="come by places that the map shows, seen from where it was recorded",
        where=timeline.place(first, last),
        weight="break" if share > _BROKEN_LOST_SHARE else "doubt" if share > _MAX_LOST_SHARE else "note",
    )


def floor_warnings(config: TraversableConfig, resolution_m: float, *, has_path: bool) -> list[RunWarning]:
    """Return what is doubtful about the traversable floor.

    Args:
        config: Limits of the robot.
        resolution_m: Edge of a voxel.
        has_path: Whether the path tells the height of the floor.
    """
    found = []
    if config.max_step_m < resolution_m * (1.0 - 1e-6):
        found.append(
            RunWarning(
                kind=FLOOR,
                sentence=f"traversable.max_step_m = {config.max_step_m:g} m is less than a voxel of "
                f"{resolution_m:g} m; steps of {resolution_m:g} m count as floor",
                suggestion=f"--set octree.resolution_m={config.max_step_m:g}, or less",
            )
        )
    if not has_path:
        found.append(
            RunWarning(
                kind=FLOOR,
                sentence="no floor was found below the path; the traversable floor is what lies at the "
                "height of the floor, wherever that was seen",
                suggestion="show the floor that the sensor is carried over",
            )
        )
    return found


@dataclass(frozen=True, slots=True)
class _TimeLine:
    """Stamps of a log's frames.

    Attributes:
        stamps_ns: (N,) of all frames, in time order.
        usual_ns: Median interval.
        begins_ns: First stamps of sessions that were appended: what lies before them is a pause, no gap.
    """

    stamps_ns: Stamps
    usual_ns: float
    begins_ns: tuple[int, ...]

    @classmethod
    def of(cls, results: RunResults, manifest: Manifest) -> "_TimeLine":
        stamps_ns = np.array([record.stamp_ns for record in results.records], np.int64)
        usual_ns = float(np.median(np.diff(stamps_ns))) if len(stamps_ns) > 1 else 0.0
        return cls(stamps_ns, usual_ns, tuple(log.begins_ns for log in manifest.input.appended))

    def place(self, first: int, last: int) -> str:
        """Return between which seconds of the log two frames lie."""
        begin_s, end_s = (self.stamps_ns[[first, last]] - self.stamps_ns[0]) / NS_PER_S
        return f"{begin_s:.1f} … {end_s:.1f} s"

    def duration_s(self, first: int, last: int) -> float:
        """Return the seconds between two frames."""
        return float(self.stamps_ns[last] - self.stamps_ns[first]) / NS_PER_S


def _runs_of(marked: Sequence[bool]) -> Iterator[tuple[int, int]]:
    """Yield the first and last index of each run of frames that are marked."""
    for is_marked, run in groupby(enumerate(marked), key=lambda one: one[1]):
        indices = [index for index, _ in run]
        if is_marked:
            yield indices[0], indices[-1]


def _skipped(records: Sequence[FrameRecord], manifest: Manifest) -> Iterator[RunWarning]:
    if not manifest.skipped:
        return
    share = len(manifest.skipped) / max(len(records), 1)
    yield RunWarning(
        kind="skipped",
        sentence=f"{len(manifest.skipped)} of {len(records)} frames could not be read; the first: "
        f"{manifest.skipped[0].reason}",
        suggestion="repair the log, or record it again" if share > _MAX_SKIPPED_SHARE else "",
        weight="doubt" if share > _MAX_SKIPPED_SHARE else "note",
    )


def _gaps(timeline: _TimeLine) -> Iterator[RunWarning]:
    pauses_ns = np.diff(timeline.stamps_ns)
    limit_ns = max(_GAP_INTERVALS * timeline.usual_ns, _LEAST_GAP_S * NS_PER_S)
    is_gap = (pauses_ns > limit_ns) & ~np.isin(timeline.stamps_ns[1:], timeline.begins_ns)
    gaps = np.flatnonzero(is_gap)
    if not len(gaps):
        return
    longest = int(gaps[pauses_ns[gaps].argmax()])
    total_s = float(pauses_ns[gaps].sum()) / NS_PER_S
    yield RunWarning(
        kind="gap",
        sentence=f"the log has {_counted(len(gaps), 'gap')}, {total_s:.1f} s in all, the longest "
        f"{pauses_ns[longest] / NS_PER_S:.1f} s; frames come every {timeline.usual_ns / NS_PER_S:.2g} s",
        where=timeline.place(longest, longest + 1),
    )


def _lost(records: Sequence[FrameRecord], timeline: _TimeLine) -> Iterator[RunWarning]:
    left_out = [record for record in records if record.diagnostics.method == DISCONNECTED]
    if left_out:
        yield RunWarning(
            kind="left out",
            sentence=f"{len(left_out)} of {len(records)} frames lie in parts of the path that nothing "
            "connects to the rest; they are left out",
            suggestion="show a known place again after a loss, or record wheel odometry",
            weight="break",
        )
    is_lost = [record.outcome == "lost" and record.diagnostics.method != DISCONNECTED for record in records]
    lost = sum(is_lost)
    if not lost:
        return
    share = lost / len(records)
    runs = [(max(first - 1, 0), min(last + 1, len(records) - 1)) for first, last in _runs_of(is_lost)]
    first, last = max(runs, key=lambda run: timeline.duration_s(*run))
    longest_s = timeline.duration_s(first, last)
    is_long = longest_s > _BROKEN_LOST_S and last - first > _BROKEN_LOST_FRAMES
    weight: Weight = "note" if share <= _MAX_LOST_SHARE else "doubt"
    if share > _BROKEN_LOST_SHARE or is_long:
        weight = "break"
    yield RunWarning(
        kind="lost",
        sentence=f"{lost} of {len(records)} frames were lost, {share:.1%}, for {longest_s:.1f} s at the "
        f"longest (at most {_MAX_LOST_SHARE:.0%} and {_BROKEN_LOST_S:g} s are harmless)",
        where=timeline.place(first, last),
        weight=weight,
    )


def _doubtful(records: Sequence[FrameRecord], timeline: _TimeLine) -> Iterator[RunWarning]:
    doubtful = [record for record in records if record.outcome == "doubtful"]
    if not doubtful:
        return
    placed = sum(record.node is not None for record in records)
    share = len(doubtful) / placed
    # The same doubt with other figures is the same reason.
    examples: dict[str, str] = {}
    for record in doubtful:
        for doubt in record.doubts:
            examples.setdefault(_without_figures(doubt), doubt)
    reasons = Counter(_without_figures(doubt) for record in doubtful for doubt in record.doubts)
    texts = [f"{examples[reason]} ({count})" for reason, count in reasons.most_common(_REASONS)]
    first, last = max(
        _runs_of([record.outcome == "doubtful" for record in records]), key=lambda run: run[1] - run[0]
    )
    too_many = len(doubtful) > _FEW_FRAMES and share > _MAX_DOUBTFUL_SHARE
    yield RunWarning(
        kind="doubtful",
        sentence=f"{len(doubtful)} of {placed} placed frames are doubtful, {share:.1%} "
        f"(at most {_MAX_DOUBTFUL_SHARE:.0%} are usual): {'; '.join(texts)}",
        where=timeline.place(first, last),
        weight="doubt" if too_many else "note",
    )


def _stretches(pairs: Sequence[tuple[int, int]], graph: PoseGraph) -> int:
    """Return how many stretches of time some pairs of nodes span: pairs that overlap in time are one."""
    spans = sorted(sorted(graph.stamps_ns[node] for node in pair) for pair in pairs)
    count, until_ns = 0, -1
    for begin_ns, end_ns in spans:
        count += begin_ns >= until_ns
        until_ns = max(until_ns, end_ns)
    return count


def _counted(number: int, what: str) -> str:
    return f"{number} {what}{'s' if number > 1 else ''}"


def _without_figures(text: str) -> str:
    return re.sub(r"-?\d+(\.\d+)?", "…", text)


def _loops(results: RunResults) -> Iterator[RunWarning]:
    held = [loop for loop in results.loops if loop.verdict == "accepted" and loop.before is not None]
    contradicting = [loop for loop in results.loops if loop.reason.startswith("solver")]
    tried = len(held) + len(contradicting)
    if len(contradicting) >= _LEAST_LOOPS_REFUSED and len(contradicting) > _MAX_REFUSED_SHARE * tried:
        yield RunWarning(
            kind="loops",
            sentence=f"{len(contradicting)} of {tried} loops contradict the rest of the graph "
            f"(at most {_MAX_REFUSED_SHARE:.0%} is usual)",
            suggestion="mapper loops RUN lists them; mapper loops RUN --remove I J takes a wrong one back",
            weight="doubt",
        )
    if not held:
        return
    before = [loop.before for loop in held if loop.before is not None]
    miss_m = float(np.median([miss.translation_m for miss in before]))
    miss_rad = float(np.median([miss.rotation_rad for miss in before]))
    stamps_ns = results.trajectory.stamps_ns
    steps_m = np.linalg.norm(np.diff(results.trajectory.positions_world, axis=0), axis=1)
    travelled_m = np.concatenate([[0.0], np.cumsum(steps_m)])
    ends = np.searchsorted(stamps_ns, [[loop.stamp_i_ns, loop.stamp_j_ns] for loop in held])
    ends = np.minimum(ends, len(stamps_ns) - 1)
    path_m = float(np.median(np.abs(np.diff(travelled_m[ends], axis=1))))
    limit_m = max(_MAX_LOOP_M, _MAX_LOOP_SHARE * path_m)
    if miss_m <= limit_m and miss_rad <= _MAX_LOOP_RAD:
        return
    yield RunWarning(
        kind="loops",
        sentence=f"before the solve the median loop was {miss_m:.2f} m and {np.degrees(miss_rad):.1f}° "
        f"from the odometry, over {path_m:.1f} m of path (at most {limit_m:.2f} m and "
        f"{np.degrees(_MAX_LOOP_RAD):.0f}° are usual): either the odometry is wrong or the loops are",
        suggestion="mapper loops RUN lists them; mapper loops RUN --remove I J takes a wrong one back",
        weight="doubt",
    )


def _levelling(manifest: Manifest) -> Iterator[RunWarning]:
    levelling = manifest.levelling
    if levelling is None:
        return
    if levelling.method == "camera":
        yield RunWarning(
            kind="levelling",
            sentence=f"up is no more than the sensor's mean up direction: {levelling.detail}",
            suggestion="show floor and walls, or raise level.plane_tolerance_m where depth is noisy",
            weight="doubt",
        )
    elif not levelling.has_floor:
        yield RunWarning(
            kind="levelling",
            sentence=f"the height of the floor is a guess: {levelling.detail}",
            suggestion="show the floor",
        )


def _depth_reach(manifest: Manifest) -> Iterator[RunWarning]:
    reach = manifest.depth
    if reach is not None and reach.counted_ratio < _MIN_COUNTED_DEPTH:
        yield RunWarning(
            kind="reach",
            sentence=reach.sentence,
            suggestion="raise octree.resolution_m, or set octree.max_range_m if noise in the map is no harm",
        )


def _wheels(results: RunResults) -> Iterator[RunWarning]:
    T_world_node = results.graph.T_world_node
    factors = [factor for factor in results.graph.factors if factor.origin == "wheel"]
    if len(factors) < _LEAST_WHEEL_FACTORS:
        return
    misses = [
        np.concatenate(log(inverse(factor.T_i_j) @ inverse(T_world_node[factor.i]) @ T_world_node[factor.j]))
        for factor in factors
    ]
    chi2 = [
        float(miss @ factor.information @ miss) / 6.0 for miss, factor in zip(misses, factors, strict=True)
    ]
    if np.median(chi2) <= _MAX_WHEEL_CHI2:
        return
    miss_m = float(np.median([np.linalg.norm(miss[3:]) for miss in misses]))
    moved_m = float(np.median([np.linalg.norm(factor.T_i_j[:3, 3]) for factor in factors]))
    yield RunWarning(
        kind="wheels",
        sentence=f"wheels and odometry disagree: in the median by {miss_m:.2f} m where keyframes are "
        f"{moved_m:.2f} m apart, {np.sqrt(np.median(chi2)):.0f} times what their noise explains "
        f"(at most {np.sqrt(_MAX_WHEEL_CHI2):.0f} is usual)",
        suggestion="check the wheels' calibration and clock, and the mounting of the sensor",
        weight="doubt",
    )


def _uncertainty(results: RunResults) -> Iterator[RunWarning]:
    poses = results.poses
    if poses is None:
        return
    known = np.flatnonzero(np.isfinite(poses.position_sigmas_m) & ~poses.is_doubtful)
    if len(known) < 2:
        return
    path_m = results.trajectory.path_length_m
    sigma_m = float(poses.position_sigmas_m[known[-1]])
    share = sigma_m / max(path_m, 1e-9)
    if sigma_m > _MAX_SIGMA_M and share > _MAX_SIGMA_SHARE:
        yield RunWarning(
            kind="uncertainty",
            sentence=f"the last pose is known to {sigma_m:.2g} m (1 σ) after {path_m:.1f} m of path "
            f"({share:.0%}, at most {_MAX_SIGMA_SHARE:.0%} is usual)",
            suggestion="come back to known places, so that loops hold the path",
            weight="break" if share > _BROKEN_SIGMA_SHARE else "doubt",
        )


def _wide_steps(results: RunResults, timeline: _TimeLine) -> Iterator[RunWarning]:
    """Yield a warning if two parts of the path hang together by steps that little is known of."""
    try:
        relative = marginals_of(results.graph).relative
    except GraphError:
        return
    sigmas = {
        nodes: np.sqrt([covariance[part, part].trace() for part in (slice(3, 6), slice(0, 3))])
        for nodes, covariance in relative.items()
    }
    wide = [nodes for nodes, (m, rad) in sigmas.items() if m > _MAX_STEP_M or rad > _MAX_STEP_RAD]
    if not wide:
        return
    worst = max(wide, key=lambda nodes: float(sigmas[nodes][0]))
    stamps_ns = sorted(results.graph.stamps_ns[node] for node in worst)
    first, last = (int(index) for index in np.searchsorted(timeline.stamps_ns, stamps_ns))
    worst_m, worst_rad = sigmas[worst]
    steps = _counted(_stretches(wide, results.graph), "step")
    yield RunWarning(
        kind="uncertainty",
        sentence=f"{steps} between keyframes known to {_MAX_STEP_M:g} m or "
        f"{np.degrees(_MAX_STEP_RAD):.0f}° at best (1 σ), the worst to {worst_m:.2g} m and "
        f"{np.degrees(worst_rad):.2g}°: the parts before and after may not fit",
        where=timeline.place(first, last),
        suggestion="come back to known places, so that loops hold the path",
        weight="doubt",
    )
