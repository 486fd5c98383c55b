"""Degeneracy: motions that a registration cannot observe, as along a corridor or about a tunnel's axis."""

from dataclasses import dataclass

import numpy as np

from mapper.core.errors import DataError
from mapper.core.geometry import Array, Points, adjoint, transform
from mapper.core.linear import gram

_MIN_SHARE = 0.004
_MIN_ARM_M = 1e-3  # a pole's turning about itself must stay a number
_PART = 0.5  # a motion is named for its rotation, its translation, or both when mixed
_SAME_DIRECTION = 0.97  # squared cosine: 10°
_AXES = "xyz"


@dataclass(frozen=True, slots=True, eq=False)
class Degeneracy:
    """Observability of six independent motions.

    Attributes:
        shares: (6,) ascending, 0 … 1: share of a motion's displacements that goes along the normals.
        motions: (6, 6) tangents (rotation, translation) of the source as rows, in the same order; each
            displaces the cloud by 1 m root mean square.
        extent_m: Root mean square distance of the points from their centroid.
        unobservable_count: Number of them, from the first, that are unobservable.
        directions: (K, 3) orthonormal rows: the translations among these.
        text: Their names, as in "translation along x"; empty when all are observable.
    """

    shares: Array
    motions: Array
    extent_m: float
    unobservable_count: int
    directions: Array
    text: str

    @property
    def reason(self) -> str:
        """Reason to refuse an answer with this degeneracy; empty when every motion is observable."""
        return f"degenerate: no surface shows {self.text}" if self.text else ""


def degeneracy_of(information: Array, *, points: Points, min_share: float = _MIN_SHARE) -> Degeneracy:
    """Return which motions an information matrix leaves unobservable.

    Zhang, Kaess & Singh (2016, §III) compare the eigenvalues of JᵀJ with a threshold. Radians and metres
    make those depend on units and on the origin, so here they are divided by those of the same points if
    every surface faced the motion (the point-to-point JᵀJ): Σ(n·δ)² / Σ|δ|² over the displacements δ. A cube
    seen from within has a third for each translation, a corridor 0 along itself.

    Args:
        information: (6, 6) of the source's tangent (rotation, translation), from point-to-plane distances.
        points: (N, 3) source points, metres, source frame.
        min_share: A motion with a smaller share is unobservable. Noise of 2 cm in 20 cm voxels gives 0.002
            where no surface shows it; an open yard with five boxes has 0.009, a street 0.15.

    Raises:
        DataError: The information is not finite or there is none, or there are no points.
    """
    total = float(np.trace(information[3:, 3:]))
    if not np.isfinite(information).all() or total <= 0.0 or len(points) == 0:
        raise DataError(f"degeneracy: information {total:g} from {len(points)} points; want some of both")
    centroid = points.mean(axis=0)
    centred = points - centroid
    squares = gram(centred, centred) / len(points)
    arms, axes = np.linalg.eigh(np.trace(squares) * np.eye(3) - squares)
    metre = np.eye(6)  # motions about the centroid that displace the points by 1 m root mean square
    metre[:3, :3] = (axes / np.sqrt(np.maximum(arms, _MIN_ARM_M**2))) @ axes.T
    tangents = adjoint(transform(np.eye(3), centroid)) @ metre
    shares, vectors = np.linalg.eigh(tangents.T @ information @ tangents / total)
    count = int((shares < min_share).sum())
    return Degeneracy(
        shares,
        (tangents @ vectors).T,
        float(np.sqrt(np.trace(squares))),
        count,
        _spanned(vectors[3:, :count]).T,
        _text(vectors[:, :count]),
    )


def plane_rows(points: Points) -> Array:
    """Return the (N, 6) Jacobian of the heights of (N, 3) points, metres, by a tangent: of z and tilt."""
    up = np.broadcast_to([0.0, 0.0, 1.0], points.shape)
    return np.hstack([np.cross(points, up), up])


def plane_information(points: Points, *, like: Array) -> Array:
    """Return the (6, 6) information that points lie in a plane of constant z: it has z and tilt.

    Args:
        points: (N, 3) source points, metres.
        like: (6, 6) information of the same points' distances along normals in the plane, which are as
            certain.
    """
    rows = plane_rows(points)
    weight = float(np.trace(like[3:, 3:])) / max(len(points), 1)
    return np.asarray(weight * (rows.T @ rows), np.float64)


def projected(information: Array, degeneracy: Degeneracy) -> Array:
    """Return the information without that of the unobservable motions: unknown to within the cloud's extent.

    What they had is noise's; the observable motions keep theirs.

    Args:
        information: (6, 6) that the degeneracy was found in.
        degeneracy: Its degeneracy.

    Returns:
        (6, 6) positive definite information.
    """
    motions, count = degeneracy.motions, degeneracy.unobservable_count
    eigenvalues = np.einsum("ki,ij,kj->k", motions, information, motions)
    eigenvalues[:count] = np.minimum(eigenvalues[:count], degeneracy.extent_m**-2)
    eigenvalues = np.maximum(eigenvalues, np.finfo(float).eps * eigenvalues.max())
    columns = np.linalg.inv(motions)
    result: Array = (columns * eigenvalues) @ columns.T
    return 0.5 * (result + result.T)


def _text(unobservable: Array) -> str:
    """Return the names of (6, K) motions about the centroid; any basis of one space gets the same names."""
    names = []
    for name, block in (("translation along", unobservable[3:]), ("rotation about", unobservable[:3])):
        lines = _spanned(block)
        if lines.size:
            names.append(f"{name} {_lines(lines)}")
    return ", ".join(names)


def _spanned(block: Array) -> Array:
    """Return (3, K) orthonormal columns: the directions that make up most of some of (3, N) vectors."""
    if not block.size:
        return np.empty((3, 0))
    lines, weights, _ = np.linalg.svd(block, full_matrices=False)
    return lines[:, weights**2 >= _PART]


def _lines(lines: Array) -> str:
    """Return the name of the space that (3, K) orthonormal columns span, by axes where it contains them."""
    contained = (lines**2).sum(axis=1)
    axes = [axis for axis, part in zip(_AXES, contained, strict=True) if part >= _SAME_DIRECTION]
    if len(axes) == lines.shape[1]:
        return " and ".join(axes)
    if lines.shape[1] == 2:
        return f"all normal to {_vector(np.cross(lines[:, 0], lines[:, 1]))}"
    return _vector(lines[:, 0])


def _vector(v: Array) -> str:
    v = v * np.sign(v[np.argmax(np.abs(v))])
    return "({:.2f}, {:.2f}, {:.2f})".format(*(np.round(v, 2) + 0.0))
