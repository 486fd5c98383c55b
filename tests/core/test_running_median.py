import numpy as np
import pytest

from mapper.core.running_median import RunningMedian


def test_the_last_values_count():
    running = RunningMedian(memory=5)
    for value in (100.0, 200.0, 1.0, 2.0, 3.0, 4.0, 5.0):
        running.add(value)

    assert running.median == 3.0
    assert len(running) == 5


def test_too_few_values_say_nothing():
    running = RunningMedian(memory=10, fewest=3)
    for value in (7.0, 8.0):
        running.add(value)
    assert (running.median, running.sigma, running.is_known) == (0.0, 0.0, False)

    running.add(9.0)
    assert (running.median, running.is_known) == (8.0, True)


def test_sigma_is_the_standard_deviation_of_normal_values_whatever_the_outliers():
    running = RunningMedian(memory=1000)
    rng = np.random.default_rng(0)
    for value in (*rng.normal(5.0, 2.0, 900), *np.full(50, 1e6)):
        running.add(value)

    assert running.sigma == pytest.approx(2.0, rel=0.1)
