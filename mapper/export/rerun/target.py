"""Targets of a recording: a file, a viewer that is started, or one that runs."""

import os
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

from mapper.core.errors import ConfigError, ViewerError
from mapper.core.units import MIB
from mapper.runtime.atomic import atomic_file

if TYPE_CHECKING:
    import rerun as rr
    import rerun.blueprint as rrb

_HOST, _PORT = "127.0.0.1", 9876
DEFAULT_URL = f"rerun+http://{_HOST}:{_PORT}/proxy"
ENDING = ".rrd"
_SPAWN, _CONNECT = "spawn", "connect"
_TIMEOUT_S = 3.0
_START_S = 30.0


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
        recording: Recording that is sent.
        target: FILE.rrd, "spawn", "connect" or "connect:URL".
        blueprint: Arrangement of the viewer.
        keeps: Whether an error inside leaves the file too, with what was recorded until then.

    Raises:
        ConfigError: The target is none.
        ViewerError: No viewer can be started or reached.
    """
    check_target(target)
    if Path(target).suffix == ENDING:
        with atomic_file(Path(target)) as part:
            failure = None
            with _piped(recording, part, blueprint):
                try:
                    yield
                except BaseException as error:
                    if not keeps():
                        raise
                    error.add_note(f"what it recorded so far is in {target}")
                    failure = error
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
        recording.flush(timeout_sec=_START_S)
    except RuntimeError as error:
        raise ViewerError(f"rerun: the viewer went away: {error}; record to a FILE{ENDING} instead") from None


@contextmanager
def _piped(recording: "rr.RecordingStream", path: Path, blueprint: "rrb.Blueprint") -> Iterator[None]:
    """Save a recording to a file through a pipe.

    Rerun's own writer of files ends when the disk is full, and the program may then wait for it forever. Here
    the rest is read and dropped, and the error raised at the end.
    """
    read, write = os.pipe()
    errors: list[OSError] = []
    copying = threading.Thread(target=_copy, args=(read, path, errors), name="rerun file", daemon=True)
    copying.start()
    try:
        try:
            recording.save(f"/dev/fd/{write}", default_blueprint=blueprint)
        finally:
            os.close(write)  # Rerun has opened it anew, so the pipe ends when Rerun closes it
        yield
        recording.flush()
    finally:
        recording.disconnect()
        copying.join()
    if errors:
        raise errors[0]


def _copy(read: int, path: Path, errors: list[OSError]) -> None:
    with os.fdopen(read, "rb", buffering=0) as pipe, path.open("wb", buffering=0) as file:
        while data := pipe.read(MIB):
            try:
                while data and not errors:
                    data = data[file.write(data) :]
            except OSError as error:
                errors.append(error)


def _spawn(recording: "rr.RecordingStream", blueprint: "rrb.Blueprint") -> None:
    """Start a viewer that listens on this machine only, unlike the one that ``rr.spawn`` starts."""
    viewer = Path(sys.executable).with_name("rerun")  # in an environment that need not be on the PATH
    port = _free_port()
    url = f"rerun+http://{_HOST}:{port}/proxy"
    command = [
        str(viewer) if viewer.exists() else "rerun",
        *("--bind", _HOST, "--port", str(port), "--expect-data-soon"),
    ]
    try:
        process = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,  # the window stays when this process ends
        )
    except OSError as error:
        raise ViewerError(f"rerun: the viewer cannot be started: {command[0]}: {error.strerror}") from None
    deadline = time.monotonic() + _START_S
    while not _listens(_HOST, port):
        if process.poll() is not None:
            status = process.returncode
            raise ViewerError(f"rerun: the viewer cannot be started: it ended with status {status}")
        if time.monotonic() > deadline:
            process.terminate()
            raise ViewerError(f"rerun: the viewer did not answer at {url} within {_START_S:g} s")
        time.sleep(0.05)
    recording.connect_grpc(url, default_blueprint=blueprint)


def _free_port() -> int:
    """Return Rerun's usual port, or another where that is taken, perhaps by a viewer of another user."""
    for port in (_PORT, 0):
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((_HOST, port))
            except OSError:
                continue
            return int(probe.getsockname()[1])
    raise ViewerError(f"rerun: no free port for a viewer on {_HOST}")


def _listens(host: str, port: int) -> bool:
    try:
        socket.create_connection((host, port), timeout=_TIMEOUT_S).close()
    except OSError:
        return False
    return True


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
        port = parts.port or _PORT
        socket.create_connection((str(parts.hostname), port), timeout=_TIMEOUT_S).close()
    except (OSError, ValueError) as error:
        raise ViewerError(
            f"rerun: no viewer answers at {url} ({error}); start one there with: rerun"
        ) from None
