"""Stretches of a log whose frames show no motion, or not all of it, bridged by inertial readings."""

import itertools
from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from mapper.core.doubts import Doubt
from mapper.core.errors import GraphError
from mapper.core.geometry import Array, Transform, adjoint, inverse
from mapper.core.timebase import NS_PER_S
from mapper.core.units import OTHER_UNIT
from mapper.graph.components import component_numbers
from mapper.graph.inertial_smoothing import SmoothedPath, smooth_path
from mapper.graph.measurement_covariance import information_of
from mapper.graph.model import BetweenFactor, PoseGraph
from mapper.loops.odometry_drift import LARGEST_SIGMA_M, LARGEST_SIGMA_RAD
from mapper.odometry.base import FrameResult
from mapper.odometry.gyroscope_calibration import (
    body_readings,
    mounting_of_accelerations,
    with_body_rates,
)
from mapper.pipeline.disconnected_components import largest_component
from mapper.pipeline.tracking_result import TrackingResult
from mapper.run.graph_warnings import MAX_STEP_RAD
from mapper.run.manifest import RunWarning
from mapper.runtime.progress import SILENT, Progress
from mapper.sensing.inertial import InertialReadings
from mapper.sources.base import Accelerations, Log

_TRUSTED_MPS = 0.1
"""Standard deviation of the velocity up to which a motion that surfaces leave open is known."""
_CONTRADICTION = 25.0
"""Variance factor from which on residuals are not noise but wrong readings: 5 standard deviations."""
METHOD = "inertial"
_CERTAIN = 5.0  # standard deviations
_FAR_LESS, _LEAST_UNKNOWN_MPS = 4.0, 0.2
"""Times the path's standard deviation of the velocity, and least one, from which on it replaces that of
surfaces; below, poses keep what surfaces say of them."""
_PARTS = slice(0, 3), slice(3, 6)  # rotation and translation of a covariance


def bridge(source: Log, tracking: TrackingResult, *, progress: Progress) -> TrackingResult:
    """Return the result with what the log's inertial readings say where its frames say too little.

    Frames that were lost are placed, doubtful as nothing of them is seen, and the parts of the path on both
    sides of them are connected. Where surfaces leave a motion open, or the readings contradict the odometry,
    keyframes' factors and frames' poses become the smoothed ones; these are no longer doubtful where the
    velocity is known. All else stays as it is.

    Args:
        source: The log.
        tracking: Result of its first pass, whose graph is not solved yet.
        progress: Receives notes.
    """
    before = len(tracking.warnings)
    tracks = tracking.tracks
    calibration = tracking.gyroscope
    if calibration is None or source.accelerations is None:
        return tracking
    source, warnings, is_sign_known = check_accelerations(source, tracking)
    if warnings:
        tracking = replace(tracking, warnings=(*tracking.warnings, *warnings))
    readings = body_readings(source, calibration)
    if readings is None:
        sentence = "accelerations are not used: their unit, axes or mounting on the body are not known"
        progress.note(sentence)
        return _with_note(tracking, sentence)
    # A frame that no reading reaches from the one before begins another window, at the first known pose.
    unreached = [
        k + 1 for k, (a, b) in enumerate(pairwise(tracks)) if not readings.covers(a.stamp_ns, b.stamp_ns)
    ]
    for begin, end in pairwise([0, *unreached, len(tracks)]):
        known = [k for k in range(begin, end) if tracks[k].node is not None]
        if len(known) > 1:
            tracking = _bridge_window(tracking, readings, known[0], end - 1, is_sign_known=is_sign_known)
    for warning in tracking.warnings[before:]:
        progress.note(warning.text)
    return tracking


def check_accelerations(source: Log, tracking: TrackingResult) -> tuple[Log, tuple[RunWarning, ...], bool]:
    """Return the log with accelerations in the gyroscope's axes that point up at rest, and warnings.

    Third whether the sign is known. The path's changes of velocity tell axes and sign, which gravity alone
    does not, and whether the frames' lengths are metres; where accelerations explain too little of these
    changes, neither sign nor lengths are known. Without accelerations where their axes are not known.

    Args:
        source: The log.
        tracking: Its tracked frames, of which those of the largest part are used that surfaces place.
    """
    whole = largest_component(tracking, progress=SILENT)
    sure = tuple(track for track in whole.tracked if not track.diagnostics.unobservable)
    felt = source.accelerations
    calibration = tracking.gyroscope
    readings = None if calibration is None or felt is None else body_readings(source, calibration)
    if calibration is None or felt is None or readings is None:
        return source, (), False
    are_stated = calibration.scale > 0.0
    if not sure:
        return source if are_stated else replace(source, accelerations=None), (), False
    trajectory = replace(whole, tracks=sure).tracked_trajectory()
    warnings = []
    axes = readings.felt_axes(
        mounting_of_accelerations(source, calibration),
        trajectory.stamps_ns,
        trajectory.T_world_body,
        are_stated=are_stated,
    )
    if axes is None:
        return replace(source, accelerations=None), (), False
    if not np.array_equal(axes, np.eye(3)):
        felt = replace(felt, acceleration_mps2=felt.acceleration_mps2 @ axes.T)
        source = replace(source, accelerations=felt)
        readings = body_readings(source, calibration)
        sentence = (
            f"the accelerometer's axes are not the gyroscope's, as the path shows; {_named(axes)} is used"
        )
        warnings.append(RunWarning(kind="imu", sentence=sentence))
    found = readings and readings.path_scale(trajectory.stamps_ns, trajectory.T_world_body)
    if not found:
        return source, tuple(warnings), False
    scale, sigma = found
    if scale < -_CERTAIN * sigma:
        source = replace(source, accelerations=replace(felt, acceleration_mps2=-felt.acceleration_mps2))
        sentence = "accelerations have the opposite sign, as changes of velocity show; they are used reversed"
        warnings.append(RunWarning(kind="imu", sentence=sentence))
    if abs(np.log(abs(scale))) > np.log(OTHER_UNIT) and abs(scale) > _CERTAIN * sigma:
        setting = "source.camera.depth_factor" if source.sensor == "rgbd" else "source.cloud_scale"
        warnings.append(
            RunWarning(
                kind="imu",
                sentence=f"by the accelerations the path is {1.0 / abs(scale):.2g} times as long as by the "
                "frames: their lengths may not be metres",
                suggestion=f"{setting}, by which lengths become metres",
                weight="doubt",
            )
        )
    return source, tuple(warnings), True


def _named(axes: Array) -> str:
    """Return what axes are in those of readings, as (y, -x, z)."""
    names = [("-" if axis.sum() < 0.0 else "") + "xyz"[int(np.abs(axis).argmax())] for axis in axes]
    return f"({', '.join(names)})"


def with_body_readings(source: Log, tracking: TrackingResult) -> Log:
    """Return the log with what its inertial unit measures of the body, as far as the path shows that."""
    if tracking.gyroscope is None:
        return source
    checked, _, is_sign_known = check_accelerations(source, tracking)
    readings = body_readings(checked, tracking.gyroscope)
    if readings is not None:
        felt = Accelerations(
            readings.stamps_ns,
            readings.accelerations_mps2,
            are_axes_stated=True,
            are_checked=is_sign_known,
        )
        source = replace(source, accelerations=felt)
    return with_body_rates(source, tracking.gyroscope)


def _is_weak(track: FrameResult) -> bool:
    return track.node is None or bool(track.diagnostics.unobservable) or _is_open(track)


def _is_open(track: FrameResult) -> bool:
    return any(doubt.kind == "unobservable" for doubt in track.doubts)


@dataclass(frozen=True, slots=True, eq=False)
class _Window:
    """Frames that inertial readings reach, as the problem of ``smooth_path``.

    Attributes:
        tracks: The frames, of which the first is placed.
        index_of: Index of each node: that of its frame, or, before the window, one after all frames.
        poses: Pose of each frame that is placed, and of each node, by its index.
        part_of: Number of the part of the path, by index.
        factors: The odometry's measurements between them.
    """

    tracks: Sequence[FrameResult]
    index_of: Mapping[int, int]
    poses: Mapping[int, Transform]
    part_of: Mapping[int, int]
    factors: Sequence[BetweenFactor]


def _window_of(tracks: Sequence[FrameResult], graph: PoseGraph, part_of_node: Mapping[int, int]) -> _Window:
    frame_at = {track.stamp_ns: k for k, track in enumerate(tracks)}
    nodes = sorted({track.node for track in tracks if track.node is not None})
    later = itertools.count(len(tracks))
    at = [frame_at.get(graph.stamps_ns[node]) for node in nodes]
    index_of = {node: next(later) if index is None else index for node, index in zip(nodes, at, strict=True)}
    poses = {index: graph.T_world_node[node] for node, index in index_of.items()}
    part_of = {index: part_of_node[node] for node, index in index_of.items()}
    factors = [
        replace(factor, i=index_of[factor.i], j=index_of[factor.j])
        for factor in graph.factors
        if factor.origin != "loop" and factor.i in index_of and factor.j in index_of
    ]
    for k, track in enumerate(tracks):
        if track.node is None or k in poses:
            continue
        poses[k] = graph.T_world_node[track.node] @ track.T_node_body
        part_of[k] = part_of_node[track.node]
        if track.covariance is not None and (not track.doubts or _is_open(track)):
            information = information_of(track.covariance)
            factors.append(BetweenFactor(index_of[track.node], k, track.T_node_body, information))
    held = {index for factor in factors for index in (factor.i, factor.j)}
    poses = {index: T for index, T in poses.items() if index < len(tracks) or index in held}
    return _Window(tracks, index_of, poses, part_of, factors)


def _bridge_window(
    tracking: TrackingResult, readings: InertialReadings, first: int, last: int, *, is_sign_known: bool
) -> TrackingResult:
    """Return the result with the smoothed poses of the weak frames first … last."""
    graph, part_of_node = tracking.graph, component_numbers(tracking.graph.without_loops())
    window = _window_of(tracking.tracks[first : last + 1], graph, part_of_node)
    tracks, factors = window.tracks, window.factors
    weak = np.array([_is_weak(track) for track in tracks])
    stamps_ns = np.array([track.stamp_ns for track in tracks], np.int64)
    try:
        path = smooth_path(stamps_ns, window.poses, window.part_of, factors, readings)
        if not is_sign_known:
            reversed_ = replace(readings, accelerations_mps2=-readings.accelerations_mps2)
            other = smooth_path(stamps_ns, window.poses, window.part_of, factors, reversed_)
            path = min(path, other, key=lambda one: one.variance_factor)
    except GraphError as error:
        return _with_note(tracking, f"accelerations are not used: {error}") if weak.any() else tracking
    if path.variance_factor > _CONTRADICTION:
        return _with_note(
            tracking,
            "accelerations are not used: with the angular velocities they contradict the path of the frames "
            f"by {np.sqrt(path.variance_factor):.0f} standard deviations; are their axes and clock right?",
        )
    inside = {node: index for node, index in window.index_of.items() if index < len(tracks)}
    for factor in factors:
        later = max(factor.i, factor.j)
        if later < len(tracks) and path.contradicts(factor):
            weak[later] = True
    weak |= _know_less(tracks, path, inside.values())
    changed = _place_frames(tracks, weak, path, inside)
    replaced = _replace_factors(graph, weak, path, inside)
    connected = _connect_parts(replaced, part_of_node, path, inside)
    if weak.any():
        lost = sum(track.node is None for track in tracks)
        placed = lost - sum(track.node is None for track in changed)
        tracking = _with_note(
            tracking,
            f"by the IMU {placed} of {lost} lost frames are placed, the motion of {weak.sum() - lost} that "
            "surfaces leave open or it contradicts is smoothed, and "
            f"{len(connected.factors) - len(replaced.factors)} parts of the path are connected; it knows the "
            f"velocity to ±{path.velocity_sigmas_mps[weak].max():.2g} m/s",
        )
    return replace(
        tracking,
        tracks=(*tracking.tracks[:first], *changed, *tracking.tracks[last + 1 :]),
        graph=connected,
    )


def _know_less(tracks: Sequence[FrameResult], path: SmoothedPath, nodes: Container[int]) -> NDArray[np.bool_]:
    """Return the (N,) frames whose motion since a node surfaces know far less than the smoothed path does."""
    less, last_node = np.zeros(len(tracks), np.bool_), -1
    for k, track in enumerate(tracks):
        if track.covariance is not None and last_node >= 0:
            elapsed_s = (track.stamp_ns - tracks[last_node].stamp_ns) / NS_PER_S
            sigma_mps = max(_FAR_LESS * path.velocity_sigmas_mps[k], _LEAST_UNKNOWN_MPS)
            variance_rad2, variance_m2 = (np.trace(track.covariance[part, part]) for part in _PARTS)
            less[k] = variance_rad2 > MAX_STEP_RAD**2 or variance_m2 > (sigma_mps * elapsed_s) ** 2
        if k in nodes:
            last_node = k
    return less


def _with_note(tracking: TrackingResult, sentence: str) -> TrackingResult:
    return replace(tracking, warnings=(*tracking.warnings, RunWarning(kind="imu", sentence=sentence)))


def _place_frames(
    tracks: Sequence[FrameResult], weak: NDArray[np.bool_], path: SmoothedPath, index_of: Mapping[int, int]
) -> list[FrameResult]:
    """Return the results of a window's frames, weak ones at their smoothed poses relative to a node."""
    node_of = {index: node for node, index in index_of.items()}
    changed, before = [], -1
    for k, track in enumerate(tracks):
        before = k if k in node_of else before
        if not weak[k] or before < 0:
            changed.append(track)
            continue
        is_known = path.velocity_sigmas_mps[k] <= _TRUSTED_MPS
        doubts = tuple(doubt for doubt in track.doubts if doubt.kind != "unobservable" or not is_known)
        if track.is_keyframe:
            changed.append(replace(track, doubts=doubts))
            continue
        covariance = path.covariance(before, k)
        if track.node is None and not _is_useful(covariance):
            changed.append(track)
            continue
        if track.node is None:
            off_m = float(np.sqrt(np.linalg.eigvalsh(covariance[3:, 3:])[-1]))
            doubts = (Doubt("unobservable", f"nothing is seen, placed by the IMU to ±{off_m:.2g} m"),)
            track = replace(track, diagnostics=replace(track.diagnostics, method=METHOD))
        changed.append(
            replace(
                track,
                node=node_of[before],
                T_node_body=inverse(path.T_world_body[before]) @ path.T_world_body[k],
                covariance=covariance,
                doubts=doubts,
            )
        )
    return changed


def _replace_factors(
    graph: PoseGraph, weak: NDArray[np.bool_], path: SmoothedPath, index_of: Mapping[int, int]
) -> PoseGraph:
    """Return the graph with one smoothed factor to each weak node, in place of the odometry's.

    The errors of consecutive ones are those of one velocity, not independent: their covariances grow until
    their sum is that of the whole stretch.
    """
    ends: dict[int, tuple[int, int]] = {}
    for number, factor in enumerate(graph.factors):
        if factor.origin == "odometry" and factor.i in index_of and factor.j in index_of:
            i, j = index_of[factor.i], index_of[factor.j]
            if weak[max(i, j)]:
                ends[number] = i, j
    nearest = {max(ends[number]): number for number in sorted(ends, key=lambda number: min(ends[number]))}
    smoothed: dict[int, BetweenFactor] = {}
    for chain in _chains({number: ends[number] for number in nearest.values()}):
        for number, covariance in zip(chain, _covariances(path, [ends[k] for k in chain]), strict=True):
            factor = graph.factors[number]
            smoothed[number] = _factor(path, factor.i, factor.j, *ends[number], covariance)
    kept = enumerate(graph.factors)
    return graph.with_factors(smoothed.get(k, f) for k, f in kept if k in smoothed or k not in ends)


def _connect_parts(
    graph: PoseGraph, part_of: Mapping[int, int], path: SmoothedPath, index_of: Mapping[int, int]
) -> PoseGraph:
    """Return the graph with a factor between parts that follow each other, the later moved to its place."""
    by_time = sorted(index_of.items(), key=lambda one: one[1])
    joined = dict(part_of)
    for (a, i), (b, j) in pairwise(by_time):
        if joined[a] == joined[b]:
            continue
        covariance = path.covariance(i, j)
        if not _is_useful(covariance):
            continue
        factor = _factor(path, a, b, i, j, covariance)
        T_new_old = graph.T_world_node[a] @ factor.T_i_j @ inverse(graph.T_world_node[b])
        moved = {node for node, part in joined.items() if part == joined[b]}
        joined |= dict.fromkeys(moved, joined[a])
        graph = graph.with_poses(
            {node: T_new_old @ T if node in moved else T for node, T in graph.T_world_node.items()}
        )
        others, loops = graph.without_loops().factors, graph.loops
        graph = graph.with_factors([*others, factor, *loops])
    return graph


def _is_useful(covariance: Array) -> bool:
    """Return whether a motion is known better than loops take a step to be of which nothing is seen."""
    rad2, m2 = (np.linalg.eigvalsh(covariance[part, part])[-1] for part in _PARTS)
    return bool(rad2 <= LARGEST_SIGMA_RAD**2 and m2 <= LARGEST_SIGMA_M**2)


def _factor(path: SmoothedPath, a: int, b: int, i: int, j: int, covariance: Array) -> BetweenFactor:
    """Return the factor between nodes a and b, whose poses are those of times i and j."""
    T_i_j = inverse(path.T_world_body[i]) @ path.T_world_body[j]
    return BetweenFactor(a, b, T_i_j, information_of(covariance))


def _chains(ends: Mapping[int, tuple[int, int]]) -> list[list[int]]:
    """Return the factors, given by their ends, in chains in which each begins where the one before ends."""
    chains: list[list[int]] = []
    for number in sorted(ends, key=lambda k: ends[k][1]):
        if chains and ends[chains[-1][-1]][1] == ends[number][0]:
            chains[-1].append(number)
        else:
            chains.append([number])
    return chains


def _covariances(path: SmoothedPath, ends: Sequence[tuple[int, int]]) -> list[Array]:
    """Return the covariances of a chain of motions, grown until their sum is at least that of the whole."""
    from scipy.linalg import eigh

    whole = path.covariance(ends[0][0], ends[-1][1])
    T_world_end = path.T_world_body[ends[-1][1]]
    to_end = [adjoint(inverse(T_world_end) @ path.T_world_body[j]) for _, j in ends]
    single = [path.covariance(i, j) for i, j in ends]
    ratios, axes = eigh(whole, sum(Ad @ C @ Ad.T for Ad, C in zip(to_end, single, strict=True)))
    growth = np.linalg.inv(axes).T @ np.diag(np.sqrt(np.maximum(ratios, 1.0))) @ axes.T
    grown = [np.linalg.solve(Ad, growth @ Ad) for Ad in to_end]
    return [G @ C @ G.T for G, C in zip(grown, single, strict=True)]
