"""Settings of the methods that register two scans.

A new method is registered in two places: its settings in ``AnyRegistration`` here, its class in
``factory.py``.

The local methods' lengths are multiples of one voxel, so that this one setting fits them to a scene.
"""

from typing import Annotated, Literal

from pydantic import Field, NonNegativeFloat, PositiveFloat, PositiveInt

from mapper.core.config import Config, Ratio
from mapper.registration.hough.config import HoughGicpConfig, HoughNdtConfig

VOXEL_M = {"lidar": 0.3, "lidar-2d": 0.1, "rgbd": 0.05}
"""Voxel for a scene some tens of metres wide, and for one of a few metres."""

NEED_NO_GUESS = frozenset({"hough-gicp", "hough-ndt", "kiss-matcher"})
"""Global methods: they search all motions, and use no guess."""


class AcceptanceConfig(Config):
    """Acceptance of a motion."""

    near_voxels: PositiveFloat = 3.5
    surface_voxels: PositiveFloat = 0.33
    """A source point agrees if it is this near to a target point and to the surface around it."""
    min_agreeing_ratio: Annotated[float, Field(gt=0.0, le=1.0)] = 0.3
    """Share of the surfaces facing any one direction that has to agree. On streets and in yards, against
    scans and dense maps, nearly all right results had more, and every wrong one 0.28 or less."""


class RefinedConfig(Config):
    """Settings common to the methods whose answer is refined by nearest pairs."""

    voxel_m: PositiveFloat = VOXEL_M["lidar"]
    """Scans are reduced to one point in each such voxel; every other length is a multiple of it."""
    neighbours: Annotated[int, Field(ge=5)] = 10
    """Number of nearest points for each normal and covariance."""
    max_iterations: PositiveInt = 40
    """Largest number of iterations at each of the pair distances, a coarse one and a fine one."""
    acceptance: AcceptanceConfig = AcceptanceConfig()


class IcpConfig(RefinedConfig):
    """Point-to-point ICP (Besl & McKay 1992)."""

    kind: Literal["icp"] = "icp"


class PlaneIcpConfig(RefinedConfig):
    """Point-to-plane ICP (Chen & Medioni 1992)."""

    kind: Literal["plane-icp"] = "plane-icp"


class GicpConfig(RefinedConfig):
    """Generalised ICP (Segal, Haehnel & Thrun 2009)."""

    kind: Literal["gicp"] = "gicp"


class NdtConfig(Config):
    """Normal distributions transform (Magnusson 2009), by Open3D."""

    kind: Literal["ndt"] = "ndt"
    voxel_m: PositiveFloat = VOXEL_M["lidar"]
    """The source is reduced to one point in each such voxel; every other length is a multiple of it."""
    neighbours: Annotated[int, Field(ge=5)] = 10
    """Number of nearest points for each normal, with which the result is assessed."""
    max_iterations: PositiveInt = 30
    """Largest number of iterations at each of the cell sizes, a coarse one and a fine one."""
    acceptance: AcceptanceConfig = AcceptanceConfig()


class KissMatcherConfig(RefinedConfig):
    """KISS-Matcher (Lim et al. 2025): matched features, no guess; then GICP."""

    kind: Literal["kiss-matcher"] = "kiss-matcher"
    feature_voxels: PositiveFloat = 3.33
    """Features are computed on clouds reduced to voxels this many times larger: a quarter of the time of 1,
    with as many right results."""


AnyRegistration = (
    HoughGicpConfig | HoughNdtConfig | IcpConfig | PlaneIcpConfig | GicpConfig | NdtConfig | KissMatcherConfig
)
RegistrationConfig = Annotated[AnyRegistration, Field(discriminator="kind")]


class IsvdConfig(Config):
    """Iterative SVD on matched 3D points (Somlyai, PhD thesis, alg. 7, eq. 4.1–4.2)."""

    kind: Literal["isvd"] = "isvd"
    threshold: Literal["power", "halving"] = "power"
    """How the largest pair distance shrinks: α·j^β (alg. 7), or by half (alg. 6)."""
    alpha_mm: PositiveFloat = 1200.0
    """α of the power law, as published: the first limit. Raise it where frames are farther apart."""
    beta: Annotated[float, Field(lt=0.0)] = -2.6
    """β of the power law, as published. Nearer to 0 the limit shrinks more slowly, for frames that are
    farther apart."""
    step: Literal["svd", "icp"] = "svd"
    """The motion in each iteration: the SVD of the pairs (alg. 6, 7), or ICP on their points (alg. 5)."""
    max_iterations: PositiveInt = 25
    """Largest number of iterations."""
    min_error_mm: NonNegativeFloat = 0.0
    """Stop once the threshold falls below this (e_min of alg. 5, 6)."""
    agreement_mm: PositiveFloat = 50.0
    """Pairs this close after the motion agree with it."""
    min_agreeing: Annotated[int, Field(ge=3)] = 20
    """A motion with fewer agreeing pairs is rejected."""
    min_agreement_ratio: Ratio = 0.25
    """A motion with a smaller share of agreeing pairs is rejected."""
