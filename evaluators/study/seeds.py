"""Seeds of a configuration: another draw of everything random."""

from typing import Any, TypeVar

from mapper.core.config import Config

AnyConfig = TypeVar("AnyConfig", bound=Config)

_SEEDS = frozenset({"seed", "ransac_seed"})


def seeded(config: AnyConfig, seed: int) -> AnyConfig:
    """Return a configuration with every seed in it set; the same configuration if it has none."""
    changed: dict[str, Any] = {}
    for name, value in config:
        if isinstance(value, Config):
            changed[name] = seeded(value, seed)
        elif name in _SEEDS:
            changed[name] = seed
    return config.model_copy(update=changed)
