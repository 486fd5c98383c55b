"""``mapper config``: every setting with its value and meaning."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from mapper.cli.answer import Answer, Output, rows_text
from mapper.cli.options import ConfigFile, Overrides, SettingKey
from mapper.core.errors import ConfigError

if TYPE_CHECKING:
    from mapper.config.describe import Setting

_MOST_NEIGHBOURS = 12


def show_config(
    key: SettingKey = None,
    config: ConfigFile = None,
    set_: Overrides = None,
    sensor: Annotated[
        Literal["rgbd", "lidar", "lidar-2d"], typer.Option(help="Sensor whose defaults are used.")
    ] = "rgbd",
    docs: Annotated[bool, typer.Option("--docs", help="Explain every setting.")] = False,
    *,
    output: Output,  # noqa: ARG001
) -> Answer:
    """Print every setting that a build with these options would use, as TOML; with KEY, explain it.

    KEY is a setting, a table of settings (octree), or the end of a name (resolution_m).

    Example: mapper config octree.resolution_m, or: mapper config --set odometry.kind=isvd > isvd.toml, then:
    mapper build LOG --config isvd.toml
    """
    from mapper.config.loading import load_config

    loaded = load_config(config, set_ or (), sensor=sensor)
    values = loaded.model_dump(mode="json")
    if key is None and not docs:
        from mapper.core.config import toml_text

        return Answer(values, toml_text(values))

    from mapper.config.describe import settings

    every = list(settings(sensor))
    found = every if key is None else _asked_for(key, every)
    shown = [setting for setting in found if not setting.is_table] or found
    document = {"settings": [_document(setting, values) for setting in shown]}
    if docs or len({setting.key for setting in shown}) == 1:
        siblings = [] if docs else _neighbours(shown[0], every)
        *first, last = shown
        text = "\n\n".join(
            [*(_explained(each, values) for each in first), _explained(last, values, siblings)]
        )
    else:
        text = rows_text([(setting.key, _in_short(setting, values)) for setting in shown])
    return Answer(document, text, "\n\n".join(_explained(setting, values) for setting in shown))


def _asked_for(key: str, every: "Sequence[Setting]") -> "Sequence[Setting]":
    """Return the settings of a name, or below it, or whose names end with it.

    Raises:
        ConfigError: There are none; the nearest are named.
    """
    from difflib import get_close_matches

    key = key.strip(".")
    for found in (
        [setting for setting in every if setting.key == key and not setting.is_table],
        [setting for setting in every if setting.key.startswith(f"{key}.") or setting.key == key],
        [setting for setting in every if setting.key.endswith(f".{key}")],
    ):
        if found:
            return found
    names = list(dict.fromkeys(setting.key for setting in every))
    if near := get_close_matches(key, names, n=3, cutoff=0.7):
        raise ConfigError(f"{key}: no such setting; did you mean {' or '.join(near)}?")
    ends = {name.rpartition(".")[2]: name for name in reversed(names)}
    if near := get_close_matches(key.rpartition(".")[2], list(ends), n=3):
        raise ConfigError(f"{key}: no such setting; did you mean {' or '.join(ends[end] for end in near)}?")
    tables = ", ".join(setting.key for setting in every if setting.is_table and "." not in setting.key)
    raise ConfigError(f"{key}: no such setting; the tables are {tables}")


def _document(setting: "Setting", values: Mapping[str, Any]) -> dict[str, Any]:
    return {
        "key": setting.key,
        "type": setting.type,
        "unit": setting.unit,
        "default": setting.default,
        "value": _value_of(setting, values),
        "choices": setting.choices,
        "needs": dict(setting.needs),
        "doc": setting.doc,
    }


def _explained(setting: "Setting", values: Mapping[str, Any], more: Sequence[tuple[str, str]] = ()) -> str:
    """Return a setting's meaning, what it takes, its default, and its value where that is another."""
    rows = [("setting", setting.key)]
    if setting.doc:
        rows.append(("meaning", setting.doc))
    unit = f", in {setting.unit}" if setting.unit else ""
    rows.append(("takes", " | ".join(setting.choices) if setting.choices else f"{setting.type}{unit}"))
    rows.append(("default", _with_unit(setting.default_text, setting)))
    value = _value_of(setting, values)
    if not setting.is_table and value is not None and value != setting.default:
        rows.append(("here", _with_unit(_text_of(value), setting)))
    rows += [("only with", f"{name} {' or '.join(kinds)}") for name, kinds in setting.needs]
    return rows_text([*rows, *more])


def _in_short(setting: "Setting", values: Mapping[str, Any]) -> str:
    value = _value_of(setting, values)
    text = setting.default_text if value is None else _text_of(value)
    only = "".join(f" ({' or '.join(kinds)})" for _, kinds in setting.needs[:1])
    first, dot, _ = setting.doc.partition(". ")
    return f"{_with_unit(text, setting)}{only}: {first}{dot.strip()}"


def _neighbours(setting: "Setting", every: "Sequence[Setting]") -> list[tuple[str, str]]:
    table = setting.key.rpartition(".")[0]
    siblings = [
        name
        for name in dict.fromkeys(each.key for each in every)
        if name != setting.key and name.rpartition(".")[0] == table
    ]
    if not siblings:
        return []
    shown = [name.rpartition(".")[2] for name in siblings[:_MOST_NEIGHBOURS]]
    more = f", … (mapper config {table} lists {len(siblings) + 1})" if len(siblings) > len(shown) else ""
    return [("beside", ", ".join(shown) + more)]


def _value_of(setting: "Setting", values: Mapping[str, Any]) -> Any:
    """Return a setting's value in the configuration; None also where its method is not the chosen one."""
    if any(_at(name, values) not in kinds for name, kinds in setting.needs):
        return None
    return _at(setting.key, values)


def _at(key: str, values: Mapping[str, Any]) -> Any:
    node: Any = values
    for part in key.split("."):
        if not isinstance(node, Mapping) or part not in node:
            return None
        node = node[part]
    return node


def _text_of(value: Any) -> str:
    import json

    match value:
        case str():
            return value
        case list():
            return ",".join(map(_text_of, value))
    return json.dumps(value)


def _with_unit(text: str, setting: "Setting") -> str:
    return f"{text} {setting.unit}" if setting.unit and text != "none" else text
