"""Manifest of a run: versions, input, counts, timing and outcome."""

import platform
import sys
from datetime import UTC, datetime
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Literal, TypeVar

from pydantic import Field, ValidationError
from pydantic_core import from_json

import mapper
from mapper.core.config import Config, drop_unknown
from mapper.core.errors import DataError, RunError
from mapper.mapping.config import AppliedEdit
from mapper.run.georeference_record import Georeference
from mapper.run.manifest_logs import GyroscopeFit, Input
from mapper.runtime.atomic import MANIFEST_NAME, write_text
from mapper.runtime.regular_files import MOST_BYTES, read_regular, read_text
from mapper.sensing.config import DepthNoiseConfig
from mapper.sources.base import Log

Status = Literal["building", "complete", "failed", "interrupted"]

_LIBRARIES = (
    "foxglove-sdk",
    "gtsam",
    "kiss-icp",
    "matplotlib",
    "mcap",
    "numba",
    "numpy",
    "open3d",
    "opencv-contrib-python-headless",
    "pydantic",
    "rosbags",
    "simplejpeg",
)


class Counts(Config):
    """Counts of frames, nodes, factors and voxels.

    Every listed frame is skipped, lost, doubtful or tracked.
    """

    listed: int = 0
    read: int = 0
    """Frames that are not skipped."""
    skipped: int = 0
    """Frames that could not be read; ``Manifest.skipped`` says why."""
    lost: int = 0
    """Frames that were read, but not placed."""
    doubtful: int = 0
    """Frames that were placed, but whose pose may be wrong; ``frames.csv`` says why."""
    tracked: int = 0
    nodes: int = 0
    factors: int = 0
    loops: int = 0
    """Loop closures that hold."""
    loop_candidates: int = 0
    leaves: int = 0
    """Known voxels of the octree, free and occupied."""
    occupied: int = 0
    """Occupied voxels of the octree."""
    cloud_points: int = 0
    dynamic_points: int = 0

    @property
    def voxels_text(self) -> str:
        """Numbers of voxels, as text."""
        return f"{self.occupied} occupied and {self.leaves - self.occupied} free voxels"

    @property
    def frames_text(self) -> str:
        """Numbers of frames by outcome, as text."""
        return f"{self.tracked} tracked, {self.doubtful} doubtful, {self.lost} lost, {self.skipped} skipped"


Weight = Literal["note", "doubt", "break"]


class RunWarning(Config):
    """Warning: something suspicious about a run."""

    kind: str
    """E.g. "gap", "loops", "depth"; docs/verdict.md lists them."""
    sentence: str
    """Finding, with the value and the limit."""
    suggestion: str = ""
    """What to try."""
    where: str = ""
    """Seconds of the log."""
    weight: Weight = "note"
    """"note": worth knowing; "doubt": the map may be wrong; "break": a part of it is missing or wrong."""

    @property
    def text(self) -> str:
        """All of it in one line."""
        text = f"{self.sentence} (at {self.where})" if self.where else self.sentence
        return f"{text}; try: {self.suggestion}" if self.suggestion else text


class Verdict(Config):
    """Verdict on whether a run is to be trusted."""

    state: Literal["trusted", "doubtful", "broken in parts"]
    sentences: tuple[str, ...] = ()
    """Reasons against it, and what to try."""


class SkippedFrame(Config):
    """A frame that could not be read."""

    stamp_ns: int
    reason: str


SURE_SIGMAS = 2.0
"""Standard errors by which surfaces are thinner at poses that are adjusted to planes. Three real logs, whose
adjusted poses differ by less than the truth's error, have −2.6 to 2.0 by how their cells lie; synthetic ones,
whose ATE halves, 2.5 to 18."""


class PlaneAdjustment(Config):
    """Record of the adjustment of scans' poses to the surfaces that they share.

    All figures are of points that took no part in it.
    """

    is_kept: bool
    """Whether the poses are the adjusted ones: surfaces are thinner by more than two standard errors."""
    surfaces: int
    thinner_sigmas: float
    """By how many standard errors the surfaces are thinner, in the mean; less than 0 if they are thicker."""
    thickness_before_m: float
    """Geometric mean of the standard deviations of points across their surface."""
    thickness_m: float
    """The same at the adjusted poses."""
    moved_m: float
    """Root mean square of the nodes' motion."""

    @property
    def sentence(self) -> str:
        """What was found."""
        surfaces = (
            f"{self.surfaces} surfaces of other points {{}} {self.thinner_sigmas:.1f} standard errors thinner"
        )
        if not self.is_kept:
            return f"poses are not adjusted to planes: {surfaces.format('would be')}, want {SURE_SIGMAS:g}"
        return (
            f"poses are adjusted to planes: {surfaces.format('are')}, "
            f"{1e3 * self.thickness_before_m:.1f} → {1e3 * self.thickness_m:.1f} mm; "
            f"nodes moved by {1e3 * self.moved_m:.0f} mm"
        )


class Solve(Config):
    """Record of the pose graph's solve."""

    error_before: float
    """½ χ² of the first estimates."""
    error_after: float
    iterations: int
    components: int = 1
    """Connected components of the graph; each is solved on its own."""
    loop_residual_m: float | None = None
    loop_residual_rad: float | None = None
    """Median distance and angle of the accepted loops from odometry's poses, before the solve; None without
    loops."""
    loop_residual_sigma: float | None = None
    """Median Mahalanobis distance of the accepted loops from the prediction of odometry and wheels: 2.3 where
    all covariances are right, many times that where those of the odometry are too small."""
    loops_rejected: float | None = None
    """Share of the loops that reached the solver and were rejected by it."""
    planes: PlaneAdjustment | None = None
    """Adjustment of 3D scans' poses that came after it; None if there was none."""


class Levelling(Config):
    """Record of how the world's z axis and floor were found."""

    method: str
    detail: str
    has_floor: bool = True
    """Whether the floor was seen; otherwise its height is a guess."""


class DepthReach(Config):
    """Depth up to which a camera's measurements count in the maps."""

    noise: DepthNoiseConfig
    detail: str
    """Source of the noise; part of a sentence."""
    limit_m: float
    """Depth at which its standard deviation is a voxel's edge: farther returns only mark space as free."""
    counted_ratio: float
    """Share of the measured depths within this limit."""

    @property
    def sentence(self) -> str:
        """A sentence for the user."""
        return (
            f"depth counts up to {self.limit_m:.1f} m, {self.counted_ratio:.0%} of all returns: there its "
            f"noise of {self.noise.text} m, {self.detail}, is as large as a voxel"
        )


class Resumption(Config):
    """Resumption of a build by another process."""

    at: str
    """UTC, ISO 8601."""
    step: Literal["track", "solve", "fuse"]
    frame: int
    """The first frame of that step, in the order of the log, that was not done yet."""

    @property
    def text(self) -> str:
        """Step and frame at which the build was resumed; part of a sentence."""
        return f"{self.step} at frame {self.frame}" if self.step != "solve" else self.step


class Timing(Config):
    """All that differs between two runs on the same input."""

    started: str = ""
    """UTC, ISO 8601."""
    stage_s: dict[str, float] = Field(default_factory=dict)
    """Wall seconds of each stage."""
    total_s: float = 0.0
    log_s: float = 0.0
    """Time between the log's first and last tracked frame."""
    frames_per_s: float = 0.0
    """Frames read per wall second, every stage included."""
    real_time_factor: float = 0.0
    """Seconds of log mapped per wall second."""
    peak_memory_mb: float = 0.0
    resumed: tuple[Resumption, ...] = ()
    """Resumptions of a build that was killed or interrupted; its times are the sums over all processes."""


class FileDigest(Config):
    """A file as it was written."""

    size_bytes: int
    sha256: str


class Manifest(Config):
    """``manifest.json``."""

    status: Status
    reason: str = ""
    """Why a run failed."""
    mapper_version: str = mapper.__version__
    python_version: str = platform.python_version()
    platform: str = f"{sys.platform} {platform.machine()}"
    libraries: dict[str, str] = Field(default_factory=dict, repr=False)
    input: Input
    counts: Counts = Counts()
    skipped: tuple[SkippedFrame, ...] = ()
    warnings: tuple[RunWarning, ...] = ()
    """All that is suspicious about the run, what weighs most first."""
    verdict: Verdict | None = None
    """None until the maps are made."""
    solve: Solve | None = None
    levelling: Levelling | None = None
    georeference: Georeference | None = None
    """None where the map is in a frame of its own."""
    gyroscope: GyroscopeFit | None = None
    """None where the log has no gyroscope that was of use."""
    depth: DepthReach | None = None
    """None where the range of octree and cloud is a setting."""
    edits: tuple[AppliedEdit, ...] = ()
    """The edits by hand that are in the maps: ``edits.toml`` as it was when they were made."""
    timing: Timing = Timing()
    files: dict[str, FileDigest] = Field(default_factory=dict, repr=False)
    """Every file of the run but this; empty while it is being built."""

    def with_body_rates(self, log: Log) -> Log:
        """Return the run's first log with the readings of its gyroscope calibrated as by the run."""
        return log if self.gyroscope is None else self.gyroscope.applied_to(log)

    def save(self, path: Path) -> None:
        """Write the manifest atomically."""
        write_text(path, self.model_dump_json(indent=2) + "\n")


StretchState = Literal["localised", "doubtful", "not localised"]


class Stretch(Config):
    """Consecutive frames of a log with the same outcome."""

    state: StretchState
    begin_s: float
    """Time of its first frame, in seconds since the log's first."""
    end_s: float
    frames: int
    constraints: int
    """Keyframes in it that were recognised in the map."""
    sigma_m: float | None = None
    """Median standard deviation of the position in its least certain direction; None if unknown."""


class LocalisedManifest(Manifest):
    """``manifest.json`` of a localised log; ``counts.loops`` are the constraints to the map that hold."""

    kind: Literal["localised log"] = "localised log"
    map: str
    """Folder of the run or merged map, absolute."""
    stretches: tuple[Stretch, ...] = ()

    @property
    def localised_share(self) -> float:
        """Share of all frames of the log that are localised without a doubt."""
        return self.counts.tracked / max(self.counts.listed, 1)


AnyManifest = TypeVar("AnyManifest", bound=Manifest)


def read_manifest(path: Path) -> Manifest:
    """Return a run's manifest; errors as of ``read_manifest_of``."""
    return read_manifest_of(path, Manifest)


def read_manifest_of(path: Path, kind: type[AnyManifest]) -> AnyManifest:
    """Return a folder's manifest, of that kind.

    Raises:
        RunError: There is none, or it is not one that this version wrote.
    """
    try:
        tree = from_json(read_regular(path, most_bytes=MOST_BYTES))
        drop_unknown(kind, tree)  # what another version wrote in addition
        return kind.model_validate(tree)
    except OSError as error:
        raise RunError(f"{path}: cannot be read: {error.strerror}; is {path.parent} a run folder?") from None
    except DataError as error:
        raise RunError(f"{path}: {error}") from None
    except ValidationError as error:
        first = error.errors()[0]
        name = ".".join(str(part) for part in first["loc"])
        raise RunError(f"{path}: {name or 'manifest'}: {first['msg']}") from None
    except ValueError as error:
        raise RunError(f"{path}: no JSON: {error}") from None


def library_versions() -> dict[str, str]:
    """Return the installed version of every library that can change a result, or "absent"."""
    return {name: _version(name) for name in _LIBRARIES}


@cache
def _version(name: str) -> str:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return "absent"


def now_text() -> str:
    """Return the present moment, UTC, to the second."""
    return datetime.now(tz=UTC).isoformat(timespec="seconds")


def is_merged_map(folder: Path) -> bool:
    """Return whether a folder holds a merged map, not a run."""
    return _is_of_kind(folder, "merged map")


def is_localised_log(folder: Path) -> bool:
    """Return whether a folder holds a log that was localised in a map, not a run."""
    return _is_of_kind(folder, "localised log")


def _is_of_kind(folder: Path, kind: str) -> bool:
    """Return whether a folder's manifest is of a kind, by what comes before its damage if it is damaged."""
    try:
        manifest = from_json(read_text(folder / MANIFEST_NAME), allow_partial=True)
    except (DataError, ValueError):
        return False
    return isinstance(manifest, dict) and manifest.get("kind") == kind
