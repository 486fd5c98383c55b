"""Methods that register two scans.

The baselines' lengths are multiples of one voxel, so that one knob fits them to a scene.
"""

from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import Field, PositiveFloat, PositiveInt

from mapper.config.base import Config
from mapper.config.hough import HoughGicpConfig, HoughNdtConfig

if TYPE_CHECKING:
    from mapper.registration.base import Registration

VOXEL_M = {"lidar": 0.3, "rgbd": 0.05}
"""What suits a scene some tens of metres wide, and one of a few metres."""

NEED_NO_GUESS = frozenset({"hough-gicp", "hough-ndt", "kiss-matcher"})
"""They look for the motion everywhere, and not at a guess."""

Distances = Annotated[tuple[PositiveFloat, ...], Field(min_length=1)]


class TrustConfig(Config):
    """When a motion is believed."""

    near_voxels: PositiveFloat = 3.5
    surface_voxels: PositiveFloat = 0.33
    """A source point agrees that lies this near to a target point, and to the surface about it."""
    min_agreeing_ratio: Annotated[float, Field(gt=0.0, le=1.0)] = 0.3
    """Of the surfaces that face any one direction, so large a share has to agree. On streets and in yards,
    against scans and dense maps, nearly all right answers had more, and every wrong one 0.28 or less."""


class RefinedConfig(Config):
    """What the methods share whose answer is refined by nearest pairs."""

    voxel_m: PositiveFloat = VOXEL_M["lidar"]
    """Scans are reduced to one point in each such voxel; every other length is a multiple of it."""
    neighbours: Annotated[int, Field(ge=5)] = 10
    """Nearest points that give each normal and covariance."""
    pair_distances_voxels: Distances = (7.0, 3.5)
    """Largest distance between the points of a pair, from coarse to fine."""
    max_iterations: PositiveInt = 40
    """At each of these distances."""
    trust: TrustConfig = TrustConfig()


class IterativeConfig(RefinedConfig):
    """Nearest pairs and the best motion for them, in turn."""

    kind: Literal["icp", "plane-icp", "gicp"]

    def build(self) -> "Registration":
        """Return the method this configures."""
        from mapper.registration.iterative import Iterative

        return Iterative(self)


class IcpConfig(IterativeConfig):
    """Point-to-point ICP (Besl & McKay 1992)."""

    kind: Literal["icp"] = "icp"


class PlaneIcpConfig(IterativeConfig):
    """Point-to-plane ICP (Chen & Medioni 1992)."""

    kind: Literal["plane-icp"] = "plane-icp"


class GicpConfig(IterativeConfig):
    """Generalised ICP (Segal, Haehnel & Thrun 2009)."""

    kind: Literal["gicp"] = "gicp"


class NdtConfig(Config):
    """Normal distributions transform (Magnusson 2009), by Open3D."""

    kind: Literal["ndt"] = "ndt"
    voxel_m: PositiveFloat = VOXEL_M["lidar"]
    """The source is reduced to one point in each such voxel; every other length is a multiple of it."""
    neighbours: Annotated[int, Field(ge=5)] = 10
    """Nearest points that give each normal by which the answer is judged."""
    cells_voxels: Distances = (7.0, 3.5)
    """Edges of the target's cells, each with one Gaussian, from coarse to fine."""
    min_points: Annotated[int, Field(ge=4)] = 6
    """Cells with fewer points have none."""
    max_iterations: PositiveInt = 30
    """At each of these cells."""
    trust: TrustConfig = TrustConfig()

    def build(self) -> "Registration":
        """Return the method this configures."""
        from mapper.registration.ndt import Ndt

        return Ndt(self)


class KissMatcherConfig(RefinedConfig):
    """KISS-Matcher (Lim et al. 2025): matched features, no guess; then GICP."""

    kind: Literal["kiss-matcher"] = "kiss-matcher"
    feature_voxels: PositiveFloat = 3.33
    """Features are computed on clouds reduced to voxels this many times larger: a quarter of the time of 1,
    and as many right answers."""

    def build(self) -> "Registration":
        """Return the method this configures."""
        from mapper.registration.kiss_matcher import KissMatcher

        return KissMatcher(self)


AnyRegistration = (
    HoughGicpConfig | HoughNdtConfig | IcpConfig | PlaneIcpConfig | GicpConfig | NdtConfig | KissMatcherConfig
)
RegistrationConfig = Annotated[AnyRegistration, Field(discriminator="kind")]
