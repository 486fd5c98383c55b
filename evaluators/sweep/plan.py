"""Plan of a sweep: its settings, and every build of every log by every method in every configuration."""

import shutil
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from glob import glob, has_magic
from itertools import product
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import BeforeValidator, Field, NonNegativeInt, model_validator

from mapper.config.build import BuildConfig
from mapper.config.loading import load_config, load_source_config, read_config
from mapper.core.config import Config, flattened
from mapper.core.errors import ConfigError
from mapper.core.trajectory import with_rotations
from mapper.evaluators.study.engine import CELLS, digest, run_study, seeded, versions
from mapper.evaluators.sweep.build_job import BuildJob
from mapper.loops.config import PlaceLoopsConfig, ScanLoopsConfig, ThesisLoopsConfig
from mapper.odometry.config import IsvdOdometryConfig, KeyframeOdometryConfig
from mapper.odometry.scans.config import ScanOdometryConfig
from mapper.run.input_logs import fingerprint
from mapper.runtime.atomic import resumable_folder, write_json
from mapper.runtime.executor import IN_PROCESS, Workers
from mapper.runtime.extras import require
from mapper.runtime.progress import SILENT, Progress
from mapper.runtime.resumable_jobs import Job, JobResult
from mapper.sources import open_source
from mapper.sources.base import Log
from mapper.sources.config import SourceConfig


def _assignments(given: Any) -> Any:
    if not isinstance(given, Mapping):
        return given
    flat = flattened(given)
    if lists := [name for name, value in flat.items() if isinstance(value, list)]:
        raise ValueError(f"{lists[0]} is a list; write it into a config file")
    return tuple(f"{name}={value}" for name, value in flat.items())


Name = Annotated[str, Field(min_length=1, max_length=60, pattern=r"^[^\s/].*$")]
Assignments = Annotated[tuple[str, ...], BeforeValidator(_assignments)]
"""``key.path=value`` as for ``--set``, or a table of the same."""


class ConfigurationConfig(Config):
    """Settings that are changed for every method alike."""

    name: Name
    set: Assignments = ()


class MethodConfig(ConfigurationConfig):
    """Method to map a log: a configuration file, and settings changed on top of it."""

    config: Path | None = None
    """TOML file, beside the sweep's own; None begins with the defaults for the log's sensor."""


class SweepConfig(Config):
    """Logs × methods × configurations, each a build of its own."""

    logs: Annotated[tuple[str, ...], Field(min_length=1)]
    """Paths or globs, beside the sweep's own file."""
    method: Annotated[tuple[MethodConfig, ...], Field(min_length=1)]
    configuration: Annotated[tuple[ConfigurationConfig, ...], Field(min_length=1)] = (
        ConfigurationConfig(name="default"),
    )
    """Configurations; they override the method's settings."""
    seeds: tuple[NonNegativeInt, ...] = ()
    """Each build is repeated with these in place of every seed of its configuration, if it has any."""
    keep: Literal["nothing", "trajectory", "run"] = "trajectory"
    """What is kept of each build besides its numbers: "trajectory" with manifest, configuration and summary
    picture, or the whole run folder."""

    @model_validator(mode="after")
    def _no_name_twice(self) -> Self:
        for kind, variants in (("method", self.method), ("configuration", self.configuration)):
            names = [variant.name for variant in variants]
            for name in names:
                if names.count(name) > 1:
                    raise ValueError(f"two of [[{kind}]] are called {name!r}; want different names")
        return self


RUNS, SCRATCH, PLAN = "runs", "scratch", "sweep.json"
_IMAGE_LOOPS = (PlaceLoopsConfig, ThesisLoopsConfig)


@dataclass(frozen=True, slots=True)
class BuildName:
    """Name of a build: its place in the table.

    Attributes:
        log: Its name, unique in the sweep.
        method: Its name.
        configuration: Its name.
        seed: None if nothing in the build is random, or none was requested.
    """

    log: str
    method: str
    configuration: str
    seed: int | None = None

    @property
    def label(self) -> str:
        """Names and seed in a line, e.g. "desk, isvd, fine, seed 1"."""
        seed = () if self.seed is None else (f"seed {self.seed}",)
        return ", ".join([self.log, self.method, self.configuration, *seed])


@dataclass(frozen=True, slots=True)
class Plan:
    """Every build of a sweep, and what cannot be built.

    Attributes:
        config: Settings of the sweep.
        out: Absolute folder of the results.
        entries: A job for every build, log by log, or the reason why its method does not apply to the log.
    """

    config: SweepConfig
    out: Path
    entries: dict[BuildName, Job | str]

    @property
    def jobs(self) -> dict[BuildName, Job]:
        """The builds that there are."""
        return {build: entry for build, entry in self.entries.items() if isinstance(entry, Job)}


def plan_sweep(path: Path, out: Path) -> Plan:
    """Return the builds of a sweep's file, every configuration checked and every log opened.

    Raises:
        ConfigError: The file, or a configuration that results from it, is wrong; no log fits a glob.
        SourceError: A log cannot be opened.
        DependencyError: The library that writes the table is not installed.
    """
    require("pyarrow", "study", "mapper sweep")
    config = read_config(path, SweepConfig)
    out = out.resolve()
    entries: dict[BuildName, Job | str] = {}
    for name, log in _logs(path, config).items():
        sources: dict[SourceConfig, Log] = {}
        mark = fingerprint(log)
        for method, configuration in product(config.method, config.configuration):
            build = BuildName(name, method.name, configuration.name)
            build_config, source = _resolved(path, log, method, configuration, sources)
            if misfit := _misfit(build_config, source):
                entries[build] = misfit
                continue
            for seed, seeded_config in _repeats(build_config, config.seeds):
                build = replace(build, seed=seed)
                key = _key(mark, seeded_config, config.keep)
                kept = None if config.keep == "nothing" else out / RUNS / key
                work = BuildJob(log.resolve(), seeded_config, out / SCRATCH, kept, config.keep)
                entries[build] = Job(key, build.label, work)
    return Plan(config, out, entries)


def run_sweep(
    plan: Plan, *, workers: Workers = IN_PROCESS, progress: Progress = SILENT
) -> dict[BuildName, JobResult]:
    """Return the result of every build; what an earlier one in the folder has finished is kept.

    Args:
        plan: The builds.
        workers: Workers that run the builds; each keeps to one core.
        progress: Receives stages, counts and notes.

    Raises:
        ConfigError: As for ``run_study``.
        RunError: OUT holds something else, or another sweep is at work there.
    """
    out = plan.out
    with resumable_folder(out, mark=PLAN):
        shutil.rmtree(out / SCRATCH, ignore_errors=True)  # what a killed sweep left
        write_json(out / PLAN, _described(plan), indent=1)
        results = run_study(plan.jobs, out / CELLS, workers=workers, progress=progress)
        with suppress(OSError):
            (out / SCRATCH).rmdir()
    return results


def _logs(path: Path, config: SweepConfig) -> dict[str, Path]:
    """Return the logs by name, in the order of the file; those of a glob in alphabetical order."""
    found: list[Path] = []
    for pattern in config.logs:
        whole = str(path.parent / Path(pattern).expanduser())
        # Path.glob refuses absolute patterns.
        logs = sorted(map(Path, glob(whole))) if has_magic(pattern) else [Path(whole)]  # noqa: PTH207
        if not logs:
            raise ConfigError(f"{path}: logs: nothing fits {pattern!r}")
        found += [log for log in logs if log not in found]
    names = [log.absolute().name for log in found]
    return {str(log) if names.count(name) > 1 else name: log for name, log in zip(names, found, strict=True)}


def _resolved(
    path: Path,
    log: Path,
    method: MethodConfig,
    configuration: ConfigurationConfig,
    sources: dict[SourceConfig, Log],
) -> tuple[BuildConfig, Log]:
    """Return a build's configuration, and its log, which is opened once: that may read all of it."""
    file = None if method.config is None else path.parent / method.config
    overrides = (*method.set, *configuration.set)
    try:
        source_config = load_source_config(file, overrides)
        if source_config not in sources:
            sources[source_config] = open_source(log, source_config)
        source = sources[source_config]
        config = load_config(file, overrides, sensor=source.sensor)
    except ConfigError as error:
        raise ConfigError(
            f"{path}: method {method.name!r}, configuration {configuration.name!r}: {error}"
        ) from None
    return config.model_copy(update={"workers": 0}), source  # a core for each cell, so that times compare


def _misfit(config: BuildConfig, source: Log) -> str:
    """Return why a log cannot be built so; empty if it can."""
    odometry, loops = config.odometry, config.loops
    if source.sensor != "rgbd" and isinstance(odometry, IsvdOdometryConfig | KeyframeOdometryConfig):
        return f"odometry.kind={odometry.kind} needs images"
    if odometry.kind == "wheels" and source.wheels is None:
        return "odometry.kind=wheels needs wheels"
    has_poses = with_rotations(source.truth) is not None or source.device_poses is not None
    if odometry.kind == "given" and odometry.path is None and not has_poses:
        return "odometry.kind=given needs truth or device poses"
    sees_scans = source.sensor != "rgbd" or isinstance(odometry, ScanOdometryConfig)
    if sees_scans and isinstance(loops, _IMAGE_LOOPS):
        return f"loops.kind={loops.kind} needs images, odometry.kind={odometry.kind} takes scans"
    if not sees_scans and isinstance(loops, ScanLoopsConfig):
        return f"loops.kind=scans needs scans, odometry.kind={odometry.kind} takes images"
    return ""


def _repeats(config: BuildConfig, seeds: tuple[int, ...]) -> Iterator[tuple[int | None, BuildConfig]]:
    """Yield the configuration with each seed, or once as it is if it has none."""
    if not seeds or seeded(config, 0) == seeded(config, 1):
        yield None, config
        return
    for seed in dict.fromkeys(seeds):
        yield seed, seeded(config, seed)


def _key(log: str, config: BuildConfig, keep: str) -> str:
    """Return a build's key: a hash of all that goes into it, not of what it is called."""
    files = [fingerprint(file) for file in _files(config.model_dump()) if file.exists()]
    return digest(log, config.model_dump(mode="json"), files, keep, versions(), digits=20)


def _files(tree: Any) -> Iterator[Path]:
    """Yield the files that a configuration names: the result depends on their content as well."""
    if isinstance(tree, Path):
        yield tree
    elif isinstance(tree, dict):
        for value in tree.values():
            yield from _files(value)


def _described(plan: Plan) -> dict[str, Any]:
    return {
        "sweep": plan.config.model_dump(mode="json"),
        "versions": versions(),
        "entries": {
            build.label: entry.key if isinstance(entry, Job) else f"does not apply: {entry}"
            for build, entry in plan.entries.items()
        },
    }
