"""A page with a map in 3D, in a browser, and what is seen on its pictures."""

import base64
import json
import time

import cv2
import numpy as np

from tests.support.chromium import Page


class MapPage(Page):
    """A page with a map, once it is decoded."""

    def __enter__(self):
        super().__enter__()
        give_up = time.monotonic() + 60.0
        while self.state() == "loading":
            assert time.monotonic() < give_up
        return self

    def state(self):
        return self.run("document.querySelector('.map').dataset.state")

    def text(self, name):
        element = f"document.querySelector('[data-map={name}]')"
        return self.run(f"(e => e.closest('[hidden]') ? null : e.textContent)({element})")

    def choose(self, name, value):
        self.run(
            f"(e => {{ e.value = {value!r}; e.dispatchEvent(new Event('input')); }})"
            f"(document.querySelector('[data-map={name}]'))"
        )

    def box(self):
        """Return where the canvas is, and its size."""
        box = "document.querySelector('.map canvas').getBoundingClientRect()"
        return self.run(f"(b => [b.x, b.y, b.width, b.height])({box})")

    def picture(self):
        """Return the pixels of the map with all points, once the graphics card has drawn them."""
        x, y, width, height = self.box()
        self.awaited(
            "new Promise(done => { const canvas = document.querySelector('.map canvas');"
            " const look = () => requestAnimationFrame("
            "canvas.dataset.share === '1' && canvas.ariaBusy !== 'true' ? () => done() : look);"
            " look(); })"
        )
        clip = {"x": x, "y": y, "width": width, "height": height, "scale": 1}
        data = self.call("Page.captureScreenshot", format="png", clip=clip)["data"]
        return cv2.imdecode(np.frombuffer(base64.b64decode(data), np.uint8), cv2.IMREAD_COLOR).astype(int)

    def saved(self, button, path):
        """Click on what saves a file, and wait for it to be in its folder."""
        self.call("Browser.setDownloadBehavior", behavior="allow", downloadPath=str(path.parent))
        self.click(f"[data-map={button}]")
        give_up = time.monotonic() + 10.0
        while not path.is_file():
            assert time.monotonic() < give_up
            time.sleep(0.05)
        return path

    def tap(self, x, y):
        self.mouse("mouseMoved", x, y)
        self.mouse("mousePressed", x, y, clicks=1)
        self.mouse("mouseReleased", x, y, clicks=1)

    def sought(self, name, wanted):
        """Move the pointer from the middle of the map outwards until a text appears; return where that is."""
        left, top, width, height = self.box()
        x, y = np.meshgrid(
            np.linspace(left + 5, left + width - 5, 70), np.linspace(top + 5, top + height - 5, 50)
        )
        places = np.column_stack([x.ravel(), y.ravel()])
        from_middle = np.linalg.norm(places - [left + width / 2, top + height / 2], axis=1)
        places = places[np.argsort(from_middle, kind="stable")].tolist()
        found = self.run(
            f"{json.dumps(places)}.find(([clientX, clientY]) => {{"
            " const canvas = document.querySelector('.map canvas');"
            " canvas.dispatchEvent(new PointerEvent('pointermove', {clientX, clientY}));"
            f" const told = document.querySelector('[data-map={name}]');"
            f" return !told.hidden && told.textContent.includes({json.dumps(wanted)}); }})"
        )
        assert found, f"nothing tells {wanted!r}"
        self.mouse("mouseMoved", *found)
        return found


def change(before, after):
    """Return the share of pixels that differ."""
    return (np.abs(after - before).max(axis=2) > 12).mean()


def lit(picture):
    """Return centre and spread of the map in a picture, each (x, y) in pixels."""
    y, x = np.nonzero(picture.max(axis=2) > 60)
    return np.array([x.mean(), y.mean()]), np.array([x.std(), y.std()])


class EditedPage(MapPage):
    """A page on which a run is edited."""

    def edits(self):
        return self.run("[...document.querySelectorAll('[data-map=edits] li')].map(e => e.textContent)")

    def drag(self, begin, end):
        """Drag with the left button from one place to another."""
        self.mouse("mousePressed", *begin, clicks=1)
        for x, y in np.linspace(begin, end, 5).tolist():
            self.call("Input.dispatchMouseEvent", type="mouseMoved", x=x, y=y, button="left", buttons=1)
        self.mouse("mouseReleased", *end, clicks=1)

    def undo_by_key(self):
        for kind in ("keyDown", "keyUp"):
            self.call("Input.dispatchKeyEvent", type=kind, code="KeyZ", key="z", modifiers=2)

    def value(self, name):
        return self.run(f"document.querySelector('[data-map={name}]').value")

    def facts(self):
        return self.run("[...document.querySelectorAll('.facts')].map(e => e.textContent)")

    def ask(self, name):
        """Click on what asks the server, and wait until the page has been loaded again."""
        self.run("window.isOld = true")
        self.click(f"[data-map={name}]")
        give_up = time.monotonic() + 90.0
        while self.run("window.isOld || document.querySelector('.map')?.dataset.state !== 'ready'"):
            assert time.monotonic() < give_up, self.text("edit-told")
            time.sleep(0.1)
