"""How loops are proposed, verified and believed."""

from functools import partial
from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import Field, NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt

from mapper.core.config import Config, Ratio
from mapper.odometry.config import MatchConfig
from mapper.places.config import PlacesConfig, ScanContextConfig
from mapper.registration.config import IsvdConfig
from mapper.registration.hough.config import ConstellationConfig, GroundConfig, VotingConfig

if TYPE_CHECKING:
    from mapper.features.view import View
    from mapper.loops.detector import KeyframeLoopDetector, LoopDetector
    from mapper.loops.online_poses import Correction
    from mapper.loops.scan_verification import ScanVerifier
    from mapper.loops.scans import ScanPlace
    from mapper.loops.verification import ImageVerifier


class VerificationConfig(Config):
    """What two views must have in common to be two views of one place."""

    match: MatchConfig = MatchConfig(filter="none", max_ratio=0.85)
    """How descriptors are paired."""
    min_matches: PositiveInt = 45
    """Fewer paired features are no loop (B5)."""
    registration: IsvdConfig = IsvdConfig()
    """ISVD on the paired points gives the first motion."""
    max_depth_m: PositiveFloat = 5.0
    """Depth beyond it is not used."""
    min_inliers: PositiveInt = 30
    """Fewer pairs that agree with the motion in the image are no loop."""
    min_inlier_ratio: Ratio = 0.45
    """A smaller share of the pairs that agrees is no loop."""
    virtual_baseline_px_m: PositiveFloat = 40.0
    """bf: depth z counts as the disparity bf / z (Mur-Artal & Tardós 2017)."""
    max_sigma_m: PositiveFloat = 0.05
    """A motion whose translation is less certain in any direction is no loop: far scenes hold it loosely."""
    measure: Literal["reprojection", "isvd"] = "reprojection"
    """Which of the two tests' motions becomes the constraint."""

    def build(self) -> "ImageVerifier":
        """Return the verifier this configures."""
        from mapper.loops.verification import ImageVerifier

        return ImageVerifier(self)


class GateConfig(Config):
    """How far off a loop may put us: what the odometry may have drifted on the way since."""

    slack_m: PositiveFloat = 0.2
    slack_rad: PositiveFloat = 0.1
    drift_ratio: NonNegativeFloat = 0.05
    """Metres per metre of path."""
    drift_rad_per_m: NonNegativeFloat = 0.02
    """Radians per metre of path."""
    drift_rad_per_rad: NonNegativeFloat = 0.05
    """Radians per radian turned."""


class NoLoopsConfig(Config):
    """No loop is looked for."""

    kind: Literal["none"] = "none"

    def build(self, _correction: "Correction", /) -> "LoopDetector":
        """Return a closer that finds nothing."""
        from mapper.loops.detector import NoLoopDetector

        return NoLoopDetector()


class KeyframeLoopsConfig(Config):
    """What the closers share that compare keyframes with known places."""

    kind: str
    min_gap_s: PositiveFloat = 5.0
    """What was seen more recently is the odometry's to know."""
    min_gap_m: NonNegativeFloat = 0.0
    """What lies less far back along the path is, too."""
    min_motion_m: NonNegativeFloat = 0.02
    min_motion_rad: NonNegativeFloat = 0.02
    """No look is taken before the sensor has moved so far or turned so much since the last one."""
    max_distance_m: PositiveFloat = 1.0
    """How near is "nearby", before the drift since is added."""
    max_candidates: PositiveInt = 4
    """Candidates compared per keyframe, the most similar first; the first loop found ends the search."""
    gate: GateConfig = GateConfig()
    min_agreeing: NonNegativeInt = 1
    """This many loops found from other keyframes nearby must tell the same before one is believed."""
    agreement_path_m: PositiveFloat = 3.0
    """How far along the path from each other two loops' ends may lie to tell of one another."""


class PlaceLoopsConfig(KeyframeLoopsConfig):
    """Every image is compared with those that look like it, however far away they are believed to be."""

    kind: Literal["places"] = "places"
    propose: Literal["auto", "places", "nearby"] = "auto"
    """By a bag of words, by believed pose, or "auto": by both, or by pose alone where descriptors have no
    words."""
    places: PlacesConfig = PlacesConfig()
    max_angle_rad: PositiveFloat = 0.8
    """Largest angle between the viewing directions of what is nearby."""
    verification: VerificationConfig = VerificationConfig()

    def build(self, correction: "Correction", /) -> "KeyframeLoopDetector[View]":
        """Return the closer; ``correction`` is how the graph is solved."""
        from mapper.loops.detector import KeyframeLoopDetector
        from mapper.loops.words import image_proposer

        return KeyframeLoopDetector(
            self, self.verification.build(), partial(image_proposer, self), correction=correction
        )


class ScanVerificationConfig(Config):
    """What two scans must have in common to be two scans of one place."""

    voxel_m: PositiveFloat = 0.75
    """One point is kept per voxel."""
    reach_m: PositiveFloat = 48.0
    """Farther points are dropped."""
    constellation: ConstellationConfig = ConstellationConfig(ground=GroundConfig(cell_m=1.0, voxel_m=0.75))
    """What stands around, from thin points: a cell of the ground has to be the larger."""
    voting: VotingConfig = VotingConfig(angles=120, peaks=10)
    pair_distances_m: Annotated[tuple[PositiveFloat, ...], Field(min_length=1)] = (2.0, 1.0)
    """Largest distance between the points of a GICP pair, from coarse to fine."""
    max_iterations: PositiveInt = 20
    """At each of these distances."""
    margin_m: PositiveFloat = 0.3
    """Margin of the free-space check along a ray, after GICP."""
    min_agreeing_ratio: Ratio = 0.3
    """A smaller share of what stands that agrees, in either direction, is no loop."""
    max_contradicting_ratio: Ratio = 0.06
    """A larger share of the visible obstacles in the other scan's free space is no loop. More, where much of
    what stands moves: parked cars leave."""
    min_compared: PositiveInt = 100
    """Fewer points that agree or contradict say nothing: bare yards all look alike."""
    min_lead: NonNegativeFloat = 0.07
    """By what a motion's share that agrees, less the share that contradicts, has to lead that of others:
    where two fit alike, as in a square yard, neither is believed."""
    sigma_rad: NonNegativeFloat = 0.002
    sigma_m: NonNegativeFloat = 0.03
    """Errors that all points share: of deskewing, calibration and voxels."""
    remembered: PositiveInt = 16
    """Places whose search trees are kept."""

    def build(self) -> "ScanVerifier":
        """Return the verifier this configures."""
        from mapper.loops.scan_verification import ScanVerifier

        return ScanVerifier(self)


class ScanLoopsConfig(KeyframeLoopsConfig):
    """Every scan is compared with those that look like it and those that may be near."""

    kind: Literal["scans"] = "scans"
    min_gap_m: NonNegativeFloat = 20.0
    min_motion_m: NonNegativeFloat = 3.0
    min_motion_rad: NonNegativeFloat = 1.0
    max_distance_m: PositiveFloat = 10.0
    max_tilt_rad: PositiveFloat = 0.8
    """Largest angle between the upright axes of what is nearby."""
    max_lookalikes: PositiveInt = 2
    """So many of the candidates, at most, are proposed by looks; the others because they are near."""
    max_candidates: PositiveInt = 3
    context: ScanContextConfig = ScanContextConfig()
    verification: ScanVerificationConfig = ScanVerificationConfig()
    gate: GateConfig = GateConfig(slack_m=1.0, drift_rad_per_m=0.005)
    min_agreeing: NonNegativeInt = 2
    agreement_path_m: PositiveFloat = 15.0

    def build(self, correction: "Correction", /) -> "KeyframeLoopDetector[ScanPlace]":
        """Return the closer; ``correction`` is how the graph is solved."""
        from mapper.loops.detector import KeyframeLoopDetector
        from mapper.loops.scans import scan_proposer

        return KeyframeLoopDetector(
            self, self.verification.build(), partial(scan_proposer, self), correction=correction
        )


class ThesisLoopsConfig(Config):
    """The thesis's loop closure (A9): sharp frames against the keyframes near their estimate."""

    kind: Literal["thesis"] = "thesis"
    keyframe_interval: PositiveInt = 20
    """One keyframe, the sharpest, in this many frames (A8)."""
    sharp_ratio: PositiveFloat = 1.2
    """A frame is tried when it has this many times the median number of features of late."""
    median_frames: PositiveInt = 20
    max_distance_m: PositiveFloat = 0.5
    """How close is close; the thesis leaves it open, as it does the angle."""
    max_angle_rad: PositiveFloat = 0.5
    """Largest angle between the two viewing directions."""
    min_gap_s: PositiveFloat = 2.0
    """Younger keyframes are not tried."""
    max_candidates: PositiveInt = 4
    """Keyframes compared per frame, the nearest first; the first loop found ends the search."""
    verification: VerificationConfig = VerificationConfig(
        match=MatchConfig(filter="none"), min_matches=20, min_inliers=20, min_inlier_ratio=0.0, measure="isvd"
    )
    """A9 matches descriptors and leaves the rest to ISVD; alg. 8's homography is for frames in a row."""

    def build(self, correction: "Correction", /) -> "LoopDetector":
        """Return the closer; ``correction`` is how the graph is solved."""
        from mapper.loops.thesis import ThesisLoopDetector

        return ThesisLoopDetector(self, correction=correction)


LoopsConfig = Annotated[
    NoLoopsConfig | PlaceLoopsConfig | ScanLoopsConfig | ThesisLoopsConfig, Field(discriminator="kind")
]
