"""Configurations read from files and overrides, with errors that name the setting."""

import json
import os
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from pydantic import ValidationError

from mapper.config.build import BuildConfig
from mapper.config.refusals import refusal, refuse_other_units
from mapper.core.config import Config, drop_unknown, flattened, kind_of, members_of
from mapper.core.errors import ConfigError, MapperWarning
from mapper.loops.config import PLANAR_LOOPS
from mapper.runtime.atomic import MANIFEST_NAME
from mapper.runtime.regular_files import AnyPath, parse_toml, read_text
from mapper.sources.config import SourceConfig

if TYPE_CHECKING:
    from mapper.core.frames import Sensor

DEFAULTS: "Mapping[Sensor, Mapping[str, Any]]" = {
    "rgbd": {},
    "lidar": {
        "odometry": {"kind": "gicp"},
        "loops": {"kind": "scans"},
        "octree": {"resolution_m": 0.2, "max_range_m": 80.0},
        "level": {"plane_tolerance_m": 0.1},
        "slice": {"min_height_m": 0.3, "max_height_m": 2.0, "above": "ground"},
        "traversable": {"max_step_m": 0.2, "slope_window_m": 2.0, "head_room_m": 2.0, "max_gap_m": 1.0},
        "costmap": {"robot_radius_m": 0.5, "inflation_radius_m": 2.0, "cost_scaling": 3.0},
        "cloud": {"voxel_m": 0.1, "frame_stride": 4},
    },
    "lidar-2d": {
        "odometry": {
            "kind": "icp",
            "pair_distances_m": (1.0, 0.3, 0.15),
            "scale": 1.0,
            "min_range_m": 0.05,
            "voxel_m": 0.1,
            "keyframe_distance_m": 0.5,
            "keyframe_angle_rad": 0.3,
            "max_pair_distance_m": 0.25,
            "rescue": None,
        },
        "loops": PLANAR_LOOPS.model_dump(exclude_unset=True) | {"kind": "scans"},
        "octree": {"resolution_m": 0.05, "max_range_m": 30.0},
        "slice": {"min_height_m": 0.0, "max_height_m": 2.0},
        "traversable": {"floor": "layer"},
        "cloud": {"voxel_m": 0.05, "frame_stride": 10},
    },
}
"""Default settings per sensor, where they differ from the classes' own. A street is coarser than a room: what
would be a step indoors is within the noise of the road."""

_PRESETS = Path(__file__).with_name("presets")

AnyConfig = TypeVar("AnyConfig", bound=Config)
Settings = Mapping[str, Any]
"""Values of settings by dotted name, ``{"octree.resolution_m": 0.1}``, or nested by name."""


def load_config(
    path: AnyPath | Settings | None = None,
    overrides: Sequence[str] = (),
    *,
    settings: Settings | None = None,
    sensor: "Sensor" = "rgbd",
) -> BuildConfig:
    """Return the configuration of a TOML file, or a run's JSON, with single settings on top.

    Args:
        path: The file, a preset's name, or settings by name; None begins with the defaults.
        overrides: ``key.path=value`` as text, parsed by the model.
        settings: The same as values by dotted name; they come last.
        sensor: Sensor whose defaults hold where nothing else is set.

    Raises:
        ConfigError: The file cannot be read or parsed, or the model refuses a name or a value.

    Example:
        >>> load_config({"octree.resolution_m": 0.1}).octree.resolution_m
        0.1
        >>> load_config(overrides=["octree.resolution_m=0.1"]).octree.resolution_m
        0.1
    """
    if isinstance(path, Mapping):
        settings, path = {**flattened(path), **flattened(settings or {})}, None
    path = None if path is None else _preset_or_file(Path(path))
    tree = {} if path is None else _read(path)
    if path is not None:
        if _is_of_a_run(path):
            _drop_former_settings(tree, path)
        _validated(BuildConfig, _over(DEFAULTS[sensor], tree), str(path))
    _put_all(tree, overrides, settings)
    where = None if overrides or settings or path is None else str(path)
    config = _validated(BuildConfig, _over(DEFAULTS[sensor], tree), where)
    refuse_other_units(config, _validated(BuildConfig, dict(DEFAULTS[sensor]), None))
    return config


def load_run_config(path: Path) -> BuildConfig:
    """Return the configuration that a run keeps; settings that an older version had are dropped.

    Warns:
        MapperWarning: Names the settings that were dropped.

    Raises:
        ConfigError: The file cannot be read or parsed, or the model refuses a value.
    """
    tree = _read(path)
    _drop_former_settings(tree, path)
    return checked_config(tree, BuildConfig, str(path))


def load_source_config(
    path: AnyPath | None = None, overrides: Sequence[str] = (), *, settings: Settings | None = None
) -> SourceConfig:
    """Return the part of a configuration that opens a log, before it is known which sensor took it.

    Args:
        path: As of ``load_config``.
        overrides: The same; those of other parts are left out.
        settings: The same.

    Raises:
        ConfigError: As ``load_config``, of that part alone.
    """
    tree = {} if path is None else _read(_preset_or_file(Path(path)))
    _put_all(
        tree,
        [override for override in overrides if override.startswith("source.")],
        {name: value for name, value in _by_name(settings).items() if name.split(".")[0] == "source"},
    )
    return _validated(
        BuildConfig, {"source": tree.get("source", {})}, None if path is None else str(path)
    ).source


def read_config(path: Path, model: type[AnyConfig]) -> AnyConfig:
    """Return what a TOML or JSON file holds, as a model of any kind; what it leaves out is the model's own.

    Raises:
        ConfigError: The file cannot be read or parsed, or the model refuses a name or a value.
    """
    return checked_config(_read(path), model, str(path))


def parse_config(text: str, path: Path, model: type[AnyConfig]) -> AnyConfig:
    """Return what the text of a TOML or JSON file holds, as :func:`read_config` does.

    Raises:
        ConfigError: As :func:`read_config`.
    """
    return checked_config(_parsed(text, path), model, str(path))


def _preset_or_file(path: Path) -> Path:
    """Return the file of a preset, such as "lidar-indoor", where there is no file of that name."""
    if path.suffix or path.name != f"{path}" or path.exists():
        return path
    preset = _PRESETS / f"{path.name.replace('-', '_')}.toml"
    if not preset.is_file():
        names = ", ".join(sorted(one.stem.replace("_", "-") for one in _PRESETS.glob("*.toml")))
        raise ConfigError(f"{path}: no such file, and no preset; these are {names}")
    return preset


def _read(path: Path) -> dict[str, Any]:
    return _parsed(read_text(path, error=ConfigError, may_be_pipe=True), path)


def _parsed(text: str, path: Path) -> dict[str, Any]:
    is_json = path.suffix == ".json"
    try:
        tree: dict[str, Any] = json.loads(text) if is_json else parse_toml(text)
    except (ValueError, RecursionError) as error:
        raise ConfigError(f"{path}: not valid {'JSON' if is_json else 'TOML'}: {error}") from None
    return tree


def _is_of_a_run(path: Path) -> bool:
    return path.suffix == ".json" and (path.parent / MANIFEST_NAME).is_file()


def _drop_former_settings(tree: dict[str, Any], path: Path) -> None:
    """Delete the names that are no settings; a run's file was complete when it was written."""
    names = drop_unknown(BuildConfig, tree)
    if names:
        warnings.warn(
            f"{path}: settings of an older version, which this one does not have, are ignored: "
            f"{', '.join(names)}",
            MapperWarning,
            stacklevel=3,
        )


def _over(defaults: Mapping[str, Any], tree: Mapping[str, Any]) -> dict[str, Any]:
    """Return the tree with what it leaves out taken from the defaults, part by part.

    A part of another kind than the default's has none of its settings.
    """
    filled: dict[str, Any] = {**defaults, **tree}
    for name, value in tree.items():
        default = defaults.get(name)
        if isinstance(value, dict) and isinstance(default, dict):
            is_other = value.get("kind", default.get("kind")) != default.get("kind")
            filled[name] = value if is_other else _over(default, value)
    return filled


def overridden(
    config: AnyConfig, overrides: Sequence[str] = (), *, settings: Settings | None = None
) -> AnyConfig:
    """Return a configuration of any kind with single settings on top, given as for ``load_config``.

    Where another ``kind`` of a part is chosen, the settings of the former one are left out.

    Raises:
        ConfigError: The model refuses a name or a value.
    """
    tree, changed = config.model_dump(), dict[str, Any]()
    _put_all(changed, overrides, settings)
    _drop_other_kinds(tree, changed)
    _put_all(tree, overrides, settings)
    found = _validated(type(config), tree, None)
    if isinstance(config, BuildConfig):
        refuse_other_units(found, config)
    return found


def _drop_other_kinds(tree: dict[str, Any], changed: Mapping[str, Any]) -> None:
    for name, value in changed.items():
        part = tree.get(name)
        if isinstance(part, dict) and isinstance(value, dict):
            if value.get("kind", part.get("kind")) != part.get("kind"):
                part.clear()
            _drop_other_kinds(part, value)


def parse_assignments(overrides: Sequence[str]) -> dict[str, str]:
    """Return the values of ``name=value`` by dotted name; of several of one name the last.

    Raises:
        ConfigError: One has no name or no ``=``.
    """
    values = {}
    for override in overrides:
        dotted, equals, value = override.partition("=")
        if not equals or not dotted:
            raise ConfigError(f"setting {override!r}: want name=value, such as octree.resolution_m=0.1")
        values[dotted] = value
    return values


def _put_all(tree: dict[str, Any], overrides: Sequence[str], settings: Settings | None) -> None:
    for dotted, value in (*parse_assignments(overrides).items(), *_by_name(settings).items()):
        _put(tree, dotted, value)


def _by_name(settings: Settings | None) -> Settings:
    """Return settings as given to a function, {} for None."""
    if settings is None:
        return {}
    if not isinstance(settings, Mapping) or not all(isinstance(name, str) for name in settings):
        raise ConfigError(f"settings {settings!r}: want values by name, {{'octree.resolution_m': 0.1}}")
    return settings


def _put(tree: dict[str, Any], dotted: str, value: Any) -> None:
    """Set one dotted key; a table of values sets each of them, and text is parsed by the model."""
    if isinstance(value, Mapping):
        for key, inner in value.items():
            _put(tree, f"{dotted}.{key}", inner)
        return
    *parents, leaf = dotted.split(".")
    node = tree
    for key in parents:
        if node.get(key) is None:  # a part that may be missing, such as octree.depth_noise
            node[key] = {}
        node = node[key]
        if not isinstance(node, dict):
            raise ConfigError(f"setting {f'{dotted}={value}'!r}: {key} is a value, not a table")
    node[leaf] = os.fspath(value) if isinstance(value, os.PathLike) else value


def _with_kinds(tree: dict[str, Any], default: Config) -> dict[str, Any]:
    """Return the tree with what it leaves out and the classes' own defaults would not restore.

    That is every ``kind``, and whatever a part's default adds to its class: an override of one setting
    must not turn back the others.
    """
    filled = dict(tree)
    for name, value in tree.items():
        member = getattr(default, name, None)
        if not isinstance(value, dict) or not isinstance(member, Config):
            continue
        if "kind" in type(member).model_fields:
            value = {"kind": kind_of(type(member)), **value}
            members = members_of(type(default).model_fields[name].annotation)
            member = next((m() for m in members if kind_of(m) == value["kind"]), member)
        filled[name] = member.model_dump(include=member.model_fields_set) | _with_kinds(value, member)
    return filled


def _validated(model: type[AnyConfig], tree: dict[str, Any], where: str | None) -> AnyConfig:
    return checked_config(_with_kinds(tree, model()), model, where)


def checked_config(tree: Mapping[str, Any], model: type[AnyConfig], where: str | None) -> AnyConfig:
    """Return a configuration from values that are nested by name.

    Args:
        tree: The values.
        model: Kind of the configuration.
        where: File that the values come from, for messages; None of a caller's own, which they name.

    Raises:
        ConfigError: The model refuses a name or a value.
    """
    try:
        return model.model_validate(tree)
    except ValidationError as error:
        refused = refusal(model, error.errors()[0])
        raise ConfigError(refused if where is None else f"{where}: {refused}") from None
