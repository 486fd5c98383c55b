import cv2
import numpy as np

from mapper.export.exporters import export
from mapper.export.figures import OCCUPIED_CELL
from mapper.octree.grid import OCCUPIED, UNKNOWN


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
