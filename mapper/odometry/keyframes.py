"""Which frames of a log represent their neighbourhood."""

from mapper.core.errors import ConfigError


class SharpestKeyframes:
    """Names the sharpest of every so many frames: the one with most features (thesis §4.1.2)."""

    def __init__(self, interval: int) -> None:
        """Start with no frame seen.

        Raises:
            ConfigError: The interval is not positive.
        """
        if interval < 1:
            raise ConfigError(f"keyframe interval {interval}: want at least 1 frame")
        self._interval = interval
        self._seen = 0
        self._best: tuple[int, int] | None = None

    def add(self, node: int, features: int) -> int | None:
        """Take the next frame in; return the keyframe when an interval is complete, else None.

        Args:
            node: The frame's graph node.
            features: How many features its image has; of equals the earlier frame counts as sharper.
        """
        if self._best is None or features > self._best[1]:
            self._best = (node, features)
        self._seen += 1
        if self._seen < self._interval:
            return None
        keyframe, _ = self._best
        self._seen, self._best = 0, None
        return keyframe
