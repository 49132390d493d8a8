"""The live page and a replay in a real browser: objects are found, nothing fails."""

import json
import threading
from pathlib import Path

import pytest
from browser import Browser, needs_browser
from view_fixtures import END, shown_run

from iga_drake.viewing.meshcat import RunButtons, wait_for_browser
from iga_drake.viewing.replay import replay_html

pytestmark = needs_browser

# Drake's page, asked without changing it: the object at a path, or null.
FIND = """
(path) => {
  let node = viewer.scene_tree;
  for (const name of ["drake", ...path.split("/")]) node = node && node.children[name];
  return node ? node.object : null;
}
"""

FIND_TEXT = "viewer.scene_tree.find(['Cameras', 'default', 'rotated', '<object>', 'text']).children"


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    with Browser(tmp_path_factory.mktemp("browser"), width=640, height=400) as browser:
        yield browser


def has_shape(path: str) -> str:
    """Script: whether something with a surface, line or points hangs below `path`."""
    return (
        f"(() => {{ let found = false; const top = ({FIND})({json.dumps(path)});"
        " if (top) top.traverse(o => { found = found || !!o.geometry; }); return found; })()"
    )


def is_visible(path: str) -> str:
    return f"({FIND})({json.dumps(path)}).visible"


def test_live_page(browser):
    meshcat = shown_run().meshcat
    buttons = RunButtons(meshcat)
    try:
        browser.open(meshcat.web_url())
        assert wait_for_browser(meshcat, 60.0)
        for path in (
            "observed/pan", "predicted/grasp/modes", "predicted/grasp/chosen/hand",
            "ahead/2 at grasp", "cameras/left/frustum",
        ):  # fmt: skip
            browser.wait_for(has_shape(path))
        image = next(
            f"cameras/left/image at {entry.time:.2f} s"
            for entry in shown_run().status.timeline
            if entry.phase.value == "infer"
        )
        browser.wait_for(has_shape(image))  # a textured plane, which loads by itself
        words = "Object.keys(viewer.camera.children.length ? " + FIND_TEXT + " : {}).join()"
        browser.wait_for(words)
        assert "move grasp" in browser.evaluate(words)

        def click(name: str) -> None:
            script = (
                "(() => { const [line] = [...document.querySelectorAll('.dg li.function')]"
                f".filter(e => e.innerText.trim() == {json.dumps(name)});"
                " line.click(); return true; })()"
            )
            before = meshcat.GetButtonClicks(name)
            assert browser.evaluate(script)
            for _ in range(500):
                if meshcat.GetButtonClicks(name) > before:
                    return
                threading.Event().wait(0.02)
            pytest.fail(f"a click on '{name}' didn't arrive")

        assert buttons.proceed()
        click(RunButtons.STEP)  # pauses, and lets one step through
        assert buttons.proceed()
        waiting = threading.Thread(target=buttons.proceed, daemon=True)
        waiting.start()
        waiting.join(0.2)
        assert waiting.is_alive()
        click(RunButtons.PAUSE)
        waiting.join(30.0)
        assert not waiting.is_alive() and buttons.proceed()
        click(RunButtons.RESTART)
        assert buttons.restarts and not buttons.proceed()
    finally:
        buttons.remove()
    assert browser.errors == []


def test_replay(browser, tmp_path: Path):
    timeline = [
        {"time": e.time, "phase": e.phase.value, "subject": e.subject, "detail": e.detail}
        for e in shown_run().status.timeline
    ]
    row = {
        "task": "grasp", "aligner": "two modes", "seed": 3, "split": "test", "success": False,
        "cause": "time", "reason": "</script> is over", "simulated_seconds": END,
        "timeline": timeline,
        "waypoints": [
            {"name": "grasp", "energy": -2.5, "position_error": 0.004, "rotation_error": 0.035}
        ],
    }  # fmt: skip
    page = tmp_path / "replay.html"
    page.write_text(replay_html(shown_run().meshcat, row), encoding="utf-8")
    browser.open(page.as_uri() + "#t=0.1")
    browser.wait_for("typeof iga == 'object' && iga.ready()")
    words = browser.evaluate("document.body.innerText")
    for text in (
        "grasp, seed 3", "FAILURE (time)", "</script> is over", "0.4 cm, 2\u00b0", "way ahead",
        "0.10 s observe pan",
    ):  # fmt: skip
        assert text in words, text
    phases = browser.evaluate("[...document.querySelectorAll('.phase')].map(e => e.textContent)")
    assert phases == [f"{e['phase']} {e['subject']}" for e in timeline]
    for path in ("observed/pan", "predicted/grasp/modes", "predicted/grasp/chosen"):
        browser.wait_for(has_shape(path))
        assert browser.evaluate(is_visible(path)) is False, path
    browser.evaluate(f"iga.seek({END - 0.1})")
    for path in ("observed/pan", "predicted/grasp/modes", "predicted/grasp/chosen"):
        assert browser.evaluate(is_visible(path)) is True, path
    assert "move grasp" in browser.evaluate("document.getElementById('iga-now').innerText")
    assert browser.errors == []
