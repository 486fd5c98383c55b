"""Place recognition: by visual words, and by the heights around a scanner."""

from pathlib import Path
from typing import Annotated

from pydantic import Field, PositiveFloat, PositiveInt

from mapper.core.config import Config, Ratio
from mapper.features.config import OrbConfig, UniformOrbConfig


class VocabularyConfig(Config):
    """Training of a vocabulary: a tree of k-means++ clusters (B2; Arthur & Vassilvitskii 2007)."""

    detector: Annotated[OrbConfig | UniformOrbConfig, Field(discriminator="kind")] = UniformOrbConfig()
    frames_per_log: PositiveInt = 200
    """This many frames of a log are used, evenly spread."""
    branching: Annotated[int, Field(ge=2, le=255)] = 13
    """k: parts that a cluster is split into."""
    levels: Annotated[int, Field(ge=1, le=8)] = 3
    """d: how often. More words (k^d) make all similarities smaller: with about 2200 the published 0.32 tells
    the same place from others, with 10 000 no two images reach it."""
    max_iterations: PositiveInt = 12
    """Of each split."""


class PlacesConfig(Config):
    """When two images are taken to show the same place (B5)."""

    path: Path | None = None
    """File of the vocabulary; None is the one trained on synthetic logs that comes with the toolkit."""
    min_similarity: Ratio = 0.32
    """Of two images' words (eq. 10), as published. It suits images of about 1000 features; 0.22 would do for
    500, 0.45 for 2000."""
    min_deviations: PositiveFloat = 3.0
    """Whatever its similarity, a place is proposed that stands out from all others by this many standard
    deviations: so images with few features find theirs as well."""


class ScanContextConfig(Config):
    """When two scans are taken to show the same place (Kim & Kim 2018)."""

    rings: PositiveInt = 20
    sectors: PositiveInt = 60
    reach_m: PositiveFloat = 48.0
    """Radius of the outermost ring; 80 m as published, but loops keep no farther points."""
    max_height_m: PositiveFloat = 15.0
    """What is higher counts as this high."""
    shortlist: PositiveInt = 50
    """So many places with the nearest ring keys are turned to where they fit best."""
    min_similarity: Ratio = 0.4
    """Mean cosine between the sectors of two places, from which on one is proposed."""
