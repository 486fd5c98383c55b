"""Keyframe selection of Somlyai (PhD thesis, §4.1.2): the sharpest frame of every interval."""

from mapper.core.errors import ConfigError


class SharpestKeyframes:
    """Selector of the sharpest frame, the one with most features, of each run of frames."""

    def __init__(self, interval: int) -> None:
        """Start before the first frame.

        Raises:
            ConfigError: The interval is not positive.
        """
        if interval < 1:
            raise ConfigError(f"keyframe interval {interval}: want at least 1 frame")
        self._interval = interval
        self._count = 0
        self._best: tuple[int, int] | None = None

    def add(self, node: int, features: int) -> int | None:
        """Add the next frame; return the keyframe when an interval is complete, else None.

        Args:
            node: The frame's graph node.
            features: Number of features in its image; among equals the earlier frame counts as sharper.
        """
        if self._best is None or features > self._best[1]:
            self._best = (node, features)
        self._count += 1
        if self._count < self._interval:
            return None
        keyframe, _ = self._best
        self._count, self._best = 0, None
        return keyframe
