"""A run's page to edit it on: served to browsers of this machine only, until its last tab is closed."""

import json
import re
import shutil
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, wait
from contextlib import contextmanager, suppress
from functools import partial
from hmac import compare_digest
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from queue import Empty, Full, Queue
from secrets import token_hex, token_urlsafe
from threading import Lock, Thread
from typing import Any, Self

from mapper.config.loading import parse_config
from mapper.core.errors import ConfigError, MapperError
from mapper.export.report.data import Chapter, chapter_of
from mapper.export.report.map_page import run_page
from mapper.export.report.packing import pack_points
from mapper.mapping.placed_frames import placed_frames
from mapper.pipeline.edit import apply_edits
from mapper.run.edits_file import EditsFile
from mapper.run.folder import Run, moved_log, open_run
from mapper.run.input_logs import paths_of
from mapper.runtime.atomic import put_in_place
from mapper.runtime.progress import SILENT, Progress, Report
from mapper.sources.base import Log

_MOST_BYTES = 1 << 16
"""Of an edits file that a page sends."""
_KEPT = 5
"""Earlier states that can be restored: each has a run's maps."""
_TICK_S = 0.5
_ABSENT_S = 5.0
"""Time without a tab after which the server ends: a tab that loads the page again has none meanwhile."""
_STEP_M, _MOST_POINTS = 0.005, 40_000
"""Of a scan that is aligned by hand."""
_SCANS = re.compile(r"scans/(\d{1,9})/(\d{1,9})", re.ASCII)
_TIMEOUT_S = 30.0
"""Of a connection that says nothing."""
_HEADERS = {
    "Cache-Control": "no-store",
    "Referrer-Policy": "same-origin",
    "X-Content-Type-Options": "nosniff",
    "Content-Security-Policy": "frame-ancestors 'none'",
    "Cross-Origin-Resource-Policy": "same-origin",
}


def serve_edit_page(
    source: Log, run: Run, *, on_ready: Callable[[str], None], progress: Progress = SILENT
) -> Run:
    """Serve a run's page on 127.0.0.1 until its tabs are closed, or Ctrl-C; return the run as it is then.

    The page sends edits files, which :func:`~mapper.pipeline.edit.apply_edits` makes. Every request has to
    know the token in the page's address, and to come from the page itself.

    Args:
        source: The log that the run was built from.
        run: A finished run.
        on_ready: Receives the page's address.
        progress: Receives the stages of each solve and fuse.

    Raises:
        MapperError: A file of the run cannot be read.
    """
    session = _Session(source, run, progress)
    with session, _Server(session) as server:
        Thread(target=server.serve_forever, args=(_TICK_S,), daemon=True).start()
        on_ready(f"{server.origin}/{server.token}/")
        try:
            session.work()
        finally:
            server.shutdown()
    return session.run


class _Session:
    """One run while it is edited.

    Attributes:
        run: The run as it is now.
        earlier: Copies of its folder before each solve, the last one last.
        status: What is being done, for the page.
    """

    def __init__(self, source: Log, run: Run, progress: Progress) -> None:
        self.run, self.earlier, self.status = run, list[Path](), ""
        self._source, self._progress = source, progress
        self._jobs = Queue[tuple[Callable[[], None], Future[None]]](maxsize=1)
        self._busy, self._page = Lock(), ""
        self._counting, self._tabs, self._left_at = Lock(), 0, float("inf")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        for folder in self.earlier:
            shutil.rmtree(folder)

    def work(self) -> None:
        """Do what tabs ask for, in this thread, which Ctrl-C stops; return once all are closed."""
        while self._tabs or time.monotonic() - self._left_at < _ABSENT_S:
            try:
                job, done = self._jobs.get(timeout=_TICK_S)
            except Empty:
                continue
            except KeyboardInterrupt:
                return
            try:
                with self._busy:
                    job()
                done.set_result(None)
            except BaseException as error:
                done.set_exception(error if isinstance(error, MapperError) else ConfigError("stopped"))
                if not isinstance(error, MapperError):
                    raise
            finally:
                self.status = ""

    def ask(self, job: Callable[[], None]) -> Future[None]:
        """Have a job done; called by the threads of requests.

        Raises:
            ConfigError: Another one is waiting to be done.
        """
        done = Future[None]()
        try:
            self._jobs.put_nowait((job, done))
        except Full:
            raise ConfigError("another solve has not ended yet; wait for it") from None
        return done

    def solve(self, text: str) -> None:
        """Make the edits of an edits file; what the run was like before is kept."""
        edits = parse_config(text, Path("edits"), EditsFile)
        earlier = _copy(self.run.path)
        try:
            self.run = apply_edits(
                self._source, self.run, edits, progress=_PageProgress(self, self._progress)
            )
        except BaseException:
            shutil.rmtree(earlier)
            raise
        self.earlier.append(earlier)
        for old in self.earlier[:-_KEPT]:
            shutil.rmtree(old)
        self.earlier, self._page = self.earlier[-_KEPT:], ""

    def undo(self) -> None:
        """Put back what the run was like before the last solve."""
        if not self.earlier:
            raise ConfigError("nothing was solved since mapper edit began; mapper edit RUN --undo")
        put_in_place(self.earlier.pop(), self.run.path.resolve())
        self.run = self._opened(self.run.path)
        self._page = ""

    def page(self) -> str:
        """Return the page: the run, and beside it what it was like before the last solve."""
        with self.tab(), self._busy:
            if not self._page:
                name = self.run.path.resolve().name
                self._page = run_page(name, self._chapters(name), editing="served")
            return self._page

    def scans(self, i: int, j: int) -> str:
        """Return the scans of two nodes, with their poses in the world as rows of (4, 4), as JSON.

        Raises:
            MapperError: A node is unknown, or its frame cannot be read.
        """
        with self._busy:
            graph = self.run.graph
            if not {i, j} <= graph.stamps_ns.keys():
                raise ConfigError(f"keyframes {i} and {j}: want two of the graph's nodes")
            node_of = {graph.stamps_ns[node]: node for node in (i, j)}
            shown = {}
            for placed in placed_frames(self._source, self.run.trajectory):
                if (node := node_of.get(placed.entry.stamp_ns)) is not None:
                    points = placed.scan_of(placed.entry.load()).points_body
                    packed = pack_points(points, [], step_m=_STEP_M, most=_MOST_POINTS)
                    shown[node] = {"T_world_body": placed.T_world_body.tolist(), "points": packed}
        return json.dumps([shown[node] for node in (i, j)])

    def _chapters(self, name: str) -> list[Chapter]:
        if not self.earlier:
            return [chapter_of(self.run, name, ())]
        return [chapter_of(self._opened(self.earlier[-1]), "before", ()), chapter_of(self.run, "after", ())]

    def _opened(self, folder: Path) -> Run:
        return moved_log(open_run(folder), *paths_of(self._source))

    @contextmanager
    def tab(self) -> Iterator[None]:
        """Count a tab, while it is open."""
        with self._counting:
            self._tabs += 1
        try:
            yield
        finally:
            with self._counting:
                self._tabs -= 1
                self._left_at = time.monotonic()


class _PageProgress:
    """Progress that the page shows, too."""

    def __init__(self, session: _Session, progress: Progress) -> None:
        self._session, self._progress = session, progress

    @contextmanager
    def stage(self, name: str) -> Iterator[Report]:
        """Enter a stage."""
        with self._progress.stage(name) as report:

            def report_both(done: int, total: int) -> None:
                self._session.status = f"{name}: {done} of {total}"
                report(done, total)

            self._session.status = name
            yield report_both

    def note(self, message: str) -> None:
        """Pass a note on."""
        self._progress.note(message)


def _copy(folder: Path) -> Path:
    """Return a hidden copy of a run beside it; its files are the same ones where the disk can do that."""
    copy = folder.resolve().with_name(f".{folder.resolve().name}.{token_hex(8)}.part")

    def link(source: str, target: str) -> None:
        try:
            Path(target).hardlink_to(source)
        except OSError:
            shutil.copy2(source, target)

    shutil.copytree(folder, copy, copy_function=link, symlinks=True)
    return copy


class _Server(ThreadingHTTPServer):
    """Server of a session's page, bound to this machine's own address."""

    daemon_threads, block_on_close = True, False

    def __init__(self, session: _Session) -> None:
        super().__init__(("127.0.0.1", 0), _Handler)
        self.session, self.token = session, token_urlsafe()
        self.origin = f"http://127.0.0.1:{self.server_port}"

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Pass over connections that the other side ended."""
        if not isinstance(sys.exception(), OSError):
            super().handle_error(request, client_address)


class _Handler(BaseHTTPRequestHandler):
    """Handler of requests: refuses those that are not from the page."""

    server: _Server
    timeout = _TIMEOUT_S

    def do_GET(self) -> None:
        """Answer with the page, two scans, or the status for as long as the page is open."""
        name = self._name()
        if name == "":
            self._answer_with(self.server.session.page, "text/html")
        elif name == "open":
            self._send_status()
        elif match := _SCANS.fullmatch(name or ""):
            self._answer_with(lambda: self.server.session.scans(*map(int, match.groups())))
        else:
            self._refuse()

    def do_POST(self) -> None:
        """Solve with an edits file, or undo the last solve; answer "done", or what is wrong.

        Spaces are sent meanwhile, as browsers give up answers that take minutes.
        """
        name, length = self._name(), self.headers.get("Content-Length", "")
        if name not in ("solve", "undo") or "Origin" not in self.headers:
            self._refuse()
            return
        if not (length.isascii() and length.isdigit() and int(length) <= _MOST_BYTES):
            self._answer(HTTPStatus.OK, f"edits: {length or 'unknown'} bytes, at most {_MOST_BYTES} at once")
            return
        text, session = self.rfile.read(int(length)).decode("utf-8", "replace"), self.server.session
        self._head(HTTPStatus.OK, "text/plain")
        try:
            done = session.ask(session.undo if name == "undo" else partial(session.solve, text))
            while wait([done], timeout=_TICK_S).not_done:
                self.wfile.write(b" ")
            done.result()
            self.wfile.write(b"done")
        except MapperError as error:
            self.wfile.write(str(error).encode("utf-8", "replace"))

    def _name(self) -> str | None:
        """Return what is asked for behind the token; None if the request is not the page's own."""
        origin = f"http://{self.headers.get('Host')}"
        if not origin == self.headers.get("Origin", origin) == self.server.origin:
            return None
        _, _, rest = self.path.partition("/")
        token, slash, name = rest.partition("/")
        return name if slash and compare_digest(token.encode(), self.server.token.encode()) else None

    def _send_status(self) -> None:
        """Send what is being done as server-sent events, until the tab is closed."""
        self._head(HTTPStatus.OK, "text/event-stream")
        with self.server.session.tab(), suppress(OSError):
            while True:
                self.wfile.write(f"data: {self.server.session.status}\n\n".encode())
                time.sleep(_TICK_S)

    def _refuse(self) -> None:
        self._answer(HTTPStatus.FORBIDDEN, "refused: open the address that mapper edit --page has printed")

    def _answer_with(self, work: Callable[[], str], kind: str = "text/plain") -> None:
        try:
            text = work()
        except MapperError as error:
            self._answer(HTTPStatus.BAD_REQUEST, str(error))
        else:
            self._answer(HTTPStatus.OK, text, kind)

    def _answer(self, status: HTTPStatus, text: str, kind: str = "text/plain") -> None:
        with suppress(OSError):  # the tab was closed meanwhile
            self._head(status, kind)
            self.wfile.write(text.encode("utf-8", "replace"))

    def _head(self, status: HTTPStatus, kind: str) -> None:
        self.send_response(status)
        for name, value in {"Content-Type": f"{kind}; charset=utf-8", **_HEADERS}.items():
            self.send_header(name, value)
        self.end_headers()

    def log_message(self, *_: Any) -> None:
        """Log nothing: addresses have the token."""
