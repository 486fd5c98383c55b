"""Loops between a near and a far view of one place, and views of other places that features do not tell."""

from dataclasses import replace

import numpy as np
import pytest

from mapper.core.geometry import inverse
from mapper.features.config import SiftConfig
from mapper.loops.image_verification import verify_wide
from mapper.odometry.config import IsvdOdometryConfig
from mapper.odometry.factory import build_frame_odometry
from mapper.registration.image_agreement import image_agreement
from tests.support.stepped_wall import facing, painting, wall_image

NEAR, FAR = facing(0.1, 0.0, -1.6), facing(-0.3, 0.3, -5.5, yaw=0.1)
T_FAR_NEAR = inverse(FAR) @ NEAR
PAINTED = painting(1)


@pytest.fixture(scope="module")
def images():
    """The wall from near and from far, and a wall of the same shape that is painted otherwise, by stamp."""
    return dict(
        enumerate(
            [wall_image(PAINTED, NEAR, 0), wall_image(PAINTED, FAR, 1), wall_image(painting(2), FAR, 2)]
        )
    )


@pytest.fixture(scope="module")
def views(images):
    """Their SIFT features."""
    detector = SiftConfig(threshold=0.01, min_threshold=0.01)
    odometry = build_frame_odometry(IsvdOdometryConfig(detector=detector, max_depth_m=12.0))
    return [odometry.view(odometry.observe(image)) for image in images.values()]


def test_a_wall_is_recognised_from_three_times_as_far_away(images, views):
    found = verify_wide(views[0], views[1], images.__getitem__)
    assert found.reason == ""
    assert np.linalg.norm((T_FAR_NEAR @ found.T_i_j)[:3, 3]) < 0.05
    sigma_m = np.sqrt(np.linalg.eigvalsh(np.linalg.inv(found.information)[3:, 3:])[-1])
    assert 0.03 < sigma_m < 0.2


def test_a_few_features_of_another_wall_are_no_place(images, views):
    assert verify_wide(views[0], views[2], images.__getitem__).reason.startswith("matching")


def test_views_from_alike_distances_are_left_to_orb(images, views):
    """What ORB does not recognise there is texture that repeats: the floors of corridors agreed 6 m off."""
    again = replace(views[0], stamp_ns=3)
    assert verify_wide(views[0], again, images.__getitem__).reason.startswith("distance")


def test_features_that_agree_are_not_enough(images, views):
    """The far view's stamp leads to the image of the other wall: its surfaces agree, its paint does not."""
    assert verify_wide(views[0], views[1], lambda stamp: images[2 * stamp]).reason.startswith("images")


def test_images_agree_by_the_true_motion_alone(images):
    right = image_agreement(images[0], images[1], T_FAR_NEAR)
    assert right.same_ratio > 0.9
    assert right.correlation > 0.9
    shifted = image_agreement(images[0], images[1], inverse(FAR) @ facing(1.1, 0.0, -1.6))
    assert shifted.same_ratio < 0.9
    assert shifted.correlation < 0.5


def test_another_painting_has_the_same_depths_and_other_grey_levels(images):
    other = image_agreement(images[0], images[2], T_FAR_NEAR)
    assert other.same_ratio > 0.9
    assert other.correlation < 0.3


def shaded(seed):
    """Return a painting in pale colours, in the light of a lamp at its side."""
    light = np.linspace(40.0, 215.0, 1200)
    return light[np.newaxis] + 0.15 * (painting(seed) - 128.0)


def test_light_alone_makes_no_place(views):
    """Two walls in the light of one lamp: only the details of the images tell them apart."""
    near, same, other = (wall_image(shaded(seed), T, 0) for seed, T in ((1, NEAR), (1, FAR), (2, FAR)))
    alike = image_agreement(near, other, T_FAR_NEAR)
    assert alike.correlation > 0.6
    assert alike.local_correlation < 0.3
    assert image_agreement(near, same, T_FAR_NEAR).local_correlation > 0.6
    assert verify_wide(views[0], views[1], [near, same].__getitem__).reason == ""
    assert verify_wide(views[0], views[1], [near, other].__getitem__).reason.startswith("images")


def test_views_that_share_nothing_do_not_agree(images):
    assert image_agreement(images[0], images[1], facing(0.0, 0.0, -9.0)).points == 0
