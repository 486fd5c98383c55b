"""How registrations become odometries and odometries registrations, and what every method is shown."""

from itertools import pairwise

import numpy as np
import pytest

from mapper.core.errors import FrameError
from mapper.core.frames import PinholeCamera, RgbdFrame, Scan
from mapper.core.geometry import angle_between, apply, exp, inverse
from mapper.evaluators.compare.catalogue import kiss_icp, methods_for, registrations_for
from mapper.evaluators.compare.config import CompareConfig, RgbdCompareConfig
from mapper.evaluators.compare.methods import FrameReader, FrameToFrame, odometry_method
from mapper.features.frame_view import ScanView
from mapper.odometry.base import Diagnostics, FrameResult
from mapper.odometry.scans.config import KissOdometryConfig
from mapper.registration.base import Alignment, failed
from mapper.registration.config import VOXEL_M
from mapper.registration.hough.config import HoughGicpConfig
from mapper.registration.rgbd import HybridRgbd
from mapper.sources import open_source
from mapper.sources.config import SourceConfig

STEP_NS = 100_000_000


def scan(stamp_ns, points=((1.0, 2.0, 3.0),)):
    return Scan(stamp_ns, np.array(points, np.float32))


class Scripted:
    """Answers as told, and remembers what it was asked."""

    def __init__(self, *answers):
        self.answers, self.asked = list(answers), []

    def prepare(self, target):
        return Bound(self, target)


class Bound:
    def __init__(self, script, target):
        self.script, self.target = script, target

    def align(self, source, T_target_source):
        self.script.asked.append((self.target.stamp_ns, source.stamp_ns, T_target_source))
        return self.script.answers.pop(0)


def found(T):
    return Alignment(T, converged=True, inlier_ratio=1.0, inlier_rmse_m=0.0)


def along_x(distance_m):
    T = np.eye(4)
    T[0, 3] = distance_m
    return T


def test_each_frame_is_registered_to_the_one_before_from_the_motion_before():
    script = Scripted(found(along_x(1.0)), found(along_x(3.0)), found(along_x(0.5)))
    tracker = FrameToFrame(lambda target: script.prepare(target).align)
    stamps = [0, STEP_NS, 3 * STEP_NS, 4 * STEP_NS]
    assert [tracker.add(scan(stamp)) for stamp in stamps] == [True] * 4

    assert [asked[:2] for asked in script.asked] == list(pairwise(stamps))
    guesses_m = [T_guess[0, 3] for *_, T_guess in script.asked]
    assert guesses_m == pytest.approx([0.0, 2.0, 1.5])  # twice the time after, then half
    np.testing.assert_allclose(tracker.trajectory().positions_world[:, 0], [0.0, 1.0, 4.0, 4.5])


def test_where_a_registration_fails_the_motion_before_carries_on():
    turn = exp(np.array([0.0, 0.0, 0.1]), np.array([1.0, 0.0, 0.0]))
    script = Scripted(found(turn), failed("no overlap"), found(turn))
    tracker = FrameToFrame(lambda target: script.prepare(target).align)
    assert [tracker.add(scan(k * STEP_NS)) for k in range(4)] == [True, True, False, True]
    np.testing.assert_allclose(tracker.trajectory().T_world_body[3], turn @ turn @ turn, atol=1e-12)
    assert script.asked[2][0] == 2 * STEP_NS


class Centred:
    """An odometry for scans that lays their middles on each other; scans of one point are lost."""

    def __init__(self):
        self.first = None

    def observe(self, frame):
        if len(frame.points_body) == 0:
            raise FrameError("empty")
        return frame

    def track(self, frame):
        middle = frame.points_body.astype(np.float64).mean(axis=0)
        self.first = middle if self.first is None else self.first
        T = np.eye(4)
        T[:3, 3] = self.first - middle
        node = None if len(frame.points_body) == 1 else 0
        return FrameResult(frame.stamp_ns, node, np.eye(4), T, False, Diagnostics(0, 0, 0, 0.0, "m", "map"))

    def view(self, frame):
        return ScanView(frame.stamp_ns, frame.points_body)

    def finish(self):
        return ()


def registered_by(build):
    return odometry_method("it", build, sees_images=False).registration


def test_an_odometry_that_sees_two_scans_registers_them_wherever_the_guess_is():
    rng = np.random.default_rng(0)
    target = scan(0, rng.normal(size=(50, 3)))
    T_guess = exp(np.array([0.0, 0.0, 0.3]), np.array([0.2, 0.1, 0.0]))
    # Turned as the guess says, and shifted beyond it: what is left for the odometry is the shift.
    T_target_source = along_x(0.5) @ T_guess
    source = scan(STEP_NS, apply(inverse(T_target_source), target.points_body.astype(np.float64)))

    alignment = registered_by(Centred)(target)(source, T_guess)

    assert alignment.converged
    np.testing.assert_allclose(alignment.T_target_source, T_target_source, atol=1e-6)


def test_an_odometry_that_is_lost_gives_no_answer():
    two, one = scan(0, np.zeros((2, 3))), scan(1)
    assert registered_by(Centred)(two)(one, np.eye(4)).reason == "the source was lost"
    assert registered_by(Centred)(one)(two, np.eye(4)).reason == "the target alone was lost"


def test_scans_of_images_stand_upright():
    camera = PinholeCamera(64, 48, 60.0, 60.0, 31.5, 23.5)
    depth_m = np.zeros((48, 64), np.float32)
    depth_m[0, 0] = 2.0  # up and left of the middle
    depth_m[2, 2] = 9.0  # too deep
    frame = RgbdFrame(7, np.zeros((48, 64), np.uint8), depth_m, camera)

    moment = FrameReader(RgbdCompareConfig()).read(Loaded(frame))

    ((ahead_m, left_m, up_m),) = moment.scan.points_body.tolist()
    assert ahead_m == pytest.approx(2.0)
    assert left_m == pytest.approx(2.0 * 31.5 / 60.0)
    assert up_m == pytest.approx(2.0 * 23.5 / 60.0)
    np.testing.assert_allclose(
        apply(moment.T_body_scan, moment.scan.points_body), frame.scan().points_body[:1]
    )
    forward = np.eye(4)
    forward[2, 3] = 1.0  # along the optical axis
    np.testing.assert_allclose(moment.upright(forward)[:3, 3], [1.0, 0.0, 0.0])


class Loaded:
    def __init__(self, frame):
        self.frame = frame

    def load(self, **_options):
        return self.frame


@pytest.fixture(scope="module")
def frames(desk_log):
    return [entry.load(colour=False) for entry in open_source(desk_log, SourceConfig(last_frame=4)).entries()]


@pytest.fixture(scope="module")
def T_first_last(desk_log):  # noqa: N802
    T = open_source(desk_log).truth.T_world_body
    return inverse(T[0]) @ T[4]


def test_the_hybrid_odometry_recovers_a_motion_both_ways_wherever_the_camera_is(frames, T_first_last):
    T_body_camera = exp(np.array([0.4, -0.8, 1.2]), np.array([0.1, 0.2, -0.3]))
    first, last = (
        RgbdFrame(frame.stamp_ns, frame.image, frame.depth_m, frame.camera, T_body_camera)
        for frame in (frames[0], frames[-1])
    )
    T_true = T_body_camera @ T_first_last @ inverse(T_body_camera)
    before = [(frame.gray.copy(), frame.depth_m.copy()) for frame in (first, last)]
    forth, again = (HybridRgbd(first).align(last, np.eye(4)) for _ in range(2))
    back = HybridRgbd(last).align(first, np.eye(4))
    for alignment, T in ((forth, T_true), (back, inverse(T_true))):
        assert alignment.converged
        assert np.linalg.norm(alignment.T_target_source[:3, 3] - T[:3, 3]) < 0.01
        assert angle_between(alignment.T_target_source[:3, :3], T[:3, :3]) < np.deg2rad(0.5)
        assert 0.3 < alignment.inlier_ratio <= 1.0
    np.testing.assert_array_equal(again.T_target_source, forth.T_target_source)
    for frame, (gray, depth_m) in zip((first, last), before, strict=True):
        np.testing.assert_array_equal(frame.gray, gray)
        np.testing.assert_array_equal(frame.depth_m, depth_m)


def test_the_hybrid_odometry_gives_no_answer_without_depth(frames):
    camera = frames[0].camera
    nothing = RgbdFrame(0, frames[0].gray, np.zeros_like(frames[0].depth_m), camera)
    alignment = HybridRgbd(frames[0]).align(nothing, np.eye(4))
    assert not alignment.converged
    assert alignment.reason


@pytest.mark.parametrize("sensor", ["rgbd", "lidar"])
def test_lengths_are_fitted_to_the_sensor(sensor):
    configs = {config.kind: config for config in registrations_for(sensor)}
    gicp, hough, kiss = configs["gicp"], configs["hough-gicp"], kiss_icp(sensor)
    assert gicp.voxel_m == VOXEL_M[sensor]
    share = 0.1 if sensor == "rgbd" else 1.0
    usual = HoughGicpConfig()
    assert hough.voting.bin_m == pytest.approx(share * usual.voting.bin_m)
    assert hough.refinement.pair_distances_m[0] == pytest.approx(share * usual.refinement.pair_distances_m[0])
    assert hough.constellation.levelling.max_height_m == usual.constellation.levelling.max_height_m
    for name in ("inlier_m", "cell_m", "reach_m"):
        length_m = getattr(usual.constellation.levelling, name)
        assert getattr(hough.constellation.levelling, name) == pytest.approx(share * length_m)
    assert hough.acceptance.pair_m == pytest.approx(share * usual.acceptance.pair_m)
    for name in ("map_voxel_m", "initial_threshold_m", "min_motion_m"):
        assert getattr(kiss, name) == pytest.approx(share * getattr(KissOdometryConfig(), name))
    assert (kiss.rescue, kiss.usual_ratio, kiss.lost_ratio) == (None, 0.0, 0.0)


def test_every_method_serves_as_odometry_and_on_pairs(desk_log):
    source = open_source(desk_log, SourceConfig(last_frame=1))
    methods, notes = methods_for(source, CompareConfig())
    assert not notes
    reader = FrameReader(RgbdCompareConfig())
    first, second = (reader.read(entry) for entry in source.entries())
    for method in methods:
        tracker = method.tracker()
        placed = [tracker.add(method.view(moment)) for moment in (first, second)]
        alignment = method.registration(method.view(first))(method.view(second), np.eye(4))
        assert len(tracker.trajectory()) == 2, method.name
        if not method.name.startswith("hough"):  # too few objects stand on this desk
            assert placed == [True, True], method.name
            assert alignment.converged, method.name
