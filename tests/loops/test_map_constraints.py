"""A street driven on another day, compared with the places of a finished map."""

from functools import cache
from itertools import pairwise

import numpy as np

from mapper.core.geometry import exp, inverse
from mapper.core.timebase import NS_PER_S
from mapper.features.frame_view import ScanView
from mapper.graph.model import BetweenFactor, PoseSigmas
from mapper.loops.closure import pose_difference
from mapper.loops.config import ScanLoopsConfig
from mapper.loops.map_constraints import KnownPlaces, build_map_constraint_detector
from mapper.loops.scan_verification import ScanVerifier
from tests.support.feature_room import track
from tests.support.street_scans import on_street, street, view

LINK = PoseSigmas(rotation_rad=0.002, translation_m=0.05).information
T_MAP_WORLD = exp(np.array([0.0, 0.0, 0.7]), np.array([20.0, -5.0, 1.0]))
CONFIG = ScanLoopsConfig()


@cache
def known():
    """Sixty metres of a street, in a map's frame."""
    scene, verifier = street(3), ScanVerifier(CONFIG.verification)
    poses = [on_street(scene, along_m) for along_m in np.arange(0.0, 60.0, 3.0)]
    places = {node: verifier.describe(view(scene, T, seed=node)) for node, T in enumerate(poses)}
    return KnownPlaces(places, {node: T_MAP_WORLD @ T for node, T in enumerate(poses)})


def drive(seed, alongs_m):
    """Return the keyframes of a drive beside the first one, two a second."""
    scene = street(seed)
    poses = [on_street(scene, along_m, left_m=0.7) for along_m in alongs_m]
    return poses, [view(scene, T, seed=500 + k) for k, T in enumerate(poses)]


def feed(detector, poses, views, odometry):
    first = known().map_node + 1
    for k, (T, seen) in enumerate(zip(odometry, views, strict=True)):
        links = [BetweenFactor(first + k - 1, first + k, inverse(odometry[k - 1]) @ T, LINK)] if k else []
        timed = ScanView(k * NS_PER_S // 2, seen.points_body)
        detector.add(first + k, track(first + k, timed.stamp_ns, T, links), lambda timed=timed: timed)
    held = [loop for loop in detector.closures() if loop.verdict == "accepted"]
    for loop in held:
        miss = pose_difference(loop.T_i_j, T_MAP_WORLD @ poses[loop.j - first])
        assert miss.translation_m < 0.15
        assert miss.rotation_rad < 0.02
    return [loop.j - first for loop in held]


def test_constraints_are_poses_in_the_map():
    poses, views = drive(3, np.arange(4.0, 40.0, 3.2))
    detector = build_map_constraint_detector(CONFIG, known())
    held = feed(detector, poses, views, [exp(np.zeros(3), np.array([5.0, 0.0, 0.0])) @ T for T in poses])
    assert len(held) >= 8
    first = known().map_node + 1
    estimate = detector.current_estimate(first + held[-1])
    np.testing.assert_allclose(estimate[:3, 3], (T_MAP_WORLD @ poses[held[-1]])[:3, 3], atol=0.15)


def test_nothing_of_another_street_is_recognised():
    poses, views = drive(4, np.arange(4.0, 40.0, 3.2))
    assert feed(build_map_constraint_detector(CONFIG, known()), poses, views, poses) == []


def test_after_a_jump_that_odometry_did_not_see_the_whole_map_is_searched():
    alongs_m = np.concatenate([np.arange(2.0, 18.0, 3.2), np.arange(38.0, 56.0, 3.2)])
    poses, views = drive(3, alongs_m)
    odometry, jump = [poses[0]], 5
    for k, (before, after) in enumerate(pairwise(poses), start=1):
        step = inverse(before) @ after if k != jump else exp(np.zeros(3), np.array([3.2, 0.0, 0.0]))
        odometry.append(odometry[-1] @ step)
    held = feed(build_map_constraint_detector(CONFIG, known()), poses, views, odometry)
    assert sum(k < jump for k in held) >= 3
    assert sum(k >= jump for k in held) >= 2
