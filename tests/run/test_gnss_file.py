"""Fixes that correct a path stay with its run."""

import numpy as np
import pytest

from mapper.core.errors import DataError
from mapper.graph.model import PositionFactor
from mapper.run.gnss_file import read_fixes, write_fixes


def test_fixes_are_read_as_they_were_written(tmp_path):
    rng = np.random.default_rng(2)
    root = rng.normal(size=(3, 3, 3))
    fixes = [
        PositionFactor(7 * k, rng.normal(size=3), rng.normal(size=3), A @ A.T, 0.1 * (k + 1), 10**18 + k)
        for k, A in enumerate(root)
    ]
    write_fixes(tmp_path / "gnss.csv", fixes)
    for read, fix in zip(read_fixes(tmp_path / "gnss.csv"), fixes, strict=True):
        assert (read.node, read.weight, read.stamp_ns) == (fix.node, fix.weight, fix.stamp_ns)
        np.testing.assert_array_equal(read.point_node, fix.point_node)
        np.testing.assert_array_equal(read.position_world, fix.position_world)
        np.testing.assert_allclose(read.information, fix.information, rtol=1e-15)


def test_another_table_is_refused(tmp_path):
    (tmp_path / "gnss.csv").write_text("stamp_ns,node\n1,2\n")
    with pytest.raises(DataError, match=r"gnss\.csv"):
        read_fixes(tmp_path / "gnss.csv")
