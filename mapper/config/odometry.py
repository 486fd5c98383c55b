"""Odometry methods and the ISVD registration inside the thesis's one."""

from typing import Annotated, Literal

from pydantic import Field, NonNegativeFloat, PositiveFloat, PositiveInt

from mapper.config.base import Config
from mapper.config.features import DetectorConfig, OrbConfig, SurfConfig


class MatchConfig(Config):
    """Pairs between two images' features (thesis alg. 8)."""

    filter: Literal["homography", "none"] = "homography"
    """"homography": RANSAC with four pairs, as published; "none": every mutual match goes on to ISVD."""
    max_ratio: Annotated[float, Field(gt=0.0, le=1.0)] = 0.8
    """Lowe's ratio between the best and the second-best descriptor distance."""
    homography_tolerance_px: PositiveFloat = 3.0
    homography_iterations: PositiveInt = 2000


class IsvdConfig(Config):
    """Iterative SVD on matched 3D points (thesis alg. 7, eq. 4.1–4.2)."""

    kind: Literal["isvd"] = "isvd"
    alpha_mm: PositiveFloat = 1200.0
    beta: Annotated[float, Field(lt=0.0)] = -2.6
    max_iterations: PositiveInt = 25
    min_error_mm: NonNegativeFloat = 0.0
    """Stop once the threshold α·j^β falls below this."""
    min_pairs: PositiveInt = 20
    """Stop before fewer pairs than this would remain ("Auto")."""


class IsvdOdometryConfig(Config):
    """The thesis's odometry: each frame against the MP frames before it (alg. 7, "ISLAM")."""

    kind: Literal["isvd"] = "isvd"
    detector: DetectorConfig = SurfConfig()
    match: MatchConfig = MatchConfig()
    registration: IsvdConfig = IsvdConfig()
    previous_frames: PositiveInt = 4
    """MP: how many earlier frames each frame is registered against."""
    average: Literal["weighted", "mean"] = "weighted"
    """How the MP candidate translations become one: by eq. 4.1's weights, or plainly."""
    rotation: Literal["nearest", "mean"] = "nearest"
    """The nearest frame's rotation, or the weighted mean on SO(3); the thesis leaves it open."""
    depth_filter: bool = False
    """DIF (A2) before back-projection."""
    max_depth_m: PositiveFloat = 5.0
    keyframe_interval: PositiveInt = 20
    """At least one keyframe, the sharpest, in this many frames (A8)."""


class LocalMapConfig(Config):
    """Reprojection tracking against a local map of keyframes, refined by local bundle adjustment."""

    kind: Literal["local-map"] = "local-map"
    detector: DetectorConfig = OrbConfig()
    max_depth_m: PositiveFloat = 4.0
    """Deeper features are tracked but do not become map points."""


OdometryConfig = Annotated[IsvdOdometryConfig | LocalMapConfig, Field(discriminator="kind")]
