"""Loop closures: their file, their verdicts, and what the solver makes of them."""

from dataclasses import replace

import numpy as np
import pytest

from mapper.core.errors import DataError, RunError
from mapper.core.geometry import exp, transform
from mapper.graph.model import Solution
from mapper.loops.closure import (
    SOLVER,
    Discrepancy,
    apply_solution,
    discrepancy,
    read_closures,
    rejections,
    write_closures,
)
from tests.support.loop_closures import loop
from tests.support.planar import at


def test_the_file_of_closures_comes_back_whole(tmp_path):
    path = tmp_path / "loops.jsonl"
    accepted = loop(
        1,
        5,
        at(0.3, 0.2, 0.7),
        similarity=0.41,
        matches=80,
        inliers=60,
        rmse_m=0.01,
        residual_px=0.8,
        before=Discrepancy(0.2, 0.01),
        after=Discrepancy(0.01, 0.001),
        weight=1.0,
    )
    refused = loop(2, 6, verdict="rejected", reason="isvd: 3 pairs", information=None, T_i_j=None)
    refused = replace(refused, T_i_j=None)
    write_closures(path, [accepted, refused])
    first, second = read_closures(path)
    np.testing.assert_allclose(first.T_i_j, accepted.T_i_j, atol=1e-12)
    np.testing.assert_array_equal(first.information, accepted.information)
    assert (first.before, first.after, first.similarity) == (
        accepted.before,
        accepted.after,
        accepted.similarity,
    )
    assert (second.verdict, second.reason, second.T_i_j) == ("rejected", "isvd: 3 pairs", None)


def test_a_damaged_line_is_named(tmp_path):
    path = tmp_path / "loops.jsonl"
    write_closures(path, [loop(1, 5)])
    path.write_text(path.read_text() + '{"i": 3}\n')
    with pytest.raises(DataError, match=r"loops\.jsonl:2: not a loop closure"):
        read_closures(path)
    with pytest.raises(RunError, match="cannot be read"):
        read_closures(tmp_path / "none.jsonl")


def test_a_verdict_fits_its_reason():
    with pytest.raises(DataError, match="a rejected loop says why"):
        loop(1, 2, verdict="rejected")
    with pytest.raises(DataError, match="a rejected loop says why"):
        loop(1, 2, reason="unconfirmed: …")
    with pytest.raises(DataError, match="without a measurement"):
        loop(1, 2, information=None)


def test_loops_that_the_solver_lets_go_are_rejected():
    before = {0: at(0.0), 1: at(1.0), 2: at(2.0)}
    loops = [
        loop(0, 1, at(1.1)),
        loop(0, 2, verdict="rejected", reason="unconfirmed: no", information=None),
        loop(0, 2, at(5.0)),
    ]
    solved = Solution({0: at(0.0), 1: at(1.1), 2: at(2.0)}, 1, (0.0,) * 3, (0.0,) * 3, (1.0, 0.9, 0.02))
    kept, unconfirmed, refused = apply_solution(loops, before, solved)
    assert kept.verdict == "accepted"
    assert kept.before.translation_m == pytest.approx(0.1)
    assert kept.after.translation_m == pytest.approx(0.0, abs=1e-9)
    assert kept.weight == 0.9
    assert unconfirmed is loops[1]
    assert (refused.verdict, refused.weight) == ("rejected", 0.02)
    assert [loop.rejected_by for loop in (kept, unconfirmed, refused)] == ["", "unconfirmed", SOLVER]
    assert rejections([kept, unconfirmed, refused, refused]) == {SOLVER: 2, "unconfirmed": 1}


def test_the_constraint_is_a_loop():
    assert loop(1, 5).factor.origin == "loop"
    with pytest.raises(DataError, match="nothing was measured"):
        _ = replace(loop(1, 5, verdict="rejected", reason="x: y"), T_i_j=None).factor


def test_discrepancy_is_zero_where_the_loop_holds():
    T_i = transform(exp(np.array([0.1, 0.2, 0.3]), np.zeros(3))[:3, :3], np.array([1.0, 2.0, 3.0]))
    T_i_j = at(0.5, 0.2, 0.3)
    assert discrepancy(T_i_j, T_i, T_i @ T_i_j).translation_m == pytest.approx(0.0, abs=1e-12)
