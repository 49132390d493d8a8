"""Headless Chromium for tests of pages, driven by the DevTools protocol over a pipe.

    .venv/bin/python tests/browser.py REPLAY.html

prints the size of a replay, and how long it takes from asking for it until its first picture, which
comes with the page, and until the robot is drawn, at the beginning of the recording.
"""

import base64
import json
import os
import select
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from types import TracebackType
from typing import Any

import psutil
import pytest

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser"))), None)
# `make test` installs a browser and the project's checks set IGA_NEEDS_BROWSER, so that its lack is
# an error there; a bare `pytest` on a machine without one goes on with the other tests.
needs_browser = pytest.mark.skipif(
    CHROMIUM is None and not os.environ.get("IGA_NEEDS_BROWSER"),
    reason="no chromium: apt-get install chromium",
)


class Browser:
    """One page of headless Chromium, drawn in software; a context manager that ends it.

    `errors` are the messages of level "error" and the exceptions of the page so far.
    """

    def __init__(self, profile: Path, *, width: int = 1280, height: int = 720) -> None:
        """`profile`: a new folder for the browser's own files."""
        assert CHROMIUM is not None, "chromium is missing: apt-get install chromium"
        from_browser, to_us = os.pipe()
        to_browser, from_us = os.pipe()
        # The browser reads commands from descriptor 3 and writes answers to descriptor 4.
        script = f'exec "$@" 3<&{to_browser} 4>&{to_us}'
        self._process = subprocess.Popen(
            [
                "bash", "-c", script, "chromium", CHROMIUM, "--headless", "--no-sandbox",
                "--remote-debugging-pipe", f"--user-data-dir={profile}", "--no-first-run",
                "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--hide-scrollbars",
                "--disable-dev-shm-usage", f"--window-size={width},{height}", "about:blank",
            ],
            pass_fds=[to_browser, to_us],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )  # fmt: skip
        os.close(to_browser)
        os.close(to_us)
        self._read, self._write = from_browser, from_us
        self._buffer = b""
        self._number = 0
        self._session: str | None = None
        self.errors: list[str] = []
        targets = self.command("Target.getTargets")["targetInfos"]
        page = next(target["targetId"] for target in targets if target["type"] == "page")
        self._session = self.command("Target.attachToTarget", targetId=page, flatten=True)[
            "sessionId"
        ]
        for domain in ("Page", "Runtime", "Log"):
            self.command(f"{domain}.enable")
        self.command(
            "Emulation.setDeviceMetricsOverride",
            width=width, height=height, deviceScaleFactor=1, mobile=False,
        )  # fmt: skip

    def __enter__(self) -> "Browser":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._process.kill()
        self._process.wait()
        os.close(self._read)
        os.close(self._write)

    def command(self, method: str, timeout: float = 300.0, **parameters: Any) -> dict[str, Any]:
        """Sends a command and returns its result; events that come before it are noted."""
        self._number += 1
        message = {"id": self._number, "method": method, "params": parameters}
        if self._session is not None:
            message["sessionId"] = self._session
        os.write(self._write, json.dumps(message).encode() + b"\0")
        end = time.monotonic() + timeout
        while True:
            answer = self._receive(end - time.monotonic())
            if answer.get("id") == self._number:
                assert "error" not in answer, f"{method}: {answer['error']}"
                return answer["result"]

    def _receive(self, timeout: float) -> dict[str, Any]:
        while b"\0" not in self._buffer:
            ready, _, _ = select.select([self._read], [], [], max(0.0, timeout))
            assert ready, "the browser doesn't answer"
            part = os.read(self._read, 1 << 20)
            assert part, "the browser has ended"
            self._buffer += part
        text, _, self._buffer = self._buffer.partition(b"\0")
        message = json.loads(text)
        found, event = message.get("params", {}), message.get("method")
        if event == "Runtime.exceptionThrown":
            detail = found["exceptionDetails"]
            self.errors.append(detail.get("exception", {}).get("description", detail["text"]))
        elif event == "Runtime.consoleAPICalled" and found["type"] in ("error", "assert"):
            self.errors.append(" ".join(str(a.get("value", a)) for a in found["args"]))
        elif event == "Log.entryAdded" and found["entry"]["level"] == "error":
            self.errors.append(f"{found['entry']['text']} {found['entry'].get('url', '')}")
        return message

    def open(self, url: str) -> None:
        """Begins to load a page."""
        self.command("Page.navigate", url=url)

    def evaluate(self, script: str) -> Any:
        """The value of a JavaScript expression."""
        done = self.command("Runtime.evaluate", expression=script, returnByValue=True)
        assert "exceptionDetails" not in done, done["exceptionDetails"]
        return done["result"].get("value")

    def wait_for(self, script: str, timeout: float = 300.0) -> None:
        """Waits until an expression has a value that counts as true."""
        end = time.monotonic() + timeout
        while not self.evaluate(f"Boolean({script})"):
            assert time.monotonic() < end, f"not within {timeout} s: {script}; {self.errors}"
            time.sleep(0.05)

    def press(self, code: str) -> None:
        """Presses a key, named as in JavaScript: "Space", "KeyN"."""
        self.command("Input.dispatchKeyEvent", type="keyDown", code=code)
        self.command("Input.dispatchKeyEvent", type="keyUp", code=code)

    def picture(self, path: Path, **options: Any) -> None:
        """Writes what is seen as a picture; `options` of `Page.captureScreenshot`."""
        data = self.command("Page.captureScreenshot", **options)["data"]
        path.write_bytes(base64.b64decode(data))

    def cpu_seconds(self) -> float:
        """Processor time of all of the browser's processes until now."""
        total = 0.0
        for process in [root := psutil.Process(self._process.pid), *root.children(recursive=True)]:
            try:
                times = process.cpu_times()
            except psutil.NoSuchProcess:
                continue
            total += times.user + times.system
        return total


def is_drawn(path: list[str]) -> str:
    """Script: whether something is drawn below a path of Meshcat's tree."""
    return (
        "(() => { let found = false;"
        f" viewer.scene_tree.find({path}).object.traverse(o => {{ found = found || o.geometry; }});"
        " return found; })()"
    )


def click(browser: Browser, button: str) -> None:
    """Clicks a button of Meshcat's controls."""
    script = (
        "(() => { const [line] = [...document.querySelectorAll('.dg li.function')]"
        f".filter(e => e.innerText.trim() == {json.dumps(button)});"
        " line.click(); return true; })()"
    )
    assert browser.evaluate(script)


ROBOT = ["drake", "illustration", "panda", "panda_link7"]


def open_replay(browser: Browser, page: Path, picture: Path, *, at: float | None = None) -> None:
    """Opens a replay, which begins to play, or stands still `at` so many seconds, and takes its
    first picture in which the robot is drawn."""
    browser.open(page.resolve().as_uri() + (f"#t={at}" if at is not None else ""))
    browser.wait_for("typeof iga == 'object' && iga.ready()")
    browser.wait_for(is_drawn(ROBOT))
    browser.picture(picture)


def first_paint(browser: Browser) -> float:
    """Time (s) from the page's beginning until it showed a picture or words."""
    script = "performance.getEntriesByName('first-contentful-paint')[0].startTime / 1000"
    return float(browser.evaluate(script))


def main(page: Path) -> None:
    """Prints the size of a replay and the times to its first picture and to the robot, medians of
    five."""
    firsts, walls, cpus = [], [], []
    with tempfile.TemporaryDirectory() as folder:
        for number in range(5):
            with Browser(Path(folder) / str(number)) as browser:
                cpu, begin = browser.cpu_seconds(), time.monotonic()
                open_replay(browser, page, Path(folder) / "picture.png")
                walls.append(time.monotonic() - begin)
                cpus.append(browser.cpu_seconds() - cpu)
                firsts.append(first_paint(browser))
    print(
        f"{page}: {page.stat().st_size / 1e6:.1f} MB, first picture after "
        f"{sorted(firsts)[2]:.1f} s ({min(firsts):.1f} to {max(firsts):.1f}), drawn by the "
        f"browser after {sorted(walls)[2]:.1f} s ({min(walls):.1f} to {max(walls):.1f}) and "
        f"{sorted(cpus)[2]:.1f} s of a processor's time"
    )


if __name__ == "__main__":
    main(Path(sys.argv[1]))
