"""Warnings about a run, all of them, from its results."""

from collections import Counter
from collections.abc import Iterator, Sequence

import numpy as np

from mapper.core.geometry import path_length
from mapper.core.timebase import NS_PER_S, stretches
from mapper.navigation.config import TraversableConfig
from mapper.odometry.base import SEE_MORE
from mapper.run.frame_outcomes import DISCONNECTED, FrameRecord
from mapper.run.graph_warnings import (
    COME_BACK,
    loop_warnings,
    step_warnings,
    uncertainty_warnings,
    wheel_warnings,
)
from mapper.run.manifest import Manifest, RunWarning, Verdict, Weight
from mapper.run.results import RunResults, with_truth
from mapper.run.timeline import TimeLine, counted

FLOOR = "floor"
INPUT_KINDS = frozenset(
    {"log", "depth", "camera", "shutter", "imu", "sweep", "frozen", "far returns", "conflict", "level", FLOOR}
)
"""Kinds that are found while the log is read or fused; a finished run has them in its manifest alone."""

_ORDER: tuple[Weight, ...] = ("break", "doubt", "note")
_GAP_INTERVALS, _LEAST_GAP_S = 3.0, 0.5
_MAX_SKIPPED_SHARE = 0.1
_MAX_LOST_SHARE, _BROKEN_LOST_SHARE = 0.02, 0.25
_BROKEN_LOST_S, _BROKEN_LOST_FRAMES = 2.0, 3
_MAX_DOUBTFUL_SHARE, _FEW_FRAMES = 0.02, 2
_MIN_COUNTED_DEPTH = 0.5
_LEAST_AGREEMENT, _LEAST_SHARED_VOXELS = 0.15, 1000
_MAX_ERROR_SHARE, _LEAST_ERROR_M = 0.03, 0.1
_REASONS = 3


def find_warnings(results: RunResults, manifest: Manifest) -> list[RunWarning]:
    """Return all that is suspicious about a run, what weighs most first.

    What was found while the log was read is taken from the manifest, all else is worked out anew.
    docs/verdict.md lists the kinds and their limits.

    Args:
        results: Results of the solved run.
        manifest: Manifest with the input's notes, the skipped frames and the levelling.
    """
    known = [warning for warning in manifest.warnings if warning.kind in INPUT_KINDS]
    reported = {warning.sentence for warning in known}
    notes = [note for source in (manifest.input, *manifest.input.appended) for note in source.notes]
    timeline = TimeLine.of(results, manifest)
    doubtful = list(_doubtful(results.records, timeline))
    # Where surfaces leave motions open, the path is uncertain for the same reason.
    suggestion = next((warning.suggestion for warning in doubtful if warning.suggestion), COME_BACK)
    found = [
        *known,
        *(RunWarning(kind="log", sentence=note) for note in notes if note not in reported),
        *_skipped(results.records, manifest),
        *_gaps(timeline),
        *_lost(results.records, timeline),
        *doubtful,
        *loop_warnings(results),
        *_levelling(manifest),
        *_depth_reach(manifest),
        *wheel_warnings(results),
        *uncertainty_warnings(results, suggestion),
        *step_warnings(results, timeline, suggestion),
        *_truth(results),
    ]
    return sorted(found, key=lambda warning: _ORDER.index(warning.weight))


def verdict_of(warnings: Sequence[RunWarning]) -> Verdict:
    """Return the verdict: the heaviest weight of any warning, and the sentences above a note."""
    heavy = [warning for warning in warnings if warning.weight != "note"]
    weights = {warning.weight for warning in heavy}
    state = "broken in parts" if "break" in weights else "doubtful" if "doubt" in weights else "trusted"
    return Verdict(state=state, sentences=tuple(warning.text for warning in heavy))


def merge_warnings(name: str, *, agreement: float | None, shared_voxels: int) -> list[RunWarning]:
    """Return a warning if a run's walls are not where those of the runs merged before it are.

    Args:
        name: Name of the run.
        agreement: Share occupied in both, of the shared voxels that are occupied in either.
        shared_voxels: Number of voxels that are known in both.
    """
    if agreement is None or shared_voxels < _LEAST_SHARED_VOXELS or agreement >= _LEAST_AGREEMENT:
        return []
    return [
        RunWarning(
            kind="merge",
            sentence=f"{name}: {agreement:.0%} of its walls are where those of the runs before it are, of "
            f"{shared_voxels} voxels known in both (at least {_LEAST_AGREEMENT:.0%} is usual): "
            "are the runs of one world?",
            suggestion="--place auto, --place truth, or --poses FILE",
            weight="doubt",
        )
    ]


def localisation_warnings(results: RunResults, manifest: Manifest) -> list[RunWarning]:
    """Return all that is suspicious about a log that was localised in a map, what weighs most first.

    Args:
        results: Results of the localised log; a frame without a known pose in the map is lost.
        manifest: Manifest with the input's notes and the skipped frames.
    """
    timeline, records = TimeLine.of(results, manifest), results.records
    found = [
        *(warning for warning in manifest.warnings if warning.kind in INPUT_KINDS),
        *_skipped(records, manifest),
        *_gaps(timeline),
        *_not_localised(records, timeline),
        *_doubtful(records, timeline),
    ]
    return sorted(found, key=lambda warning: _ORDER.index(warning.weight))


def _not_localised(records: Sequence[FrameRecord], timeline: TimeLine) -> Iterator[RunWarning]:
    is_lost = [record.outcome == "lost" for record in records]
    if not any(is_lost):
        return
    share = sum(is_lost) / len(records)
    first, last = max(stretches(is_lost), key=lambda run: timeline.duration_s(*run))
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
        has_path: Whether the height of the floor is known from the path.
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


def _gaps(timeline: TimeLine) -> Iterator[RunWarning]:
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
        sentence=f"the log has {counted(len(gaps), 'gap')}, {total_s:.1f} s in all, the longest "
        f"{pauses_ns[longest] / NS_PER_S:.1f} s; frames come every {timeline.usual_ns / NS_PER_S:.2g} s",
        where=timeline.place(longest, longest + 1),
    )


def _lost(records: Sequence[FrameRecord], timeline: TimeLine) -> Iterator[RunWarning]:
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
    first, last = max(stretches(is_lost, margin=1), key=lambda run: timeline.duration_s(*run))
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


def _doubtful(records: Sequence[FrameRecord], timeline: TimeLine) -> Iterator[RunWarning]:
    doubtful = [record for record in records if record.outcome == "doubtful"]
    if not doubtful:
        return
    placed = sum(record.node is not None for record in records)
    are_too_many = len(doubtful) > max(_FEW_FRAMES, _MAX_DOUBTFUL_SHARE * placed)
    unseen = sum(bool(record.diagnostics.unobservable) for record in doubtful)
    doubts = [doubt for record in doubtful for doubt in record.doubts]
    examples = {doubt.kind: doubt.text for doubt in reversed(doubts)}
    kinds = Counter(doubt.kind for doubt in doubts)
    texts = [f"{examples[kind]} ({count})" for kind, count in kinds.most_common(_REASONS)]
    first, last = max(
        stretches([record.outcome == "doubtful" for record in records]), key=lambda run: run[1] - run[0]
    )
    yield RunWarning(
        kind="doubtful",
        sentence=f"{len(doubtful)} of {placed} placed frames are doubtful, {len(doubtful) / placed:.1%} "
        f"(at most {_MAX_DOUBTFUL_SHARE:.0%} are usual): {'; '.join(texts)}",
        suggestion=SEE_MORE if are_too_many and 2 * unseen > len(doubtful) else "",
        where=timeline.place(first, last),
        weight="doubt" if are_too_many else "note",
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


def _truth(results: RunResults) -> Iterator[RunWarning]:
    """Yield a warning if the path is far from the true poses: one of the two is wrong."""
    pairs = None if results.truth is None else with_truth(results.truth, results.tracked)
    if pairs is None:
        return
    estimated, known = pairs
    rmse_m = float(np.sqrt(((estimated.positions_world - known) ** 2).sum(axis=1).mean()))
    true_path_m = path_length(known)
    path_m = min(estimated.path_length_m, true_path_m)  # errors make a path longer
    if rmse_m > max(_MAX_ERROR_SHARE * path_m, _LEAST_ERROR_M):
        yield RunWarning(
            kind="truth",
            sentence=f"frames without doubt are {rmse_m:.2f} m (RMSE) from the true poses, on {path_m:.1f} m "
            f"of path (doubt from {_MAX_ERROR_SHARE:.0%} and {_LEAST_ERROR_M:g} m on): one of both is wrong",
            suggestion="mapper report, to see where; check that the truth is of this log and in its clock",
            weight="doubt",
        )
