"""Warnings about a run, all of them, from its results, and the verdict that follows from them."""

from collections import Counter
from collections.abc import Iterator, Sequence

import numpy as np

from mapper.core.geometry import angle_between, angle_of
from mapper.core.timebase import GAP_INTERVALS, NS_PER_S, stretches
from mapper.core.trajectory import Trajectory
from mapper.navigation.config import TraversableConfig
from mapper.odometry.base import see_more
from mapper.run.doubtful_frames import MAX_GAP_NS
from mapper.run.frame_records import DISCONNECTED, FrameRecord
from mapper.run.graph_warnings import (
    HARMLESS_M,
    MAX_DRIFT_SHARE,
    loop_warnings,
    step_warnings,
    uncertainty_warnings,
    ways_to_hold,
    wheel_warnings,
)
from mapper.run.manifest import Manifest, RunWarning, Verdict, Weight
from mapper.run.results import RunResults, with_truth
from mapper.run.timeline import MAX_SHARE, TimeLine, counted

FLOOR, DEPTH_TIME = "floor", "depth time"
"""Kinds that are found each time a run is fused; the second after tracking, too."""
INPUT_KINDS = frozenset(
    {
        "log",
        "stamps",
        "depth",
        "frame",
        "camera",
        "shutter",
        "imu",
        "gnss",
        "sweep",
        "frozen",
        "far returns",
        "conflict",
        "mounting",
        "level",
        FLOOR,
        DEPTH_TIME,
    }
)
"""Kinds that are found while the log is read or fused; a finished run has them in its manifest alone."""

_ORDER: tuple[Weight, ...] = ("break", "doubt", "note")
_LEAST_GAP_S = 0.5
_BROKEN_SHARE, _FEW_FRAMES = 0.25, 2
_LONG_FRAMES = 3
_MIN_COUNTED_DEPTH = 0.5
_LEAST_AGREEMENT, _LEAST_SHARED_VOXELS = 0.15, 1000
_MAX_TURN_SHARE, _LEAST_TURN_RAD, _NO_TURN_RAD = 0.5, np.radians(2.0), 1e-6
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
    doubtful = list(_doubtful(results, timeline))
    # Where surfaces leave motions open, the path is uncertain for the same reason.
    suggestion = next(
        (warning.suggestion for warning in doubtful if warning.suggestion), ways_to_hold(results)
    )
    found = [
        *known,
        *(RunWarning(kind="log", sentence=note) for note in notes if note not in reported),
        *_skipped(results.records, manifest),
        *_gaps(timeline),
        *_lost(results, timeline),
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
    """Return the verdict: the heaviest weight of any warning, and the sentences above a note.

    To these come the notes on the log and on its depth's time: what was assumed may be the cause.
    """
    heavy = [warning for warning in warnings if warning.weight != "note"]
    weights = {warning.weight for warning in heavy}
    state = "broken in parts" if "break" in weights else "doubtful" if "doubt" in weights else "trusted"
    known = [one for one in warnings if one.kind in ("log", DEPTH_TIME) and one.weight == "note"]
    causes = [f"a possible cause: {warning.text}" for warning in known] if heavy else []
    return Verdict(state=state, sentences=(*(warning.text for warning in heavy), *causes))


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
        *_doubtful(results, timeline),
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
        f"too little of the map was recognised (at most {MAX_SHARE:.0%} is harmless)",
        suggestion="come by places that the map shows, seen from where it was recorded",
        where=timeline.place(first, last),
        weight="break" if share > _BROKEN_SHARE else "doubt" if share > MAX_SHARE else "note",
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
        suggestion="repair the log, or record it again" if share > MAX_SHARE else "",
        weight="doubt" if share > MAX_SHARE else "note",
    )


def _gaps(timeline: TimeLine) -> Iterator[RunWarning]:
    pauses_ns = np.diff(timeline.stamps_ns)
    limit_ns = max(GAP_INTERVALS * timeline.usual_ns, _LEAST_GAP_S * NS_PER_S)
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


def _lost(results: RunResults, timeline: TimeLine) -> Iterator[RunWarning]:
    records = results.records
    left_out = [record for record in records if record.diagnostics.method == DISCONNECTED]
    if left_out:
        wheels = "" if results.graph.has_wheels else ", or record wheel odometry"
        yield RunWarning(
            kind="left out",
            sentence=f"{len(left_out)} of {len(records)} frames lie in parts of the path that nothing "
            "connects to the rest; they are left out",
            suggestion=f"show a known place again after a loss{wheels}",
            weight="break",
        )
    is_lost = [record.outcome == "lost" and record.diagnostics.method != DISCONNECTED for record in records]
    lost = sum(is_lost)
    if not lost:
        return
    share = lost / len(records)
    first, last = _longest(is_lost, timeline)
    is_long = _is_long(first, last, timeline)
    yield RunWarning(
        kind="lost",
        sentence=f"{lost} of {len(records)} frames were lost, {share:.1%}, for "
        f"{timeline.duration_s(first, last):.1f} s at the longest (at most {MAX_SHARE:.0%} and "
        f"{MAX_GAP_NS / NS_PER_S:g} s are harmless)",
        where=timeline.place(first, last),
        weight="break"
        if share > _BROKEN_SHARE or is_long
        else "doubt"
        if lost > _FEW_FRAMES and share > MAX_SHARE
        else "note",
    )


def _doubtful(results: RunResults, timeline: TimeLine) -> Iterator[RunWarning]:
    records = results.records
    is_doubtful = [record.outcome == "doubtful" for record in records]
    doubtful = [record for record in records if record.outcome == "doubtful"]
    if not doubtful:
        return
    placed = sum(record.node is not None for record in records)
    counted = len(doubtful) - _repeated(records, is_doubtful)
    first, last = _longest(is_doubtful, timeline)
    are_too_many = counted > max(_FEW_FRAMES, MAX_SHARE * placed) or _is_long(first, last, timeline)
    unseen = sum(bool(record.diagnostics.unobservable) for record in doubtful)
    doubts = [doubt for record in doubtful for doubt in record.doubts]
    examples = {doubt.kind: doubt.text for doubt in reversed(doubts)}
    kinds = Counter(doubt.kind for doubt in doubts)
    texts = [f"{examples[kind]} ({count})" for kind, count in kinds.most_common(_REASONS)]
    is_unseen = are_too_many and 2 * unseen > len(doubtful)
    yield RunWarning(
        kind="doubtful",
        sentence=f"{len(doubtful)} of {placed} placed frames are doubtful, {len(doubtful) / placed:.1%}, for "
        f"{timeline.duration_s(first, last):.1f} s at the longest (at most {MAX_SHARE:.0%} and "
        f"{MAX_GAP_NS / NS_PER_S:g} s are harmless): {'; '.join(texts)}",
        suggestion=see_more(has_wheels=results.graph.has_wheels) if is_unseen else "",
        where=timeline.place(first, last),
        weight="doubt" if are_too_many else "note",
    )


def _longest(flags: Sequence[bool], timeline: TimeLine) -> tuple[int, int]:
    """Return the frames around the longest stretch of flagged ones."""
    return max(stretches(flags, margin=1), key=lambda run: timeline.duration_s(*run))


def _is_long(first: int, last: int, timeline: TimeLine) -> bool:
    return timeline.duration_s(first, last) > MAX_GAP_NS / NS_PER_S and last - first > _LONG_FRAMES


def _repeated(records: Sequence[FrameRecord], is_doubtful: Sequence[bool]) -> int:
    """Return how many frames only repeat the one or two before them: those around hold their poses."""
    return sum(
        last + 1 - first
        for first, last in stretches(is_doubtful)
        if last - first < _FEW_FRAMES  # drivers repeat a frame or two when a sensor is late
        and all(doubt.kind == "repeated image" for k in range(first, last + 1) for doubt in records[k].doubts)
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
    """Yield warnings if the path or its turns are far from the true ones: one of the two is wrong."""
    pairs = None if results.truth is None else with_truth(results.truth, results.tracked)
    if pairs is None:
        return
    estimated, known = pairs
    rmse_m = float(np.sqrt(((estimated.positions_world - known.positions_world) ** 2).sum(axis=1).mean()))
    path_m = min(estimated.path_length_m, known.path_length_m)  # errors make a path longer
    suggestion = "mapper report, to see where; check that the truth is of this log and in its clock"
    if rmse_m > max(MAX_DRIFT_SHARE * path_m, HARMLESS_M):
        yield RunWarning(
            kind="truth",
            sentence=f"frames without doubt are {rmse_m:.2f} m (RMSE) from the true poses, on {path_m:.1f} m "
            f"of path (doubt from {MAX_DRIFT_SHARE:.0%} and {HARMLESS_M:g} m on): one of both is wrong",
            suggestion=suggestion,
            weight="doubt",
        )
    error_rad, turned_rad = _turn_errors(estimated, known)
    if error_rad > max(_MAX_TURN_SHARE * turned_rad, _LEAST_TURN_RAD):
        yield RunWarning(
            kind="truth",
            sentence=f"turns of a second are {np.degrees(error_rad):.1f}° (RMSE) from the true ones of "
            f"{np.degrees(turned_rad):.1f}° (doubt from {_MAX_TURN_SHARE:.0%} and "
            f"{np.degrees(_LEAST_TURN_RAD):.0f}° on): one of both is wrong",
            suggestion=f"{suggestion}; are the images mirrored, its quaternions w first, or its poses "
            "inverse or of another frame?",
            weight="doubt",
        )


def _turn_errors(estimated: Trajectory, known: Trajectory) -> tuple[float, float]:
    """Return the RMS angle between estimated and true turns of a second, and of the true ones, radians.

    Both are 0 where the truth has no rotations, or nothing lasts a second.
    """
    ends = np.searchsorted(known.stamps_ns, known.stamps_ns + NS_PER_S)
    windows = [(begin, end) for begin, end in enumerate(ends.tolist()) if end < len(known)]
    of_truth = [known.T_world_body[i, :3, :3].T @ known.T_world_body[j, :3, :3] for i, j in windows]
    turned_rad = np.array([angle_of(turn) for turn in of_truth])
    if turned_rad.max(initial=0.0) < _NO_TURN_RAD:
        return 0.0, 0.0
    R = estimated.T_world_body[:, :3, :3]
    errors_rad = [angle_between(R[i].T @ R[j], turn) for (i, j), turn in zip(windows, of_truth, strict=True)]
    return float(np.sqrt(np.mean(np.square(errors_rad)))), float(np.sqrt(np.mean(turned_rad**2)))
