"""ISVD odometry on made features: a wall of landmarks before a moving camera."""

import numpy as np
import pytest

from mapper.core.errors import FrameError
from mapper.core.frames import PinholeCamera, RgbdFrame, Scan
from mapper.core.geometry import apply, exp, inverse, log, mean_rotation, rotation_log
from mapper.features.base import Features
from mapper.features.config import OrbConfig
from mapper.odometry.config import IsvdOdometryConfig
from mapper.odometry.isvd.frame_pairs import IsvdObservation
from mapper.odometry.isvd.odometry import IsvdOdometry
from mapper.sensing.gyroscope import Gyroscope

CAMERA = PinholeCamera(640, 480, 500.0, 500.0, 320.0, 240.0)
BF_PX_M = 40.0
PUBLISHED = {"earlier": "frames", "residual": "points", "average": "weighted"}


class Wall:
    """Landmarks on a wall 2 m ahead, a few centimetres deep: (N, 3) metres, world = first camera frame."""

    def __init__(self, seed: int, *, depth_m: float = 0.03, width_m: float = 12.0) -> None:
        self.rng = np.random.default_rng(seed)
        n = int(300 * width_m)
        self.points = self.rng.uniform([-2.0, -1.5, 2.0], [width_m, 1.5, 2.0 + depth_m], (n, 3))
        self.descriptors = self.rng.integers(0, 256, (n, 32), dtype=np.uint8)

    def seen_from(
        self, T_world_body: np.ndarray, stamp_ns: int, *, noise_m: float = 0.002
    ) -> IsvdObservation:
        points = apply(inverse(T_world_body), self.points)
        pixels = CAMERA.project(np.maximum(points, [-np.inf, -np.inf, 0.1]))
        visible = ((pixels > 0) & (pixels < [640, 480])).all(axis=1) & (points[:, 2] > 0.3)
        measured = points[visible] + self.rng.normal(0.0, noise_m, (visible.sum(), 3))
        measured[::9] = np.nan  # holes in the depth image
        return observation(stamp_ns, pixels[visible], measured, self.descriptors[visible])


def observation(stamp_ns, pixels, points, descriptors) -> IsvdObservation:
    zeros = np.zeros(len(pixels), np.float32)
    features = Features(pixels.astype(np.float32), np.zeros(len(pixels), np.int32), zeros, zeros, descriptors)
    measured = np.column_stack([pixels, BF_PX_M / points[:, 2]])
    intrinsics = np.array([CAMERA.fx_px, CAMERA.fy_px, CAMERA.cx_px, CAMERA.cy_px, BF_PX_M])
    return IsvdObservation(
        stamp_ns, features, points, measured, np.ones((len(pixels), 3)), intrinsics, CAMERA, np.eye(4)
    )


def strangers(stamp_ns: int) -> IsvdObservation:
    """A view that shares nothing with the wall."""
    return Wall(999).seen_from(np.eye(4), stamp_ns)


def path(n: int, *, step_m: float = 0.02) -> list[np.ndarray]:
    return [
        exp(np.array([0.0, 0.05 * np.sin(0.1 * i), 0.0]), np.array([step_m * i, 0.03 * np.sin(0.2 * i), 0.0]))
        for i in range(n)
    ]


def config(**changes) -> IsvdOdometryConfig:
    return IsvdOdometryConfig(detector=OrbConfig()).model_copy(update=changes)


def follow(odometry: IsvdOdometry, wall: Wall, poses: list[np.ndarray], *, first: int = 0):
    return [odometry.track(wall.seen_from(T, first + i)) for i, T in enumerate(poses)]


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"earlier": "frames"},
        {"residual": "points"},
        *(
            PUBLISHED | {"average": a, "rotation": r}
            for a in ("weighted", "mean")
            for r in ("nearest", "mean")
        ),
    ],
    ids=lambda changes: "-".join(changes.values()) or "defaults",
)
def test_follows_a_path(changes):
    poses = path(30)

    tracks = follow(IsvdOdometry(config(**changes)), Wall(0), poses)

    assert [track.node for track in tracks] == list(range(30))
    gaps = [
        np.linalg.norm(track.T_world_body[:3, 3] - T[:3, 3]) for track, T in zip(tracks, poses, strict=True)
    ]
    assert max(gaps) < 0.02
    assert {track.diagnostics.method for track in tracks[1:]} == {"isvd"}


@pytest.mark.parametrize("previous_frames", [1, 2, 4, 6])
def test_every_registration_is_a_factor(previous_frames):
    poses = path(10)

    odometry = IsvdOdometry(config(**PUBLISHED, previous_frames=previous_frames))
    tracks = follow(odometry, Wall(1), poses)

    for n, track in enumerate(tracks):
        assert [factor.i for factor in track.factors] == list(
            range(n - 1, max(n - previous_frames, 0) - 1, -1)
        )
        for factor in track.factors:
            assert factor.j == n
            assert np.allclose(factor.T_i_j, inverse(poses[factor.i]) @ poses[n], atol=0.01)


def test_keyframes_connect_a_frame_with_views_that_were_long_ago():
    """There and back: the way back is registered against the keyframes of the way there."""
    there = path(20, step_m=0.05)
    poses = [*there, *there[::-1]]

    tracks = follow(IsvdOdometry(config(previous_frames=3)), Wall(1), poses)

    assert [factor.i for factor in tracks[-1].factors][:2] == [38, 0]
    assert all(len(track.factors) == 3 for track in tracks[15:])
    gaps = [factor.j - factor.i for track in tracks for factor in track.factors]
    assert max(gaps) == 39
    assert all(
        np.allclose(factor.T_i_j, inverse(poses[factor.i]) @ poses[factor.j], atol=0.01)
        for track in tracks
        for factor in track.factors
    )


def test_far_views_are_no_partners():
    odometry = IsvdOdometry(config())

    tracks = follow(odometry, Wall(1), path(30, step_m=0.1))

    reach_m = max(np.linalg.norm(factor.T_i_j[:3, 3]) for track in tracks for factor in track.factors)
    assert 0.2 < reach_m < 1.3  # 0.6 of the wall's 2 m, and a step


def test_factors_of_one_frame_share_the_information_of_its_features():
    one, four = (
        follow(IsvdOdometry(config(previous_frames=previous, earlier="frames")), Wall(1), path(6))[-1].factors
        for previous in (1, 4)
    )

    assert (len(one), len(four)) == (1, 4)
    np.testing.assert_allclose(four[0].information, one[0].information / 2.0)


def test_weighted_mean_is_equation_4_1s():
    wall, poses = Wall(2), path(6)
    odometry = IsvdOdometry(config(**PUBLISHED, rotation="mean"))
    tracks = follow(odometry, wall, poses[:5])
    new = wall.seen_from(poses[5], 5)
    candidates = odometry._register(new, list(odometry._recent)[-4:][::-1], config().match)

    track = odometry.track(new)

    weights = np.array([candidate.weight for candidate in candidates])
    positions = np.array(
        [(tracks[c.earlier.node].T_world_body @ c.alignment.T_target_source)[:3, 3] for c in candidates]
    )
    assert len(candidates) == 4
    assert np.allclose(track.T_world_body[:3, 3], weights @ positions / weights.sum())
    assert np.allclose(
        track.T_world_body[:3, :3],
        mean_rotation([c.T_world_body[:3, :3] for c in candidates], weights),
    )


def test_covariances_weigh_the_average():
    wall, poses = Wall(2), path(6)
    odometry = IsvdOdometry(config())
    follow(odometry, wall, poses[:5])
    new = wall.seen_from(poses[5], 5)
    candidates = odometry._register(new, odometry._earlier(), config().match)

    T = odometry.track(new).T_world_body

    pulls = [c.information @ np.concatenate(log(inverse(T) @ c.T_world_body)) for c in candidates]
    assert len(candidates) > 1
    assert np.linalg.norm(sum(pulls)) < 1e-3 * max(np.linalg.norm(pull) for pull in pulls)


def test_a_lost_frame_is_reported_and_adds_no_motion():
    wall, poses = Wall(3), path(14)
    odometry = IsvdOdometry(config())
    before = follow(odometry, wall, poses[:10])

    lost = [odometry.track(strangers(10 + i)) for i in range(3)]
    back = odometry.track(wall.seen_from(poses[13], 13))

    for track in lost:
        assert track.node is None
        assert track.diagnostics.method == "lost"
        assert not track.factors
        assert not track.is_keyframe
        assert np.array_equal(track.T_world_body, before[-1].T_world_body)
    assert back.node == 10
    assert np.allclose(back.T_world_body, poses[13], atol=0.02)


def test_relocalises_at_a_keyframe():
    wall = Wall(4)
    odometry = IsvdOdometry(config(keyframe_interval=5))
    follow(odometry, wall, path(60, step_m=0.08))  # 4.7 m on: the start is out of view
    start = exp(np.zeros(3), np.array([0.1, 0.0, 0.0]))

    odometry.track(strangers(60))
    back = odometry.track(wall.seen_from(start, 61))

    assert back.diagnostics.method == "relocalised"
    assert len(back.factors) == 1
    assert back.factors[0].i < 5
    assert np.allclose(back.T_world_body, start, atol=0.02)


def test_keyframes_far_from_the_loss_are_tried_in_turn(monkeypatch):
    wall = Wall(5)
    monkeypatch.setattr("mapper.odometry.isvd.odometry.RELOCALISATION_KEYFRAMES", 2)
    odometry = IsvdOdometry(config(keyframe_interval=5))
    follow(odometry, wall, path(60, step_m=0.08))
    start = np.eye(4)

    methods = [odometry.track(wall.seen_from(start, 60 + i)).diagnostics.method for i in range(8)]

    assert methods[0] == "lost"
    assert "relocalised" in methods
    assert methods[-1] == "isvd"


def swaying(time_s: float) -> np.ndarray:
    return exp(0.2 * np.array([0.6 * np.sin(1.7 * time_s), np.sin(1.3 * time_s), 0.0]), np.zeros(3))


@pytest.mark.parametrize("has_gyroscope", [True, False])
def test_a_gyroscope_rules_out_a_view_of_another_direction(has_gyroscope):
    times_s = np.arange(0.0, 5.0, 0.005)
    steps = [rotation_log((inverse(swaying(t - 1e-4)) @ swaying(t + 1e-4))[:3, :3]) / 2e-4 for t in times_s]
    gyroscope = Gyroscope("imu", np.round(1e9 * times_s).astype(np.int64), np.array(steps))
    odometry = IsvdOdometry(IsvdOdometryConfig(), gyroscope=gyroscope if has_gyroscope else None)
    wall = Wall(3)
    for k in range(40):
        result = odometry.track(wall.seen_from(swaying(0.1 * k), k * 100_000_000))
        assert result.node is not None
    if has_gyroscope:
        np.testing.assert_allclose(odometry.gyroscope_calibration().R_body_imu, np.eye(3), atol=0.05)
    turned = swaying(3.9) @ exp(np.array([0.0, 0.3, 0.0]), np.zeros(3))
    assert (odometry.track(wall.seen_from(turned, 3_910_000_000)).node is None) == has_gyroscope


def test_bridges_a_view_without_a_common_plane_by_matching_without_homography(monkeypatch):
    deep = Wall(6, depth_m=4.0)
    poses = [np.eye(4), exp(np.array([0.0, 0.3, 0.0]), np.array([0.4, 0.1, 0.3]))]

    tracks = follow(IsvdOdometry(config()), deep, poses)

    assert tracks[1].diagnostics.method in ("isvd", "fallback")
    assert np.allclose(tracks[1].T_world_body, poses[1], atol=0.01)
    monkeypatch.setattr("mapper.features.matching.TOLERANCE_PX", 0.01)
    assert follow(IsvdOdometry(config()), deep, poses)[1].diagnostics.method == "fallback"


def textured_frame(**changes) -> RgbdFrame:
    rng = np.random.default_rng(8)
    image = np.kron(rng.integers(0, 256, (48, 64)), np.ones((10, 10))).astype(np.uint8)
    depth_m = np.full((480, 640), 2.0, np.float32)
    depth_m[:, 320:] = 0.0
    fields = {"stamp_ns": 1, "image": image, "depth_m": depth_m, "camera": CAMERA}
    return RgbdFrame(**{**fields, **changes})


def test_observes_points_where_there_is_depth():
    observed = IsvdOdometry(config()).observe(textured_frame())

    measured = np.isfinite(observed.points_body[:, 2])
    left = observed.features.pixels[:, 0] < 319
    assert 50 < measured.sum() < len(measured)
    assert (measured[left]).all()
    assert not measured[observed.features.pixels[:, 0] > 321].any()
    back = CAMERA.project(observed.points_body[measured])
    assert np.allclose(back, observed.features.pixels[measured], atol=1e-3)


def test_points_of_whole_pixels_are_those_of_the_depth_image():
    observed = IsvdOdometry(config(whole_pixels=True)).observe(textured_frame())

    measured = np.isfinite(observed.points_body[:, 2])
    pixels = observed.features.pixels[measured]
    assert np.abs(pixels - np.rint(pixels)).max() > 0.1  # coarse octaves lie between pixels
    assert np.allclose(CAMERA.project(observed.points_body[measured]), np.rint(pixels), atol=1e-3)


def test_observes_in_the_body_frame():
    T_body_camera = exp(np.array([0.1, 0.2, 0.3]), np.array([0.5, 0.0, -0.2]))

    camera_points = IsvdOdometry(config()).observe(textured_frame()).points_body
    body_points = IsvdOdometry(config()).observe(textured_frame(T_body_camera=T_body_camera)).points_body

    assert np.allclose(body_points, apply(T_body_camera, camera_points), equal_nan=True)


def test_lens_correction_and_depth_filter_can_be_switched():
    camera = PinholeCamera(640, 480, 500.0, 500.0, 320.0, 240.0, (0.2, -0.5, 0.0, 0.0, 0.3))
    depth_m = np.full((480, 640), 2.0, np.float32)
    depth_m[::2, ::2] = 0.0  # holes that DIF fills
    frame = textured_frame(camera=camera, depth_m=depth_m)

    plain = IsvdOdometry(config()).observe(frame).points_body
    raw = IsvdOdometry(config(undistort=False)).observe(frame).points_body
    filled = IsvdOdometry(config(depth_filter=True)).observe(frame).points_body

    assert np.nanmax(np.linalg.norm(plain - raw, axis=1)) > 0.01
    assert np.isnan(plain).any()
    assert np.isfinite(filled).all()


def test_a_bare_scan_is_refused():
    with pytest.raises(FrameError, match="needs an image"):
        IsvdOdometry(config()).observe(Scan(5, np.zeros((1, 3), np.float32)))
