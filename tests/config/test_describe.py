from functools import cache

import pytest

from mapper.config.build import BuildConfig
from mapper.config.describe import Setting, settings, settings_of
from mapper.config.loading import load_config
from mapper.core.config import Config
from mapper.core.errors import ConfigError
from mapper.simulation.config import SynthConfig


@cache
def described(sensor="rgbd"):
    return list(settings(sensor))


def needed(setting):
    """The overrides with which a setting exists."""
    return [f"{key}={values[0]}" for key, values in setting.needs]


def named(key, **needs):
    """The description of a key, under a kind where there are several."""
    found = [
        setting
        for setting in described()
        if setting.key == key
        and all(kind in dict(setting.needs)[name.replace("__", ".")] for name, kind in needs.items())
    ]
    (setting,) = found
    return setting


def leaves(tree, prefix=""):
    for name, value in tree.items():
        if isinstance(value, dict):
            yield from leaves(value, f"{prefix}{name}.")
        else:
            yield prefix + name, value


@pytest.mark.parametrize("sensor", ["rgbd", "lidar"])
def test_every_setting_of_the_default_kinds_is_described_with_its_default(sensor):
    config = load_config(sensor=sensor).model_dump(mode="json")
    defaults = {}
    for setting in described(sensor):
        if all(value_at(config, key) in values for key, values in setting.needs):
            defaults.setdefault(setting.key, []).append(setting.default)
    kept = {key for key, _ in leaves(config)}
    fixed = {key for key in kept if key.endswith(".kind")}  # of methods that have no other
    assert kept - fixed <= defaults.keys()
    for key, value in leaves(config):
        if key in defaults:
            assert defaults[key] == [value], key


def value_at(tree, dotted):
    """The value of a key; None within a table that is none."""
    for name in dotted.split("."):
        tree = None if tree is None else tree[name]
    return tree


@pytest.mark.parametrize("sensor", ["rgbd", "lidar"])
def test_every_description_has_a_meaning_in_sentences(sensor):
    for setting in described(sensor):
        assert len(setting.doc) > 10, setting.key
        assert setting.doc.endswith((".", ".)", '."')), setting
        assert "``" not in setting.doc


def test_keys_and_defaults_are_what_an_override_takes():
    for setting in described():
        if setting.is_table or setting.default is None:
            continue
        before = load_config(overrides=needed(setting))
        if value_at(before.model_dump(mode="json"), setting.key) is None:
            continue
        after = load_config(overrides=[*needed(setting), f"{setting.key}={setting.default_text}"])
        assert after == before, setting.key


def test_every_choice_is_taken_and_no_other():
    for setting in (one for one in described() if one.choices and not one.key.startswith("octree.depth")):
        for choice in setting.choices:
            load_config(overrides=[*needed(setting), f"{setting.key}={choice}"])
        if "number" not in setting.type:
            with pytest.raises(ConfigError):
                load_config(overrides=[*needed(setting), f"{setting.key}=zebra"])


def test_limits_are_those_of_the_model():
    limited = [one for one in described() if one.type.startswith(("number >", "number ≥", "whole number >"))]
    assert len(limited) > 100
    for setting in limited:
        low = float(setting.type.split()[-1 if "and" not in setting.type and "or" not in setting.type else 2])
        with pytest.raises(ConfigError, match=setting.key.rsplit(".", 1)[-1]):
            load_config(overrides=[*needed(setting), f"{setting.key}={low - 1:.12g}"])


def test_units_follow_the_names():
    assert named("octree.resolution_m").unit == "m"
    assert named("loops.gate.drift_rad_per_m", loops__kind="places").unit == "rad/m"
    assert named("traversable.max_slope_rad").unit == "rad"
    assert named("odometry.virtual_baseline_px_m", odometry__kind="local-map").unit == "px·m"
    assert named("workers").unit == ""


def test_kinds_say_what_they_are_and_which_settings_they_have():
    kind = named("loops.kind")
    assert kind.default == "places"
    assert kind.choices == ("places", "none", "scans", "thesis")
    assert "none: No loop is searched. " in kind.doc
    needs = named("odometry.previous_frames").needs
    assert needs == (("odometry.kind", ("isvd",)),)
    assert named("odometry.keyframe_ratio").needs == (("odometry.kind", ("local-map", "pnp")),)


def test_a_sensor_has_its_own_defaults_with_the_meaning_of_the_class_above():
    of = {one.key: one.default for one in described("lidar")}
    assert (of["octree.resolution_m"], of["odometry.kind"]) == (0.2, "gicp")
    (scans,) = [one for one in described("lidar") if one.key == "loops.min_gap_m" and one.default == 20.0]
    assert scans.doc == "Places nearer than this along the path are left to the odometry."


def test_any_model_is_described():
    class Inner(Config):
        width_px: int = 3
        """Width of it."""

    class Outer(Config):
        inner: Inner = Inner()
        """A part."""
        sizes_m: tuple[float, ...] = (1.0, 2.5)
        """Sizes of it."""

    described = list(settings_of(Outer()))

    assert described[1].type == "whole number"
    assert described[-1].type == "list of numbers"
    assert described[-1].default_text == "1.0,2.5"
    assert isinstance(described[0], Setting)
    assert len(list(settings_of(SynthConfig()))) > 50
    assert len(list(settings_of(BuildConfig()))) == len(list(settings()))
