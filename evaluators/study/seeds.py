"""Seeds of a configuration: another draw of everything random."""

from mapper.core.config import AnyConfig, with_changes

_SEEDS = frozenset({"seed", "ransac_seed"})


def seeded(config: AnyConfig, seed: int) -> AnyConfig:
    """Return a configuration with every seed in it set; the same configuration if it has none."""
    return with_changes(config, lambda name, value: seed if name in _SEEDS else value)
