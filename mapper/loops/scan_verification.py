"""Whether two scans are of one place: neither may have looked through what stands in the other."""

from dataclasses import dataclass, replace
from functools import lru_cache, partial

import numpy as np
from numpy.typing import NDArray

from mapper.core.errors import ConfigError
from mapper.core.geometry import Array, Points, Transform, apply, inverse
from mapper.features.scan_view import ScanView
from mapper.graph.noise import inflated
from mapper.loops.base import Verification
from mapper.loops.closure import Discrepancy, discrepancy, exceeds
from mapper.loops.config import ScanVerificationConfig
from mapper.loops.scans import ScanPlace
from mapper.odometry.base import Seen
from mapper.registration.base import Alignment
from mapper.registration.degeneracy import degeneracy_of
from mapper.registration.hough.ground_kernels import thin
from mapper.registration.hough.ground_plane import level
from mapper.registration.hough.ground_removal import find_ground, find_obstacles
from mapper.registration.hough.object_detection import centres_of
from mapper.registration.hough.overlap_kernels import look, range_picture
from mapper.registration.hough.voting import vote
from mapper.registration.refining import refine
from mapper.registration.surfaces import Prepared, prepared

_SAME = Discrepancy(translation_m=3.0, rotation_rad=0.3)
"""Guesses nearer to a motion are taken for it: GICP would lead from there to the same."""


@dataclass(frozen=True, slots=True, eq=False)
class _Outlook:
    """What one scan has to say about a motion.

    Attributes:
        centres_level: (N, 2) metres: its constellation.
        obstacles_body: (M, 3) metres: what stands on the ground, one point per voxel.
        picture: Least range in each direction, metres.
    """

    centres_level: Array
    obstacles_body: Points
    picture: NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class _Testimony:
    """What one scan says of what stands in another.

    Attributes:
        obstacles: How many points were looked at.
        agree: How many of them lie where it saw a surface.
        through: How many of them it looked through.
    """

    obstacles: int
    agree: int
    through: int

    @property
    def agreeing(self) -> float:
        """Share of all that agrees."""
        return self.agree / max(self.obstacles, 1)

    @property
    def contradicting(self) -> float:
        """Share that contradicts, of what was not hidden."""
        return self.through / max(self.agree + self.through, 1)

    @property
    def score(self) -> float:
        """Largest where most agrees and least contradicts."""
        return self.agreeing - self.contradicting


class ScanVerifier:
    """Guesses the motion by constellations (C3), refines it by GICP, and asks both scans whether it holds.

    Points that lie together say little: any ground lies on any other, and the walls of one street on those
    of the next. What stands where the other scan saw farther says that these are two places.
    """

    def __init__(self, config: ScanVerificationConfig) -> None:
        self._config = config
        # Keyframes in a row are compared with the same places.
        self._outlook = lru_cache(config.remembered)(partial(_outlook_of, config=config))
        self._cloud = lru_cache(config.remembered)(partial(_cloud_of, config=config))

    def describe(self, seen: Seen, /) -> ScanPlace:
        """Return the scan, thin.

        Raises:
            ConfigError: It is an image's view.
        """
        if not isinstance(seen, ScanView):
            raise ConfigError("loops.kind=scans compares scans, and these are images; want places or thesis")
        config = self._config
        # A cloud is made of these points by a grid through the origin; in another one, voxels would merge.
        reach_m = config.voxel_m * np.ceil(config.reach_m / config.voxel_m)
        points_body = seen.points_body[thin(seen.points_body, config.voxel_m, reach_m)]
        levelling = level(points_body, config.constellation.levelling)
        return ScanPlace(seen.stamp_ns, points_body, levelling.T_level_body)

    def verify(self, i: ScanPlace, j: ScanPlace) -> Verification:
        """Return how scan j lies to scan i, or why they are not of one place."""
        config = self._config
        guesses = self._guesses(i, j)
        if not guesses:
            return Verification(0, "vote: nothing stands in both that could agree on a motion")
        _, guess = guesses[0]
        told = self._told(i, j, guess, margin_m=config.guess_margin_m)
        if told.reason:
            return told
        alignment = self._refined(i, j, guess)
        if not alignment.converged:
            return replace(told, reason=f"gicp: {alignment.reason}")
        T_i_j = alignment.T_target_source
        told = replace(self._told(i, j, T_i_j, margin_m=config.margin_m), rmse_m=alignment.inlier_rmse_m)
        if told.reason:
            return told
        rivals = [score for score, other in guesses if exceeds(discrepancy(other, np.eye(4), T_i_j), _SAME)]
        lead = self._score(i, j, T_i_j) - max(rivals, default=-1.0)
        if lead < config.min_lead:
            return replace(told, reason=f"rival: leads another motion by {lead:.2f}, want {config.min_lead}")
        return self._measured(told, alignment, self._cloud(j))

    def _guesses(self, i: ScanPlace, j: ScanPlace) -> list[tuple[float, Transform]]:
        """Return planar motions that what stands in both scans votes for, scored, the best first."""
        centres = self._outlook(i).centres_level, self._outlook(j).centres_level
        peaks = vote(*centres, self._config.voting)
        guesses = [inverse(i.T_level_body) @ peak.motion @ j.T_level_body for peak in peaks]
        scored = [(self._score(i, j, guess), guess) for guess in guesses]
        return sorted(scored, key=lambda of: -of[0])

    def _score(self, i: ScanPlace, j: ScanPlace, T_i_j: Transform) -> float:
        """Return how much more agrees than contradicts, for the scan that likes a guess less."""
        return min(of.score for of in self._testimonies(i, j, T_i_j, self._config.guess_margin_m))

    def _testimonies(
        self, i: ScanPlace, j: ScanPlace, T_i_j: Transform, margin_m: float
    ) -> tuple[_Testimony, _Testimony]:
        """Return what each scan says of what stands in the other."""
        outlook_i, outlook_j = self._outlook(i), self._outlook(j)
        return (
            self._testimony(outlook_i, outlook_j, T_i_j, margin_m),
            self._testimony(outlook_j, outlook_i, inverse(T_i_j), margin_m),
        )

    def _testimony(self, by: _Outlook, of: _Outlook, T_by_of: Transform, margin_m: float) -> _Testimony:
        config = self._config
        agree, through = look(
            by.picture,
            np.zeros(3),
            of.obstacles_body,
            T_by_of,
            config.direction_rad,
            margin_m,
            config.margin_ratio,
            config.min_returns,
        )
        return _Testimony(len(of.obstacles_body), agree, through)

    def _told(self, i: ScanPlace, j: ScanPlace, T_i_j: Transform, *, margin_m: float) -> Verification:
        """Return the verdict of the scan that likes the motion less."""
        config = self._config
        worse = min(self._testimonies(i, j, T_i_j, margin_m), key=lambda of: of.score)
        compared, reason = worse.agree + worse.through, ""
        if compared < config.min_compared:
            reason = f"overlap: {compared} points to compare, want {config.min_compared}"
        elif worse.agreeing < config.min_agreeing_ratio:
            reason = (
                f"overlap: {worse.agreeing:.0%} of what stands in one stands in the other, "
                f"want {config.min_agreeing_ratio:.0%}"
            )
        elif worse.contradicting > config.max_contradicting_ratio:
            reason = (
                f"sight: {worse.contradicting:.0%} of what stands in one was looked through in the other, "
                f"at most {config.max_contradicting_ratio:.0%}"
            )
        return Verification(compared, reason, worse.agree)

    def _refined(self, i: ScanPlace, j: ScanPlace, T_i_j: Transform) -> Alignment:
        for distance_m in self._config.pair_distances_m:
            alignment = refine(
                self._cloud(i),
                self._cloud(j),
                T_i_j,
                kind="gicp",
                max_pair_distance_m=distance_m,
                max_iterations=self._config.max_iterations,
            )
            if not alignment.converged:
                break
            T_i_j = alignment.T_target_source
        return alignment

    def _measured(self, told: Verification, alignment: Alignment, source: Prepared) -> Verification:
        """Return the motion as a measurement, if the surfaces hold it in every direction."""
        config = self._config
        assert alignment.information is not None  # GICP converged
        degeneracy = degeneracy_of(alignment.information, points=source.points)
        if degeneracy.is_degenerate:
            return replace(told, reason=f"degenerate: no surface shows {degeneracy.text}")
        information = inflated(alignment.information, sigma_rad=config.sigma_rad, sigma_m=config.sigma_m)
        return replace(told, T_i_j=alignment.T_target_source, information=information)


def _cloud_of(place: ScanPlace, *, config: ScanVerificationConfig) -> Prepared:
    return prepared(place.points_body, voxel_m=config.voxel_m)


def _outlook_of(place: ScanPlace, *, config: ScanVerificationConfig) -> _Outlook:
    points_body, T_level_body = place.points_body, place.T_level_body
    ground = find_ground(points_body, T_level_body, config.constellation.ground)
    obstacles, _ = find_obstacles(points_body, T_level_body, ground, config.constellation.ground)
    return _Outlook(
        centres_of(obstacles, config.constellation.centres),
        apply(inverse(T_level_body), obstacles.astype(np.float64)),
        range_picture(points_body, np.zeros(3), config.direction_rad),
    )
