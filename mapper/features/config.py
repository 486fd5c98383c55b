"""Settings of feature detectors."""

from typing import Annotated, Literal

from pydantic import Field, PositiveFloat, PositiveInt

from mapper.core.config import Config

_ENOUGH = 300  # however many are allowed: a limit that is raised must not lower the threshold


class _DetectorConfig(Config):
    """Settings of any detector."""

    kind: str
    max_features: PositiveInt = 1000
    """Largest number of features of an image, the strongest first. More in images of higher resolution; fewer
    are faster."""


class _AdaptiveConfig(_DetectorConfig):
    """Settings of a detector whose threshold is halved while there are too few features."""

    threshold: float
    min_threshold: float

    @property
    def enough_features(self) -> int:
        """With fewer features the threshold is halved."""
        return min(_ENOUGH, self.max_features)


class SurfConfig(_AdaptiveConfig):
    """SURF (Bay et al. 2008), chosen by Somlyai (PhD thesis); octaves, layers and thresholds as OpenCV's."""

    kind: Literal["surf"] = "surf"
    threshold: PositiveFloat = 500.0
    """First threshold of the Hessian's determinant, grey levels²; halved while there are too few features."""
    min_threshold: PositiveFloat = 25.0
    """Last threshold; raise it if noise produces features."""
    octaves: PositiveInt = 4
    """Number of times that the filter's size doubles; more find larger features."""
    layers: PositiveInt = 3
    """Filter sizes per octave in which points are found."""


class SiftConfig(_AdaptiveConfig):
    """SIFT (Lowe 2004) by OpenCV."""

    kind: Literal["sift"] = "sift"
    threshold: PositiveFloat = 0.04
    """First contrast threshold; halved while there are too few features."""
    min_threshold: PositiveFloat = 0.01
    """Last threshold; raise it if noise produces features."""


class AkazeConfig(_AdaptiveConfig):
    """AKAZE (Alcantarilla et al. 2013) by OpenCV."""

    kind: Literal["akaze"] = "akaze"
    threshold: PositiveFloat = 0.001
    """First threshold of the detector's response; halved while there are too few features."""
    min_threshold: PositiveFloat = 0.0001
    """Last threshold; raise it if noise produces features."""


class OrbConfig(_AdaptiveConfig):
    """ORB (Rublee et al. 2011) by OpenCV."""

    kind: Literal["orb"] = "orb"
    threshold: PositiveInt = 20
    """First FAST threshold, grey levels; halved while there are too few features."""
    min_threshold: PositiveInt = 5
    """Last threshold; raise it if noise produces features."""
    levels: PositiveInt = 8
    """Number of pyramid levels. More let features be found again over larger changes of distance."""


class UniformOrbConfig(_DetectorConfig):
    """ORB distributed evenly over the image by a quadtree (Zhao et al. 2020, §1.1)."""

    kind: Literal["uniform-orb"] = "uniform-orb"
    threshold: PositiveInt = 20
    """FAST threshold, grey levels, tried first in every cell."""
    min_threshold: PositiveInt = 7
    """FAST threshold for cells in which the first finds nothing; raise it if noise produces features."""
    cell_px: PositiveInt = 30
    """Edge of the cells in which corners are searched. Smaller cells spread features more evenly."""
    levels: PositiveInt = 8
    """Number of pyramid levels. More let features be found again over larger changes of distance."""


DetectorConfig = Annotated[
    SurfConfig | SiftConfig | AkazeConfig | OrbConfig | UniformOrbConfig, Field(discriminator="kind")
]
