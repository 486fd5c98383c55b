"""Exports of a map that GNSS placed: LAS, GIS and nav2 say where it is."""

import json
import re
from dataclasses import replace

import cv2
import laspy
import numpy as np
import pytest
import yaml

from mapper.core.geodesy import FLATTENING, SEMI_MAJOR_M
from mapper.export.crs import wkt_of
from mapper.export.exporters import export
from mapper.export.figures import OCCUPIED_CELL
from mapper.octree.grid import OCCUPIED, UNKNOWN
from mapper.run.georeference_record import Georeference

PLACE = Georeference(
    latitude_deg=47.4979,
    longitude_deg=19.0402,
    height_m=850.0,
    is_corrected=True,
    fixes=200,
    outliers=3,
    residual_before_m=2.5,
    residual_m=0.8,
    heading_sigma_rad=0.01,
    has_antenna=True,
)


@pytest.fixture(scope="module")
def placed(desk_run):
    return replace(desk_run, manifest=desk_run.manifest.model_copy(update={"georeference": PLACE}))


def projected(wkt: str, geodetic: np.ndarray) -> np.ndarray:
    """Coordinates of Snyder's transverse Mercator (USGS 1395, eq. 8-9 to 8-15), by a WKT's parameters."""
    number = {name: float(value) for name, value in re.findall(r'PARAMETER\["(\w+)",([-\d.e]+)\]', wkt)}
    e2 = FLATTENING * (2.0 - FLATTENING)
    second = e2 / (1.0 - e2)

    def meridian_m(latitude):
        return SEMI_MAJOR_M * (
            (1 - e2 / 4 - 3 * e2**2 / 64 - 5 * e2**3 / 256) * latitude
            - (3 * e2 / 8 + 3 * e2**2 / 32 + 45 * e2**3 / 1024) * np.sin(2 * latitude)
            + (15 * e2**2 / 256 + 45 * e2**3 / 1024) * np.sin(4 * latitude)
            - 35 * e2**3 / 3072 * np.sin(6 * latitude)
        )

    phi, lam = np.radians(geodetic[:, :2]).T
    phi_0, lam_0 = np.radians([number["latitude_of_origin"], number["central_meridian"]])
    N = SEMI_MAJOR_M / np.sqrt(1 - e2 * np.sin(phi) ** 2)
    T, C, A = np.tan(phi) ** 2, second * np.cos(phi) ** 2, (lam - lam_0) * np.cos(phi)
    x = N * (A + (1 - T + C) * A**3 / 6)
    y = meridian_m(phi) - meridian_m(phi_0)
    y = y + N * np.tan(phi) * (A**2 / 2 + (5 - T + 9 * C + 4 * C**2) * A**4 / 24)
    return number["scale_factor"] * np.column_stack([x, y])


@pytest.mark.parametrize(("reach_m", "limit_m"), [(1000.0, 1e-3), (3000.0, 2e-3), (10_000.0, 2e-2)])
def test_the_projections_coordinates_are_the_maps(reach_m, limit_m):
    points = np.random.default_rng(1).uniform(-1.0, 1.0, (50, 3)) * [reach_m, reach_m, 0.0]
    off = projected(wkt_of(PLACE), PLACE.origin.geodetic(points)) - points[:, :2]
    assert np.abs(off).max() < limit_m


@pytest.mark.parametrize("name", ["cloud.las", "cloud.laz"])
def test_las_has_the_reference_system(placed, desk_run, tmp_path, name):
    cloud = laspy.read(export(placed, "las", tmp_path / name))
    (record,) = [vlr for vlr in cloud.header.vlrs if vlr.user_id == "LASF_Projection"]
    assert record.record_id == 2112
    assert record.string == wkt_of(PLACE)
    assert (str(cloud.header.version), cloud.header.global_encoding.wkt) == ("1.4", True)
    plain = laspy.read(export(desk_run, "las", tmp_path / f"plain_{name}"))
    assert str(plain.header.version) == "1.2"
    np.testing.assert_array_equal(cloud.xyz, plain.xyz)
    np.testing.assert_array_equal(cloud.red, plain.red)


def test_gis_has_the_reference_system_and_the_path_on_earth(placed, tmp_path):
    folder = export(placed, "gis", tmp_path / "gis")
    for name in ("slice", "traversable"):
        assert (folder / f"{name}.prj").read_text().strip() == wkt_of(PLACE)
        assert "<SRS>PROJCS[" in (folder / f"{name}.png.aux.xml").read_text()
    (feature,) = json.loads((folder / "trajectory.geojson").read_text())["features"]
    longitude_latitude_height = np.array(feature["geometry"]["coordinates"])
    positions = PLACE.origin.enu(longitude_latitude_height[:, [1, 0, 2]])
    np.testing.assert_allclose(positions, placed.trajectory.positions_world, atol=1e-5)
    assert feature["properties"]["stamps_ns"] == placed.trajectory.stamps_ns.tolist()
    export(placed, "gis", folder, overwrite=True)  # knows its own files


def test_nav2_has_the_datum(placed, desk_run, tmp_path):
    parameters = yaml.safe_load((export(placed, "nav2", tmp_path / "a") / "nav2_params.yaml").read_text())
    datum = parameters["navsat_transform"]["ros__parameters"]
    assert datum == {"wait_for_datum": True, "datum": [47.4979, 19.0402, 0.0]}
    plain = yaml.safe_load((export(desk_run, "nav2", tmp_path / "b") / "nav2_params.yaml").read_text())
    assert plain == {name: value for name, value in parameters.items() if name != "navsat_transform"}


def test_autoware_knows_the_place(placed, tmp_path):
    projector = yaml.safe_load(
        (export(placed, "autoware", tmp_path / "map") / "map_projector_info.yaml").read_text()
    )
    assert projector.pop("scale_factor") == pytest.approx(1.0 + 850.0 / 6371e3, abs=1e-8)
    assert projector == {
        "projector_type": "TransverseMercator",
        "vertical_datum": "WGS84",
        "map_origin": {"latitude": 47.4979, "longitude": 19.0402},
    }
    moved = export(placed, "autoware", tmp_path / "moved", frame="start")
    assert (moved / "map_projector_info.yaml").read_text() == "projector_type: Local\n"


def test_a_gis_finds_every_cell_where_it_is(desk_run, tmp_path):
    folder = export(desk_run, "gis", tmp_path / "gis")
    assert {path.name for path in folder.iterdir()} == {
        *("manifest.json", "slice.png", "slice.pgw", "traversable.png", "traversable.pgw"),
    }
    for name, grid in (("slice", desk_run.slice), ("traversable", desk_run.traversable)):
        bgra = cv2.imread(str(folder / f"{name}.png"), cv2.IMREAD_UNCHANGED)
        assert bgra.shape == (*grid.cells.shape, 4)
        width_m, turned, skewed, height_m, x, y = map(float, (folder / f"{name}.pgw").read_text().split())
        assert (width_m, turned, skewed, height_m) == (grid.resolution_m, 0.0, 0.0, -grid.resolution_m)
        rows, columns = np.nonzero(grid.cells == OCCUPIED)
        centres_m = grid.origin_world_m + (np.column_stack([columns, rows]) + 0.5) * grid.resolution_m
        pixels = (centres_m - [x, y]) / [width_m, height_m]
        np.testing.assert_allclose(pixels, np.rint(pixels), atol=1e-6)
        columns, rows = np.rint(pixels).astype(int).T
        assert (bgra[rows, columns] == (*OCCUPIED_CELL[::-1], 255)).all()
        assert ((bgra[..., 3] == 0) == (grid.cells[::-1] == UNKNOWN)).all()
