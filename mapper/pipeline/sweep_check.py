"""Whether the times of a LiDAR's points are right, by how its sweeps fit each other once they are tracked."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from mapper.config.build import BuildConfig
from mapper.core.deskew import Twist, twist_between
from mapper.core.errors import FrameError
from mapper.core.frames import Scan
from mapper.core.geometry import Array
from mapper.core.timebase import NS_PER_S
from mapper.odometry.base import FrameResult
from mapper.odometry.scan_to_map.config import AnyScanOdometryConfig
from mapper.odometry.scan_to_map.scan_observation import ScanObservation, observe_scan
from mapper.odometry.scan_to_map.surroundings import adapted_to_scan
from mapper.odometry.scan_to_map.sweep_factor import Sweep, SweepFactor, fits_otherwise, sweep_factor
from mapper.run.manifest import RunWarning
from mapper.sources.base import Log
from mapper.sources.config import SourceConfig
from mapper.sources.point_times import azimuth_times_s

_PAIRS, _FEWEST_PAIRS, _SCREENED = 8, 4, 3
_APART = (1, 2, 3, 4, 6)
"""Scans between the two of a pair: so few that they see the same surfaces."""
_NEAR = 0.4  # largest distance of a pair, of the median distance of the points
_LONGEST_INTERVAL_S = 1.0  # over a longer one the mean velocity says little on that during a sweep
_TURN_S = 0.1  # of a sweep without times, as assumed: the factor then tells the true duration
_OTHERS: Mapping[bool, tuple[float, ...]] = {True: (0.5, 0.0, -1.0), False: (0.5, 1.0)}
"""Factors that are tried beside the assumed one, for points with times and without."""
_WRONG = 0.4
"""Least difference from the assumed factor that is a doubt: right times are within 0.1, and the possible
mistakes at 0, -1 and shares of a sweep."""
_LONGEST_SWEEP, _FEWEST_SCANS = 3.0, 10  # of the usual time from scan to scan, half where scans are repeated
_NEAREST = 0.15  # to a whole factor that explains itself
_POSSIBLE = (-1.5, 4.0)  # others show that poses are wrong
_BETTER, _LEAST_GAIN, _ERRORS = 0.75, 0.1, 3.0
"""Share of the pairs that have to fit better, their mean gain, and how many standard errors that has to be.
Gains of wrong times are 0.2 to 0.5."""


def sweep_warnings(source: Log, tracks: Sequence[FrameResult], config: BuildConfig) -> list[RunWarning]:
    """Return a doubt if sweeps fit each other under other times than their points have, else nothing.

    Scans without times are taken for turns of a spinning LiDAR whose file is in the order of measuring.

    Args:
        source: The log.
        tracks: Its tracked frames, in time order.
        config: Settings that tracked them; nothing is checked unless their odometry registers scans.
    """
    if source.sensor != "lidar" or not isinstance(config.odometry, AnyScanOdometryConfig):
        return []
    if overlap := _overlap(source, config.source):
        return [overlap]
    found = _measured(source, tracks, config.odometry)
    if found is None:
        return []
    measured, has_times = found
    gains = measured.gains
    mean, error = float(gains.mean()), float(gains.std(ddof=1)) / np.sqrt(len(gains))
    is_better = (gains > 0.0).mean() >= _BETTER and mean > max(_LEAST_GAIN, _ERRORS * error)
    is_possible = _POSSIBLE[0] <= measured.factor <= _POSSIBLE[1]
    if not is_better or not is_possible or abs(measured.factor - float(has_times)) < _WRONG:
        return []
    pairs = f"{(gains > 0.0).sum()} of {len(gains)} pairs of scans, by {mean:.0%}"
    if has_times:
        return [_of_times(measured.factor, pairs, config.source)]
    sweep_s = _TURN_S * measured.factor
    return [
        RunWarning(
            kind="sweep",
            sentence="points have no times, but scans are bent by the sensor's motion: they fit each other "
            f"better as turns of {sweep_s:.2g} s ({pairs})",
            suggestion=f"--set source.sweep_s={sweep_s:.2g}",
            weight="doubt",
        )
    ]


def _overlap(source: Log, config: SourceConfig) -> RunWarning | None:
    """Return a doubt if sweeps last much longer than from one scan to the next."""
    if len(source) < _FEWEST_SCANS:
        return None
    try:
        times_s = source.entry_at(len(source) // 2).scan().times_s
    except FrameError:
        return None
    interval_s = float(np.median(np.diff(source.stamps_ns))) / NS_PER_S
    lasting_s = 0.0 if times_s is None else float(np.ptp(times_s))
    if lasting_s <= _LONGEST_SWEEP * interval_s:
        return None
    return RunWarning(
        kind="sweep",
        sentence=f"the points of a scan were measured within {lasting_s:.2g} s by their times, but scans are "
        f"{interval_s:.2g} s apart: their times have another unit, or are shares of a sweep",
        suggestion=_corrected(config, interval_s / lasting_s),
        weight="doubt",
    )


def _of_times(factor: float, pairs: str, config: SourceConfig) -> RunWarning:
    how, said = f"if their points' times are multiplied by {factor:.2g}", "these have another unit or clock"
    if abs(factor) < _NEAREST:
        factor, how, said = 0.0, "if not deskewed by their points' times", "they seem to be deskewed already"
    elif abs(factor + 1.0) < _NEAREST:
        factor, how, said = -1.0, "with their points' times reversed", "these seem to count backwards"
    return RunWarning(
        kind="sweep",
        sentence=f"scans fit each other better {how} ({pairs}): {said}",
        suggestion=_corrected(config, factor),
        weight="doubt",
    )


def _corrected(config: SourceConfig, factor: float) -> str:
    """Return the setting that multiplies the times by a factor more than now."""
    if config.sweep_s is not None:
        return "" if factor <= 0.0 else f"--set source.sweep_s={factor * config.sweep_s:.2g}"
    return f"--set source.point_time_scale={factor * config.point_time_scale:.2g}"


def _measured(
    source: Log, tracks: Sequence[FrameResult], config: AnyScanOdometryConfig
) -> tuple[SweepFactor, bool] | None:
    """Return the factor on the times, and whether points have some; None where nothing contradicts these.

    A few pairs of scans are looked at first, and more only if these contradict.
    """
    moving = _Velocities(tracks)
    middle = next(iter(np.flatnonzero(moving.known)[moving.known.sum() // 2 :].tolist()), None)
    if middle is None:
        return None

    def scan(track: int) -> Scan:
        return source.entry_of(tracks[track].stamp_ns).scan()

    try:
        first = scan(middle)
        adapted = adapted_to_scan(config, first)
        has_times = first.times_s is not None
        range_m = float(np.median(np.linalg.norm(first.points_body - first.origin_body, axis=1)))
        chosen = moving.pairs(range_m)
        if len(chosen) < _FEWEST_PAIRS:
            return None
        sweeps: dict[int, Sweep] = {}

        def pairs_of(tracks_of_pairs: Sequence[tuple[int, int]]) -> list[tuple[Sweep, Sweep]]:
            for track in sorted({track for pair in tracks_of_pairs for track in pair} - sweeps.keys()):
                observation = _observed(scan(track), adapted)
                sweeps[track] = Sweep(observation, moving.twist(track), tracks[track].T_world_body)
            return [(sweeps[one], sweeps[other]) for one, other in tracks_of_pairs]

        if not fits_otherwise(pairs_of(chosen[:_SCREENED]), float(has_times)):
            return None
        return sweep_factor(pairs_of(chosen), float(has_times), _OTHERS[has_times]), has_times
    except FrameError:
        return None


def _observed(scan: Scan, config: AnyScanOdometryConfig) -> ScanObservation:
    """Return the thinned scan, with times by azimuth if it has none.

    Raises:
        FrameError: Too few points are in range, or they show no turn.
    """
    if scan.times_s is None:
        times_s = azimuth_times_s(scan.points_body, scan.origin_body, _TURN_S)
        if times_s is None:
            raise FrameError(f"scan {scan.stamp_ns}: its points are not in the order of a turning LiDAR's")
        scan = replace(scan, times_s=times_s)
    return observe_scan(scan, config)


class _Velocities:
    """Velocities at the tracked scans, by the poses before and after.

    Attributes:
        known: (N,) whether a scan's is known.
    """

    def __init__(self, tracks: Sequence[FrameResult]) -> None:
        certain = np.array(
            [
                track.node is not None and not track.doubts and not track.diagnostics.unobservable
                for track in tracks
            ],
            np.bool_,
        )
        self._poses = np.array([track.T_world_body for track in tracks]).reshape(-1, 4, 4)
        elapsed_s = np.diff([track.stamp_ns for track in tracks]) / NS_PER_S
        self._velocities, self._changes = np.zeros((len(tracks), 6)), np.zeros((len(tracks), 6))
        self.known = np.zeros(len(tracks), np.bool_)
        before: Array | None = None
        for index, interval_s in enumerate(elapsed_s.tolist()):
            after = None
            if certain[index] and certain[index + 1] and 0.0 < interval_s <= _LONGEST_INTERVAL_S:
                change = twist_between(self._poses[index], self._poses[index + 1], duration_s=interval_s)
                after = change.vector
            if before is not None and after is not None:
                share = elapsed_s[index - 1] / (elapsed_s[index - 1] + interval_s)
                self._velocities[index] = before + share * (after - before)
                self._changes[index] = after - before
                self.known[index] = True
            before = after

    def twist(self, index: int) -> Twist:
        """Return the velocity at a scan."""
        return Twist(self._velocities[index, :3], self._velocities[index, 3:])

    def pairs(self, range_m: float) -> list[tuple[int, int]]:
        """Return the pairs whose velocities differ most, less what they are uncertain, each scan in one.

        Args:
            range_m: Median distance of the points, by which rotations count.
        """
        metres = np.array([range_m] * 3 + [1.0] * 3)
        uncertain = 0.5 * np.linalg.norm(self._changes * metres, axis=1)
        found: list[tuple[float, int, int]] = []
        for apart in _APART:
            near = np.linalg.norm(self._poses[apart:, :3, 3] - self._poses[:-apart, :3, 3], axis=1)
            both = self.known[apart:] & self.known[:-apart] & (near <= _NEAR * range_m)
            differ = np.linalg.norm((self._velocities[apart:] - self._velocities[:-apart]) * metres, axis=1)
            score = differ - uncertain[apart:] - uncertain[:-apart]
            found += [(-float(score[i]), i, i + apart) for i in np.flatnonzero(both).tolist()]
        taken: set[int] = set()
        chosen: list[tuple[int, int]] = []
        for _, first, second in sorted(found):
            if len(chosen) < _PAIRS and not taken & {first, second}:
                taken |= {first, second}
                chosen.append((first, second))
        return chosen
