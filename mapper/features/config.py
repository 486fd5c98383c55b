"""Detectors of image features."""

from typing import Annotated, Literal

from pydantic import Field, PositiveFloat, PositiveInt

from mapper.core.config import Config

ScaleFactor = Annotated[float, Field(gt=1.0)]
"""Size of a pixel on one pyramid level relative to the level below."""


class SurfConfig(Config):
    """SURF (Bay et al. 2008), described by mahotas; the thesis's choice (A4)."""

    kind: Literal["surf"] = "surf"
    max_features: PositiveInt = 1000
    threshold: PositiveFloat = 100.0
    """Determinant of the Hessian, grey levels², to start from; halved while there are too few features."""
    min_threshold: PositiveFloat = 1.0
    min_features: PositiveInt = 300
    octaves: PositiveInt = 4


class SiftConfig(Config):
    """SIFT (Lowe 2004) by OpenCV."""

    kind: Literal["sift"] = "sift"
    max_features: PositiveInt = 1000
    threshold: PositiveFloat = 0.04
    """Contrast threshold to start from; halved while an image gives too few features."""
    min_threshold: PositiveFloat = 0.01
    min_features: PositiveInt = 300


class AkazeConfig(Config):
    """AKAZE (Alcantarilla et al. 2013) by OpenCV."""

    kind: Literal["akaze"] = "akaze"
    max_features: PositiveInt = 1000
    threshold: PositiveFloat = 0.001
    """Detector response threshold to start from; halved while an image gives too few features."""
    min_threshold: PositiveFloat = 0.0001
    min_features: PositiveInt = 300


class OrbConfig(Config):
    """ORB (Rublee et al. 2011) by OpenCV."""

    kind: Literal["orb"] = "orb"
    max_features: PositiveInt = 1000
    threshold: PositiveInt = 20
    """FAST threshold (grey levels) to start from; halved while an image gives too few features."""
    min_threshold: PositiveInt = 5
    min_features: PositiveInt = 300
    levels: PositiveInt = 8
    scale_factor: ScaleFactor = 1.2


class UniformOrbConfig(Config):
    """ORB spread evenly over the image by a quadtree (B1; Mur-Artal & Tardós 2017)."""

    kind: Literal["uniform-orb"] = "uniform-orb"
    max_features: PositiveInt = 1000
    threshold: PositiveInt = 20
    """FAST threshold (grey levels) tried first in every cell."""
    min_threshold: PositiveInt = 7
    """FAST threshold of cells in which the first finds nothing."""
    cell_px: PositiveInt = 30
    levels: PositiveInt = 8
    scale_factor: ScaleFactor = 1.2


DetectorConfig = Annotated[
    SurfConfig | SiftConfig | AkazeConfig | OrbConfig | UniformOrbConfig, Field(discriminator="kind")
]
