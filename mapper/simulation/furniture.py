"""Pieces of furniture, each built of boxes in its own frame.

In a piece's frame x runs along its width, +y is its front, z is up; the origin is the middle of its
footprint.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from mapper.core.frames import Image
from mapper.simulation import textures
from mapper.simulation.builder import Builder, Place, Skin
from mapper.simulation.noise import fractal, muted_color, tinted

_SAMPLE_M = 1.6
_FRONT, _TOP = 3, 5
_BOARD_M = 0.03

Print = Callable[[np.random.Generator, tuple[int, int]], Image]
"""(rng, (H, W) in pixels) -> image."""

Size = tuple[float, float, float]
"""Width, depth, height in metres."""


class Studio:
    """Materials, random numbers and the builder, which every piece needs.

    Materials are drawn once, and each piece shows another part of them.

    Args:
        builder: Takes the boxes.
        rng: Draws what a piece looks like, and where it stands.
        another_day: Draws where loose pieces stand instead; None leaves them where they are.
        px_per_m: Detail of the materials.
    """

    def __init__(
        self,
        builder: Builder,
        rng: np.random.Generator,
        another_day: np.random.Generator | None = None,
        *,
        px_per_m: float,
    ) -> None:
        self.builder, self.rng, self.another_day, self._px_per_m = builder, rng, another_day, px_per_m
        side = (round(_SAMPLE_M * px_per_m),) * 2
        self._boards = [textures.wood(rng, side, px_per_m, tone=tone) for tone in textures.WOODS]
        self._woods = [builder.texture(board) for board in self._boards]
        self._fabrics = [builder.texture(textures.fabric(rng, side, px_per_m)) for _ in range(5)]
        self._paints = [builder.texture(self._paint(side)) for _ in range(6)]

    def _paint(self, side: tuple[int, int]) -> Image:
        gain = 0.05 * fractal(self.rng, side, cell_px=(side[0] / 3, side[1] / 3), octaves=6)
        return tinted(muted_color(self.rng), gain)

    def wood(self) -> Skin:
        """Return the skin of a board."""
        return self._lay(self._woods)

    def fabric(self) -> Skin:
        """Return the skin of upholstery."""
        return self._lay(self._fabrics)

    def paint(self) -> Skin:
        """Return the skin of painted metal or plastic."""
        return self._lay(self._paints)

    def _lay(self, pool: list[int]) -> Skin:
        column_m, row_m = self.rng.uniform(0.0, _SAMPLE_M, 2)
        texture = pool[int(self.rng.integers(len(pool)))]
        return Skin(texture, self._px_per_m, (float(column_m), float(row_m)))

    def front(self, size_m: tuple[float, float], *, columns: int, rows: int) -> Skin:
        """Return doors or drawers for a front of (width, height)."""
        board = self._boards[int(self.rng.integers(len(self._boards)))]
        shape = self._shape(size_m)
        tiled = np.tile(board, (shape[0] // board.shape[0] + 1, shape[1] // board.shape[1] + 1, 1))
        image = np.ascontiguousarray(tiled[: shape[0], : shape[1]])
        return Skin(self.builder.texture(textures.cabinet_front(self.rng, image, columns=columns, rows=rows)))

    def print(self, draw: Print, size_m: tuple[float, float]) -> Skin:
        """Return a face of (width, height) with a drawing of its own."""
        shape = self._shape(size_m, finer=2.0 if draw is textures.document else 1.5)
        return Skin(self.builder.texture(draw(self.rng, shape)))

    def _shape(self, size_m: tuple[float, float], finer: float = 1.0) -> tuple[int, int]:
        scale = finer * self._px_per_m
        return max(round(size_m[1] * scale), 12), max(round(size_m[0] * scale), 12)


@dataclass(frozen=True, slots=True)
class Piece:
    """A kind of furniture.

    Attributes:
        name: Name of its boxes.
        smallest: Smallest size.
        largest: Largest size.
        build: Adds the boxes of one piece of a given size.
        at_wall: It stands with its back to a wall; otherwise anywhere, turned any way.
    """

    name: str
    smallest: Size
    largest: Size
    build: Callable[[Studio, Place, Size], None]
    at_wall: bool


def shelf(studio: Studio, place: Place, size: Size) -> None:
    """A bookcase with books of many heights."""
    width, depth, height = size
    box, rng, skin = studio.builder.box, studio.rng, studio.wood()
    for left in (-width / 2, width / 2 - _BOARD_M):
        box("shelf", place, low=(left, -depth / 2, 0), size=(_BOARD_M, depth, height), skin=skin)
    inner = width - 2 * _BOARD_M
    box("shelf", place, low=(-inner / 2, -depth / 2, 0), size=(inner, 0.01, height), skin=studio.wood())
    boards = int(height / 0.36)
    for z in np.linspace(0.06, height - _BOARD_M, boards):
        box(
            "shelf",
            place,
            low=(-inner / 2, -depth / 2 + 0.01, z),
            size=(inner, depth - 0.01, _BOARD_M),
            skin=skin,
        )
        if z > height - 0.2:
            break
        left = -inner / 2
        while left < inner / 2 - 0.1:
            wide = min(float(rng.uniform(0.1, 0.32)), inner / 2 - left)
            row = (wide, float(rng.uniform(0.5, 0.85)) * depth, float(rng.uniform(0.17, 0.27)))
            if rng.random() < 0.85:
                low = (left, -depth / 2 + 0.012, z + _BOARD_M)
                spines = {_FRONT: studio.print(textures.spines, (row[0], row[2]))}
                box("books", place, low=low, size=row, skin=studio.paint(), faces=spines)
            left += wide + 0.004


def cabinet(studio: Studio, place: Place, size: Size) -> None:
    """A sideboard or a wardrobe; a low one has things on it."""
    width, depth, height = size
    columns, rows = max(round(width / 0.5), 1), (1 if height > 1.5 else int(studio.rng.integers(1, 4)))
    front = studio.front((width, height - 0.06), columns=columns, rows=rows)
    low = (-width / 2, -depth / 2, 0.06)
    body = (width, depth, height - 0.06)
    studio.builder.box("cabinet", place, low=low, size=body, skin=studio.wood(), faces={_FRONT: front})
    foot = (width - 0.06, depth - 0.06, 0.06)
    studio.builder.box(
        "cabinet", place, low=(low[0] + 0.03, low[1] + 0.03, 0), size=foot, skin=studio.paint()
    )
    _clutter(studio, place, size, count=6)


def desk(studio: Studio, place: Place, size: Size) -> None:
    """A desk with drawers, a monitor, papers, and what else lies about."""
    width, depth, height = size
    _table_frame(studio, place, size, name="desk")
    box = studio.builder.box
    drawers = (0.4, depth - 0.1, height - 0.1)
    front = studio.front((drawers[0], drawers[2]), columns=1, rows=3)
    low = (width / 2 - 0.5, -depth / 2 + 0.05, 0.04)
    box("desk", place, low=low, size=drawers, skin=studio.wood(), faces={_FRONT: front})
    stand, panel = (0.22, 0.18, 0.015), (0.55, 0.04, 0.34)
    box("monitor", place, low=(-0.11, -0.28, height), size=stand, skin=studio.paint())
    box("monitor", place, low=(-0.02, -0.22, height + 0.015), size=(0.04, 0.03, 0.1), skin=studio.paint())
    faces = {_FRONT: studio.print(textures.screen, (panel[0], panel[2]))}
    box("monitor", place, low=(-0.275, -0.2, height + 0.1), size=panel, skin=studio.paint(), faces=faces)
    keyboard = (0.44, 0.15, 0.02)
    faces = {_TOP: studio.print(textures.document, (keyboard[0], keyboard[1]))}
    box("keyboard", place, low=(-0.22, 0.08, height), size=keyboard, skin=studio.paint(), faces=faces)
    _clutter(studio, place, size, count=12)


def table(studio: Studio, place: Place, size: Size) -> None:
    """A table with a few things on it."""
    _table_frame(studio, place, size, name="table")
    _clutter(studio, place, size, count=7)


def chair(studio: Studio, place: Place, size: Size) -> None:
    """Four legs, a seat, a back."""
    width, depth, height = size
    seat_m = 0.46
    _legs(studio, place, (width, depth, seat_m), name="chair")
    box, fabric = studio.builder.box, studio.fabric()
    box("chair", place, low=(-width / 2, -depth / 2, seat_m), size=(width, depth, 0.05), skin=fabric)
    for z, high in ((seat_m + 0.15, 0.1), (height - 0.18, 0.18)):
        box("chair", place, low=(-width / 2, -depth / 2, z), size=(width, 0.03, high), skin=fabric)
    for left in (-width / 2, width / 2 - 0.03):
        post = (0.03, 0.029, height - seat_m - 0.05)
        box("chair", place, low=(left, -depth / 2 + 0.001, seat_m + 0.05), size=post, skin=studio.wood())


def sofa(studio: Studio, place: Place, size: Size) -> None:
    """A sofa with cushions."""
    width, depth, height = size
    box, fabric = studio.builder.box, studio.fabric()
    box("sofa", place, low=(-width / 2, -depth / 2, 0.08), size=(width, depth, 0.32), skin=fabric)
    box("sofa", place, low=(-width / 2, -depth / 2, 0.4), size=(width, 0.2, height - 0.4), skin=fabric)
    for left in (-width / 2, width / 2 - 0.16):
        box("sofa", place, low=(left, -depth / 2 + 0.2, 0.4), size=(0.16, depth - 0.2, 0.2), skin=fabric)
    for left in np.linspace(-width / 2 + 0.2, width / 2 - 0.6, 3):
        turn = float(studio.rng.uniform(-0.3, 0.3))
        low = (float(left), -depth / 2 + 0.26, 0.4)
        box("cushion", place, low=low, size=(0.38, 0.12, 0.36), skin=studio.fabric(), turn_rad=turn)


def cartons(studio: Studio, place: Place, size: Size) -> None:
    """A crooked pile of cardboard boxes."""
    width, depth, height = size
    z = 0.0
    while z < height - 0.2:
        high = float(studio.rng.uniform(0.2, 0.35))
        scale = float(studio.rng.uniform(0.6, 0.75))
        side = (scale * width, scale * depth, high)
        _carton(studio, place, (0.0, 0.0, z), side)
        z += high


PIECES = (
    Piece("shelf", (0.8, 0.26, 1.6), (1.3, 0.32, 2.1), shelf, at_wall=True),
    Piece("cabinet", (0.8, 0.38, 0.7), (1.4, 0.5, 1.1), cabinet, at_wall=True),
    Piece("wardrobe", (0.9, 0.5, 1.8), (1.4, 0.6, 2.1), cabinet, at_wall=True),
    Piece("desk", (1.2, 0.6, 0.7), (1.6, 0.7, 0.78), desk, at_wall=True),
    Piece("sofa", (1.5, 0.75, 0.7), (1.9, 0.85, 0.85), sofa, at_wall=True),
    Piece("shelf", (0.8, 0.26, 0.8), (1.2, 0.32, 1.2), shelf, at_wall=True),
    Piece("cartons", (0.5, 0.45, 0.5), (0.7, 0.6, 1.1), cartons, at_wall=False),
    Piece("chair", (0.42, 0.42, 0.86), (0.48, 0.46, 0.98), chair, at_wall=False),
    Piece("table", (0.6, 0.5, 0.5), (0.9, 0.7, 0.74), table, at_wall=False),
)


def _table_frame(studio: Studio, place: Place, size: Size, *, name: str) -> None:
    width, depth, height = size
    _legs(studio, place, (width - 0.04, depth - 0.04, height - 0.04), name=name)
    low = (-width / 2, -depth / 2, height - 0.04)
    studio.builder.box(name, place, low=low, size=(width, depth, 0.04), skin=studio.wood())


def _legs(studio: Studio, place: Place, size: Size, *, name: str) -> None:
    width, depth, height = size
    skin = studio.wood()
    for left in (-width / 2, width / 2 - 0.045):
        for back in (-depth / 2, depth / 2 - 0.045):
            studio.builder.box(name, place, low=(left, back, 0), size=(0.045, 0.045, height), skin=skin)


def _clutter(studio: Studio, place: Place, size: Size, *, count: int) -> None:
    """Books, papers, cups and cartons on a top of the given size, in cells so that none collide."""
    width, depth, height = size
    columns = max(int(width / 0.24), 1)
    rows = max(int(depth / 0.24), 1)
    cells = studio.rng.permutation(columns * rows)[:count]
    for cell in cells:
        x = -width / 2 + (cell % columns + 0.5) * width / columns
        y = -depth / 2 + (cell // columns + 0.5) * depth / rows
        kind = studio.rng.integers(4)
        if kind == 0:
            _carton(studio, place, (x, y, height), (0.16, 0.13, float(studio.rng.uniform(0.08, 0.22))))
        elif kind == 1:
            cup = (0.07, 0.07, float(studio.rng.uniform(0.08, 0.2)))
            low = (x - 0.035, y - 0.035, height)
            studio.builder.box("cup", place, low=low, size=cup, skin=studio.fabric(), turn_rad=0.4)
        elif kind == 2:
            _sheet(studio, place, (x, y, height), (0.15, 0.2, 0.002))
        else:
            z = height
            for _ in range(int(studio.rng.integers(1, 5))):
                thick = float(studio.rng.uniform(0.015, 0.04))
                _sheet(studio, place, (x, y, z), (0.14, 0.19, thick))
                z += thick


def _carton(studio: Studio, place: Place, base: tuple[float, float, float], size: Size) -> None:
    x, y, z = base
    faces = {face: studio.print(textures.carton, (size[0], size[2])) for face in (1, 2, _FRONT)}
    faces[_TOP] = studio.print(textures.carton, (size[0], size[1]))
    turn, low = float(studio.rng.uniform(-0.5, 0.5)), (x - size[0] / 2, y - size[1] / 2, z)
    studio.builder.box("carton", place, low=low, size=size, skin=faces[1], faces=faces, turn_rad=turn)


def _sheet(studio: Studio, place: Place, base: tuple[float, float, float], size: Size) -> None:
    x, y, z = base
    cover = studio.print(textures.poster if size[2] > 0.01 else textures.document, (size[0], size[1]))
    turn, low = float(studio.rng.uniform(-0.6, 0.6)), (x - size[0] / 2, y - size[1] / 2, z)
    skin = studio.paint()
    studio.builder.box("paper", place, low=low, size=size, skin=skin, faces={_TOP: cover}, turn_rad=turn)
