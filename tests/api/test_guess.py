"""First guesses of a motion, as text and as files."""

import numpy as np
import pytest

from mapper.api.register import parse_guess
from mapper.core.errors import ConfigError
from mapper.core.rotations import rotation_from_euler


def test_a_guess_is_read_in_every_form(tmp_path):
    R = rotation_from_euler(*np.radians([10.0, -20.0, 30.0]))
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, [1.0, -2.0, 0.5]
    assert np.allclose(parse_guess("1, -2 0.5 10 -20 30"), T)
    assert np.array_equal(parse_guess(None), np.eye(4))
    matrix, rows, tum = tmp_path / "T.txt", tmp_path / "rows.txt", tmp_path / "pose.tum"
    np.savetxt(matrix, T)
    np.savetxt(rows, T[:3])
    tum.write_text("# stamp x y z qx qy qz qw\n1.5 1 -2 0.5 0 0 0.7071067811865476 0.7071067811865476\n")
    assert np.allclose(parse_guess(str(matrix)), T)
    assert np.allclose(parse_guess(str(rows)), T)
    assert np.allclose(parse_guess(str(tum))[:3, 3], T[:3, 3])
    assert np.allclose(parse_guess(str(tum))[:2, :2], [[0.0, -1.0], [1.0, 0.0]])


@pytest.mark.parametrize(
    ("content", "complaint"),
    [("1 2 nan 0 0 0", "not finite"), ("somewhere", "no such file"), ("1 2 3 4 5 6 7", "7 numbers")],
)
def test_a_guess_that_is_none_says_why(content, complaint):
    with pytest.raises(ConfigError, match=complaint):
        parse_guess(content)


def test_a_matrix_that_is_no_motion_is_refused(tmp_path):
    path = tmp_path / "T.txt"
    np.savetxt(path, 2.0 * np.eye(4))
    with pytest.raises(ConfigError, match="no rigid motion"):
        parse_guess(str(path))
