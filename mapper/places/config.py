"""Settings of place recognition."""

from pathlib import Path
from typing import Annotated

from pydantic import Field, PositiveFloat, PositiveInt

from mapper.core.config import Config, Ratio
from mapper.features.config import OrbConfig, UniformOrbConfig


class VocabularyConfig(Config):
    """Training of a vocabulary: a tree of k-means++ clusters (Zhao et al. 2020, §1.1)."""

    detector: Annotated[OrbConfig | UniformOrbConfig, Field(discriminator="kind")] = UniformOrbConfig()
    """Features that become words."""
    frames_per_log: PositiveInt = 200
    """This many frames of a log are used, evenly spread."""
    branching: Annotated[int, Field(ge=2, le=255)] = 13
    """k: number of parts that a cluster is split into (Arthur & Vassilvitskii 2007)."""
    levels: Annotated[int, Field(ge=1, le=8)] = 3
    """d: number of splits from the root to a word. More words (k^d) make all similarities smaller: with about
    2200 the published 0.32 separates the same place from others, with 10 000 no two images reach it."""
    max_iterations: PositiveInt = 12
    """Largest number of iterations of each split."""


class PlacesConfig(Config):
    """Decision whether two images show the same place (Zhao et al. 2020, §1.3)."""

    path: Path | None = None
    """File of the vocabulary; None is the included one, which was trained on synthetic logs."""
    min_similarity: Ratio = 0.32
    """Similarity of two images' words (eq. 10), as published. It suits images of about 1000 features; 0.22
    suits 500, 0.45 suits 2000."""


class ScanContextConfig(Config):
    """Scan Context: decision whether two scans show the same place (Kim & Kim 2018)."""

    rings: PositiveInt = 20
    """Number of rings around the sensor. More distinguish places better, but tolerate less offset."""
    sectors: PositiveInt = 60
    """Number of sectors of a full turn. Fewer are faster; more resolve the heading better."""
    reach_m: PositiveFloat = 48.0
    """Radius of the outermost ring; 80 m as published, but loop detection keeps no farther points."""
    max_height_m: PositiveFloat = 15.0
    """Higher points count as this high."""
    min_similarity: Ratio = 0.4
    """Smallest mean cosine between the sectors of two places for a proposal."""
