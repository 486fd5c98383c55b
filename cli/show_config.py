"""``mapper config``: every knob with its value."""

from cli.options import ConfigFile, Overrides


def show_config(config: ConfigFile = None, set_: Overrides = None) -> None:
    """Print every setting that a build with these options would use, as JSON.

    Example: mapper config --set odometry.kind=isvd > isvd.json, then: mapper build LOG --config isvd.json
    """
    from mapper.config import load_config

    print(load_config(config, set_ or ()).model_dump_json(indent=2))
