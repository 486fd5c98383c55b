"""A page with a map in 3D, in a browser, and what is seen on its pictures."""

import base64
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
        for x, y in places[np.argsort(from_middle, kind="stable")].tolist():
            self.mouse("mouseMoved", x, y)
            if wanted in (self.text(name) or ""):
                return x, y
        raise AssertionError(f"nothing tells {wanted!r}")


def change(before, after):
    """Return the share of pixels that differ."""
    return (np.abs(after - before).max(axis=2) > 12).mean()


def lit(picture):
    """Return centre and spread of the map in a picture, each (x, y) in pixels."""
    y, x = np.nonzero(picture.max(axis=2) > 60)
    return np.array([x.mean(), y.mean()]), np.array([x.std(), y.std()])
