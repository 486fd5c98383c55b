"""Run folder: a finished run, its log and its files, read on first access."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from functools import cached_property
from importlib import import_module
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Any, Literal

from mapper.config.build import BuildConfig
from mapper.config.loading import load_run_config
from mapper.core.errors import MapperError, RunError, listed
from mapper.core.timebase import Stamps
from mapper.core.trajectory import Trajectory
from mapper.graph.g2o import read_g2o
from mapper.graph.model import PoseGraph
from mapper.loops.closure import LoopClosure, read_closures
from mapper.odometry.config import GivenOdometryConfig
from mapper.run import files
from mapper.run.digests import changing, checked, regular
from mapper.run.doubtful_frames import without_doubtful
from mapper.run.frame_records import FrameRecord, read_frame_ms, read_records, stamps_of
from mapper.run.gnss_file import read_fixes
from mapper.run.input_logs import open_inputs
from mapper.run.manifest import Manifest, Verdict, is_localised_log, is_merged_map, read_manifest
from mapper.run.map_folder import MapFolder
from mapper.run.pose_covariances import UncertainPoses, read_poses
from mapper.run.results import RunResults, aligned_truth
from mapper.runtime.atomic import partial_of
from mapper.runtime.regular_files import AnyPath
from mapper.sources import open_source
from mapper.sources.base import Log
from mapper.sources.trajectory_files import read_tum

if TYPE_CHECKING:  # compiled code, which takes longer to load than most files of a run
    from matplotlib.axes import Axes

    from mapper.core.frames import Cloud
    from mapper.runtime.progress import Progress


@dataclass(frozen=True, repr=False)
class Run(MapFolder):
    """A finished run: its folder, whose files are read on first access, each once.

    Attributes:
        path: Its folder.
        config: Settings by which it was built, every default spelled out.
        manifest: Its ``manifest.json``.
    """

    manifest: Manifest

    def file(self, name: str) -> Path:
        """Return the path of one of its files, after comparing it with its digest in the manifest.

        Raises:
            RunError: It is missing, or is not as it was written, or is no regular file.
        """
        if not self.manifest.files:
            return regular(self.path / name)
        digests = read_manifest(self.path / files.MANIFEST).files  # exports and plans add theirs
        return checked(self.path, name, digests)

    def changing(self, names: Iterable[str]) -> AbstractContextManager[None]:
        """Return a context in which files of the run may be written; it records their digests at its end."""
        return changing(self.path, names)

    @cached_property
    def trajectory(self) -> Trajectory:
        """Solved body poses of all placed frames, doubtful ones too, in the levelled world."""
        return read_tum(self.file(files.TRAJECTORY))

    @cached_property
    def tracked_trajectory(self) -> Trajectory:
        """Poses of the frames that maps are made from: those that are not doubtful."""
        return without_doubtful(self.trajectory, self.records)

    @cached_property
    def poses(self) -> UncertainPoses:
        """The poses of ``trajectory`` with their covariance."""
        return read_poses(self.file(files.POSES))

    @cached_property
    def truth(self) -> Trajectory | None:
        """True body poses, in the truth's own frame; None if the log has none."""
        path = self.file(files.TRUTH)
        return read_tum(path) if path.exists() else None

    @cached_property
    def graph(self) -> PoseGraph:
        """Pose graph with its nodes at the solution, in the levelled world."""
        graph, fixes = read_g2o(self.file(files.GRAPH)), self.file(files.FIXES)
        return replace(graph, fixes=read_fixes(fixes)) if fixes.exists() else graph

    @cached_property
    def loops(self) -> list[LoopClosure]:
        """Every loop candidate with its verdict."""
        return read_closures(self.file(files.LOOPS))

    @cached_property
    def records(self) -> list[FrameRecord]:
        """Outcome of every frame."""
        return read_records(self.file(files.FRAMES))

    @property
    def frames_ns(self) -> Stamps:
        """(N,) stamps of all frames of the log, tracked or not."""
        return stamps_of(self.records)

    @cached_property
    def frame_ms(self) -> dict[int, float]:
        """Milliseconds that each frame took to track, by stamp."""
        return read_frame_ms(self.file(files.FRAME_MS))

    @cached_property
    def keyframes(self) -> Trajectory:
        """Poses of the keyframes."""
        return read_tum(self.file(files.KEYFRAMES))

    @cached_property
    def results(self) -> RunResults:
        """All of the above, with the truth aligned with the trajectory; its maps may still be missing."""
        truth = None if self.truth is None else aligned_truth(self.truth, self.trajectory)
        return RunResults(
            self.trajectory, self.graph, self.records, self.loops, self.frame_ms, truth, self.poses
        )

    @property
    def verdict(self) -> Verdict:
        """Verdict on whether it is to be trusted.

        Raises:
            RunError: It is still being built.
        """
        if self.manifest.verdict is None:
            raise RunError(f"{self.path}: has no verdict; make one with mapper fuse {self.path}")
        return self.manifest.verdict

    @cached_property
    def cloud(self) -> "Cloud":
        """Coloured cloud."""
        from mapper.run.cloud import read_cloud

        return read_cloud(self.file(files.CLOUD))

    def plot(self, axes: "Axes | None" = None) -> "Axes":
        """Draw the path over the slice, seen from above, with loops, uncertainty and the truth if known.

        Args:
            axes: Matplotlib's axes to draw on; None makes a figure of pyplot's.

        Returns:
            The axes, in metres of the levelled world.
        """
        from mapper.export.picture import plot_run

        return plot_run(self, axes)

    def export(
        self,
        kind: str,
        path: AnyPath | None = None,
        *,
        settings: Mapping[str, Any] | None = None,
        frame: Literal["map", "start", "base"] = "map",
        poses_of: str | None = None,
        crop: Sequence[float] | None = None,
        overwrite: bool = False,
        progress: "Progress | Callable[[str], object] | None" = None,
    ) -> Path:
        """Write the run for another program, as ``mapper export --as KIND`` does, and return where it is.

        Args:
            kind: Such as "octomap", "las" or "rosbag2".
            path: File or folder to write; None keeps a file in the run.
            settings: Values by dotted name that this kind reads, such as ``{"mesh.voxel_m": 0.01}``.
            frame: Frame of poses and points: "map", or "start" or "base", the body or the robot's base at its
                first pose.
            poses_of: With "tum" and "kitti", whose poses: "base", or a frame that the manifest names; None is
                the body.
            crop: Lowest and highest corner of what is written, x y z x y z, metres in the map; None is all.
            overwrite: Replace what is at PATH.
            progress: As for ``mapper.build``.

        Raises:
            ConfigError: No such kind, a name that does not end like one, or settings, a frame or a crop that
                this kind cannot have.
            RunError: PATH is there already, or a file or the log that the kind needs is missing.
        """
        wanted = {"settings": settings, "frame": frame, "poses_of": poses_of, "box_m": crop}
        written: Path = import_module("mapper.api.runs").export(
            self, kind, path, overwrite=overwrite, progress=progress, **wanted
        )
        return written

    def fuse(
        self,
        *,
        settings: Mapping[str, Any] | None = None,
        trajectory: Trajectory | None = None,
        progress: "Progress | Callable[[str], object] | None" = None,
    ) -> "Run":
        """Make the maps again with other settings or poses, as ``mapper fuse`` does, and return the new run.

        Args:
            settings: Values by dotted name, such as ``{"octree.resolution_m": 0.1}``.
            trajectory: Better poses of the body; None keeps the run's.
            progress: As for ``mapper.build``.

        Raises:
            RunError: The log is no longer there, or is not what it was.
            ConfigError: A setting is unknown, has no such value, or is not of the maps.
        """
        fused: Run = import_module("mapper.api.runs").fuse(
            self, settings=settings, trajectory=trajectory, progress=progress
        )
        return fused

    def edit(
        self,
        kind: Literal["erase", "keep", "keepout", "undo"],
        *,
        progress: "Progress | Callable[[str], object] | None" = None,
        **region: Any,
    ) -> "Run":
        """Erase, keep or block a region of the maps, as ``mapper edit`` does, and return the new run.

        Args:
            kind: What to do in the region; "undo" takes the last edit back and has none.
            progress: As for ``mapper.build``.
            region: Conditions of ``edits.toml``: ``box_m``, ``height_m``, ``path_radius_m``, ``polygon_m``.

        Raises:
            ConfigError: No such kind or condition, or nothing to undo.
            DataError: Nothing would be left of the map.
            RunError: The log is no longer there, or is not what it was.
        """
        edited: Run = import_module("mapper.api.runs").edit(self, kind, region, progress=progress)
        return edited

    def view(self, path: AnyPath | None = None, *, overwrite: bool = False) -> Path:
        """Write the map in 3D as a page for any browser, as ``mapper view --html`` does; return its path.

        Args:
            path: HTML file to write; None is ``RUN.html`` in the current folder.
            overwrite: Replace a file that is there.

        Raises:
            RunError: The file is there already.
        """
        written: Path = import_module("mapper.api.runs").write_page([self.path], path, overwrite=overwrite)
        return written

    def report(self, path: AnyPath | None = None, *, overwrite: bool = False) -> Path:
        """Write a page with the run's map, verdict and numbers, as ``mapper report`` does; return its path.

        Args:
            path: HTML file to write; None is ``report.html``, or with a number if that exists.
            overwrite: Replace a file that is there.

        Raises:
            RunError: The file is there already.
        """
        reports = import_module("mapper.evaluators.pictures.run_report")
        written: Path = reports.report([self], path, overwrite=overwrite)
        return written

    def _repr_html_(self) -> str:
        from mapper.export.picture import run_html

        return run_html(self)

    def __repr__(self) -> str:
        return f"Run({str(self.path)!r})"

    @property
    def fused_config(self) -> BuildConfig:
        """Configuration by which its maps were made: its own, with the noise of depth that was measured."""
        if self.manifest.depth is None:
            return self.config
        octree = self.config.octree.model_copy(update={"depth_noise": self.manifest.depth.noise})
        return self.config.model_copy(update={"octree": octree})

    def scan_updates(self) -> Path | None:
        """Return the path of the frames' updates; None where a user deleted it."""
        return self.file(files.SCAN_UPDATES) if (self.path / files.SCAN_UPDATES).exists() else None

    def open_log(self) -> Log:
        """Return the log that it was built from, with the same frames selected and all that was appended.

        Gyroscopes are calibrated as by the build.

        Raises:
            RunError: It is no longer there, or is not what it was.
            SourceError: It cannot be opened.
        """
        return open_inputs(self.manifest, self.config.source, run=self.path)

    def files(self) -> list[Path]:
        """Return the folder's files, by name."""
        return sorted(child for child in self.path.iterdir() if child.is_file())


def open_run(path: AnyPath) -> Run:
    """Return a finished run; its files are read on first access.

    Args:
        path: Its folder.

    Raises:
        RunError: The folder is missing, is no run, or is not finished; the message says how it ended. Or its
            settings are not as they were written.
    """
    path = Path(path)
    if not path.is_dir():
        partial = partial_of(path)
        if is_merged_map(partial):
            raise RunError(f"{path}: not finished; the mapper merge that began it resumes it")
        if (partial / files.MANIFEST).is_file():
            raise RunError(f"{path}: not finished: {_ending(partial)}")
        if path.exists():
            raise RunError(f"{path}: {_not_a_run(path)}")
        raise RunError(f"{path}: no such run folder; make one with mapper build LOG --out {path}")
    if is_merged_map(path):
        raise RunError(
            f"{path}: is a merged map, not a run; mapper eval, view --html, export and plan take it"
        )
    if is_localised_log(path):
        raise RunError(f"{path}: is a localised log, not a run; its manifest names the map that it lies in")
    if not (path / files.MANIFEST).exists():
        raise RunError(f"{path}: {_not_a_run(path)}")
    manifest = read_manifest(path / files.MANIFEST)
    if manifest.status != "complete":
        raise RunError(f"{path}: not finished: {_ending(path)}")
    return Run(
        path, _with_own_poses(load_run_config(checked(path, files.CONFIG, manifest.files)), path), manifest
    )


def _with_own_poses(config: BuildConfig, folder: Path) -> BuildConfig:
    """Return a run's configuration with the poses that the run keeps where its folder is now."""
    poses = folder / files.ODOMETRY
    if not isinstance(config.odometry, GivenOdometryConfig) or not poses.is_file():
        return config
    odometry = config.odometry.model_copy(update={"path": poses.resolve()})
    return config.model_copy(update={"odometry": odometry})


def moved_log(run: Run, *logs: Path) -> Run:
    """Return the run with its logs at other paths.

    Raises:
        RunError: It was made from another number of logs.
    """
    moved = run.manifest.input.moved(logs, run=run.path)
    return replace(run, manifest=run.manifest.model_copy(update={"input": moved}))


def _not_a_run(path: Path) -> str:
    """Return what a file or folder is that is no run, and what was perhaps meant."""
    if path.is_file() and (path.parent / files.MANIFEST).is_file():
        return f"is a file of a run; give the folder {path.parent}"
    if path.is_dir() and (runs := sorted(child.parent.name for child in path.glob(f"*/{files.MANIFEST}"))):
        return f"is no run itself, but holds {listed(runs)}"
    try:
        open_source(path)
    except MapperError:
        return f"is no run folder: it has no {files.MANIFEST}"
    return f"is a log, not a run; map it first: mapper build {quote(str(path))}"


def _ending(folder: Path) -> str:
    manifest = read_manifest(folder / files.MANIFEST)
    if manifest.status == "building":
        ending = "is still being built, or its process was killed"
    else:
        ending = f"{manifest.status}: {manifest.reason}"
    hint = "; the same mapper build resumes it" if (folder / files.CHECKPOINTS).is_dir() else ""
    return f"{folder} {ending}{hint}"
