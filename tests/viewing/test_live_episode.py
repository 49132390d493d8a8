"""One whole episode watched in a browser, from the first picture to the replay.

With IGA_PICTURES=DIR the pictures of the documentation are written there.
"""

import json
import os
import subprocess
import sys
from pathlib import Path

from browser import Browser, needs_browser

SIZE = {"width": 1280, "height": 720} if os.environ.get("IGA_PICTURES") else {
    "width": 480, "height": 300,
}  # fmt: skip
TEXT = "['Cameras', 'default', 'rotated', '<object>', 'text']"


def says(words: str) -> str:
    """Script: whether the text at the top of the live page has these words."""
    found = f"Object.keys(viewer.scene_tree.find({TEXT}).children).join().includes"
    return f"typeof viewer == 'object' && {found}({json.dumps(words)})"


@needs_browser
def test_an_episode_is_watched_paused_and_kept_as_a_replay(tmp_path: Path):
    page, row = tmp_path / "stack.html", tmp_path / "stack.json"
    pictures = Path(os.environ.get("IGA_PICTURES", tmp_path))
    options = {"format": "jpeg", "quality": 82}
    command = [
        sys.executable, "-m", "iga_drake.cli", "simulate", "stack", "--seed", "3", "--meshcat",
        "--wait", "120", "--stay", "--html", str(page), "--result", str(row),
    ]  # fmt: skip
    with (
        Browser(tmp_path / "browser", **SIZE) as browser,
        subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, text=True) as p,
    ):
        try:
            assert p.stdout is not None
            browser.open(p.stdout.readline().split()[1])
            browser.wait_for(says("move stack"), timeout=900.0)
            browser.press("Space")
            for path in ("observed", "predicted", "ahead", "cameras", "demonstrations"):
                browser.wait_for(f"viewer.scene_tree.children.drake.children.{path}")
            browser.picture(pictures / "live.jpg", **options)
            browser.press("Space")
            browser.wait_for(says("SUCCESS"), timeout=900.0)
            assert next(line for line in p.stdout if line.startswith("press Enter"))
            browser.evaluate(
                "[...document.querySelectorAll('.dg li.function')]"
                ".find(e => e.innerText.trim() == 'end').click()"
            )
            assert p.wait(60.0) == 0
        finally:
            p.kill()
        assert browser.errors == []
        assert json.loads(row.read_text())["success"] is True
        assert page.stat().st_size <= 6e6
        browser.open(page.as_uri() + "#t=3.5")
        browser.wait_for("typeof iga == 'object' && iga.ready()")
        assert "SUCCESS" in browser.evaluate("document.body.innerText")
        browser.picture(pictures / "replay.jpg", **options)
        assert browser.errors == []
