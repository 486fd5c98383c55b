"""Whether two scans are of one place: what stands in one has to stand in the other."""

from dataclasses import dataclass, replace
from functools import lru_cache, partial

import cv2
import numpy as np
from numpy.typing import NDArray

from mapper.config.loops import OverlapConfig
from mapper.errors import ConfigError
from mapper.features.scan_view import ScanView
from mapper.geometry import Array, Transform, apply, inverse
from mapper.graph.noise import softened
from mapper.loops.base import Verification
from mapper.loops.scans import ScanPlace
from mapper.odometry.base import Seen
from mapper.registration.base import Alignment
from mapper.registration.degeneracy import degeneracy_of
from mapper.registration.gicp import Prepared, prepared, refine
from mapper.registration.ground import find_ground, find_obstacles
from mapper.registration.kernels import thin
from mapper.registration.levelling import level
from mapper.registration.objects import centres_of
from mapper.registration.voting import vote

_UPRIGHT = 0.7
"""Largest vertical part of an upright surface's unit normal."""


@dataclass(frozen=True, slots=True, eq=False)
class _Plan:
    """A place seen from above.

    Attributes:
        centres_level: (N, 2) metres: its constellation.
        is_taken: (E, E) bool: something stands in or next to a cell of a centred grid, rows along y.
        cell_m: Edge of a cell.
    """

    centres_level: Array
    is_taken: NDArray[np.bool_]
    cell_m: float

    def holds(self, positions_level: Array) -> float:
        """Return at what share of (M, 2) positions something stands, of those on the grid."""
        cells = np.floor(positions_level / self.cell_m).astype(np.intp) + len(self.is_taken) // 2
        cells = cells[((cells >= 0) & (cells < len(self.is_taken))).all(axis=1)]
        return float(self.is_taken[cells[:, 1], cells[:, 0]].mean()) if len(cells) else 0.0


class OverlapVerifier:
    """Guesses the motion by constellations (C3), refines it by GICP, and asks whether the rest agrees.

    Any ground overlaps with any other, so the questions are about what stands on it: how much of each scan
    finds a counterpart in the other, and whether the surfaces hold the motion in every direction.
    """

    def __init__(self, config: OverlapConfig) -> None:
        self._config = config
        # Keyframes in a row are compared with the same places.
        self._plan = lru_cache(config.remembered)(partial(_planned, config=config))
        self._cloud = lru_cache(config.remembered)(partial(_prepared, config=config))

    def digest(self, seen: Seen, /) -> ScanPlace:
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
        guess = self._guess(i, j)
        if guess is None:
            return Verification(0, "vote: nothing stands in either scan that agrees on a motion")
        distances_m = self._config.pair_distances_m
        target, source = self._cloud(i), self._cloud(j)
        found = self._compared(target, source, guess, within_m=distances_m[-1])
        if found.reason:
            return found
        for distance_m in distances_m:
            alignment = refine(
                target,
                source,
                guess,
                kind="gicp",
                max_pair_distance_m=distance_m,
                max_iterations=self._config.max_iterations,
            )
            if not alignment.converged:
                return replace(found, reason=f"gicp: {alignment.reason}")
            guess = alignment.T_target_source
        found = self._compared(target, source, guess, within_m=self._config.voxel_m)
        return (
            replace(found, rmse_m=alignment.inlier_rmse_m)
            if found.reason
            else self._measured(found, alignment, source)
        )

    def _guess(self, i: ScanPlace, j: ScanPlace) -> Transform | None:
        """Return the planar motion that brings most of what stands in either scan onto the other's."""
        plan_i, plan_j = self._plan(i), self._plan(j)
        peaks = vote(plan_i.centres_level, plan_j.centres_level, self._config.voting)
        if not peaks:
            return None
        best = max(peaks, key=lambda peak: _shared(plan_i, plan_j, peak.motion))
        guess: Transform = inverse(i.T_level_body) @ best.motion @ j.T_level_body
        return guess

    def _compared(
        self, target: Prepared, source: Prepared, T_target_source: Transform, *, within_m: float
    ) -> Verification:
        """Return how much of what stands has a counterpart: the smaller share of the two scans."""
        config = self._config
        found = [
            _counterparts(target, source, T_target_source, within_m=within_m),
            _counterparts(source, target, inverse(T_target_source), within_m=within_m),
        ]
        matches, inliers = min(found, key=lambda of: of[1] / max(of[0], 1))
        reason = ""
        if matches < config.min_upright or inliers < config.min_overlap * matches:
            reason = (
                f"overlap: {inliers} of {matches} upright points have a counterpart within {within_m} m, "
                f"want {config.min_overlap:.0%} of at least {config.min_upright}"
            )
        return Verification(matches, reason, inliers)

    def _measured(self, found: Verification, alignment: Alignment, source: Prepared) -> Verification:
        config = self._config
        assert alignment.information is not None  # GICP converged
        degeneracy = degeneracy_of(alignment.information, points=source.points)
        if degeneracy.is_degenerate:
            return replace(
                found, reason=f"degenerate: {degeneracy.text} not seen", rmse_m=alignment.inlier_rmse_m
            )
        return replace(
            found,
            rmse_m=alignment.inlier_rmse_m,
            T_i_j=alignment.T_target_source,
            information=softened(alignment.information, sigma_rad=config.sigma_rad, sigma_m=config.sigma_m),
        )


def _prepared(place: ScanPlace, *, config: OverlapConfig) -> Prepared:
    return prepared(place.points_body, voxel_m=config.voxel_m)


def _planned(place: ScanPlace, *, config: OverlapConfig) -> _Plan:
    of_ground = config.constellation.ground
    ground = find_ground(place.points_body, place.T_level_body, of_ground)
    obstacles = find_obstacles(place.points_body, place.T_level_body, ground, of_ground)
    edge = 2 * int(np.ceil(of_ground.radius_m / of_ground.cell_m))
    cells = np.floor(obstacles[:, :2] / of_ground.cell_m).astype(np.intp) + edge // 2
    is_taken = np.zeros((edge, edge), np.uint8)
    is_taken[cells[:, 1], cells[:, 0]] = 1
    around = cv2.dilate(is_taken, np.ones((3, 3), np.uint8)).astype(np.bool_)
    return _Plan(centres_of(obstacles, config.constellation.centres), around, of_ground.cell_m)


def _shared(i: _Plan, j: _Plan, T_i_j: Transform) -> float:
    """Return the smaller share of either plan's centres at which something stands in the other."""
    return min(
        i.holds(j.centres_level @ T_i_j[:2, :2].T + T_i_j[:2, 3]),
        j.holds((i.centres_level - T_i_j[:2, 3]) @ T_i_j[:2, :2]),
    )


def _counterparts(
    target: Prepared, source: Prepared, T_target_source: Transform, *, within_m: float
) -> tuple[int, int]:
    """Return how many upright points the source has, and how many of them have one of the target's near."""
    upright = np.abs(source.normals[:, 2]) < _UPRIGHT
    _, distances_m = target.nearest(apply(T_target_source, source.points[upright]))
    return len(distances_m), int((distances_m <= within_m).sum())
