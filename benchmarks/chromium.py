"""Drives a headless Chromium over the DevTools protocol, for the tests and the benchmark of `twin view`.

Pages are drawn without a GPU (SwiftShader). `errors` collects a page's errors: uncaught exceptions and console errors.
"""

import atexit
import base64
import itertools
import json
import os
import shutil
import signal
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from websockets.sync.client import ClientConnection, connect

_NAMES = ("chromium", "chromium-browser", "google-chrome")
_FLAGS = (
    "--headless=new",
    "--no-sandbox",  # a container has no user namespaces
    "--disable-dev-shm-usage",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-extensions",
    "--mute-audio",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--remote-debugging-port=0",
)
_START_TIME = 30.0  # [s]


def find_chromium() -> str | None:
    """Path of the browser; None if there is none."""
    return next((path for path in map(shutil.which, _NAMES) if path), None)


class Chromium:
    """A headless browser with one page; a context manager."""

    def __init__(self, size: tuple[int, int] = (1280, 720)) -> None:
        """`size`: width, height [px] of the page."""
        program = find_chromium()
        assert program, "Chromium is not installed; call `find_chromium` first"
        self.errors: list[str] = []
        self.log: list[str] = []
        self._ids = itertools.count(1)
        self._profile = tempfile.mkdtemp(prefix="chromium-")
        flags = [*_FLAGS, f"--user-data-dir={self._profile}", f"--window-size={size[0]},{size[1]}", "about:blank"]
        self._process = subprocess.Popen(
            [program, *flags], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True
        )
        atexit.register(self.close)
        try:
            self._page = self._connect()
            for domain in ("Page", "Runtime", "Log", "DOM"):
                self.call(f"{domain}.enable")
            self.call(
                "Emulation.setDeviceMetricsOverride", width=size[0], height=size[1], deviceScaleFactor=1, mobile=False
            )
        except BaseException:
            self.close()
            raise

    def _connect(self) -> ClientConnection:
        port_file, end = Path(self._profile) / "DevToolsActivePort", time.monotonic() + _START_TIME
        while not (port_file.exists() and port_file.read_text().count("\n") >= 1):
            assert time.monotonic() < end and self._process.poll() is None, "chromium does not start"
            time.sleep(0.05)
        port, path = port_file.read_text().split()[:2]
        with connect(f"ws://127.0.0.1:{port}{path}", max_size=None) as browser:
            browser.send(json.dumps({"id": 1, "method": "Target.getTargets"}))
            while (answer := json.loads(browser.recv())).get("id") != 1:
                pass
        target = next(t["targetId"] for t in answer["result"]["targetInfos"] if t["type"] == "page")
        return connect(f"ws://127.0.0.1:{port}/devtools/page/{target}", max_size=None)

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Calls a method of the protocol and returns its result."""
        number = next(self._ids)
        self._page.send(json.dumps({"id": number, "method": method, "params": parameters}))
        while True:
            message = json.loads(self._page.recv(timeout=120.0))
            if message.get("id") == number:
                assert "error" not in message, f"{method}: {message['error']}"
                return message["result"]
            self._note(message)

    def _note(self, event: dict[str, Any]) -> None:
        given = event.get("params", {})
        if event.get("method") == "Runtime.exceptionThrown":
            details = given["exceptionDetails"]
            self.errors.append(str(details.get("exception", {}).get("description", details["text"])))
        elif event.get("method") == "Runtime.consoleAPICalled":
            line = " ".join(str(a.get("value", a.get("description", ""))) for a in given["args"])
            (self.errors if given["type"] in ("error", "assert") else self.log).append(line)
        elif event.get("method") == "Log.entryAdded":
            entry = given["entry"]
            line = f"{entry['text']} {entry.get('url', '')}"
            (self.errors if entry["level"] == "error" else self.log).append(line)

    def open(self, url: str) -> None:
        self.call("Page.navigate", url=url)

    def evaluate(self, script: str) -> Any:
        """The value of a JavaScript expression, awaited if it is a promise."""
        out = self.call("Runtime.evaluate", expression=script, awaitPromise=True, returnByValue=True)
        assert "exceptionDetails" not in out, out["exceptionDetails"]
        return out["result"].get("value")

    def wait(self, condition: str | Callable[[], Any], seconds: float = 120.0) -> Any:
        """Waits until a JavaScript expression or a function is true, and returns its value."""
        end = time.monotonic() + seconds
        while True:
            value = self.evaluate(condition) if isinstance(condition, str) else condition()
            if value:
                return value
            assert time.monotonic() < end, (
                f"still false after {seconds:g} s: {condition}; errors of the page: {self.errors}"
            )
            time.sleep(0.05)

    def screenshot(self) -> bytes:
        """A PNG of the page."""
        return base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])

    def mouse(self, kind: str, x: float, y: float, **more: Any) -> None:
        """A mouse event: `mousePressed`, `mouseMoved`, `mouseReleased` or `mouseWheel`, at a position [px]."""
        self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, **more)

    def click(self, x: float, y: float) -> None:
        for kind in ("mousePressed", "mouseReleased"):
            self.mouse(kind, x, y, button="left", buttons=1, clickCount=1)

    def click_on(self, kind: str, text: str) -> None:
        """Clicks the first visible element that matches the CSS selector `kind` and whose text is `text`.

        An element without text counts as having the text of its row in viser's panel.
        """
        found = self.wait(
            f"""(() => {{
              for (const e of document.querySelectorAll({json.dumps(kind)})) {{
                let row = e;
                for (let k = 0; k < 9 && row !== null && row.textContent.trim() === ""; k++) row = row.parentElement;
                if (row === null || row.textContent.trim() !== {json.dumps(text)} || e.offsetParent === null) continue;
                e.scrollIntoView({{block: "nearest"}});
                const box = e.getBoundingClientRect();
                return [box.x + box.width / 2, box.y + box.height / 2];
              }}
              return null;
            }})()"""
        )
        self.click(*found)

    def slide(self, label: str, share: float) -> None:
        """Clicks a slider of viser's panel at a fraction of its length; the text of its row starts with `label`."""
        left, width, y = self.wait(
            f"""(() => {{
              for (const e of document.querySelectorAll("[role=slider]")) {{
                let row = e;
                while (row !== null && !row.textContent.trim().startsWith({json.dumps(label)})) row = row.parentElement;
                const track = e.parentElement;
                if (row === null || e.offsetParent === null) continue;
                if (row.querySelectorAll("[role=slider]").length > 1) continue;
                track.scrollIntoView({{block: "nearest"}});
                const box = track.getBoundingClientRect();
                return [box.x, box.width, box.y + box.height / 2];
              }}
              return null;
            }})()"""
        )
        self.click(left + share * width, y)

    def key(self, letter: str, down: bool) -> None:
        """Presses or releases a letter's key."""
        self.call(
            "Input.dispatchKeyEvent",
            type="keyDown" if down else "keyUp",
            key=letter,
            code=f"Key{letter.upper()}",
            windowsVirtualKeyCode=ord(letter.upper()),
            **({"text": letter} if down else {}),
        )

    def close(self) -> None:
        atexit.unregister(self.close)
        if hasattr(self, "_page"):
            self._page.close()
        try:
            os.killpg(self._process.pid, signal.SIGTERM)
            self._process.wait(10.0)
        except (ProcessLookupError, subprocess.TimeoutExpired):
            pass
        finally:
            if self._process.poll() is None:
                os.killpg(self._process.pid, signal.SIGKILL)
                self._process.wait()
            shutil.rmtree(self._profile, ignore_errors=True)

    def __enter__(self) -> "Chromium":
        return self

    def __exit__(self, *error: object) -> None:
        self.close()
