"""The small log that most tests of whole runs share, and the run built of it."""

from pathlib import Path

from mapper.config.loading import load_config
from mapper.pipeline.build import build
from mapper.simulation import write_tum_log
from mapper.simulation.config import SynthConfig
from mapper.sources import open_source

DESK = SynthConfig(
    path="desk",
    duration_s=2.0,
    frame_rate_hz=15.0,
    width_px=320,
    height_px=240,
    texture_px_per_m=64,
    posters_per_room=3,
    furniture_per_room=4,
)
REPEATABLE = "mcap.frame_times=false"
MANY_KEYFRAMES = ("odometry.max_keyframe_gap=3", "loops.min_motion_m=0.0")
"""Settings for a keyframe every few frames, so that a second of walking leaves enough of them to tie."""


def write_desk_log(log: Path) -> None:
    """Write 31 frames before a desk, with truth, as a TUM folder."""
    write_tum_log(log, DESK)


def write_log_of_another_flat(log: Path) -> None:
    """Write 13 frames before a desk that is in no other log."""
    size = {"width_px": 320, "height_px": 240, "texture_px_per_m": 64}
    write_tum_log(log, SynthConfig(seed=5, path="desk", duration_s=0.8, frame_rate_hz=15.0, **size))


def build_desk_run(log: Path, out: Path) -> None:
    """Build the log with the defaults, but for the measured times in its MCAP file."""
    config = load_config(None, [REPEATABLE])
    build(open_source(log, config.source), config, out)
