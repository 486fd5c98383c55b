"""Targets of a recording: a file, a viewer that is started, or one that runs."""

import os
import socket
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

from mapper.core.errors import ConfigError, ViewerError
from mapper.runtime.atomic import atomic_file

if TYPE_CHECKING:
    import rerun as rr
    import rerun.blueprint as rrb

DEFAULT_URL = "rerun+http://127.0.0.1:9876/proxy"
ENDING = ".rrd"
_SPAWN, _CONNECT = "spawn", "connect"
_PATIENCE_S = 3.0
_FLUSH_S = 60.0


def check_target(target: str) -> str:
    """Return a target that is one.

    Raises:
        ConfigError: It is neither "spawn" nor "connect" nor "connect:URL" nor the name of an ``.rrd`` file.
    """
    kind, _, url = target.partition(":")
    if target == _SPAWN or Path(target).suffix == ENDING:
        return target
    if kind == _CONNECT and (not url or urlsplit(url).hostname):
        return target
    raise ConfigError(
        f"rerun target {target!r}: want FILE{ENDING}, {_SPAWN}, {_CONNECT} or {_CONNECT}:{DEFAULT_URL}"
    )


@contextmanager
def streaming(
    recording: "rr.RecordingStream",
    target: str,
    blueprint: "rrb.Blueprint",
    *,
    keeps: Callable[[], bool],
) -> Iterator[None]:
    """Send a recording to a target while inside; a file appears at the end, whole.

    Args:
        recording: What is sent.
        target: FILE.rrd, "spawn", "connect" or "connect:URL".
        blueprint: How it is arranged.
        keeps: Whether an error inside leaves the file too, with what was recorded until then.

    Raises:
        ConfigError: The target is none.
        ViewerError: No viewer can be started or reached.
    """
    check_target(target)
    if Path(target).suffix == ENDING:
        with atomic_file(Path(target)) as part:
            recording.save(part, default_blueprint=blueprint)
            failure = None
            try:
                yield
            except BaseException as error:
                if not keeps():
                    raise
                error.add_note(f"what it recorded so far is in {target}")
                failure = error
            recording.flush()
            recording.disconnect()
        if failure is not None:
            raise failure
        return
    if target == _SPAWN:
        _refuse_without_screen()
        _spawn(recording, blueprint)
    else:
        url = target.partition(":")[2] or DEFAULT_URL
        _refuse_without_listener(url)
        recording.connect_grpc(url, default_blueprint=blueprint)
    yield
    try:
        recording.flush(timeout_sec=_FLUSH_S)
    except RuntimeError as error:
        raise ViewerError(f"rerun: the viewer went away: {error}; record to a FILE{ENDING} instead") from None


def _spawn(recording: "rr.RecordingStream", blueprint: "rrb.Blueprint") -> None:
    import rerun as rr

    viewer = Path(sys.executable).with_name("rerun")  # in an environment that need not be on the PATH
    try:
        rr.spawn(
            executable_path=str(viewer) if viewer.exists() else None,
            default_blueprint=blueprint,
            recording=recording,
        )
    except RuntimeError as error:
        raise ViewerError(f"rerun: the viewer cannot be started: {str(error).splitlines()[0]}") from None


def _refuse_without_screen() -> None:
    if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise ViewerError(
            f"rerun: there is no screen to open a viewer on; write a FILE{ENDING}, and open it elsewhere "
            f"with: rerun FILE{ENDING}"
        )


def _refuse_without_listener(url: str) -> None:
    """Ask by a plain connection: Rerun itself would wait, log and drop the data at the end."""
    parts = urlsplit(url)
    try:
        port = parts.port or 9876
        socket.create_connection((str(parts.hostname), port), timeout=_PATIENCE_S).close()
    except (OSError, ValueError) as error:
        raise ViewerError(
            f"rerun: no viewer answers at {url} ({error}); start one there with: rerun"
        ) from None
