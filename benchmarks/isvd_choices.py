"""Choices of ISVD odometry that Somlyai's thesis leaves open, for benchmarks/isvd_study.py."""

from dataclasses import dataclass, field
from typing import Literal

from mapper.features.config import DetectorConfig, OrbConfig, SiftConfig, SurfConfig


@dataclass(frozen=True, slots=True)
class Choice:
    """One setting of everything that is studied; the defaults are those of configs/thesis/MP4.toml."""

    detector: DetectorConfig = field(default_factory=lambda: SurfConfig(max_features=5000))
    first_features: int = 0
    """Use only so many of the strongest; 0 is all."""
    ratio: float = 0.9
    ratio_of: Literal["new frame", "earlier frame"] = "new frame"
    """Whose features have to be distinct from the other frame's second best."""
    cross_check: bool = True
    vote: bool = False
    """Keep matches whose change of size and angle most others share, as Emgu CV's example does."""
    left_out: float = 0.0
    """Leave out this share of the matches, at random: tells how much of an error is chance."""
    tolerance_px: float = 4.0
    iterations: int = 2000
    filter: Literal["homography", "none"] = "homography"
    depth: Literal["nearest", "floor", "bilinear", "bilinear or none", "dif"] = "nearest"
    ray: Literal["feature", "pixel"] = "pixel"
    """A feature's point lies on its own ray, or is the point of the pixel that it lies in."""
    max_depth_m: float = 5.0
    intrinsics: Literal["log", "ros"] = "log"
    undistort: bool = False
    alpha_mm: float = 1200.0
    beta: float = -2.6
    max_iterations: int = 25
    min_pairs: int = 100
    min_error_mm: float = 0.0
    last_fit: Literal["before", "after"] = "before"
    """Whether the motion is that of the last iteration, or fitted again to what it left."""
    returning: bool = False
    """Dropped pairs may come back: every iteration tests all pairs."""
    fit_weight: Literal["none", "1/z2", "1/z4"] = "none"
    quality: Literal["all pairs", "kept pairs"] = "all pairs"
    """Pairs over which eq. 4.1's W is averaged: those of the last fit, or those within its threshold."""
    previous: int = 4
    average: Literal["weighted", "mean", "nearest"] = "weighted"
    rotation: Literal["nearest", "mean", "last"] = "mean"
    averaged: Literal["position", "column"] = "position"
    """Average the frame's positions, or the last columns of the inverse poses, which take points to it."""


EXPERIMENTS: dict[str, list[tuple[str, dict[str, object]]]] = {
    "detector": [
        ("SIFT", {"detector": SiftConfig()}),
        ("ORB", {"detector": OrbConfig()}),
        ("SURF, 300 features", {"first_features": 300}),
        ("SURF, 500 features", {"first_features": 500}),
        ("SURF, 1000 features", {"detector": SurfConfig()}),
        ("SURF, threshold 100", {"detector": SurfConfig(max_features=5000, threshold=100.0)}),
        ("SURF, threshold 2000", {"detector": SurfConfig(max_features=5000, threshold=2000.0)}),
    ],
    "ratio": [(f"ratio {value}", {"ratio": value}) for value in (0.6, 0.7, 0.8, 1.0)],
    "ratio's side": [("ratio of the earlier frame", {"ratio_of": "earlier frame"})],
    "cross-check": [
        ("no cross-check", {"cross_check": False}),
        ("no cross-check, ratio 0.8", {"cross_check": False, "ratio": 0.8}),
        ("Emgu's votes", {"cross_check": False, "ratio": 0.8, "vote": True}),
    ],
    "tolerance": [
        (f"homography {value} px", {"tolerance_px": value}) for value in (1.0, 2.0, 3.0, 6.0, 10.0)
    ],
    "homography": [
        ("no homography", {"filter": "none"}),
        ("homography, 100 samples", {"iterations": 100}),
        ("homography, 10 samples", {"iterations": 10}),
    ],
    "depth": [
        (f"depth {value}", {"depth": value, "ray": "feature"}) for value in ("bilinear", "bilinear or none")
    ],
    "points": [
        ("points on features' rays", {"ray": "feature"}),
        ("truncated pixels", {"depth": "floor"}),
    ],
    "DIF": [("depth after DIF", {"depth": "dif"})],
    "max depth": [(f"depth ≤ {value} m", {"max_depth_m": value}) for value in (3.0, 4.0, 10.0)],
    "intrinsics": [
        ("ROS's 525 px", {"intrinsics": "ros"}),
        ("undistorted", {"undistort": True}),
    ],
    "power law": [
        ("α 600 mm", {"alpha_mm": 600.0}),
        ("α 2400 mm", {"alpha_mm": 2400.0}),
        ("β -2.0", {"beta": -2.0}),
        ("β -3.2", {"beta": -3.2}),
    ],
    "stop": [
        *[(f"≥ {value} pairs", {"min_pairs": value}) for value in (10, 20, 50, 150, 200)],
        *[(f"th ≥ {value} mm", {"min_error_mm": value}) for value in (5.0, 10.0, 20.0)],
        ("fitted again at the end", {"last_fit": "after"}),
        ("dropped pairs may return", {"returning": True}),
    ],
    "fit": [(f"weights {value}", {"fit_weight": value}) for value in ("1/z2", "1/z4")],
    "composition": [
        ("W of kept pairs", {"quality": "kept pairs"}),
        ("plain mean", {"average": "mean"}),
        ("nearest only", {"average": "nearest"}),
        ("nearest frame's rotation", {"rotation": "nearest"}),
        ("farthest frame's rotation", {"rotation": "last"}),
        ("mean of inverse poses", {"averaged": "column"}),
    ],
    "chance": [(f"{share:.0%} of matches left out", {"left_out": share}) for share in (0.01, 0.05)],
    "MP": [(f"MP {value}", {"previous": value}) for value in (1, 2, 3, 6)],
    "iterations": [
        (f"{value} iterations", {"max_iterations": value}) for value in (1, 3, 4, 5, 7, 9, 11, 13, 15, 20)
    ],
}
