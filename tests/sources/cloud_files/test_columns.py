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


LIVOX = "Version,Slot ID,LiDAR Index,Rsvd,Error Code,Timestamp Type,Data Type,Timestamp,X,Y,Z,Reflectivity"
OUSTER = "TIMESTAMP (ns), RANGE (mm), SIGNAL (photons), X (m), Y (m), Z (m), MEASUREMENT_ID"


@pytest.mark.parametrize(("header", "before", "after"), [(LIVOX, 8, 1), (OUSTER, 3, 1)])
def test_names_of_several_words_are_one_column_each(tmp_path, header, before, after):
    """As Livox Viewer and ouster-cli write them."""
    path = tmp_path / "cloud 1.csv"
    table = np.column_stack([np.full((N, before), 7), POINTS, np.full((N, after), 9)])
    np.savetxt(path, table, delimiter=",", header=header, comments="")
    np.testing.assert_allclose(read_cloud(path).points, POINTS, atol=1e-4)
    np.savetxt(path, table[:, 1:], delimiter=",", header=header, comments="")
    with pytest.raises(FrameError, match=f"a header of {before + 3 + after} names, but {before + 2 + after}"):
        read_cloud(path)


@pytest.mark.parametrize("is_shuffled", [False, True])
def test_coordinates_one_after_the_other_are_read(tmp_path, is_shuffled):
    """As the Oxford RobotCar's files have them."""
    path, rng = tmp_path / "cloud.bin", np.random.default_rng(1)
    azimuth = np.linspace(0.0, 2.0 * np.pi, 3000)
    points = np.column_stack([9.0 * np.cos(azimuth), 9.0 * np.sin(azimuth), rng.normal(-1.5, 0.5, 3000)])
    records = np.column_stack([points, rng.uniform(0.0, 255.0, 3000)]).astype("<f4")
    if is_shuffled:
        rng.shuffle(records)
    for stored in (records, records.T):
        stored.tofile(path)
        cloud = read_cloud(path)
        np.testing.assert_array_equal(cloud.points, records[:, :3])
        np.testing.assert_array_equal(cloud.intensities, records[:, 3])
