"""Job of a sweep: one whole build, and its numbers as a record."""

import platform
import shutil
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Literal

import numpy as np

from mapper.config.build import BuildConfig
from mapper.core.errors import DataError, MapperError
from mapper.core.trajectory import Trajectory, with_rotations
from mapper.evaluators.metrics.odometry import ONE_SECOND, PathErrors, path_errors
from mapper.evaluators.metrics.segments import lengths_for, segment_errors
from mapper.evaluators.metrics.trajectory_errors import Matched, align, associate, start_end_offset
from mapper.evaluators.study.table import Record, Value
from mapper.pipeline.build import build
from mapper.run.files import CONFIG, MANIFEST, OCTREE_MAP, SUMMARY, TRAJECTORY, TRUTH
from mapper.run.folder import Run
from mapper.runtime.progress import forget_peak_memory
from mapper.sources import open_source


def summary(run: Run) -> dict[str, Value]:
    """Return the errors of a run's path, and which share of its log has poses; None is not known.

    Nothing is known of the errors where the log has no truth or too few poses have one, nothing of those over
    a second or over stretches of the path where there are none. ``relative_…`` are means over the
    segments of :func:`mapper.evaluators.metrics.segments.lengths_for`, as KITTI's table has them.
    """
    counts, trajectory, truth = run.manifest.counts, run.trajectory, with_rotations(run.truth)
    matched = None if truth is None else _aligned(trajectory, truth)
    errors = PathErrors() if matched is None else path_errors(matched, ONE_SECOND)
    relative = _relative(matched, 0.0 if truth is None else truth.path_length_m)
    return {
        "listed_frames": counts.listed,
        "tracked_frames": counts.tracked,
        "doubtful_frames": counts.doubtful,
        "coverage_ratio": counts.tracked / counts.listed if counts.listed else None,
        "matched_poses": 0 if matched is None else len(matched),
        "ate_m": errors.ate_m,
        "rpe_1s_m": errors.rpe_m,
        "rpe_1s_rad": errors.rpe_rad,
        "relative_translation_ratio": relative[0],
        "relative_rotation_radpm": relative[1],
        "path_m": trajectory.path_length_m,
        "start_to_end_m": start_end_offset(trajectory)[0],
        "loops": counts.loops,
    }


def _aligned(trajectory: Trajectory, truth: Trajectory) -> Matched | None:
    try:
        matched = associate(trajectory, truth)
        return align(matched, "se3").moved(matched)
    except DataError:
        return None


def _relative(matched: Matched | None, path_m: float) -> tuple[float, float] | tuple[None, None]:
    lengths = () if matched is None else segment_errors(matched, lengths_for(path_m))
    if not any(map(len, lengths)):
        return None, None
    translation = np.concatenate([length.translation_ratio for length in lengths])
    rotation = np.concatenate([length.rotation_radpm for length in lengths])
    return float(translation.mean()), float(rotation.mean())


Keep = Literal["nothing", "trajectory", "run"]

STAGES = ("track", "solve", "level", "fuse", "write")
_WITH_TRAJECTORY = {CONFIG, MANIFEST, SUMMARY, TRAJECTORY, TRUTH}


@dataclass(frozen=True, slots=True, eq=False)
class BuildJob:
    """Build of a run, which is measured, and kept as far as is wanted.

    Attributes:
        log: Absolute path.
        config: Every setting.
        scratch: Folder for the run while it is built.
        kept: Folder that the run is kept in, or None.
        keep: Files of it that are kept.
    """

    log: Path
    config: BuildConfig
    scratch: Path
    kept: Path | None
    keep: Keep

    def __call__(self) -> list[Record]:
        """Return the build's numbers, one record.

        Raises:
            MapperError: As ``build`` raises.
        """
        forget_peak_memory()
        self.scratch.mkdir(parents=True, exist_ok=True)
        with TemporaryDirectory(dir=self.scratch, ignore_cleanup_errors=True) as folder:
            try:
                source = open_source(self.log, self.config.source)
                run = build(source, self.config, Path(folder) / "run", checkpoint_s=None)
            except MapperError as error:
                raise MapperError(str(error)) from None  # its notes name a folder that will not be there
            record = _measured(run, sensor=source.sensor)
            if self.kept is not None:
                _keep(run.path, self.kept, self.keep)
        return [record]


def _measured(run: Run, *, sensor: str) -> Record:
    manifest = run.manifest
    counts, timing = manifest.counts, manifest.timing
    return {
        "sensor": sensor,
        **summary(run),
        "skipped_frames": counts.skipped,
        "lost_frames": counts.lost,
        "keyframes": counts.nodes,
        "leaves": counts.leaves,
        "cloud_points": counts.cloud_points,
        "map_bytes": (run.path / OCTREE_MAP).stat().st_size,
        **{f"{stage}_s": timing.stage_s[stage] for stage in STAGES},
        "total_s": timing.total_s,
        "frames_per_s": timing.frames_per_s,
        "real_time_factor": timing.real_time_factor,
        "peak_memory_mb": timing.peak_memory_mb,
        "host": platform.node(),
        "mapper_version": manifest.mapper_version,
        "python_version": manifest.python_version,
    }


def _keep(run: Path, kept: Path, keep: Keep) -> None:
    if keep == "trajectory":
        for file in run.iterdir():
            if file.name not in _WITH_TRAJECTORY:
                file.unlink()
    kept.parent.mkdir(parents=True, exist_ok=True)
    shutil.rmtree(kept, ignore_errors=True)  # of a build that was killed before its result was written
    run.rename(kept)
