"""Warnings about the distortion of a log's depth images."""

from mapper.run.manifest import RunWarning
from mapper.sources.base import Log
from mapper.sources.chained import sessions_of
from mapper.sources.depth_distortion import distortion_of

_DOUBTFUL_SHARE = 0.007
"""Of the median depth. White rooms by simulated sensors of 0.9 % were wrong by metres."""


def distortion_warnings(source: Log) -> list[RunWarning]:
    """Return what is found about the depth distortion of a log, and of each of a chain's, a warning each."""
    first, *later = (session.log for session in sessions_of(source))
    warnings = [_warning(first, of=""), *(_warning(log, of=f"{log.name}: ") for log in later)]
    return [warning for warning in warnings if warning is not None]


def _warning(log: Log, *, of: str) -> RunWarning | None:
    removed = log.removed_distortion is not None
    distortion = log.removed_distortion() if log.removed_distortion else distortion_of(log)
    if distortion is None:
        return None
    if removed:
        return RunWarning(
            kind="camera",
            sentence=f"{of}depth images were bent, all in the same way; the error of {distortion.text} is "
            "removed",
        )
    share = distortion.rms_m / distortion.median_depth_m
    return RunWarning(
        kind="camera",
        sentence=f"{of}depth images are bent, all in the same way: planes are off by {distortion.text}, "
        f"{share:.1%} of the median depth (a doubt from {_DOUBTFUL_SHARE:.1%} on)",
        suggestion="--set source.undistort_depth=true",
        weight="doubt" if share >= _DOUBTFUL_SHARE else "note",
    )
