"""Factory of the loop detectors and of their verifiers."""

from collections.abc import Mapping
from functools import partial
from typing import Any, assert_never

import numpy as np

from mapper.core.errors import ConfigError
from mapper.core.frames import Sensor
from mapper.features.frame_view import ImageView
from mapper.loops.base import Proposer, Verifier
from mapper.loops.config import (
    PLANAR_LOOPS,
    AnyLoops,
    ImageVerificationConfig,
    NoLoopsConfig,
    PlaceLoopsConfig,
    ScanLoopsConfig,
    ScanVerificationConfig,
    ThesisLoopsConfig,
)
from mapper.loops.detector import KeyframeLoopDetector, LoopDetector, NoLoopDetector
from mapper.loops.odometry_drift import OdometryChain
from mapper.loops.online_pose_estimator import Correction, build_pose_estimator
from mapper.loops.place_file import AnyPlace

_LOOPS_OF: Mapping[Sensor, PlaceLoopsConfig | ScanLoopsConfig] = {
    "rgbd": PlaceLoopsConfig(),
    "lidar": ScanLoopsConfig(),
    "lidar-2d": PLANAR_LOOPS,
}


def keyframe_loops(config: AnyLoops, sensor: Sensor) -> PlaceLoopsConfig | ScanLoopsConfig:
    """Return how keyframes are compared: by the settings, or as usual where these compare none."""
    return config if isinstance(config, PlaceLoopsConfig | ScanLoopsConfig) else _LOOPS_OF[sensor]


def build_loop_detector(
    config: AnyLoops, correction: Correction, verifier: Verifier[Any] | None = None
) -> LoopDetector:
    """Return the loop detector that the settings choose.

    Args:
        config: Settings.
        correction: Solver of the graph in the end; the detector's estimate of the poses is corrected
            alike.
        verifier: Compares places; None makes the one that the settings choose.
    """
    match config:
        case NoLoopsConfig():
            return NoLoopDetector()
        case PlaceLoopsConfig() | ScanLoopsConfig():
            return build_keyframe_loop_detector(config, correction, verifier)
        case ThesisLoopsConfig():
            from mapper.loops.thesis_loop_closure import ThesisLoopDetector

            verifier = verifier or build_verifier(config.verification)
            estimator = build_pose_estimator(correction)
            return ThesisLoopDetector(config, verifier, estimator)
        case _:
            assert_never(config)


def build_keyframe_loop_detector(
    config: PlaceLoopsConfig | ScanLoopsConfig,
    correction: Correction,
    verifier: Verifier[Any] | None = None,
) -> KeyframeLoopDetector[Any]:
    """Return the loop detector that compares keyframes; it can be preloaded with an earlier session."""
    verifier = verifier or build_verifier(config.verification)
    estimator = build_pose_estimator(correction)
    chain = OdometryChain()
    match config:
        case PlaceLoopsConfig():
            from mapper.loops.visual_word_proposer import image_proposer

            proposer_for = partial(image_proposer, config, estimator)
            return KeyframeLoopDetector(config, verifier, proposer_for, estimator, chain)
        case ScanLoopsConfig():
            from mapper.loops.scan_context_proposer import scan_proposer

            proposer = scan_proposer(config, estimator, chain)
            return KeyframeLoopDetector(config, verifier, lambda _: proposer, estimator, chain)
        case _:
            assert_never(config)


def build_similarity_proposer(
    config: PlaceLoopsConfig | ScanLoopsConfig, first: AnyPlace, *, most: int
) -> Proposer[Any]:
    """Return an empty proposer of similar places, wherever they are.

    Args:
        config: Settings.
        first: One of the places that will be added.
        most: Largest number of scans that are proposed, whatever the limit.

    Raises:
        ConfigError: Places such as the first cannot be recognised by similarity.
    """
    match config:
        case PlaceLoopsConfig():
            from mapper.loops.visual_word_proposer import VisualWordProposer

            if not (isinstance(first, ImageView) and first.is_orb) or config.propose == "nearby":
                raise ConfigError(
                    "places of a map are recognised by visual words; want images, an ORB detector, and "
                    "loops.propose=auto or places"
                )
            return VisualWordProposer(config.places)
        case ScanLoopsConfig():
            from mapper.loops.scan_context_proposer import ScanContextProposer

            return ScanContextProposer(
                config.context, lambda _node, _seen, nodes: np.ones(len(nodes), bool), most=most
            )
        case _:
            assert_never(config)


def build_verifier(config: ImageVerificationConfig | ScanVerificationConfig) -> Verifier[Any]:
    """Return the verifier of two places by images or by scans."""
    match config:
        case ImageVerificationConfig():
            from mapper.loops.image_verification import ImageVerifier

            return ImageVerifier(config)
        case ScanVerificationConfig():
            from mapper.loops.scan_verification import ScanVerifier

            return ScanVerifier(config)
        case _:
            assert_never(config)
