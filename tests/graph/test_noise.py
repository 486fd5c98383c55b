"""Errors that all features of a view share."""

import numpy as np
import pytest

from mapper.graph.uncertainty import with_model_error
from tests.support.planar import at


def test_model_errors_grow_with_the_distance_between_the_views():
    tight = np.eye(6) * 1e8
    near, far = with_model_error(tight, at(0.1)), with_model_error(tight, at(2.0))
    assert np.linalg.inv(far)[3, 3] ** 0.5 == pytest.approx(0.041, rel=0.01)
    assert np.linalg.inv(near)[3, 3] < np.linalg.inv(far)[3, 3]
    loose = np.eye(6)
    np.testing.assert_allclose(with_model_error(loose, at(0.1)), loose, rtol=1e-3)
