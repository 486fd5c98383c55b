import numpy as np
import pytest

from mapper.core.errors import DataError, MapFileError, expect_shape


def test_the_middle_of_a_long_message_is_left_out():
    assert str(DataError("log.txt:3: 'x' is no number")) == "log.txt:3: 'x' is no number"
    said = str(DataError(f"log.txt:3: {5000 * '1'} is no number"))
    assert said.startswith("log.txt:3: 111")
    assert " … " in said
    assert said.endswith("111 is no number")
    assert len(said) < 1000


def test_named_axes_are_returned():
    assert expect_shape(np.zeros((4, 5, 3)), "H,W,3", "image") == {"H": 4, "W": 5}


@pytest.mark.parametrize(
    ("shape", "want"), [((3, 4), "N,3"), ((3,), "N,3"), ((2, 3), "N,N"), ((), "N"), ((4, 4, 1), "4,4")]
)
def test_other_shapes_are_refused_with_both_shapes_named(shape, want):
    with pytest.raises(DataError) as refusal:
        expect_shape(np.zeros(shape), want, "octree: points")

    assert "octree: points" in str(refusal.value)
    assert str(shape) in str(refusal.value)


def test_the_caller_chooses_the_error():
    with pytest.raises(MapFileError):
        expect_shape(np.zeros(2), "N,3", "points", error=MapFileError)
