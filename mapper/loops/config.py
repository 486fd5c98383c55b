"""Settings of loop closure.

A new kind is registered in two places: its settings in ``AnyLoops`` here, its class in ``factory.py``.
"""

from typing import Annotated, Literal

from pydantic import Field, NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt

from mapper.core.config import Config, Ratio
from mapper.odometry.config import MatchConfig
from mapper.places.config import PlacesConfig, ScanContextConfig
from mapper.registration.config import IsvdConfig
from mapper.registration.hough.config import ConstellationConfig, GroundConfig, VotingConfig


class ImageVerificationConfig(Config):
    """Verification that two images show one place."""

    match: MatchConfig = MatchConfig(filter="none", max_ratio=0.85)
    """How descriptors are paired."""
    min_matches: PositiveInt = 45
    """A loop needs at least this many paired features (Zhao et al. 2020, §1.3, step 5)."""
    registration: IsvdConfig = IsvdConfig()
    """ISVD on the paired points gives the first motion."""
    max_depth_m: PositiveFloat = 5.0
    """Depth beyond it is not used."""
    min_inliers: PositiveInt = 30
    """A loop needs at least this many pairs that agree with the motion in the image. Lower it where images
    have little texture."""
    min_inlier_ratio: Ratio = 0.45
    """A loop needs at least this share of pairs that agree. Lower it where much of the view moves."""
    measure: Literal["reprojection", "isvd"] = "reprojection"
    """Which of the two tests' motions becomes the constraint."""


SLACK_RAD = 0.1
"""How far a loop may turn a node, however short the path."""


class GateConfig(Config):
    """Drift gate: how far a loop may move a node, by the drift of odometry on the path between its ends."""

    slack_m: PositiveFloat = 0.2
    """How far a loop may move a node, however short the path. Raise it where the odometry fails in places:
    more true loops are accepted, and more false ones."""
    drift_ratio: NonNegativeFloat = 0.05
    """Addition to ``slack_m`` per metre of path, and to ``SLACK_RAD`` per radian turned."""
    drift_rad_per_m: NonNegativeFloat = 0.02
    """Addition to ``SLACK_RAD`` per metre of path."""


class NoLoopsConfig(Config):
    """No loop is searched."""

    kind: Literal["none"] = "none"


class KeyframeLoopsConfig(Config):
    """Settings common to the loop detectors that compare keyframes with known places."""

    kind: str
    min_gap_s: PositiveFloat = 5.0
    """Places more recent than this are left to the odometry."""
    min_gap_m: NonNegativeFloat = 0.0
    """Places nearer than this along the path are left to the odometry."""
    min_motion_m: NonNegativeFloat = 0.02
    """Loops are searched only after the sensor has moved this far since the last search, or turned by
    ``min_motion_rad``."""
    min_motion_rad: NonNegativeFloat = 0.02
    """Loops are searched only after the sensor has turned this much since the last search, or moved by
    ``min_motion_m``."""
    max_distance_m: PositiveFloat = 1.0
    """Largest distance of a nearby place, to which the drift since then is added."""
    max_candidates: PositiveInt = 4
    """Candidates compared per keyframe, the most similar first; the first loop found ends the search. More
    finds more loops and takes longer."""
    gate: GateConfig = GateConfig()
    min_agreeing: NonNegativeInt = 1
    """This many loops found from other keyframes nearby must agree before one is accepted. 0 accepts every
    loop that passes the other tests: more true and more false ones."""
    agreement_path_m: PositiveFloat = 3.0
    """Largest distance along the path between the ends of two loops that are compared. Raise it where
    keyframes are farther apart."""


class PlaceLoopsConfig(KeyframeLoopsConfig):
    """Every keyframe's image is compared with similar ones, at any distance, and with nearby ones."""

    kind: Literal["places"] = "places"
    propose: Literal["auto", "places", "nearby"] = "auto"
    """Proposals by a bag of words, by the current estimate of the poses, or "auto": by both, or by poses
    alone if the descriptors have no words."""
    places: PlacesConfig = PlacesConfig()
    max_angle_rad: PositiveFloat = 0.8
    """Largest angle between the viewing directions of nearby places."""
    verification: ImageVerificationConfig = ImageVerificationConfig()


class ScanVerificationConfig(Config):
    """Verification that two scans are of one place."""

    is_planar: bool = False
    """Scans of a 2D laser: the motion is guessed by their correlation (Olson 2009), in any heading."""
    voxel_m: PositiveFloat = 0.5
    """One point is kept per voxel."""
    reach_m: PositiveFloat = 48.0
    """Farther points are dropped."""
    constellation: ConstellationConfig = ConstellationConfig(ground=GroundConfig(cell_m=1.0, voxel_m=0.75))
    """Centres that vote; the points are sparse, so a cell of the ground has to be larger."""
    voting: VotingConfig = VotingConfig(angles=120, peaks=10)
    pair_distances_m: Annotated[tuple[PositiveFloat, ...], Field(min_length=1)] = (2.0, 0.5)
    """Largest distance between the points of a GICP pair, from coarse to fine."""
    margin_m: PositiveFloat = 0.3
    """Margin of the free-space check along a ray, after GICP."""
    min_agreeing_ratio: Ratio = 0.3
    """A loop needs at least this share of obstacles that agree, in both directions."""
    max_contradicting_ratio: Ratio = 0.06
    """A loop may have at most this share of visible obstacles in the other scan's free space. Raise it where
    standing objects move, such as parked cars."""
    max_moved_ratio: Ratio = 0.0
    """A further share that may contradict if three quarters of the obstacles agree, decreasing to none at a
    half: between two days cars leave and objects are moved. ``mapper localise`` allows 0.14 unless more is
    set. Raise it where yards are rearranged."""
    min_compared: PositiveInt = 100
    """A loop needs at least this many points that agree or contradict, as all bare yards look alike."""
    min_lead: NonNegativeFloat = 0.07
    """Lead of a motion's score, the share that agrees less the share that contradicts, over that of others:
    if two fit equally well, as in a square yard, neither is accepted."""
    sigma_rad: NonNegativeFloat = 0.001
    """Error of the rotation that all points share, from deskewing, calibration and voxels."""
    sigma_m: NonNegativeFloat = 0.015
    """Error of the translation that all points share."""


class ScanLoopsConfig(KeyframeLoopsConfig):
    """Every keyframe's scan is compared with similar ones and with those of places that may be nearby."""

    kind: Literal["scans"] = "scans"
    min_gap_m: NonNegativeFloat = 20.0
    min_motion_m: NonNegativeFloat = 3.0
    min_motion_rad: NonNegativeFloat = 1.0
    max_distance_m: PositiveFloat = 10.0
    max_candidates: PositiveInt = 3
    context: ScanContextConfig = ScanContextConfig()
    verification: ScanVerificationConfig = ScanVerificationConfig()
    gate: GateConfig = GateConfig(slack_m=1.0, drift_rad_per_m=0.005)
    min_agreeing: NonNegativeInt = 2
    agreement_path_m: PositiveFloat = 15.0


PLANAR_LOOPS = ScanLoopsConfig(
    min_gap_m=10.0,
    min_motion_m=1.0,
    min_motion_rad=0.5,
    max_distance_m=3.0,
    context=ScanContextConfig(reach_m=16.0),
    verification=ScanVerificationConfig(
        is_planar=True,
        voxel_m=0.1,
        reach_m=30.0,
        voting=VotingConfig(peaks=5),
        pair_distances_m=(0.5, 0.2),
        margin_m=0.15,
        min_agreeing_ratio=0.4,
        min_compared=60,
        sigma_rad=0.002,
        sigma_m=0.01,
    ),
    gate=GateConfig(slack_m=0.5, drift_rad_per_m=0.005),
    agreement_path_m=5.0,
)
"""Loops between planar scans of rooms and corridors."""


class ThesisLoopsConfig(Config):
    """Sharp frames are compared with the keyframes near their estimate (Somlyai, PhD thesis, §4.3)."""

    kind: Literal["thesis"] = "thesis"
    keyframe_interval: PositiveInt = 20
    """One keyframe, the sharpest, in this many frames."""
    sharp_ratio: PositiveFloat = 1.2
    """A frame is sharp if it has this many times the median number of features of as many last frames."""
    max_distance_m: PositiveFloat = 0.5
    """Largest distance of a near keyframe; the thesis leaves it open."""
    min_gap_s: PositiveFloat = 2.0
    """More recent keyframes are not compared."""
    max_candidates: PositiveInt = 4
    """Keyframes compared per frame, the nearest first; the first loop found ends the search. More finds more
    loops and takes longer."""
    verification: ImageVerificationConfig = ImageVerificationConfig(
        match=MatchConfig(filter="none"), min_matches=20, min_inliers=20, min_inlier_ratio=0.0, measure="isvd"
    )
    """The thesis matches descriptors and leaves the rest to ISVD; the homography of its alg. 8 is for
    consecutive frames."""


AnyLoops = NoLoopsConfig | PlaceLoopsConfig | ScanLoopsConfig | ThesisLoopsConfig
LoopsConfig = Annotated[AnyLoops, Field(discriminator="kind")]
