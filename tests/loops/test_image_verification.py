"""Verification of loops between two images: right motions pass, wrong ones are rejected with a reason."""

from dataclasses import replace

import numpy as np

from mapper.core.geometry import exp, inverse, log
from mapper.loops.closure import discrepancy, pose_difference
from mapper.loops.config import ImageVerificationConfig
from mapper.loops.image_verification import ImageVerifier, verify_aligned
from mapper.odometry.config import MatchConfig
from mapper.sources import open_source
from tests.support.feature_room import Room
from tests.support.planar import at


def test_two_views_of_one_place_give_their_relative_pose():
    room = Room(1)
    T_world_i, T_world_j = at(0.2, 0.1, 0.1), at(0.5, -0.2, -0.15)
    found = ImageVerifier(ImageVerificationConfig()).verify(room.view(T_world_i, 0), room.view(T_world_j, 1))
    assert found.reason == ""
    miss = discrepancy(found.T_i_j, T_world_i, T_world_j)
    assert miss.translation_m < 0.01
    assert miss.rotation_rad < 0.005
    assert found.inliers > 100
    assert 0.2 < found.residual_px < 2.0


def test_isvd_can_be_the_measure_too():
    room = Room(1)
    views = room.view(at(0.2, 0.1, 0.1), 0), room.view(at(0.4), 1)
    by_isvd = ImageVerifier(ImageVerificationConfig(measure="isvd")).verify(*views)
    by_pixels = ImageVerifier(ImageVerificationConfig()).verify(*views)
    assert by_isvd.reason == by_pixels.reason == ""
    assert not np.array_equal(by_isvd.T_i_j, by_pixels.T_i_j)
    assert pose_difference(by_isvd.T_i_j, by_pixels.T_i_j).translation_m < 0.02


def test_the_claimed_uncertainty_covers_the_error():
    room, verifier = Room(3), ImageVerifier(ImageVerificationConfig())
    T_world_i = at(0.0)
    chi2 = []
    for k in range(20):
        T_world_j = at(0.01 * k, 0.2, 0.02 * k)
        found = verifier.verify(room.view(T_world_i, 0), room.view(T_world_j, 1))
        twist = np.concatenate(log(inverse(found.T_i_j) @ inverse(T_world_i) @ T_world_j))
        chi2.append(twist @ found.information @ twist)
    assert np.mean(chi2) < 12.0  # six are expected of honest information


def test_views_of_two_rooms_are_not_one_place():
    found = ImageVerifier(ImageVerificationConfig()).verify(
        Room(1).view(at(0.0), 0), Room(2).view(at(0.0), 1)
    )
    assert found.T_i_j is None
    assert found.reason.startswith("matching: ")
    assert "want 45" in found.reason


def test_the_same_things_standing_differently_are_not_one_place():
    room, mixed = Room(1), Room(1)
    mixed.points = np.random.default_rng(5).permutation(mixed.points)
    config = ImageVerificationConfig(min_matches=10)
    found = ImageVerifier(config).verify(room.view(at(0.0), 0), mixed.view(at(0.0), 1))
    assert found.T_i_j is None
    assert found.reason.startswith(("isvd: ", "reprojection: "))


def test_reprojection_refuses_what_isvd_alone_would_take():
    room = Room(1)
    i, j = room.view(at(0.0), 0), room.view(at(0.1), 1)
    shifted = replace(j, pixels=j.pixels + np.random.default_rng(0).normal(0.0, 15.0, j.pixels.shape))
    found = ImageVerifier(ImageVerificationConfig()).verify(i, shifted)
    assert found.reason.startswith("reprojection: ")
    assert found.rmse_m is not None


def test_a_loop_needs_a_share_of_pairs_that_agree():
    room = Room(1)
    i, j = room.view(at(0.0), 0), room.view(at(0.1), 1)
    pixels = j.pixels.copy()
    pixels[::3] += 40.0  # a third of the view moves
    moved = replace(j, pixels=pixels)
    assert ImageVerifier(ImageVerificationConfig()).verify(i, moved).reason == ""
    strict = ImageVerifier(ImageVerificationConfig(min_inlier_ratio=0.8)).verify(i, moved)
    assert strict.reason.startswith("reprojection: ")


def test_a_homography_filters_the_pairs_when_asked():
    config = ImageVerificationConfig(match=MatchConfig(filter="homography"), min_matches=45)
    room = Room(1)
    plain = ImageVerifier(ImageVerificationConfig()).verify(room.view(at(0.0), 0), room.view(at(0.3, 0.2), 1))
    filtered = ImageVerifier(config).verify(room.view(at(0.0), 0), room.view(at(0.3, 0.2), 1))
    assert filtered.matches < plain.matches


def test_frames_that_were_aligned_by_hand_are_registered_by_their_surfaces(desk_log):
    log = open_source(desk_log)
    i, j = (log.entry_at(index) for index in (0, 20))
    T_i_j = inverse(log.truth.at(i.stamp_ns)) @ log.truth.at(j.stamp_ns)
    by_hand = T_i_j @ exp(np.array([0.05, -0.08, 0.04]), np.array([0.15, 0.1, -0.12]))
    found = verify_aligned(i.load(), j.load(), by_hand)
    assert found.reason == ""
    miss = pose_difference(found.T_i_j, T_i_j)
    assert miss.translation_m < 0.02
    assert miss.rotation_rad < 0.01

    elsewhere = T_i_j @ exp(np.array([0.0, 1.2, 0.0]), np.array([1.0, 0.5, 0.0]))
    refused = verify_aligned(i.load(), j.load(), elsewhere)
    assert refused.T_i_j is None
    assert refused.reason.startswith(("gicp: ", "images: "))
