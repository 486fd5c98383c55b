"""Settings of the odometries."""

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt

from mapper.core.config import Config
from mapper.features.config import DetectorConfig, OrbConfig, UniformOrbConfig
from mapper.graph.config import WheelNoiseConfig
from mapper.odometry.scans.config import AnyScanOdometryConfig
from mapper.registration.config import IsvdConfig
from mapper.sensing.config import DepthNoiseConfig


class MatchConfig(Config):
    """Matching of two images' features (Somlyai, PhD thesis, alg. 8)."""

    filter: Literal["homography", "none"] = "homography"
    """"homography": RANSAC with four pairs, as published; "none": ISVD uses every mutual match."""
    max_ratio: Annotated[float, Field(gt=0.0, le=1.0)] = 0.9
    """Lowe's ratio between the best and the second-best descriptor distance, which the thesis leaves open."""
    seed: NonNegativeInt = 0
    """Seed of RANSAC's samples, here and in the verification of loops by P3P."""


class IsvdOdometryConfig(Config):
    """ISVD: each frame against MP earlier ones (Somlyai, PhD thesis, alg. 7, "ISLAM").

    The defaults are ours; configs/thesis has the published settings.
    """

    kind: Literal["isvd"] = "isvd"
    detector: DetectorConfig = UniformOrbConfig()
    """Features with which frames are matched; SURF, as published, takes longer."""
    match: MatchConfig = MatchConfig()
    """How features of two frames are paired."""
    fallback: MatchConfig = MatchConfig(filter="none", max_ratio=0.95)
    """Matching that is tried if ``match`` leads to no motion."""
    registration: IsvdConfig = IsvdConfig()
    """ISVD on the matched points."""
    earlier: Literal["keyframes", "frames"] = "keyframes"
    """Earlier frames that each frame is registered against: the frame before and the keyframes whose views
    are nearest, or the "frames" before it, as published."""
    previous_frames: PositiveInt = 4
    """MP: number of earlier frames that each frame is registered against."""
    residual: Literal["pixels", "points"] = "pixels"
    """Residual of the motion: "pixels" and depths weighted by their noise, starting from ISVD's motion, or
    the distances of the "points" alone, as published."""
    depth_noise: DepthNoiseConfig | None = None
    """Depth noise of the sensor, as measured by ``mapper sensor depth``; None is a Kinect v1's."""
    average: Literal["information", "weighted", "mean"] = "information"
    """Average of the MP candidate poses: weighted by their covariances, or of the translations, weighted by
    eq. 4.1 or unweighted."""
    rotation: Literal["nearest", "mean"] = "nearest"
    """With an average of the translations: the nearest frame's rotation, or the weighted mean on SO(3); the
    thesis does not state it."""
    depth_filter: bool = False
    """DIF (Somlyai, PhD thesis, alg. 4) before back-projection."""
    undistort: bool = True
    """Undistort features before back-projection; the thesis does not state it."""
    whole_pixels: bool = False
    """A feature's 3D point is that of its nearest pixel, as in a cloud indexed by pixels (Somlyai, PhD
    thesis, §4.1.1); false puts the depth of that pixel on the feature's own ray."""
    max_depth_m: PositiveFloat = 5.0
    """Depth beyond it is not used: a Kinect's error grows with the square of the depth."""
    keyframe_interval: PositiveInt = 20
    """With ``earlier = "frames"``: one keyframe, the sharpest, in this many frames (Somlyai, PhD thesis,
    §4.1.2), for frames that were lost."""


class KeyframeOdometryConfig(Config):
    """Shared settings of the odometries against keyframes' landmarks with local bundle adjustment."""

    kind: str
    detector: Annotated[OrbConfig | UniformOrbConfig, Field(discriminator="kind")] = UniformOrbConfig()
    """Evenly distributed features keep tracking in views where plain ORB finds all features in one distant
    corner."""
    max_depth_m: PositiveFloat | None = None
    """Depth beyond it is not used. None uses all: a depth z is used as a disparity bf / z, whose error is the
    same near and far, so that far points are weighted by their noise."""
    virtual_baseline_px_m: PositiveFloat = 40.0
    """bf: depth z is used as the disparity bf / z (Mur-Artal & Tardós 2017); 40 to 43 for a Kinect. For
    another sensor, set it to the focal length times the baseline."""
    depth_noise: DepthNoiseConfig | None = None
    """Depth noise of the sensor, as measured by ``mapper sensor depth``, which replaces the disparity's."""
    depth_residual: bool = True
    """bf / z is a third residual of poses and bundles; without it only pixels (Zhao et al. 2020, eq. 5–7)."""
    readout_s: float | None = None
    """Rolling shutter: time from the first line's exposure to the last line's; 0 is a global shutter. Lines
    are rows, or columns of images higher than wide. None estimates it from the log."""
    local_keyframes: NonNegativeInt = 15
    """Number of covisible keyframes whose landmarks are searched; 0 uses only the first matches."""
    min_matches: Annotated[int, Field(ge=8)] = 12
    """Fewer matches to the last frame, or to a keyframe, give no pose."""
    min_inliers: PositiveInt = 15
    """With fewer landmarks that agree with the pose, the frame is lost; with many landmarks in view more have
    to agree, as some do by chance."""
    keyframe_ratio: Annotated[float, Field(gt=0.0, le=1.0)] = 0.75
    """Keyframe if the inliers fall below this share of their maximum since the last keyframe; raise it for
    more keyframes."""
    max_keyframe_gap: PositiveInt = 20
    """Largest number of frames between keyframes."""
    bundle_keyframes: PositiveInt = 10
    """Keyframes in the window of the local bundle adjustment; fewer are faster and less accurate."""
    vocabulary: Path | None = None
    """File of the visual words; None is the included one, which was trained on synthetic logs."""
    ransac_iterations: PositiveInt = 500
    """M: largest number of samples of four pairs for P3P (Zhao et al. 2020, §1.2, take 100)."""
    ransac_tolerance_px: PositiveFloat = 4.0
    """β: largest distance between a projected point and its pixel for an inlier of P3P."""
    ransac_seed: NonNegativeInt = 0
    """Seed of P3P's samples."""
    align_depth: bool = False
    """Where an image has few landmarks, its depth image is aligned to those of the keyframes."""


class LocalMapConfig(KeyframeOdometryConfig):
    """Tracking by constant velocity against a local map of keyframes, refined by local bundle adjustment."""

    kind: Literal["local-map"] = "local-map"
    align_depth: bool = True
    """Where an image has few landmarks, its depth image is aligned to those of the keyframes; false where
    depth is unreliable."""
    search_px: PositiveFloat = 15.0
    """Search radius around the predicted pixel in the finest octave, doubled once if too little matches;
    raise it for fast motion."""


class PnpConfig(KeyframeOdometryConfig):
    """Each frame by P3P and Levenberg–Marquardt on its pixels (Zhao et al. 2020, §1.2)."""

    kind: Literal["pnp"] = "pnp"


class WheelsOdometryConfig(WheelNoiseConfig):
    """Wheel odometry alone (Somlyai, PhD thesis, §2.6.3): frames are read only as keyframes, for loops."""

    kind: Literal["wheels"] = "wheels"
    keyframe_distance_m: PositiveFloat = 0.3
    """A frame this far from the last keyframe becomes a keyframe. Lower values find more loops and take
    longer."""
    keyframe_angle_rad: PositiveFloat = 0.2
    """A frame turned this much from the last keyframe becomes a keyframe."""
    detector: Annotated[OrbConfig | UniformOrbConfig, Field(discriminator="kind")] = UniformOrbConfig()
    """Features with which loop detection recognises images; scans are recognised by their points."""


class GivenOdometryConfig(WheelNoiseConfig):
    """Known poses as the odometry: frames are read only as keyframes, for loops; their noise is constant."""

    kind: Literal["given"] = "given"
    path: Path | None = None
    """TUM text of the camera's or LiDAR's poses; a relative path starts in the working directory, or else in
    the log's folder. None is the log's own truth."""
    max_gap_s: PositiveFloat = 0.2
    """Largest gap between two poses across which they are interpolated; frames in longer ones are lost."""
    least_m: PositiveFloat = 0.002
    """Error of a factor's translation; the default is motion capture's."""
    path_share: NonNegativeFloat = 0.0
    """Additional error, as a share of the distance in between, for poses that drift."""
    least_rad: PositiveFloat = 0.002
    """Error of a factor's rotation."""
    turn_share: NonNegativeFloat = 0.0
    """Additional error, as a share of the angle turned."""
    rad_per_m: NonNegativeFloat = 0.0
    """Additional error per metre in between."""
    keyframe_distance_m: PositiveFloat = 0.3
    """A frame this far from the last keyframe becomes a keyframe. Lower values find more loops and take
    longer."""
    keyframe_angle_rad: PositiveFloat = 0.2
    """A frame turned this much from the last keyframe becomes a keyframe."""
    detector: Annotated[OrbConfig | UniformOrbConfig, Field(discriminator="kind")] = UniformOrbConfig()
    """Features with which loop detection recognises images; scans are recognised by their points."""


class OwnOdometryConfig(Config):
    """A caller's own odometry, handed to ``mapper.build`` as an object: only that program has it."""

    kind: Literal["own"] = "own"
    name: str = "the caller's"
    """Name of its class, as a record."""


FrameOdometryConfig = IsvdOdometryConfig | LocalMapConfig | PnpConfig | AnyScanOdometryConfig
"""Settings of the methods that use the frames' images or scans."""

OdometryConfig = Annotated[
    FrameOdometryConfig | WheelsOdometryConfig | GivenOdometryConfig | OwnOdometryConfig,
    Field(discriminator="kind"),
]
