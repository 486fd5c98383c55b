"""Scan Context: a descriptor of scans that does not depend on the heading (Kim & Kim 2018)."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapper.core.errors import DataError
from mapper.core.geometry import Points
from mapper.places.config import ScanContextConfig

SHORTLIST = 50
"""Places with the nearest ring keys, which are compared at all headings."""


@dataclass(frozen=True, slots=True, eq=False)
class ScanContext:
    """Descriptor: the highest point in every ring and sector around a sensor.

    Attributes:
        ring_key: (R,) float32 metres: each ring's mean height, which does not depend on the heading.
        spectrum: (R, S // 2 + 1) complex64: Fourier transform of each ring's heights around the sensor, after
            every sector is made a unit vector and divided by the root of the number of filled sectors. The
            product of two gives their correlation at all headings.
    """

    ring_key: NDArray[np.float32]
    spectrum: NDArray[np.complex64]


def scan_context(points_level: Points, config: ScanContextConfig) -> ScanContext:
    """Return the descriptor of a scan.

    Args:
        points_level: (N, 3) metres, z up, the ground below the sensor at 0 and the sensor above the origin.
        config: Rings, sectors, largest range and height.
    """
    x, y, z = points_level.T
    range_m = np.hypot(x, y)
    near = range_m < config.reach_m
    ring = (range_m[near] * (config.rings / config.reach_m)).astype(np.intp)
    turn = np.arctan2(y[near], x[near]) / (2.0 * np.pi) + 0.5
    sector = np.minimum((turn * config.sectors).astype(np.intp), config.sectors - 1)
    heights_m = np.zeros((config.rings, config.sectors))
    np.maximum.at(heights_m, (ring, sector), np.minimum(z[near], config.max_height_m))
    lengths = np.linalg.norm(heights_m, axis=0)
    filled = max(1, int(np.count_nonzero(lengths)))
    unit = heights_m / np.where(lengths > 0.0, lengths, 1.0) / np.sqrt(filled)
    return ScanContext(
        heights_m.mean(axis=1).astype(np.float32), np.fft.rfft(unit, axis=1).astype(np.complex64)
    )


class ScanContexts:
    """Index of places by their descriptors: candidates by ring keys, then compared at all headings."""

    def __init__(self, config: ScanContextConfig) -> None:
        self._config = config
        self._nodes: list[int] = []
        self._keys = np.zeros((1, config.rings), np.float32)
        frequencies = config.sectors // 2 + 1
        self._spectra = np.zeros((1, config.rings, frequencies), np.complex64)

    def __len__(self) -> int:
        return len(self._nodes)

    def add(self, node: int, context: ScanContext) -> None:
        """Add a node.

        Raises:
            DataError: The context has other rings or sectors.
        """
        if context.spectrum.shape != self._spectra.shape[1:]:
            raise DataError(
                f"scan context of node {node}: {context.spectrum.shape}, want {self._spectra.shape[1:]}"
            )
        row = len(self._nodes)
        if row == len(self._keys):
            self._keys = np.vstack([self._keys, np.zeros_like(self._keys)])
            self._spectra = np.vstack([self._spectra, np.zeros_like(self._spectra)])
        self._keys[row], self._spectra[row] = context.ring_key, context.spectrum
        self._nodes.append(node)

    def query(self, context: ScanContext, among: NDArray[np.bool_], *, limit: int) -> list[tuple[int, float]]:
        """Return the most similar nodes with their similarity, best first; of equals, the earlier.

        Args:
            context: Descriptor of the scan to recognise.
            among: (N,) which of the first N nodes, in the order they were added, are compared.
            limit: Largest number of nodes to return.
        """
        rows = np.flatnonzero(among)
        apart = np.linalg.norm(self._keys[rows] - context.ring_key, axis=1)
        rows = rows[np.argsort(apart, kind="stable")[:SHORTLIST]]
        similarity = self._similarities(context, rows)
        best = np.lexsort((rows, -similarity))[:limit]
        return [
            (self._nodes[rows[k]], float(similarity[k]))
            for k in best.tolist()
            if similarity[k] >= self._config.min_similarity
        ]

    def _similarities(self, context: ScanContext, rows: NDArray[np.intp]) -> NDArray[np.float32]:
        """Return the mean cosine between sectors at the heading where it is largest (eq. 6, 7)."""
        product = (self._spectra[rows].conj() * context.spectrum).sum(axis=1)
        turned = np.fft.irfft(product, self._config.sectors, axis=1)
        best: NDArray[np.float32] = turned.max(axis=1).astype(np.float32)
        return best
