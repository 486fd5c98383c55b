"""Debian's Chromium, without a screen, driven over a pipe by its DevTools protocol."""

import base64
import itertools
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Self

CHROMIUM = shutil.which("chromium")
MISSING = "Debian's chromium is not installed (apt-get install chromium)"
AXE = Path(sys.prefix, "share/axe/node_modules/axe-core/axe.min.js")
NO_AXE = f"axe-core is not installed (npm install --no-save --prefix {AXE.parents[2]} axe-core)"


class Page:
    """One page, a file or an address, in a browser of its own, offline; a context manager.

    Attributes:
        complaints: What the console and the page's own errors said, and every address it asked for.
    """

    def __init__(self, page: Path | str, *, width_px: int = 1400, height_px: int = 1000) -> None:
        self._url = page if isinstance(page, str) else page.resolve().as_uri()
        self._size = width_px, height_px
        self._numbers = itertools.count(1)
        self._session: str | None = None
        self.complaints: list[str] = []
        self.asked_for: list[str] = []

    def __enter__(self) -> Self:
        to_browser, self._out = os.pipe()
        self._in, from_browser = os.pipe()

        def hand_over() -> None:  # the protocol's pipe is always 3 and 4
            low, high = os.dup(to_browser), os.dup(from_browser)
            spare_low, spare_high = os.dup(low), os.dup(high)
            os.dup2(spare_low, 3)
            os.dup2(spare_high, 4)

        home = Path(os.environ.get("TMPDIR", "/tmp")) / f"chromium-{os.getpid()}"
        self._home = home
        self._browser = subprocess.Popen(
            [
                str(CHROMIUM),
                "--headless=new",
                "--no-sandbox",
                "--disable-gpu",
                "--use-angle=swiftshader",  # draws WebGL without a graphics card
                "--enable-unsafe-swiftshader",
                "--disable-background-networking",
                "--no-first-run",
                "--disable-dev-shm-usage",
                "--hide-scrollbars",
                f"--user-data-dir={home}",
                f"--window-size={self._size[0]},{self._size[1]}",
                "--remote-debugging-pipe",
                "about:blank",
            ],
            preexec_fn=hand_over,
            close_fds=False,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        os.close(to_browser)
        os.close(from_browser)
        self._rest = b""
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        self._session = self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.call(f"{domain}.enable")
        self.resize(*self._size)
        self.call("Page.navigate", url=self._url)
        while self.run("document.readyState") != "complete":
            pass
        return self

    def __exit__(self, *_: object) -> None:
        self._browser.kill()
        self._browser.wait()
        os.close(self._in)
        os.close(self._out)
        shutil.rmtree(self._home, ignore_errors=True)

    def resize(self, width_px: int, height_px: int) -> None:
        self.call(
            "Emulation.setDeviceMetricsOverride",
            width=width_px,
            height=height_px,
            deviceScaleFactor=1,
            mobile=False,
        )

    def run(self, script: str) -> Any:
        """Return the value of a JavaScript expression."""
        answer = self.call("Runtime.evaluate", expression=script, returnByValue=True)
        assert "exceptionDetails" not in answer, answer["exceptionDetails"]
        return answer["result"].get("value")

    def mouse(self, kind: str, x: float, y: float, *, clicks: int = 0) -> None:
        button = "none" if kind == "mouseMoved" else "left"
        self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button=button, clickCount=clicks)

    def touch(self, *steps: Sequence[tuple[float, float]]) -> None:
        """Put fingers down at the places of the first step, move them to those of the others, lift them."""
        for kind, fingers in zip(("touchStart", *["touchMove"] * len(steps)), (*steps, ()), strict=True):
            points = [{"x": x, "y": y, "id": finger} for finger, (x, y) in enumerate(fingers)]
            self.call("Input.dispatchTouchEvent", type=kind if points else "touchEnd", touchPoints=points)

    def key(self, kind: str, code: str) -> None:
        self.call("Input.dispatchKeyEvent", type=kind, code=code, key=code)

    def awaited(self, script: str) -> Any:
        """Return the value of a JavaScript promise."""
        answer = self.call("Runtime.evaluate", expression=script, awaitPromise=True, returnByValue=True)
        assert "exceptionDetails" not in answer, answer["exceptionDetails"]
        return answer["result"].get("value")

    def barriers(self) -> list[str]:
        """Return what axe-core calls a serious or critical barrier: each rule, and where it is broken."""
        self.run(f"{AXE.read_text(encoding='utf-8')}; 0")
        found = self.awaited("axe.run({resultTypes: ['violations']}).then(({violations}) => violations)")
        return [
            f"{one['id']}: {node['html']}"
            for one in found
            if one["impact"] in ("serious", "critical")
            for node in one["nodes"]
        ]

    def centre(self, selector: str) -> tuple[float, float]:
        """Scroll an element into view and return where its centre is."""
        x, y = self.run(
            f"(() => {{ const e = document.querySelector({json.dumps(selector)});"
            " e.scrollIntoView({block: 'center'}); const b = e.getBoundingClientRect();"
            " return [b.x + b.width / 2, b.y + b.height / 2]; })()"
        )
        return x, y

    def click(self, selector: str) -> None:
        x, y = self.centre(selector)
        self.mouse("mousePressed", x, y, clicks=1)
        self.mouse("mouseReleased", x, y, clicks=1)

    def screenshot(self, path: Path) -> None:
        shot = self.call("Page.captureScreenshot", format="png", captureBeyondViewport=True)
        path.write_bytes(base64.b64decode(shot["data"]))

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        number = next(self._numbers)
        request: dict[str, Any] = {"id": number, "method": method, "params": parameters}
        if self._session is not None:
            request["sessionId"] = self._session
        os.write(self._out, json.dumps(request).encode() + b"\0")
        while True:
            message = self._read()
            if message.get("id") == number:
                assert "error" not in message, message
                return message["result"]
            self._hear(message)

    def _read(self) -> dict[str, Any]:
        while b"\0" not in self._rest:
            data = os.read(self._in, 1 << 20)
            assert data, "chromium went away"
            self._rest += data
        message, _, self._rest = self._rest.partition(b"\0")
        return json.loads(message)

    def _hear(self, message: dict[str, Any]) -> None:
        method, told = message.get("method"), message.get("params", {})
        text = json.dumps(told)
        is_complaint = method in ("Runtime.exceptionThrown", "Log.entryAdded", "Runtime.consoleAPICalled")
        if is_complaint and "ReadPixels" not in text:  # WebGL on a CPU is read back to be shown
            self.complaints.append(text)
        if method == "Network.requestWillBeSent" and not told["request"]["url"].startswith("data:"):
            self.asked_for.append(told["request"]["url"][:80])
