"""Headless Chromium without any network, driven by its DevTools protocol over two pipes."""

import base64
import contextlib
import json
import os
import select
import shutil
import subprocess
import time

import cv2
import numpy as np

WINDOW_HW = (720, 1280)
_PATIENCE_S = 60
_SETTLED = """new Promise(done => {
  const look = () => requestAnimationFrame(() =>
    pictures.kept.get(state.frame) && !pending ? requestAnimationFrame(done) : look());
  look();
})"""


class Browser:
    """One Chromium; its pages are opened one after the other."""

    def __init__(self, folder):
        names = ("chromium", "chromium-browser", "google-chrome")
        chromium = next(filter(None, map(shutil.which, names)), None)
        assert chromium, "this test needs Chromium: apt-get install chromium"
        its_input, self._out = os.pipe()
        self._in, its_output = os.pipe()
        command = [
            *(chromium, "--headless", "--no-sandbox", "--hide-scrollbars", "--remote-debugging-pipe"),
            *("--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"),
            *("--host-resolver-rules=MAP * ~NOTFOUND", "--proxy-server=127.0.0.1:9"),
            *("--disable-background-networking", f"--user-data-dir={folder}", "about:blank"),
        ]
        # Chromium speaks over the file descriptors 3 and 4.
        shell = ["bash", "-c", f'exec "$@" 3<&{its_input} 4>&{its_output}', "bash", *command]
        self._process = subprocess.Popen(
            shell, pass_fds=(its_input, its_output), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        os.close(its_input)
        os.close(its_output)
        self._buffer, self._number = b"", 0
        self.events = []

    def call(self, method, session=None, **parameters):
        """Send a command, and return its result."""
        self._number += 1
        message = {"id": self._number, "method": method, "params": parameters}
        if session is not None:
            message["sessionId"] = session
        os.write(self._out, json.dumps(message).encode() + b"\0")
        while True:
            answer = self._next()
            if answer.get("id") == self._number:
                assert "error" not in answer, f"{method}: {answer}"
                return answer["result"]
            self.events.append(answer)

    def _next(self):
        end = time.monotonic() + _PATIENCE_S
        while b"\0" not in self._buffer:
            ready, _, _ = select.select([self._in], [], [], max(0.0, end - time.monotonic()))
            assert ready, "Chromium is silent"
            data = os.read(self._in, 1 << 20)
            assert data, "Chromium ended"
            self._buffer += data
        message, _, self._buffer = self._buffer.partition(b"\0")
        return json.loads(message)

    def close(self):
        with contextlib.suppress(AssertionError, OSError):
            self.call("Browser.close")
        self._process.wait(timeout=_PATIENCE_S)
        os.close(self._in)
        os.close(self._out)


class Tab:
    """A page that was opened from disk."""

    def __init__(self, browser, page, dark=False):
        self._browser = browser
        self._target = browser.call("Target.createTarget", url="about:blank")["targetId"]
        attached = browser.call("Target.attachToTarget", targetId=self._target, flatten=True)
        self._session = attached["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.call(f"{domain}.enable")
        height, width = WINDOW_HW
        self.call(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=1,
            mobile=False,
        )
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self.call("Emulation.setEmulatedMedia", features=[scheme])
        self.call("Page.navigate", url=page.as_uri())
        end = time.monotonic() + _PATIENCE_S
        while self.js("document.readyState !== 'complete' || location.protocol !== 'file:'"):
            assert time.monotonic() < end, "the page does not load"
            time.sleep(0.05)
        self.settle()

    def call(self, method, **parameters):
        return self._browser.call(method, self._session, **parameters)

    def js(self, expression):
        """Return the value of an expression, or of the promise that it is."""
        answer = self.call("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in answer, answer
        return answer["result"].get("value")

    def settle(self):
        """Wait until everything of the moment is drawn."""
        self.js(_SETTLED)

    def box(self, selector):
        """x, y, width, height of an element in the window."""
        found = f"document.querySelector({json.dumps(selector)}).getBoundingClientRect()"
        return self.js(f"(({{x, y, width, height}}) => [x, y, width, height])({found})")

    def text(self, selector):
        return self.js(f"document.querySelector({json.dumps(selector)}).innerText")

    def click(self, selector, at=(0.5, 0.5)):
        """Press and let go at a place of an element, given as shares of its size."""
        x, y, width, height = self.box(selector)
        assert width > 0, f"{selector} is not to be seen"
        place = {"x": x + at[0] * width, "y": y + at[1] * height}
        for kind, buttons in (("mousePressed", 1), ("mouseReleased", 0)):
            more = {"button": "left", "buttons": buttons, "clickCount": 1}
            self.call("Input.dispatchMouseEvent", type=kind, **place, **more)
        self.settle()

    def key(self, key):
        """Press and let go a key, by its name in the page's events."""
        for kind in ("keyDown", "keyUp"):
            text = {"text": key} if kind == "keyDown" and len(key) == 1 else {}
            self.call("Input.dispatchKeyEvent", type=kind, key=key, **text)
        self.settle()

    def drag(self, selector, dx, dy):
        """Move the pointer with the left button held, from the middle of an element."""
        x, y, width, height = self.box(selector)
        x, y = x + width / 2, y + height / 2
        for kind, moved, buttons in (("mousePressed", 0, 1), ("mouseMoved", 1, 1), ("mouseReleased", 1, 0)):
            place = {"x": x + moved * dx, "y": y + moved * dy, "button": "left", "buttons": buttons}
            self.call("Input.dispatchMouseEvent", type=kind, clickCount=1, **place)
        self.settle()

    def shot(self, selector=None):
        """Return the window, or an element's part of it, as RGB."""
        data = base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
        if selector is None:
            return image
        x, y, width, height = (round(value) for value in self.box(selector))
        return image[y : y + height, x : x + width]

    def problems(self):
        """What the page complained of, and what it asked of the network, since it was opened."""
        self.js("1")
        found = []
        for event in self._browser.events:
            method, about = event.get("method"), event.get("params", {})
            if event.get("sessionId") != self._session:
                continue
            bad_words = method == "Runtime.consoleAPICalled" and about["type"] in ("error", "warning")
            bad_log = method == "Log.entryAdded" and about["entry"]["level"] == "error"
            url = about["request"]["url"] if method == "Network.requestWillBeSent" else "file:"
            if method == "Runtime.exceptionThrown" or bad_words or bad_log:
                found.append(about)
            elif not url.startswith(("file:", "data:", "blob:")):
                found.append(url)
        return found

    def close(self):
        self._browser.call("Target.closeTarget", targetId=self._target)
