"""Registration of two observations by ISVD: what pixels add to the points."""

import numpy as np
import pytest

from mapper.core.frames import PinholeCamera
from mapper.core.geometry import apply, exp, inverse, log
from mapper.features.base import Features
from mapper.odometry.config import MatchConfig
from mapper.odometry.isvd.frame_pairs import IsvdObservation, PairRegistration
from mapper.registration.config import IsvdConfig

CAMERA = PinholeCamera(640, 480, 500.0, 500.0, 320.0, 240.0)
BF_PX_M, PIXEL_SIGMA, DISPARITY_SIGMA = 40.0, 0.3, 0.1
NO_FILTER = MatchConfig(filter="none")
T_BODY_CAMERA = exp(np.array([0.2, -0.1, 1.0]), np.array([0.1, 0.3, -0.2]))
MOTION = exp(np.array([0.01, -0.02, 0.015]), np.array([0.03, -0.02, 0.04]))  # of the body


def pair(seed: int) -> tuple[IsvdObservation, IsvdObservation]:
    """Two views of 400 points 1 to 4 m away, whose depth is as uncertain as a Kinect's."""
    rng = np.random.default_rng(seed)
    pixels = rng.uniform([20.0, 20.0], [620.0, 460.0], (400, 2))
    z = rng.uniform(1.0, 4.0, 400)
    rays = (pixels - [CAMERA.cx_px, CAMERA.cy_px]) / [CAMERA.fx_px, CAMERA.fy_px]
    points = apply(T_BODY_CAMERA, np.column_stack([rays * z[:, None], z]))
    descriptors = rng.integers(0, 256, (400, 32), dtype=np.uint8)
    return observed(points, descriptors, rng), observed(apply(inverse(MOTION), points), descriptors, rng)


def observed(points_body: np.ndarray, descriptors: np.ndarray, rng: np.random.Generator) -> IsvdObservation:
    points = apply(inverse(T_BODY_CAMERA), points_body)
    pixels = CAMERA.project(points) + rng.normal(0.0, PIXEL_SIGMA, (len(points), 2))
    disparity = BF_PX_M / points[:, 2] + rng.normal(0.0, DISPARITY_SIGMA, len(points))
    z = BF_PX_M / disparity
    rays = (pixels - [CAMERA.cx_px, CAMERA.cy_px]) / [CAMERA.fx_px, CAMERA.fy_px]
    zeros = np.zeros(len(points), np.float32)
    return IsvdObservation(
        stamp_ns=0,
        features=Features(
            pixels.astype(np.float32), np.zeros(len(points), np.int32), zeros, zeros, descriptors
        ),
        points_body=apply(T_BODY_CAMERA, np.column_stack([rays * z[:, None], z])),
        measured=np.column_stack([pixels, disparity]),
        weights=np.tile([PIXEL_SIGMA**-2.0, PIXEL_SIGMA**-2.0, DISPARITY_SIGMA**-2.0], (len(points), 1)),
        intrinsics=np.array([CAMERA.fx_px, CAMERA.fy_px, CAMERA.cx_px, CAMERA.cy_px, BF_PX_M]),
        camera=CAMERA,
        T_body_camera=T_BODY_CAMERA,
    )


def registered(seed: int, *, by_pixels: bool):
    return PairRegistration(IsvdConfig(), by_pixels=by_pixels)(*pair(seed), NO_FILTER)[0]


def errors(*, by_pixels: bool) -> np.ndarray:
    found = [registered(seed, by_pixels=by_pixels) for seed in range(20)]
    assert all(alignment.converged for alignment in found)
    return np.array([np.concatenate(log(inverse(MOTION) @ a.T_target_source)) for a in found])


def test_pixels_are_better_than_points_with_a_kinects_depth():
    by_points, by_pixels = (np.sqrt((errors(by_pixels=each) ** 2).mean(axis=0)) for each in (False, True))

    assert np.linalg.norm(by_pixels[3:]) < 0.5 * np.linalg.norm(by_points[3:])
    assert np.linalg.norm(by_pixels[:3]) < 0.5 * np.linalg.norm(by_points[:3])
    assert np.linalg.norm(by_pixels[3:]) < 0.002


def test_the_information_is_that_of_the_errors():
    """Normalised squares of 20 draws: six degrees of freedom each, and as calibrated as halving allows."""
    squares = [
        error @ registered(seed, by_pixels=True).information @ error
        for seed, error in enumerate(errors(by_pixels=True))
    ]

    assert 2.5 < np.mean(squares) < 12.0


@pytest.mark.parametrize(("by_pixels", "accepted"), [(False, True), (True, False)])
def test_a_motion_that_only_the_points_agree_with_is_refused(by_pixels, accepted):
    """A lens or shutter that moved the pixels: the image is the second test."""
    target, source = pair(0)
    rng = np.random.default_rng(1)
    source.measured[:, :2] += rng.normal(0.0, 40.0, (400, 2))

    alignment, _, matches = PairRegistration(IsvdConfig(), by_pixels=by_pixels)(target, source, NO_FILTER)

    assert matches == 400
    assert alignment.converged == accepted
    assert ("agree in the image" in alignment.reason) != accepted
