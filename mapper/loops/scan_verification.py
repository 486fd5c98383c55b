"""Verification of a loop between two scans: a guess by voting, GICP, and the free-space check of both."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial

import numpy as np

from mapper.core.errors import ConfigError
from mapper.core.geometry import Array, Transform, apply, inverse, transform
from mapper.features.frame_view import FrameView, ScanView
from mapper.graph.measurement_covariance import inflated
from mapper.loops.base import Verification
from mapper.loops.closure import Discrepancy, exceeds, pose_difference
from mapper.loops.config import ScanVerificationConfig
from mapper.loops.scan_context_proposer import ScanPlace
from mapper.registration.base import Alignment
from mapper.registration.correlation import correlate
from mapper.registration.degeneracy import degeneracy_of, plane_information
from mapper.registration.free_space import FreeSpaceCheck, FreeSpaceCounts, ScanDescription, range_image
from mapper.registration.hough.description import centres_of
from mapper.registration.hough.ground import find_ground, find_obstacles, level
from mapper.registration.hough.ground_kernels import thin
from mapper.registration.hough.voting import vote
from mapper.registration.pair_refinement import refine
from mapper.registration.surfaces import Prepared, prepared

DIRECTION_RAD = 0.035
"""Resolution of the range image, two degrees: the kept points are thin."""
_MOST_STEPS = 20  # of GICP at each pair distance
CACHED_PLACES = 16
"""Places whose descriptions and search trees are kept: keyframes in a row are compared with the same ones."""
GUESS_MARGIN_M = 1.5
"""Margin of the free-space check before GICP: a guess is off by up to a bin of the accumulator."""
UNMOVED_RATIOS = (0.5, 0.75)
"""Agreeing shares from which on some, and all, of ``max_moved_ratio`` may contradict besides. Of synthetic
streets with other cars 0.61 to 0.81 agreed and 0.05 to 0.20 contradicted, of different streets 0.3 to 0.62
and 0.11 to 0.35."""
_SAME = Discrepancy(translation_m=3.0, rotation_rad=0.3)
"""A guess nearer to the motion than both counts as the same one: GICP leads from there to the same answer."""


_CELLS, _SPREAD_CELLS = 2.0, 4.0
"""Voxels of a cell of the correlation of planar scans, and by which a guess is off at most."""
_PLANAR_OFFSET_M = 4.0
"""Largest distance along x and along y at which planar scans are compared."""
_METRE_HIGH = transform(np.eye(3), np.array([0.0, 0.0, 1.0]))


@dataclass(frozen=True, slots=True, eq=False)
class _Description:
    """Description of one scan.

    Attributes:
        centres_level: (N, 2) metres, level frame: the centres that vote.
        free_space: Level frame, obstacles and rays.
    """

    centres_level: Array
    free_space: ScanDescription


class ScanVerifier:
    """Verifier of loops between scans.

    A motion is guessed by Hough voting (Nagy, Gálai & Benedek 2016, §3.3), or between planar scans by their
    correlation, refined by GICP, and accepted when the free-space check of the two scans neither contradicts
    it nor fits another guess as well.
    """

    def __init__(self, config: ScanVerificationConfig) -> None:
        self._config = config
        margin_m = 2.0 * _SPREAD_CELLS * config.voxel_m if config.is_planar else GUESS_MARGIN_M
        self._coarse, self._fine = FreeSpaceCheck(margin_m), FreeSpaceCheck(config.margin_m)
        self._description = lru_cache(CACHED_PLACES)(partial(_describe, config=config))
        self._cloud = lru_cache(CACHED_PLACES)(partial(_cloud_of, config=config))

    def describe(self, seen: FrameView, /) -> ScanPlace:
        """Return the scan, thinned.

        Raises:
            ConfigError: It is the view of an image.
        """
        if not isinstance(seen, ScanView):
            raise ConfigError("loops.kind=scans compares scans, and these are images; want places or thesis")
        config = self._config
        if config.is_planar:  # all of its rays; one metre high in the plane's scan context
            is_near = np.hypot(*seen.points_body[:, :2].T) < config.reach_m
            return ScanPlace(seen.stamp_ns, seen.points_body[is_near], _METRE_HIGH)
        # A cloud is made of these points by a grid through the origin; in another one, voxels would merge.
        reach_m = config.voxel_m * np.ceil(config.reach_m / config.voxel_m)
        points_body = seen.points_body[thin(seen.points_body, config.voxel_m, reach_m)]
        levelling = level(points_body, config.constellation.levelling)
        return ScanPlace(seen.stamp_ns, points_body, levelling.T_level_body)

    def verify(self, i: ScanPlace, j: ScanPlace) -> Verification:
        """Return the pose of scan j in scan i, or why they are not of one place."""
        guesses = self._guesses(i, j)
        if not guesses:
            return Verification(0, "vote: nothing stands in both that could agree on a motion")
        _, guess = guesses[0]
        found = self._compared(i, j, guess, self._coarse)
        return found if found.reason else self.verify_near(i, j, guess, guesses)

    def verify_near(
        self, i: ScanPlace, j: ScanPlace, guess: Transform, guesses: Sequence[tuple[float, Transform]] = ()
    ) -> Verification:
        """Return the pose of scan j in scan i near a guess, or why they are not of one place.

        Args:
            i: The known scan.
            j: The other.
            guess: (4, 4) pose of j in i.
            guesses: Scores and motions, none of which may fit as well; none of a guess by hand.
        """
        config = self._config
        alignment = refine(
            self._cloud(i),
            self._cloud(j),
            guess,
            kind="gicp",
            pair_distances_m=config.pair_distances_m,
            max_iterations=_MOST_STEPS,
        )
        if not alignment.converged:
            found = self._compared(i, j, guess, self._coarse)
            return replace(found, reason=f"gicp: {alignment.reason}")
        T_i_j = alignment.T_target_source
        found = replace(self._compared(i, j, T_i_j, self._fine), rmse_m=alignment.inlier_rmse_m)
        if found.reason:
            return found
        rivals = [score for score, other in guesses if exceeds(pose_difference(other, T_i_j), _SAME)]
        lead = _score(self._worse(i, j, T_i_j, self._coarse)) - max(rivals, default=-1.0)
        if lead < config.min_lead:
            reason = f"ambiguous: another motion is {lead:.2f} worse, want {config.min_lead}"
            return replace(found, reason=reason)
        return self._measured(found, alignment, self._cloud(j))

    def _guesses(self, i: ScanPlace, j: ScanPlace) -> list[tuple[float, Transform]]:
        """Return the planar motions with most support and their scores, the best score first."""
        config = self._config
        if config.is_planar:
            motions = correlate(
                self._cloud(i).points,
                self._cloud(j).points,
                reach_m=_PLANAR_OFFSET_M,
                cell_m=_CELLS * config.voxel_m,
                peaks=config.voting.peaks,
                apart_m=_SPREAD_CELLS * config.voxel_m,
                apart_rad=_SAME.rotation_rad,
            )
            guesses = [motion for _, motion in motions]
        else:
            centres = self._description(i).centres_level, self._description(j).centres_level
            peaks = vote(*centres, config.voting)
            guesses = [inverse(i.T_level_body) @ peak.motion @ j.T_level_body for peak in peaks]
        scored = [(_score(self._worse(i, j, guess, self._coarse)), guess) for guess in guesses]
        return sorted(scored, key=lambda of: -of[0])

    def _worse(self, i: ScanPlace, j: ScanPlace, T_i_j: Transform, check: FreeSpaceCheck) -> FreeSpaceCounts:
        """Return the counts of the scan that fits the motion less."""
        result = check.compare(self._description(i).free_space, self._description(j).free_space, T_i_j)
        return min(result.source, result.target, key=_score)

    def _compared(self, i: ScanPlace, j: ScanPlace, T_i_j: Transform, check: FreeSpaceCheck) -> Verification:
        """Return the outcome of the free-space check, by the scan that fits the motion less."""
        config = self._config
        worse, reason = self._worse(i, j, T_i_j, check), ""
        moved_ratio = np.interp(worse.agreeing_ratio, UNMOVED_RATIOS, (0.0, config.max_moved_ratio))
        limit = config.max_contradicting_ratio + float(moved_ratio)
        if worse.visible < config.min_compared:
            reason = f"overlap: {worse.visible} points to compare, want {config.min_compared}"
        elif worse.agreeing_ratio < config.min_agreeing_ratio:
            reason = (
                f"overlap: {worse.agreeing_ratio:.0%} of what stands in one stands in the other, "
                f"want {config.min_agreeing_ratio:.0%}"
            )
        elif worse.visible_contradicting_ratio > limit:
            reason = (
                f"free space: {worse.visible_contradicting_ratio:.0%} of what stands in one was looked "
                f"through in the other, at most {limit:.0%}"
            )
        return Verification(worse.visible, reason, worse.agreeing)

    def _measured(self, found: Verification, alignment: Alignment, source: Prepared) -> Verification:
        """Return the motion as a measurement, if the surfaces make every direction of it observable."""
        config = self._config
        assert alignment.information is not None  # GICP converged
        measured = alignment.information
        if config.is_planar:
            measured = measured + plane_information(source.points, like=measured)
        degeneracy = degeneracy_of(measured, points=source.points)
        if degeneracy.reason:
            return replace(found, reason=degeneracy.reason)
        information = inflated(measured, sigma_rad=config.sigma_rad, sigma_m=config.sigma_m)
        return replace(found, T_i_j=alignment.T_target_source, information=information)


def _score(counts: FreeSpaceCounts) -> float:
    """Return the share that agrees, less the share of the visible that contradicts."""
    return counts.agreeing_ratio - counts.visible_contradicting_ratio


def _cloud_of(place: ScanPlace, *, config: ScanVerificationConfig) -> Prepared:
    return prepared(place.points_body, voxel_m=config.voxel_m, is_planar=config.is_planar)


def _describe(place: ScanPlace, *, config: ScanVerificationConfig) -> _Description:
    points_body, T_level_body, origin_body = place.points_body, place.T_level_body, np.zeros(3)
    if config.is_planar:
        ranges_m = range_image(points_body, origin_body, DIRECTION_RAD)
        obstacles = apply(T_level_body, _cloud_of(place, config=config).points).astype(np.float32)
        return _Description(
            obstacles[:, :2].astype(np.float64),
            ScanDescription(T_level_body, obstacles, ranges_m, DIRECTION_RAD, origin_body),
        )
    ground = find_ground(points_body, T_level_body, config.constellation.ground)
    obstacles, _ = find_obstacles(points_body, T_level_body, ground, config.constellation.ground)
    ranges_m = range_image(points_body, origin_body, DIRECTION_RAD)
    return _Description(
        centres_of(obstacles, config.constellation.centres),
        ScanDescription(T_level_body, np.ascontiguousarray(obstacles), ranges_m, DIRECTION_RAD, origin_body),
    )
