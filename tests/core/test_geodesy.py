"""WGS 84: against PROJ 9 (pyproj 3.7, EPSG:4979 to 4978 and ``+proj=topocentric``), and back again."""

import numpy as np
import pytest

from mapper.core.geodesy import GeodeticOrigin, ecef_from_geodetic, geodetic_from_ecef

OF_PROJ = {
    (47.4979, 19.0402, 150.0): (4080950.7079075677, 1408387.55346137, 4679450.594461306),
    (-34.6, -58.5, -25.5): (2746111.946905012, -4481247.413601468, -3601414.1991104623),
    (89.9, 10.0, 3000.0): (11004.860444765598, 1940.4538153435326, 6359742.562540053),
}
ORIGIN = GeodeticOrigin(47.4979, 19.0402, 150.0)


@pytest.mark.parametrize(("place", "ecef"), OF_PROJ.items())
def test_points_are_where_proj_has_them(place, ecef):
    np.testing.assert_allclose(ecef_from_geodetic(np.array([place])), [ecef], rtol=0.0, atol=1e-6)
    back = geodetic_from_ecef(np.array([ecef]))
    np.testing.assert_allclose(back[:, :2], [place[:2]], rtol=0.0, atol=1e-11)
    assert back[0, 2] == pytest.approx(place[2], abs=1e-6)


def test_the_local_frame_is_that_of_proj():
    enu = ORIGIN.enu(np.array([[47.51, 19.05, 170.0]]))
    expected = (738.2463804013962, 1345.3684936805628, 19.81528860317553)
    np.testing.assert_allclose(enu, [expected], rtol=0.0, atol=1e-6)


def test_points_within_100_km_come_back():
    points = np.random.default_rng(3).uniform(-1e5, 1e5, (1000, 3)) * [1.0, 1.0, 0.09]
    back = ORIGIN.enu(ORIGIN.geodetic(points))
    np.testing.assert_allclose(back, points, rtol=0.0, atol=1e-6)
    poles = np.array([[90.0, 0.0, 10.0], [-90.0, 0.0, 10.0]])
    np.testing.assert_allclose(
        geodetic_from_ecef(ecef_from_geodetic(poles))[:, ::2], poles[:, ::2], atol=1e-6
    )


def test_an_origin_moves_east_north_and_up():
    moved = ORIGIN.moved(np.array([300.0, -400.0, 20.0]))
    np.testing.assert_allclose(moved.enu(ORIGIN.geodetic(np.array([[300.0, -400.0, 20.0]]))), 0.0, atol=1e-6)
    assert moved.longitude_deg > ORIGIN.longitude_deg
    assert moved.latitude_deg < ORIGIN.latitude_deg
