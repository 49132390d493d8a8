"""`iga simulate --meshcat` in a process of its own, watched and steered from a browser."""

import json
import os
import re
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

from browser import ROBOT, Browser, click, is_drawn, needs_browser

from iga_drake.cli.status import FAILURE
from iga_drake.viewing.meshcat import RunButtons

# Where the last link is.
MATRIX = f"viewer.scene_tree.find({json.dumps(ROBOT)}).object.matrixWorld.elements.join()"


def wait_until(holds: Callable[[], object], what: str) -> None:
    end = time.monotonic() + 300.0
    while not holds():
        assert time.monotonic() < end, f"not within 300 s: {what}"
        time.sleep(0.05)


def still(browser: Browser) -> str:
    """Waits until the robot stands still on the page, and returns where its last link is."""
    found = [""]

    def is_still() -> bool:
        found.append(browser.evaluate(MATRIX))
        return len(found) > 20 and len(set(found[-20:])) == 1

    wait_until(is_still, "the robot stands still")
    return found[-1]


@needs_browser
def test_the_page_pauses_steps_restarts_and_ends_the_command(tmp_path: Path) -> None:
    output = tmp_path / "output"
    command = [
        "simulate", "grasp", "--aligner", "expert", "--seed", "3", "--meshcat", "--wait", "300",
        "--realtime", "0.3",
    ]  # fmt: skip
    with output.open("w") as file:
        process = subprocess.Popen(
            [sys.executable, "-m", "iga_drake.cli", *command],
            stdin=subprocess.DEVNULL, stdout=file, stderr=subprocess.STDOUT,
            env=os.environ | {"PYTHONUNBUFFERED": "1"},
        )  # fmt: skip
    try:
        wait_until(lambda: "meshcat: " in output.read_text(), "the address is told")
        with Browser(tmp_path / "browser", width=640, height=400) as browser:
            (address,) = re.findall(r"meshcat: (\S+)", output.read_text())
            browser.open(address)
            browser.wait_for(f"typeof viewer == 'object' && {is_drawn(ROBOT)}")
            wait_until(lambda: " s  move grasp" in output.read_text(), "the arm moves")
            click(browser, RunButtons.PAUSE)
            before = still(browser)
            click(browser, RunButtons.STEP)
            wait_until(lambda: browser.evaluate(MATRIX) != before, "a step moves the arm")
            assert still(browser) != before
            assert output.read_text().count("grasp, seed") == 1
            click(browser, RunButtons.RESTART)
            wait_until(lambda: "grasp, seed 4" in output.read_text(), "the next seed begins")
            moves = " s  move grasp"
            wait_until(lambda: output.read_text().count(moves) == 2, "it isn't paused any more")
            click(browser, RunButtons.END)
            assert process.wait(300) == FAILURE  # it did not succeed
            assert [error for error in browser.errors if "REFUSED" not in error] == []
    finally:
        process.kill()
        process.wait()
    assert "Traceback" not in output.read_text()
