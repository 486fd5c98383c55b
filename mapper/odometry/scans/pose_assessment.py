"""Assessment of a scan's pose by how well the log's scans fit: believed, doubtful or lost."""

from mapper.core.doubts import Doubt
from mapper.core.running_median import RunningMedian
from mapper.odometry.scans.config import ScanOdometryConfig
from mapper.odometry.scans.pose_candidate import PoseCandidate, Shares

_RECENT = 30  # recent scans over which medians are taken
_SPREADS = 4.0  # standard deviations below its median from which on a share is unusual
_FEW_SPREADS, _LITTLE = 2.0, 0.75  # standard deviations, and part of the median, that make a search worth it
_FEWEST = 5
_LEAST_OVERLAP_SPREAD = 0.04
_LEAST_AGREEMENT_SPREAD = 0.06
_MAX_CONTRADICTING, _TIMES_CONTRADICTING = 0.012, 4.0
"""Share of points in space that rays passed, none of them by a grazing ray: right poses have up to 0.007,
wrong ones 0.013 to 0.03 and more. This multiple of the log's median is allowed where people or
traffic move."""
_OTHER_PLACE, _HARDLY = 0.1, 0.2


class PoseAssessment:
    """Tests of poses against the scans that were tracked without doubt.

    Attributes:
        statistics: Statistics of these scans.
    """

    def __init__(self, config: ScanOdometryConfig) -> None:
        self._config = config
        self.statistics = FitStatistics()

    def is_suspect(self, candidate: PoseCandidate) -> bool:
        """Return whether a pose fits less than most, or is a surprise, so that others are tried."""
        return (
            candidate.jump.is_unusual
            or self.statistics.agrees_little(candidate.shares)
            or not self.fits(candidate)
        )

    def shows_less(self, candidate: PoseCandidate) -> bool:
        """Return whether the keyframe alone shows less of a scan than the log's scans do of each other."""
        return candidate.fit.overlap < self._config.usual_ratio * self.statistics.median.overlap

    def fits(self, candidate: PoseCandidate) -> bool:
        """Return whether a pose fits as the log's scans do."""
        log, shares = self.statistics, candidate.shares
        return not (
            log.has_little_overlap(shares, usual_ratio=self._config.usual_ratio)
            or log.contradicts(shares)
            or log.disagrees(shares)
        )

    def is_lost(self, candidate: PoseCandidate) -> bool:
        """Return whether next to nothing agrees, or too much speaks against the pose."""
        if self._config.lost_ratio == 0.0:
            return False
        log, shares = self.statistics, candidate.shares
        if not log.is_known:  # in a field half of the points have partners
            return shares.overlap < 0.5 * self._config.lost_ratio
        share = shares.overlap / log.median.overlap
        little = log.has_little_overlap(shares, usual_ratio=self._config.usual_ratio)
        if little and log.excludes(shares):
            return True
        speaks_against = log.contradicts(shares) or log.disagrees(shares)
        return share < (self._config.lost_ratio if speaks_against else 0.5 * self._config.lost_ratio)

    def doubts(self, candidate: PoseCandidate) -> tuple[Doubt, ...]:
        """Return what speaks against a pose; empty if it is believed.

        Little overlap alone is a new room, and a jump alone a sudden turn.
        """
        if self._config.usual_ratio == 0.0:
            return ()
        log, shares = self.statistics, candidate.shares
        little = log.has_little_overlap(shares, usual_ratio=self._config.usual_ratio)
        contradicts, disagrees = log.contradicts(shares), log.disagrees(shares)
        jumps = candidate.jump.is_unusual
        if not log.is_known:
            little = disagrees = False
        is_alone = not contradicts and little + disagrees + jumps < 2
        if is_alone and not (jumps and candidate.method == "rescued"):
            return ()
        doubts = []
        if little:
            doubts.append(
                Doubt(
                    "disagreement",
                    f"{shares.overlap:.0%} of the points agree, {log.median.overlap:.0%} is usual",
                )
            )
        if contradicts:
            doubts.append(
                Doubt(
                    "elsewhere",
                    f"{shares.contradicting:.1%} of the points stand where rays passed, "
                    f"{log.median.contradicting:.1%} is usual",
                )
            )
        if disagrees:
            doubts.append(
                Doubt(
                    "disagreement",
                    f"{shares.agreement:.0%} agree in the weakest direction, "
                    f"{log.median.agreement:.0%} is usual",
                )
            )
        if jumps:
            doubts.append(Doubt("jump", candidate.jump.text))
        return tuple(doubts)


class FitStatistics:
    """Medians and spreads of the shares of recent scans that were tracked without doubt."""

    def __init__(self) -> None:
        self._shares = [RunningMedian(memory=_RECENT) for _ in range(3)]

    def add(self, shares: Shares) -> None:
        """Add a scan's."""
        for running, share in zip(
            self._shares, (shares.overlap, shares.agreement, shares.contradicting), strict=True
        ):
            running.add(share)

    def clear(self) -> None:
        """Forget all."""
        for running in self._shares:
            running.clear()

    @property
    def is_known(self) -> bool:
        """Whether there is any scan; until then poses are searched for, but none is doubted."""
        return self._shares[0].is_known

    @property
    def median(self) -> Shares:
        """Median shares; those of a perfect fit without scans."""
        if not self.is_known:
            return Shares(overlap=1.0, agreement=1.0, contradicting=0.0)
        return Shares(*(running.median for running in self._shares))

    def has_little_overlap(self, shares: Shares, *, usual_ratio: float) -> bool:
        """Return whether the overlap is below the log's spread, and this share of its median."""
        median = self.median.overlap
        least = median - _SPREADS * self._spread(0, _LEAST_OVERLAP_SPREAD)
        return shares.overlap < min(least, usual_ratio * median)

    def disagrees(self, shares: Shares) -> bool:
        """Return whether a direction agrees less than the log's spread explains, and than half the median."""
        median = self.median.agreement
        least = median - _SPREADS * self._spread(1, _LEAST_AGREEMENT_SPREAD)
        return shares.agreement < min(least, 0.5 * median)

    def agrees_little(self, shares: Shares) -> bool:
        """Return whether a direction agrees less than most scans' do, so that a search is worth it."""
        median = self.median.agreement
        least = median - _FEW_SPREADS * self._spread(1, _LEAST_AGREEMENT_SPREAD)
        return self.is_known and shares.agreement < min(least, _LITTLE * median)

    def contradicts(self, shares: Shares) -> bool:
        """Return whether too much stands where rays passed."""
        limit = max(_MAX_CONTRADICTING, _TIMES_CONTRADICTING * self.median.contradicting)
        return shares.contradicting > limit

    def excludes(self, shares: Shares) -> bool:
        """Return whether it is another place: much stands where rays passed, a direction hardly agrees."""
        median = self.median
        return (
            shares.contradicting > _OTHER_PLACE + _TIMES_CONTRADICTING * median.contradicting
            or shares.agreement < _HARDLY * median.agreement
        )

    def _spread(self, share: int, least: float) -> float:
        running = self._shares[share]
        return max(running.sigma, least) if len(running) >= _FEWEST else least
