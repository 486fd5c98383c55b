"""``--step``: a build that waits for Enter after every frame (Somlyai, PhD thesis, §3.6)."""

import sys
from typing import TYPE_CHECKING

from mapper.core.errors import ConfigError

if TYPE_CHECKING:
    from mapper.core.geometry import Transform
    from mapper.mapping.fusion import Maps
    from mapper.run.folder import Run
    from mapper.run.observers import Observer, Step
    from mapper.run.results import RunResults


class Stepping:
    """Observer that forwards to another and waits for a key after every frame."""

    def __init__(self, other: "Observer") -> None:
        """Refuse to wait for keys where standard input is no terminal.

        Raises:
            ConfigError: Standard input is no terminal.
        """
        if not sys.stdin.isatty():
            raise ConfigError("--step: waits for Enter after each frame, but standard input is no terminal")
        self._other = other
        self._frames = 0
        self._waits = True
        _say("stepping: Enter for the next frame, c and Enter to run on")

    def on_frame(self, step: "Step", /) -> None:
        """Print how the frame went, and wait."""
        self._other.on_frame(step)
        self._frames += 1
        if not self._waits:
            return
        how = step.track.diagnostics
        place = "lost" if step.track.node is None else f"node {step.track.node}, {how.inliers} inliers"
        kept = ", a keyframe" if step.track.is_keyframe else ""
        if step.track.doubts:
            kept += f", doubtful: {', '.join(doubt.text for doubt in step.track.doubts)}"
        _say(f"frame {self._frames} at {step.track.stamp_ns}: {how.method}, {place}{kept} ", end="")
        sys.stderr.flush()
        answer = sys.stdin.readline()
        self._waits = answer.strip() != "c" and bool(answer)

    def on_levelled(self, T_level_world: "Transform", /) -> None:
        """Pass on."""
        self._other.on_levelled(T_level_world)

    def on_mapped(self, run: "Run", results: "RunResults", maps: "Maps", /) -> None:
        """Pass on."""
        self._other.on_mapped(run, results, maps)


def _say(text: str, *, end: str = "\n") -> None:
    print(text, end=end, file=sys.stderr)
