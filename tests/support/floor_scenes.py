"""The worlds that the traversable floor is measured in; robots climb 0.2 m and 20°, and are 1.8 m high."""

import numpy as np

from tests.support.floor_worlds import Block, Slab, World


def walls(x0, x1, y0, y1, *, base=0.0, height=2.6, thick=0.15):
    """Return four walls around a rectangle."""
    return [
        Block(x0 - thick, x1 + thick, y0 - thick, y0, base - 0.2, base + height),
        Block(x0 - thick, x1 + thick, y1, y1 + thick, base - 0.2, base + height),
        Block(x0 - thick, x0, y0, y1, base - 0.2, base + height),
        Block(x1, x1 + thick, y0, y1, base - 0.2, base + height),
    ]


def bush(x, y, *, base=0.0, radius=1.0, height=1.0, ring=0.1):
    """Return boxes that fill a cone: every column of it can be climbed a little higher than the last."""
    return [
        Block(x - r, x + r, y - r, y + r, base, base + height * (1.0 - r / radius))
        for r in np.arange(radius, 0.0, -ring)
    ]


def tree(x, y, *, base=0.0, canopy=2.4, reach=2.0):
    """Return a trunk, and a canopy that hangs lower outside."""
    trunk = Block(x - 0.15, x + 0.15, y - 0.15, y + 0.15, base, base + canopy)
    layers = [
        Block(x - r, x + r, y - r, y + r, base + canopy + 0.2 * n, base + canopy + 0.2 * n + 0.25)
        for n, r in enumerate(np.arange(reach, 0.3, -0.25))
    ]
    return [trunk, *layers]


def rooms():
    """Two rooms and a door between them, tables, a lamp, a shelf; a third room that has no door."""
    blocks = [*walls(0.0, 12.0, 0.0, 6.0)]
    blocks += [Block(5.0, 5.15, 0.0, 2.5, 0.0, 2.6), Block(5.0, 5.15, 3.5, 6.0, 0.0, 2.6)]
    blocks += [Block(5.0, 5.15, 2.5, 3.5, 2.0, 2.6), Block(9.0, 9.15, 0.0, 6.0, 0.0, 2.6)]
    blocks += [Block(1.0, 2.2, 4.2, 5.0, 0.7, 0.75), Block(6.5, 7.5, 0.5, 1.2, 0.0, 0.45)]
    blocks += [Block(3.0, 3.4, 1.0, 1.4, 1.9, 2.2), Block(0.0, 0.4, 0.5, 3.0, 0.0, 1.9)]
    path = [(1.2, 2.0, 0.0), (3.0, 3.0, 0.0), (7.0, 3.0, 0.0), (8.0, 5.0, 0.0)]
    return World([Slab(0.0, 12.0, 0.0, 6.0)], blocks, path, [(1.0, 2.2, 4.2, 5.0)])


def street():
    """A road that rises by 5 %, low kerbs, cars, a hedge, trees over the pavement, a house with a roof."""
    rise = (0.05, 0.0)
    slabs = [Slab(0.0, 24.0, 0.0, 6.0, 0.0, rise), Slab(0.0, 24.0, 6.0, 9.0, 0.12, rise)]
    slabs += [Slab(0.0, 24.0, -3.0, 0.0, 0.12, rise)]
    blocks = [Block(0.0, 24.0, 9.0, 9.3, -0.5, 6.0), Block(0.0, 24.0, 9.3, 12.0, 5.5, 6.0)]
    blocks += [Block(6.0, 10.2, 4.2, 5.9, 0.3, 1.9), Block(0.0, 24.0, -4.0, -3.0, 0.0, 2.4)]
    blocks += tree(14.0, 7.5, base=0.8) + tree(19.0, 7.5, base=1.0, canopy=2.6)
    blocks += bush(4.0, 7.5, base=0.3)
    path = [(1.0, 2.0, 0.05), (23.0, 2.0, 1.15)]
    return World(slabs, blocks, path, [(6.0, 10.2, 4.2, 5.9), (0.0, 24.0, 9.0, 12.0)])


def retaining_wall():
    """A street beside a wall, behind which a yard lies 0.8 m lower, and on the other side one 3 m higher."""
    slabs = [Slab(0.0, 24.0, 0.0, 6.0, 0.0, (0.03, 0.0)), Slab(0.0, 24.0, 6.3, 14.0, -0.8)]
    slabs += [Slab(0.0, 24.0, -5.0, -0.3, 3.0)]
    blocks = [Block(0.0, 24.0, 6.0, 6.3, -2.1, 1.8), Block(0.0, 24.0, -0.3, 0.0, -0.2, 3.0)]
    return World(slabs, blocks, [(1.0, 3.0, 0.03), (23.0, 4.5, 0.69)])


def ramps():
    """A yard, a ramp of 11° to a deck that one can go under, and a bank of 35° to a lawn."""
    slabs = [Slab(0.0, 26.0, 0.0, 12.0)]
    slabs += [Slab(4.0, 16.5, 8.0, 11.0, 0.0, (0.2, 0.0)), Slab(16.5, 22.0, 4.0, 11.0, 2.5)]
    slabs += [Slab(0.0, 26.0, -2.0, 0.0, 1.4, (0.0, -0.7)), Slab(0.0, 26.0, -6.0, -2.0, 1.4)]
    path = [(2.0, 3.0, 0.0), (18.0, 6.0, 0.0), (24.0, 6.0, 0.0), (24.0, 2.0, 0.0), (2.0, 2.0, 0.0)]
    path += [(2.0, 9.5, 0.0), (4.0, 9.5, 0.0), (16.5, 9.5, 2.5), (21.0, 6.0, 2.5)]
    rail = Block(16.5, 22.0, 3.9, 4.0, 2.3, 3.5)
    return World(slabs, [rail], path, [(4.0, 16.5, 8.0, 11.0)])


def bridge():
    """A road below a bridge, over which the path comes back by two ramps."""
    slabs = [Slab(0.0, 40.0, 0.0, 16.0)]
    slabs += [Slab(4.0, 16.0, 10.0, 13.0, 0.0, (0.25, 0.0)), Slab(16.0, 24.0, 10.0, 13.0, 3.0)]
    slabs += [Slab(24.0, 36.0, 10.0, 13.0, 3.0, (-0.25, 0.0))]
    path = [(20.0, 1.0, 0.0), (20.0, 15.0, 0.0), (38.0, 15.0, 0.0), (38.0, 11.5, 0.0), (36.0, 11.5, 0.0)]
    path += [(24.0, 11.5, 3.0), (16.0, 11.5, 3.0), (4.0, 11.5, 0.0), (2.0, 11.5, 0.0)]
    return World(slabs, [], path, [(4.0, 16.0, 10.0, 13.0), (24.0, 36.0, 10.0, 13.0)])


def two_storeys():
    """A hall with stairs of 17 cm to a floor above it."""
    slabs = [Slab(0.0, 10.0, 0.0, 8.0), Slab(0.0, 10.0, 1.6, 8.0, 3.06), Slab(6.5, 10.0, 0.0, 1.6, 3.06)]
    blocks = [Block(0.7 + 0.32 * n, 1.02 + 0.32 * n, 0.0, 1.3, 0.17 * n, 0.17 * (n + 1)) for n in range(18)]
    blocks += [*walls(0.0, 10.0, 0.0, 8.0, height=6.0), Block(0.0, 6.5, 1.5, 1.6, 3.06, 4.1)]
    path = [(8.0, 6.0, 0.0), (3.0, 5.0, 0.0), (0.3, 2.5, 0.0), (0.3, 0.65, 0.0), (0.7, 0.65, 0.0)]
    path += [(6.46, 0.65, 3.06), (8.0, 0.65, 3.06), (8.5, 5.0, 3.06), (2.0, 5.0, 3.06)]
    return World(slabs, blocks, path, [(0.7, 6.5, 0.0, 1.6)])


def courtyard():
    """Even ground, trees whose canopies can be climbed from bushes, a low roof on posts."""
    blocks = [*walls(0.0, 16.0, 0.0, 12.0, height=3.0)]
    blocks += (
        tree(4.0, 4.0, canopy=2.2)
        + tree(12.0, 8.0, canopy=3.0)
        + bush(8.0, 3.0)
        + bush(11.0, 4.0, height=1.6)
    )
    blocks += [Block(5.0, 8.0, 9.0, 11.5, 2.1, 2.2), Block(7.9, 8.0, 9.0, 9.1, 0.0, 2.1)]
    blocks += [Block(1.0, 3.0, 9.0, 11.0, 1.2, 1.3)]
    path = [(2.0, 2.0, 0.0), (14.0, 2.0, 0.0), (14.0, 10.0, 0.0), (6.5, 10.0, 0.0), (2.0, 7.0, 0.0)]
    return World([Slab(0.0, 16.0, 0.0, 12.0)], blocks, path)


WORLDS = {
    world.__name__: world for world in (rooms, street, retaining_wall, ramps, bridge, two_storeys, courtyard)
}
