"""Columns of clouds by what headers call them, and arrays of what is no number."""

import numpy as np
import pytest

from mapper.core.errors import FrameError
from mapper.sources.cloud_files import read_cloud

N = 60
POINTS = np.random.default_rng(3).normal(0.0, 10.0, (N, 3)).astype(np.float32)
TIMES = 1_500_000 * np.arange(N, dtype=np.uint32)


def test_columns_of_veloview_are_found(tmp_path):
    path = tmp_path / "frame (0001).csv"
    names = '"intensity","laser_id","timestamp","Points_m_XYZ:0","Points_m_XYZ:1","Points_m_XYZ:2"'
    table = np.column_stack([np.full(N, 7), np.zeros(N), TIMES, POINTS])
    np.savetxt(path, table, delimiter=",", header=names, comments="")
    cloud = read_cloud(path)
    np.testing.assert_allclose(cloud.points, POINTS, atol=1e-4)
    np.testing.assert_allclose(cloud.times, TIMES)


@pytest.mark.parametrize("names", ["x_m,y_m,z_m", "X[m],Y[m],Z[m]", "x(m),y(m),z(m)", '"xm","ym","zm"'])
def test_columns_of_metres_are_coordinates(tmp_path, names):
    path = tmp_path / "cloud 1.csv"
    table = np.column_stack([np.full(N, 7), POINTS])
    np.savetxt(path, table, delimiter=",", header=f"intensity,{names}", comments="")
    np.testing.assert_allclose(read_cloud(path).points, POINTS, atol=1e-4)


def test_an_array_of_objects_is_refused_in_words(tmp_path):
    for version in ((1, 0), (2, 0)):
        with (tmp_path / "cloud.npy").open("wb") as file:
            np.lib.format.write_array(file, np.array([{"points": POINTS}]), version, allow_pickle=True)
        with pytest.raises(FrameError, match="objects of Python"):
            read_cloud(tmp_path / "cloud.npy")
