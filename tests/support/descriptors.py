"""Random binary descriptors and noisy copies of them."""

import numpy as np

from mapper.features.hamming import pack


def random_bits(rng, n):
    return pack(rng.integers(0, 256, (n, 32), dtype=np.uint8))


def noisy(bits, flips, rng):
    """Copies with so many bits flipped, at most."""
    unpacked = np.unpackbits(bits.view(np.uint8), axis=1)
    rows = np.repeat(np.arange(len(bits)), flips)
    unpacked[rows, rng.integers(0, 256, len(rows))] ^= 1
    return pack(np.packbits(unpacked, axis=1))
