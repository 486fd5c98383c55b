"""Silent failures: what is wrong and not said, what is said and not wrong."""

import numpy as np
import pytest

from mapper.core.geometry import exp, inverse
from mapper.core.timebase import NS_PER_S
from mapper.core.trajectory import Trajectory
from mapper.evaluators.metrics.silent_failures import check_doubts
from mapper.odometry.base import Diagnostics
from mapper.run.frame_records import FrameRecord

FRAMES, RATE_HZ = 50, 10
STAMPS_NS = np.arange(FRAMES) * NS_PER_S // RATE_HZ
SEEN = Diagnostics(100, 90, 80, 0.5, "px", "map")


def walk(*, jump_at=None, jump_m=0.0, turn_rad=0.0):
    """Return a path along x at 0.5 m/s; from a frame on it lies elsewhere."""
    poses = []
    for k in range(FRAMES):
        T = np.eye(4)
        T[0, 3] = 0.5 * k / RATE_HZ
        if jump_at is not None and k >= jump_at:
            T = T @ exp(np.array([0.0, 0.0, turn_rad]), np.array([0.0, jump_m, 0.0]))
        poses.append(T)
    return Trajectory(STAMPS_NS, np.array(poses))


def records(*, flagged=(), lost=(), sigmas=None, keyframe_every=5):
    node, rows = 0, []
    for k in range(FRAMES):
        is_keyframe = k % keyframe_every == 0
        node = k if is_keyframe else node
        outcome = "doubtful" if k in flagged else "tracked"
        doubts = ("jump of 0.5 m",) if k in flagged else ()
        if k in lost:
            rows.append(FrameRecord(int(STAMPS_NS[k]), "lost", None, False, SEEN))
        else:
            rows.append(FrameRecord(int(STAMPS_NS[k]), outcome, node, is_keyframe, SEEN, doubts, sigmas))
    return rows


def without(trajectory, frames):
    kept = np.setdiff1d(np.arange(FRAMES), list(frames))
    return Trajectory(trajectory.stamps_ns[kept], trajectory.T_world_body[kept])


@pytest.mark.parametrize(("jump_m", "turn_deg"), [(0.3, 0.0), (0.0, 8.0), (0.19, 0.0), (0.0, 4.9)])
def test_a_jump_beyond_the_limits_is_in_every_window_across_it(jump_m, turn_deg):
    moved = walk(jump_at=23, jump_m=jump_m, turn_rad=np.deg2rad(turn_deg))
    check = check_doubts(moved, records(), walk())
    if jump_m < 0.2 and turn_deg < 5.0:
        assert check.wrong == 0
        return
    assert check.wrong == check.silent == RATE_HZ
    assert check.silent_at_s == tuple(np.arange(13, 23) / RATE_HZ)
    assert np.degrees(check.worst_rad) == pytest.approx(turn_deg, abs=1e-6)
    if jump_m:
        assert check.worst_m == pytest.approx(jump_m)


def test_a_doubtful_or_lost_frame_breaks_the_silence_of_its_windows():
    moved = walk(jump_at=23, jump_m=0.5)
    doubted = check_doubts(moved, records(flagged={23}), walk())
    assert (doubted.wrong, doubted.silent, doubted.worst_m) == (RATE_HZ, 0, 0.0)
    elsewhere = check_doubts(moved, records(flagged={40}), walk())
    assert elsewhere.silent == RATE_HZ

    lost = {22, 23}
    gone = check_doubts(without(moved, lost), records(lost=lost), walk())
    assert gone.wrong > 0
    assert gone.silent == 0


def test_a_gap_of_the_log_is_no_excuse():
    moved, truth = walk(jump_at=30, jump_m=0.5), walk()
    gap = set(range(20, 40))
    rows = [row for k, row in enumerate(records()) if k not in gap]
    check = check_doubts(without(moved, gap), rows, truth)
    assert check.wrong == check.silent == RATE_HZ
    assert check.silent_at_s[-1] == 1.9


def test_an_error_within_five_sigma_is_none_and_beyond_is_one():
    moved = walk(jump_at=23, jump_m=0.5)
    wide, narrow = (0.01,) * 3 + (0.1,) * 3, (0.01,) * 3 + (0.01,) * 3
    assert check_doubts(moved, records(sigmas=wide), walk()).wrong == 0
    assert check_doubts(moved, records(sigmas=narrow), walk()).silent == RATE_HZ


def test_sigmas_add_up_from_keyframe_to_keyframe():
    # From keyframe to keyframe a second has two of them: 0.5 m is 5.9 times 0.06 m times √2. From another
    # frame there are its own and the last one's besides: 4.2 times 0.06 m times √4.
    moved = walk(jump_at=23, jump_m=0.5)
    check = check_doubts(moved, records(sigmas=(1e-6,) * 3 + (0.06,) * 3), walk())
    assert check.silent_at_s == (1.5, 2.0)
    assert check_doubts(moved, records(sigmas=(1e-6,) * 3 + (0.075,) * 3), walk()).silent == 0
    assert check_doubts(moved, records(sigmas=(1e-6,) * 3 + (0.045,) * 3), walk()).silent == RATE_HZ


def test_a_keyframes_turn_moves_what_lies_before_it():
    # All from keyframe 20 on is turned about it: 0.5 rad is 1.7 σ, though frames end up 0.25 m aside.
    poses = walk().T_world_body.copy()
    turned = poses[20] @ exp(np.array([0.0, 0.0, 0.5]), np.zeros(3)) @ inverse(poses[20])
    poses[20:] = turned @ poses[20:]
    moved = Trajectory(STAMPS_NS, poses)
    assert check_doubts(moved, records(sigmas=(0.3,) * 3 + (1e-3,) * 3), walk()).wrong == 0
    assert check_doubts(moved, records(sigmas=(0.03,) * 3 + (1e-3,) * 3), walk()).silent == RATE_HZ


def test_right_frames_that_are_doubted_are_counted():
    check = check_doubts(walk(), records(flagged={7, 8, 9, 30}), walk())
    assert (check.right, check.flagged_right) == (FRAMES, 4)
    assert check.flagged_right_ratio == pytest.approx(0.08)

    off = walk()
    poses = off.T_world_body.copy()
    poses[30, 1, 3] += 0.1
    check = check_doubts(Trajectory(STAMPS_NS, poses), records(flagged={7, 30}), walk())
    assert (check.right, check.flagged_right) == (FRAMES - 1, 1)
