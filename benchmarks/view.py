"""Benchmark of `twin view` in a headless Chromium on the same cores.

    python benchmarks/view.py --scene BUILT_SCENE [--minutes 5] [--json FILE]

`twin view` runs in a separate process; the browser draws without a GPU. A picture counts when the browser has decoded
it. "Moving" is a drag of the mouse at 25 events a second; "at rest" begins when the mouse button is released. The
random part clicks, drags, presses keys and moves sliders at random, and compares memory at its end with memory after
its first fifth. The number of cores that other programs use is measured, too: speeds are meaningful only if this
number is small.
"""

import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import psutil
from chromium import Chromium, find_chromium
from record import record_parser, save

from twin.errors import print_error

TARGETS = {
    "first_picture_s": ("≤", 3.0),
    "moving.pictures_per_s": ("≥", 10.0),
    "driving.pictures_per_s": ("≥", 10.0),
    "rest.fine_s": ("≤", 1.0),
    "memory_bytes": ("≤", 1.5e9),
    "random.errors": ("≤", 0.0),
    "random.growth_bytes": ("≤", 32 * 2**20),
}
"""Figure → comparison and target."""

_SIZE = (960, 540)  # of the page [px]; the panel leaves 640×540 of it to the picture
# Counts images of the picture only: a script sets their property `src` to a blob. Images of the panel have an attribute
# `src`, and viser's own images are no blobs.
_COUNT = """
window.pictures = 0;
const source = Object.getOwnPropertyDescriptor(HTMLImageElement.prototype, "src");
Object.defineProperty(HTMLImageElement.prototype, "src", {...source, set(value) {
  if (value.startsWith("blob:"))
    this.addEventListener("load", () => { window.pictures += 1; window.width = this.naturalWidth; }, {once: true});
  source.set.call(this, value); }});
"""
_EVENTS_PER_S = 25.0


class Served:
    """A running `twin view`."""

    def __init__(self, scene: Path) -> None:
        self.began = time.monotonic()
        self.process = subprocess.Popen(
            [sys.executable, "-u", "-m", "twin.view", str(scene), "--port", "0"],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        assert line.startswith("open http"), f"twin view printed {line!r}; expected its address"
        self.url, self.served_after = line.split()[1], time.monotonic() - self.began

    @property
    def bytes(self) -> int:
        """Resident memory [bytes]."""
        return psutil.Process(self.process.pid).memory_info().rss

    def stop(self) -> str:
        """Ends the process and returns its standard error."""
        self.process.terminate()
        return self.process.communicate(timeout=30.0)[1]


class OtherWork:
    """Context manager; `cores` is the mean number of cores used by processes other than `mine` and their children."""

    def __init__(self, mine: list[int]) -> None:
        self._mine = mine

    def __enter__(self) -> "OtherWork":
        self._start = time.monotonic(), _busy(), _used(self._mine)
        return self

    def __exit__(self, *error: object) -> None:
        began, busy, used = self._start
        seconds = time.monotonic() - began
        self.cores = max(0.0, (_busy() - busy) - (_used(self._mine) - used)) / seconds


def _busy() -> float:
    times = psutil.cpu_times()
    return times.user + times.nice + times.system


def _used(roots: list[int]) -> float:
    total = 0.0
    for root in roots:
        for process in (psutil.Process(root), *psutil.Process(root).children(recursive=True)):
            try:
                times = process.cpu_times()
            except psutil.Error:
                continue
            total += times.user + times.system
    return total


def drag(browser: Chromium, seconds: float) -> float:
    """Drags the view to and fro; returns the pictures per second that the browser decoded."""
    before, began = browser.evaluate("window.pictures"), time.monotonic()
    browser.mouse("mousePressed", 300, 300, button="left", buttons=1, clickCount=1)
    k = 0
    while time.monotonic() - began < seconds:
        x = 300 + 120 * np.sin(k / 12.0)
        browser.mouse("mouseMoved", float(x), 300, button="left", buttons=1)
        k += 1
        time.sleep(max(0.0, began + k / _EVENTS_PER_S - time.monotonic()))
    shown = (browser.evaluate("window.pictures") - before) / (time.monotonic() - began)
    browser.evaluate("window.width = 0")
    browser.mouse("mouseReleased", float(x), 300, button="left", buttons=0, clickCount=1)
    return float(shown)


def rest(browser: Chromium) -> float:
    """Time from the last event to the picture at full resolution in the browser [s]."""
    began = time.monotonic()
    width = 0
    while time.monotonic() - began < 6.0:
        width = browser.evaluate("window.width")
        if width > 400:  # a coarse picture is 261 px wide
            return time.monotonic() - began
        time.sleep(0.01)
    raise AssertionError(f"no fine picture within 6 s; the last is {width} px wide")


def random_clicks(browser: Chromium, served: Served, seconds: float) -> dict[str, Any]:
    """Clicks, drags, presses keys and moves sliders at random; returns actions, errors and growth of memory."""
    rng, began, actions, early = np.random.default_rng(0), time.monotonic(), 0, 0
    while (now := time.monotonic() - began) < seconds:
        kind = rng.integers(5)
        if kind == 0:  # the picture
            x, y = rng.uniform(20, 600), rng.uniform(20, 500)
            browser.mouse("mousePressed", x, y, button="left", buttons=1, clickCount=1)
            for _ in range(int(rng.integers(1, 10))):
                x, y = x + rng.normal(0, 15), y + rng.normal(0, 10)
                browser.mouse("mouseMoved", x, y, button="left", buttons=1)
            browser.mouse("mouseReleased", x, y, button="left", buttons=0, clickCount=1)
        elif kind == 1:
            browser.mouse("mouseWheel", 300, 300, deltaX=0, deltaY=float(rng.normal(0, 200)))
        elif kind == 2:
            letter = str(rng.choice(list("wasdqe")))
            browser.key(letter, True)
            time.sleep(float(rng.uniform(0.0, 0.6)))
            browser.key(letter, False)
        else:  # an element of the panel: a tab, button, box or slider
            found = browser.evaluate(
                """(() => [...document.querySelectorAll('[role=tab], button, input, [role=slider], [role=option]')]
                  .filter((e) => e.offsetParent !== null && !/photo|Render|Save|Load/.test(e.textContent)
                          && e.type !== 'file' && e.type !== 'text')
                  .map((e) => {const b = e.getBoundingClientRect();
                    const p = e.getAttribute('role') === 'slider' ? e.parentElement.getBoundingClientRect() : b;
                    return [p.x, p.y, p.width, p.height];})
                  .filter((b) => b[0] > 640 && b[1] > 60 && b[1] + b[3] < 540 && b[2] > 2))()"""
            )
            if found:
                left, top, width, height = found[int(rng.integers(len(found)))]
                browser.click(left + float(rng.uniform(0.2, 0.8)) * width, top + height / 2)
            if rng.random() < 0.3:
                browser.mouse("mouseWheel", 800, 400, deltaX=0, deltaY=float(rng.normal(0, 300)))
        actions += 1
        time.sleep(0.1)
        if not early and now > seconds / 5:
            early = served.bytes
    return {
        "minutes": seconds / 60.0,
        "actions": actions,
        "errors": len(browser.errors),
        "messages": browser.errors[:5],
        "early_bytes": early,
        "growth_bytes": served.bytes - early,
    }


def measure(scene: Path, minutes: float) -> dict[str, Any]:
    """Measures all figures."""
    # The browser starts first: while it starts, the server would load the scene off the clock.
    with Chromium(_SIZE) as browser:
        browser.call("Page.addScriptToEvaluateOnNewDocument", source=_COUNT)
        served = Served(scene)
        try:
            browser.open(served.url)
            browser.wait("window.pictures > 0")
            first = time.monotonic() - served.began
            out: dict[str, Any] = {
                "page_served_s": served.served_after,
                "first_picture_s": first,
                "first_picture_after_open_s": first - served.served_after,
            }
            browser.click_on("[role=tab]", "Drive")
            browser.wait(
                "[...document.querySelectorAll('button')].some((e) => e.textContent.trim() === 'Start driving')"
            )
            out["robot_ready_s"] = time.monotonic() - served.began
            time.sleep(3.0)
            mine = [os.getpid()]
            drag(browser, 2.0)
            rest(browser)
            with OtherWork(mine) as other:
                speeds, rests = [], []
                for _ in range(3):
                    speeds.append(drag(browser, 4.0))
                    rests.append(rest(browser))
                    time.sleep(0.5)
            out["moving"] = {"pictures_per_s": float(np.median(speeds)), "others_cores": other.cores, "runs": speeds}
            out["rest"] = {"fine_s": float(np.median(rests)), "slowest_s": max(rests)}
            browser.click_on("button", "Start driving")
            browser.wait("document.documentElement.dataset.driving === 'true'")
            browser.key("w", True)
            time.sleep(1.0)
            before, began = browser.evaluate("window.pictures"), time.monotonic()
            with OtherWork(mine) as other:
                time.sleep(5.0)
                shown = (browser.evaluate("window.pictures") - before) / (time.monotonic() - began)
            browser.key("w", False)
            rate = browser.evaluate("(document.body.textContent.match(/([0-9.]+)× real time/) || [0, '0'])[1]")
            browser.click_on("button", "Stop")
            out["driving"] = {"pictures_per_s": shown, "real_time_factor": float(rate), "others_cores": other.cores}
            if minutes > 0:
                out["random"] = random_clicks(browser, served, 60.0 * minutes)
            out["memory_bytes"] = served.bytes
            out["errors"] = browser.errors
        finally:
            said = served.stop()
    out["said"] = [line for line in said.splitlines() if "stopped" not in line]
    return out


def main(arguments: list[str] | None = None) -> int:
    parser = record_parser(__doc__)
    parser.add_argument("--scene", type=Path, required=True, help="a built scene")
    parser.add_argument("--minutes", type=float, default=5.0, help="minutes of random clicking (default %(default)g)")
    given = parser.parse_args(arguments)
    if find_chromium() is None:
        return print_error("Chromium is not installed; install Debian's package chromium")
    figures = measure(given.scene, given.minutes)
    print(json.dumps(figures, indent=2, ensure_ascii=False))
    for name, (sense, target) in TARGETS.items():
        value: Any = figures
        for part in name.split("."):
            value = value.get(part) if isinstance(value, dict) else None
        if value is not None:
            met = value <= target if sense == "≤" else value >= target
            print(f"{name}: {value:,.2f} ({sense} {target:,.2f}: {'yes' if met else 'no'})")
    return save(given.json, figures, given.replace_record)


if __name__ == "__main__":
    sys.exit(main())
