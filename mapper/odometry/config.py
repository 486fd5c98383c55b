"""Odometry methods and the ISVD registration inside the thesis's one."""

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, NonNegativeInt, PositiveFloat, PositiveInt

from mapper.core.config import Config, Ratio
from mapper.features.config import DetectorConfig, OrbConfig, SurfConfig, UniformOrbConfig
from mapper.graph.config import WheelNoiseConfig
from mapper.odometry.scan_to_map.config import (
    GicpOdometryConfig,
    HoughOdometryConfig,
    IcpOdometryConfig,
    KissOdometryConfig,
)
from mapper.registration.config import IsvdConfig
from mapper.sensing.config import DepthNoiseConfig


class MatchConfig(Config):
    """Pairs between two images' features (thesis alg. 8)."""

    filter: Literal["homography", "none"] = "homography"
    """"homography": RANSAC with four pairs, as published; "none": every mutual match goes on to ISVD."""
    max_ratio: Annotated[float, Field(gt=0.0, le=1.0)] = 0.9
    """Lowe's ratio between the best and the second-best descriptor distance."""
    homography_tolerance_px: PositiveFloat = 4.0
    """ε of alg. 8; the thesis leaves it open, as it does the ratio."""
    homography_iterations: PositiveInt = 2000
    seed: NonNegativeInt = 0
    """Of RANSAC's draws, here and where loops are verified by P3P."""


class IsvdOdometryConfig(Config):
    """The thesis's odometry: each frame against the MP frames before it (alg. 7, "ISLAM")."""

    kind: Literal["isvd"] = "isvd"
    detector: DetectorConfig = SurfConfig()
    match: MatchConfig = MatchConfig()
    fallback: MatchConfig = MatchConfig(filter="none", max_ratio=0.95)
    """How pairs are sought once ``match`` has led to no motion."""
    registration: IsvdConfig = IsvdConfig()
    previous_frames: PositiveInt = 4
    """MP: how many earlier frames each frame is registered against."""
    average: Literal["weighted", "mean"] = "weighted"
    """How the MP candidate translations become one: by eq. 4.1's weights, or plainly."""
    rotation: Literal["nearest", "mean"] = "nearest"
    """The nearest frame's rotation, or the weighted mean on SO(3); the thesis leaves it open."""
    depth_filter: bool = False
    """DIF (A2) before back-projection."""
    undistort: bool = True
    """Correct features for the lens before back-projection; the thesis says nothing of it."""
    max_depth_m: PositiveFloat = 5.0
    keyframe_interval: PositiveInt = 20
    """At least one keyframe, the sharpest, in this many frames (A8)."""
    relocalisation_keyframes: PositiveInt = 20
    """How many of the nearest keyframes, and as many of the others in turn, a lost frame is compared with."""


class KeyframeConfig(Config):
    """What the odometries share that track against keyframes' landmarks and adjust both in bundles."""

    kind: str
    detector: Annotated[OrbConfig | UniformOrbConfig, Field(discriminator="kind")] = UniformOrbConfig()
    """Spread features survive views in which plain ORB crowds into one far corner."""
    max_depth_m: PositiveFloat = 4.0
    """Deeper features are tracked, but become landmarks only where near ones are few."""
    virtual_baseline_px_m: PositiveFloat = 40.0
    """bf: depth z counts as the disparity bf / z (Mur-Artal & Tardós 2017); a Kinect's is 40 to 43."""
    disparity_sigma_px: PositiveFloat = 1.0
    """Noise of the virtual disparity relative to that of a pixel."""
    depth_noise: DepthNoiseConfig | None = None
    """The sensor's own, which then counts instead; mapper sensor depth measures it."""
    depth_residual: bool = True
    """Poses and bundles have to explain bf / z too; without it only pixels (Zhao et al. 2020, eq. 5–7)."""
    local_search_px: PositiveFloat = 4.0
    """Search radius around the projected landmarks of the local map in the finest octave."""
    local_keyframes: NonNegativeInt = 15
    """How many covisible keyframes' landmarks are searched; 0 leaves it at what matching found."""
    min_matches: Annotated[int, Field(ge=8)] = 20
    """Fewer matches to the last frame, or to a keyframe, say nothing about the motion."""
    min_inliers: PositiveInt = 30
    """Fewer landmarks that agree with the pose mean that the frame is lost."""
    weak_inliers: PositiveInt = 150
    """With fewer, a placement has to compete with what other ways and other keyframes lead to."""
    max_lost_frames: NonNegativeInt = 15
    """After so many frames that show enough but nothing known, a new sub-map begins; 0 never begins one."""
    keyframe_ratio: Annotated[float, Field(gt=0.0, le=1.0)] = 0.75
    """Keyframe when the inliers fall below this share of the most since the last keyframe."""
    mapped_ratio: Ratio = 0.5
    """Keyframe when the inliers are a smaller share of the near features: much of the view is new."""
    max_keyframe_gap: PositiveInt = 20
    bundle_keyframes: PositiveInt = 10
    """Window of the local bundle adjustment."""
    vocabulary: Path | None = None
    """File of the visual words; None is what comes with the toolkit, trained on synthetic logs."""
    ransac_iterations: PositiveInt = 100
    """M: draws of four pairs for P3P, at most (B3)."""
    ransac_tolerance_px: PositiveFloat = 4.0
    """β: how far a pair that agrees with P3P may lie off (B3)."""
    ransac_seed: NonNegativeInt = 0
    """Of P3P's draws."""
    min_agreement_ratio: Ratio = 0.3
    """A pose that a smaller share of the matches agrees with is refused: what repeats gave 0.28."""
    relocalisation_keyframes: PositiveInt = 5
    """A lost frame is compared with as many keyframes that look like it, and as many of the nearest."""


class LocalMapConfig(KeyframeConfig):
    """Reprojection tracking against a local map of keyframes, refined by local bundle adjustment."""

    kind: Literal["local-map"] = "local-map"
    search_px: PositiveFloat = 15.0
    """Search radius around the predicted pixel in the finest octave; doubled once when too little matches."""


class PnpConfig(KeyframeConfig):
    """The second source's odometry: each frame by P3P and Levenberg–Marquardt on its pixels (B3)."""

    kind: Literal["pnp"] = "pnp"


class WheelsOdometryConfig(WheelNoiseConfig):
    """The wheels alone (thesis 2.6.3): no frame is looked at, of either sensor, but keyframes for loops."""

    kind: Literal["wheels"] = "wheels"
    keyframe_distance_m: PositiveFloat = 0.3
    keyframe_angle_rad: PositiveFloat = 0.2
    """A frame this far, or turned this much, from the last keyframe is one itself."""
    detector: Annotated[OrbConfig | UniformOrbConfig, Field(discriminator="kind")] = UniformOrbConfig()
    """What loops recognise images by; scans are recognised by their points."""


FrameOdometryConfig = (
    IsvdOdometryConfig
    | LocalMapConfig
    | PnpConfig
    | GicpOdometryConfig
    | IcpOdometryConfig
    | KissOdometryConfig
    | HoughOdometryConfig
)
"""Settings of the methods that use the frames' images or scans."""

OdometryConfig = Annotated[FrameOdometryConfig | WheelsOdometryConfig, Field(discriminator="kind")]
