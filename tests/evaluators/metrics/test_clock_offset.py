"""Clock offset of a truth."""

import numpy as np
import pytest

from mapper.cli.summary import short_text
from mapper.core.geometry import exp
from mapper.core.timebase import NS_PER_S
from mapper.core.trajectory import Trajectory
from mapper.evaluators.metrics.clock_offset import clock_offset
from mapper.evaluators.metrics.evaluate import assess


def path(at_s, *, late_s=0.0, noise_m=0.0):
    """Return a body's wavy path at (N,) times, stamped late."""
    phase = at_s + 0.03 * at_s**2
    position_m = np.column_stack([np.sin(0.9 * phase), 0.7 * np.cos(1.7 * phase), 0.2 * np.sin(0.4 * at_s)])
    position_m += noise_m * np.random.default_rng(2).standard_normal(position_m.shape)
    poses = np.array(
        [exp(np.array([0.0, 0.0, 0.3 * np.sin(s)]), p) for s, p in zip(at_s, position_m, strict=True)]
    )
    return Trajectory(np.round((at_s + late_s) * NS_PER_S).astype(np.int64), poses)


SECONDS = np.arange(0.0, 30.0, 0.1)


@pytest.mark.parametrize("late_s", [0.08, -0.513, 1.9])
@pytest.mark.parametrize("alignment", ["none", "yaw", "se3", "sim3"])
def test_an_offset_is_found_of_either_sign(late_s, alignment):
    estimate = path(SECONDS, noise_m=0.01)
    found = clock_offset(estimate, path(np.arange(-3.0, 33.0, 0.07), late_s=late_s), alignment)
    assert found.offset_s == pytest.approx(late_s, abs=0.004)
    assert found.rmse_m == pytest.approx(0.01 * 3**0.5, rel=0.1)


def test_errors_of_the_estimate_are_no_offset():
    truth = path(np.arange(-3.0, 33.0, 0.07))
    assert clock_offset(path(SECONDS, noise_m=0.05), truth, "se3") is None
    bent = path(SECONDS)
    bent.T_world_body[:, 0, 3] *= 1.0 + 0.01 * SECONDS
    assert clock_offset(bent, truth, "se3") is None


def test_it_is_not_looked_for_where_it_could_not_be_seen():
    straight = Trajectory((SECONDS * NS_PER_S).astype(np.int64), np.tile(np.eye(4), (len(SECONDS), 1, 1)))
    straight.T_world_body[:, 0, 3] = SECONDS
    late = Trajectory(straight.stamps_ns + NS_PER_S // 2, straight.T_world_body)
    assert clock_offset(straight, late, "se3") is None, "an even motion along a line shows no offset"
    few = path(SECONDS[:4])
    assert clock_offset(few, path(SECONDS[:4], late_s=0.1), "se3") is None
    beyond = clock_offset(path(SECONDS), path(SECONDS, late_s=2.5), "se3")
    assert beyond is None


def test_an_evaluation_and_the_end_of_a_build_report_it(desk_run):
    run = desk_run
    late = Trajectory(run.truth.stamps_ns + NS_PER_S // 10, run.truth.T_world_body)
    found = assess(run.trajectory, late, max_gap_s=0.05)
    assert found["clock offset of the truth: ATE"] < 0.3 * found.ate_m
    assert found["clock offset of the truth"] == pytest.approx(0.1, abs=0.02)
    assert " s late, without which ATE is 0.0" in short_text(run, found.metrics)
    early = Trajectory(run.truth.stamps_ns - NS_PER_S // 10, run.truth.T_world_body)
    assert " s early, without which ATE is 0.0" in short_text(
        run, assess(run.trajectory, early, max_gap_s=0.05).metrics
    )
    assert "seem" not in short_text(run, assess(run.trajectory, run.truth).metrics)
