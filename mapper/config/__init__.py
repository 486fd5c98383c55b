"""Every knob with its unit and default, and how files and overrides reach it."""

import json
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, TypeVar, get_args

from pydantic import Field, NonNegativeInt, PositiveFloat, PositiveInt, ValidationError

from mapper.config.base import Config, Ratio
from mapper.config.export import MeshConfig
from mapper.config.graph import GraphConfig
from mapper.config.loops import LoopsConfig, PlaceLoopsConfig
from mapper.config.navigation import CostmapConfig, TraversableConfig
from mapper.config.octree import LevelConfig, OctreeConfig, SliceConfig
from mapper.config.odometry import LocalMapConfig, OdometryConfig
from mapper.config.sensors import DEFAULTS, Sensor
from mapper.config.sources import SourceConfig
from mapper.errors import ConfigError

AnyConfig = TypeVar("AnyConfig", bound=Config)


class McapConfig(Config):
    """What goes into ``run.mcap``."""

    image_stride: NonNegativeInt = 10
    """Every n-th frame's colour image, or scan, is logged; 0 logs none."""
    image_width_px: PositiveInt = 320
    """Wider images are shrunk."""
    image_quality: Annotated[int, Field(ge=1, le=100)] = 80
    """As libjpeg counts."""
    scan_voxel_m: PositiveFloat = 0.3
    """Scans are thinned to one point per voxel."""
    frame_times: bool = True
    """Log the milliseconds of every frame; without them two builds of a log give the same bytes."""


class RerunConfig(Config):
    """What a viewer is shown while a map is built."""

    image_stride: PositiveInt = 3
    """Every n-th frame is shown with its image and cloud, which costs reading it again."""
    image_width_px: PositiveInt = 480
    """Wider images are shrunk."""
    cloud_points: PositiveInt = 20_000
    """A frame's cloud is thinned to about so many points."""


class CloudConfig(Config):
    """The coloured cloud."""

    voxel_m: PositiveFloat = 0.02
    """The cloud keeps one point, the mean, per cube of this edge."""
    frame_stride: PositiveInt = 10
    """Every n-th tracked frame gives its points."""


class BuildConfig(Config):
    """Everything ``mapper build`` can be told."""

    source: SourceConfig = SourceConfig()
    odometry: OdometryConfig = LocalMapConfig()
    loops: LoopsConfig = PlaceLoopsConfig()
    graph: GraphConfig = GraphConfig()
    octree: OctreeConfig = OctreeConfig()
    level: LevelConfig = LevelConfig()
    slice: SliceConfig = SliceConfig()
    traversable: TraversableConfig = TraversableConfig()
    cloud: CloudConfig = CloudConfig()
    mcap: McapConfig = McapConfig()
    rerun: RerunConfig = RerunConfig()
    mesh: MeshConfig = MeshConfig()
    costmap: CostmapConfig = CostmapConfig()
    min_tracked_frames: PositiveInt = 10
    """With fewer frames tracked there is no map worth the name, and the build ends in an error."""
    min_tracked_ratio: Ratio = 0.2
    """The same, as a share of the frames that could be read."""
    workers: NonNegativeInt = 2
    """Threads that decode and detect ahead; the result does not depend on it."""


def load_config(
    path: Path | None = None, overrides: Sequence[str] = (), *, sensor: Sensor = "rgbd"
) -> BuildConfig:
    """Return the configuration of a TOML file, or a run's JSON, with ``key.path=value`` overrides on top.

    Args:
        path: The file; None begins with the defaults.
        overrides: Text, parsed by the model.
        sensor: Whose defaults hold where neither says anything.

    Raises:
        ConfigError: The file cannot be read or parsed, or the model refuses a name or a value.
    """
    tree = {} if path is None else _read(path)
    if path is not None:
        _validated(BuildConfig, _over(DEFAULTS[sensor], tree), str(path))
    for override in overrides:
        _put(tree, override)
    return _validated(
        BuildConfig, _over(DEFAULTS[sensor], tree), "overrides" if overrides or path is None else str(path)
    )


def load_source_config(path: Path | None = None, overrides: Sequence[str] = ()) -> SourceConfig:
    """Return the part of a configuration that opens a log, before it is known which sensor took it.

    Raises:
        ConfigError: As ``load_config``, of that part alone.
    """
    tree = {} if path is None else _read(path)
    for override in overrides:
        if override.startswith("source."):
            _put(tree, override)
    return _validated(BuildConfig, {"source": tree.get("source", {})}, str(path or "overrides")).source


def read_config(path: Path, model: type[AnyConfig]) -> AnyConfig:
    """Return what a TOML or JSON file holds, as a model of any kind; what it leaves out is the model's own.

    Raises:
        ConfigError: The file cannot be read or parsed, or the model refuses a name or a value.
    """
    return _checked(model, _read(path), str(path))


def _read(path: Path) -> dict[str, Any]:
    is_json = path.suffix == ".json"
    try:
        text = path.read_text(encoding="utf-8")
        tree: dict[str, Any] = json.loads(text) if is_json else tomllib.loads(text)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from None
    except ValueError as error:  # what either parser raises, and text that is not UTF-8
        raise ConfigError(f"{path}: not valid {'JSON' if is_json else 'TOML'}: {error}") from None
    return tree


def _over(defaults: Mapping[str, Any], tree: Mapping[str, Any]) -> dict[str, Any]:
    """Return the tree with what it leaves out taken from the defaults, part by part."""
    filled: dict[str, Any] = {**defaults, **tree}
    for name, value in tree.items():
        default = defaults.get(name)
        if isinstance(value, dict) and isinstance(default, dict):
            filled[name] = {**default, **value}
    return filled


def overridden(config: AnyConfig, overrides: Sequence[str]) -> AnyConfig:
    """Return a configuration of any kind with ``key.path=value`` overrides on top.

    Raises:
        ConfigError: The model refuses a name or a value.
    """
    tree = config.model_dump()
    for override in overrides:
        _put(tree, override)
    return _validated(type(config), tree, "overrides")


def _put(tree: dict[str, Any], override: str) -> None:
    """Set one dotted key; the value stays text, and the model parses it."""
    dotted, equals, value = override.partition("=")
    if not equals or not dotted:
        raise ConfigError(f"override {override!r}: want key.path=value")
    *parents, leaf = dotted.split(".")
    node = tree
    for key in parents:
        node = node.setdefault(key, {})
        if not isinstance(node, dict):
            raise ConfigError(f"override {override!r}: {key} is a value, not a table")
    node[leaf] = value


def _with_kinds(tree: dict[str, Any], default: Config) -> dict[str, Any]:
    """Return the tree with what it leaves out and the classes' own defaults would not restore.

    That is every ``kind``, and whatever a part's default says beyond its class: turning one knob of a part
    must not turn back the others.
    """
    filled = dict(tree)
    for name, value in tree.items():
        member = getattr(default, name, None)
        if not isinstance(value, dict) or not isinstance(member, Config):
            continue
        if "kind" in type(member).model_fields:
            value = {"kind": _kind(type(member)), **value}
            members = get_args(type(default).model_fields[name].annotation)
            member = next((m() for m in members if _kind(m) == value["kind"]), member)
        filled[name] = member.model_dump(include=member.model_fields_set) | _with_kinds(value, member)
    return filled


def _kind(member: type[Config]) -> str:
    return str(member.model_fields["kind"].default)


def _validated(model: type[AnyConfig], tree: dict[str, Any], where: str) -> AnyConfig:
    return _checked(model, _with_kinds(tree, model()), where)


def _checked(model: type[AnyConfig], tree: dict[str, Any], where: str) -> AnyConfig:
    try:
        return model.model_validate(tree)
    except ValidationError as error:
        first = error.errors()[0]
        name = ".".join(str(part) for part in first["loc"]) or "configuration"
        raise ConfigError(f"{where}: {name}: {first['msg']}") from None
