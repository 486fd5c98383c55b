"""The folder a build leaves: what is in it, how it is filled, and how other verbs read it."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import zip_longest
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from mapper.atomic import write_text
from mapper.config import BuildConfig
from mapper.config.sources import SourceConfig
from mapper.errors import MapperError, RunError
from mapper.fingerprint import fingerprint
from mapper.graph.g2o import read_g2o
from mapper.graph.model import PoseGraph
from mapper.loops.closure import LoopClosure, read_closures
from mapper.manifest import (
    AppendedLog,
    Input,
    Log,
    Manifest,
    Timing,
    library_versions,
    now_text,
    read_manifest,
)
from mapper.measure import Stopwatch
from mapper.merging.merged_map import is_map
from mapper.records import FrameRecord, read_frame_ms, read_records
from mapper.sources import open_source
from mapper.sources.base import FrameSource
from mapper.sources.chained import Session, chained, sessions_of
from mapper.staging import MARK, partial_of, staged
from mapper.trajectory import Trajectory, read_tum

CONFIG = "config.json"
MANIFEST = MARK
TRAJECTORY = "trajectory.tum"
KEYFRAMES = "keyframes.tum"
TRUTH = "truth.tum"
GRAPH = "graph.g2o"
LOOPS = "loops.jsonl"
FRAMES = "frames.csv"
FRAME_MS = "frame_ms.csv"
OCTREE_BT = "map.bt"
OCTREE_OT = "map.ot"
OCTREE_MAP = "map.octree"
SIGHTS = "sights.bin"
CLOUD = "cloud.ply"
SLICE = "slice"
TRAVERSABLE = "traversable"
COSTMAP = "costmap"
MCAP = "run.mcap"
SUMMARY = "summary.png"
CLOUD_VIEWS = "cloud.png"
PLAN = "plan.json"
PLAN_VIEW = "plan.png"
RERUN = "run.rrd"


@dataclass(frozen=True, slots=True)
class Run:
    """A finished run.

    Attributes:
        path: Its folder.
        config: What it was built with, every default spelled out.
        manifest: What it says about itself.
    """

    path: Path
    config: BuildConfig
    manifest: Manifest

    def trajectory(self) -> Trajectory:
        """Return the solved body poses of all tracked frames, in the levelled world."""
        return read_tum(self.path / TRAJECTORY)

    def truth(self) -> Trajectory | None:
        """Return where the body really was, in the truth's own frame, if the log told."""
        path = self.path / TRUTH
        return read_tum(path) if path.exists() else None

    def graph(self) -> PoseGraph:
        """Return the pose graph with its nodes at the solution, in the levelled world."""
        return read_g2o(self.path / GRAPH)

    def loops(self) -> list[LoopClosure]:
        """Return every loop candidate with its verdict."""
        return read_closures(self.path / LOOPS)

    def records(self) -> list[FrameRecord]:
        """Return what became of every frame."""
        return read_records(self.path / FRAMES)

    def frame_ms(self) -> dict[int, float]:
        """Return how many milliseconds each frame took to track, by stamp."""
        return read_frame_ms(self.path / FRAME_MS)

    def files(self) -> list[Path]:
        """Return the folder's files, by name."""
        return sorted(child for child in self.path.iterdir() if child.is_file())


def load_run(path: Path) -> Run:
    """Return a finished run.

    Raises:
        RunError: The folder is missing, is no run, or is not finished; the message says how it ended.
    """
    if not path.is_dir():
        partial = partial_of(path)
        if is_map(partial):
            raise RunError(f"{path}: not finished; the mapper merge that began it goes on where it was")
        if (partial / MANIFEST).is_file():
            raise RunError(f"{path}: not finished: {_ending(partial)}")
        raise RunError(f"{path}: no such run folder; make one with mapper build LOG --out {path}")
    if is_map(path):
        raise RunError(
            f"{path}: is a merged map, not a run; its {OCTREE_BT}, {OCTREE_OT} and slice are in it"
        )
    manifest = read_manifest(path / MANIFEST)
    if manifest.status != "complete":
        raise RunError(f"{path}: not finished: {_ending(path)}")
    return Run(path, _read_config(path / CONFIG), manifest)


def moved_log(run: Run, *logs: Path) -> Run:
    """Return the run, knowing that its logs lie elsewhere by now.

    Raises:
        RunError: It was made from another number of logs.
    """
    known = run.manifest.input
    if len(logs) != 1 + len(known.appended):
        raise RunError(
            f"{run.path}: made from {1 + len(known.appended)} logs, {known.title}; "
            f"{len(logs)} given, want all of them in this order"
        )
    first, *others = (str(log.resolve()) for log in logs)
    appended = tuple(
        log.model_copy(update={"path": path}) for log, path in zip(known.appended, others, strict=True)
    )
    moved = known.model_copy(update={"path": first, "appended": appended})
    return replace(run, manifest=run.manifest.model_copy(update={"input": moved}))


def open_log(run: Run) -> FrameSource:
    """Return the log that a run was built from, with the same frames selected and all that was appended.

    Raises:
        RunError: It is no longer there, or is not what it was.
        SourceError: It cannot be opened.
    """
    source = _open(run, run.manifest.input, run.config.source)
    for log in run.manifest.input.appended:
        source = chained(source, _open(run, log, log.source), shift_ns=log.shift_ns)
    refuse_another_log(run, source)
    return source


def _open(run: Run, log: Log, config: SourceConfig) -> FrameSource:
    path = Path(log.path)
    if not path.exists():
        raise RunError(f"{path}: the log of {run.path} is no longer there; tell its new place with --log")
    return open_source(path, config)


def refuse_another_log(run: Run, source: FrameSource) -> None:
    """Refuse a log that is not the one that a run was built from.

    Raises:
        RunError: Its fingerprint differs, or that of a log that was appended.
    """
    logs = (run.manifest.input, *run.manifest.input.appended)
    for path, log in zip_longest(paths_of(source), logs):
        if path is None or log is None:
            raise RunError(
                f"{source.path}: {run.path} was made from {len(logs)} logs; open them with open_log"
            )
        if fingerprint(path) != log.fingerprint:
            raise RunError(f"{path}: changed since {run.path} was built from it; build it again")


def paths_of(source: FrameSource) -> list[Path]:
    """Return where the logs are that a source is made of."""
    return [session.log.path for session in sessions_of(source)]


class Draft:
    """A run folder being filled; its manifest says "building" until the end is known.

    Attributes:
        folder: Where the files go.
        clock: Times the stages.
        manifest: What will be written at the end; ``update`` replaces parts of it.
    """

    def __init__(self, folder: Path, manifest: Manifest) -> None:
        self.folder = folder
        self.clock = Stopwatch()
        self.manifest = manifest
        self.save()

    def update(self, **parts: Any) -> None:
        """Replace fields of the manifest."""
        self.manifest = self.manifest.model_copy(update=parts)

    def save(self) -> None:
        """Write the manifest as it stands."""
        self.manifest.save(self.folder / MANIFEST)


@contextmanager
def drafting(out: Path, manifest: Manifest, config: BuildConfig, *, overwrite: bool) -> Iterator[Draft]:
    """Yield a draft that becomes the run OUT on success and stays behind as ``OUT.partial`` otherwise.

    A failure or an interruption is written into the manifest; a killed process leaves it at "building".

    Raises:
        RunError: OUT exists and may not be replaced, or is being built by another process.
    """
    with staged(out, overwrite=overwrite) as folder:
        draft = Draft(folder, manifest)
        try:
            write_text(folder / CONFIG, config.model_dump_json(indent=2) + "\n")
            yield draft
        except BaseException as error:
            status = "interrupted" if isinstance(error, KeyboardInterrupt) else "failed"
            reason = str(error) if isinstance(error, MapperError) else f"{type(error).__name__}: {error}"
            draft.update(status=status, reason=reason)
            draft.save()
            error.add_note(f"what there is so far stays in {folder}")
            raise
        draft.update(status="complete")
        draft.save()


def first_manifest(source: FrameSource) -> Manifest:
    """Return the manifest of a run that has just begun."""
    return Manifest(
        status="building",
        libraries=library_versions(),
        input=Input(**_facts(source)),
        timing=Timing(started=now_text()),
    )


def appended_log(session: Session, config: SourceConfig) -> AppendedLog:
    """Return what the manifest says of a log that was appended."""
    return AppendedLog(
        **_facts(session.log),
        source=config,
        shift_ns=session.shift_ns,
        begins_ns=int(session.stamps_ns[0]),
    )


def _facts(source: FrameSource) -> dict[str, Any]:
    return {
        "path": str(source.path.resolve()),
        "kind": source.kind,
        "fingerprint": fingerprint(source.path),
        "notes": tuple(source.notes),
    }


def _ending(folder: Path) -> str:
    manifest = read_manifest(folder / MANIFEST)
    if manifest.status == "building":
        return f"{folder} is still being built, or its process was killed"
    return f"{folder} {manifest.status}: {manifest.reason}"


def _read_config(path: Path) -> BuildConfig:
    try:
        return BuildConfig.model_validate_json(path.read_bytes())
    except OSError as error:
        raise RunError(f"{path}: cannot be read: {error.strerror}") from None
    except ValidationError as error:
        first = error.errors()[0]
        name = ".".join(str(part) for part in first["loc"])
        raise RunError(f"{path}: {name}: {first['msg']}; built by another version?") from None
