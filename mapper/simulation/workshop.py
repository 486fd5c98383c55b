"""Materials of furniture, drawn once and applied to each piece with another offset."""

import numpy as np

from mapper.core.frames import Image
from mapper.simulation import prints, surfaces
from mapper.simulation.builder import Builder, Skin
from mapper.simulation.noise import fractal, muted_color, tinted

_BOARD_M = 1.6


class Workshop:
    """Maker of skins; every call may return another one."""

    def __init__(self, builder: Builder, rng: np.random.Generator, *, px_per_m: float) -> None:
        self._builder, self._rng, self._px_per_m = builder, rng, px_per_m
        side = (round(_BOARD_M * px_per_m),) * 2
        self._boards = [surfaces.wood(rng, side, px_per_m, tone=tone) for tone in surfaces.WOODS]
        self._woods = [builder.texture(board) for board in self._boards]
        self._fabrics = [builder.texture(surfaces.fabric(rng, side, px_per_m)) for _ in range(5)]
        self._paints = [builder.texture(self._paint(side)) for _ in range(6)]

    def _paint(self, side: tuple[int, int]) -> Image:
        gain = 0.05 * fractal(self._rng, side, cell_px=(side[0] / 3, side[1] / 3), octaves=6)
        return tinted(muted_color(self._rng), gain)

    def wood(self) -> Skin:
        """A board."""
        return self._laid(self._woods)

    def fabric(self) -> Skin:
        """Upholstery."""
        return self._laid(self._fabrics)

    def paint(self) -> Skin:
        """Painted metal or plastic."""
        return self._laid(self._paints)

    def _laid(self, pool: list[int]) -> Skin:
        column_m, row_m = self._rng.uniform(0.0, _BOARD_M, 2)
        texture = pool[int(self._rng.integers(len(pool)))]
        return Skin(texture, self._px_per_m, (float(column_m), float(row_m)))

    def front(self, size_m: tuple[float, float], *, columns: int, rows: int) -> Skin:
        """Doors or drawers for a front of (width, height)."""
        board = self._boards[int(self._rng.integers(len(self._boards)))]
        shape = self._shape(size_m)
        tiled = np.tile(board, (shape[0] // board.shape[0] + 1, shape[1] // board.shape[1] + 1, 1))
        image = np.ascontiguousarray(tiled[: shape[0], : shape[1]])
        return Skin(self._builder.texture(prints.cabinet_front(self._rng, image, columns=columns, rows=rows)))

    def poster(self, size_m: tuple[float, float]) -> Skin:
        """A picture of its own."""
        return Skin(self._builder.texture(prints.poster(self._rng, self._shape(size_m, finer=1.5))))

    def document(self, size_m: tuple[float, float]) -> Skin:
        """A printed sheet."""
        return Skin(self._builder.texture(prints.document(self._rng, self._shape(size_m, finer=2.0))))

    def screen(self, size_m: tuple[float, float]) -> Skin:
        """Picture of a monitor."""
        return Skin(self._builder.texture(prints.screen(self._rng, self._shape(size_m, finer=1.5))))

    def carton(self, size_m: tuple[float, float]) -> Skin:
        """One side of a cardboard box."""
        return Skin(self._builder.texture(prints.carton(self._rng, self._shape(size_m, finer=1.5))))

    def books(self, size_m: tuple[float, float]) -> Skin:
        """A row of spines."""
        return Skin(self._builder.texture(prints.spines(self._rng, self._shape(size_m, finer=1.5))))

    def _shape(self, size_m: tuple[float, float], finer: float = 1.0) -> tuple[int, int]:
        scale = finer * self._px_per_m
        return max(round(size_m[1] * scale), 12), max(round(size_m[0] * scale), 12)
