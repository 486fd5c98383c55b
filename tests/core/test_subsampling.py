import pytest

from mapper.core.subsampling import stride_for


@pytest.mark.parametrize("count", [0, 1, 9, 10, 11, 20, 21])
def test_the_smallest_step_that_leaves_few_enough(count):
    step = stride_for(count, 10)
    assert len(range(0, count, step)) <= 10
    assert step == 1 or len(range(0, count, step - 1)) > 10
