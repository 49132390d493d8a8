"""The live page and a replay in a real browser: objects are found, nothing fails."""

import json
import time
from pathlib import Path

import pytest
from browser import Browser, click, needs_browser
from view_fixtures import END, ENERGIES, PROBABILITIES, shown_run

from iga_drake.viewing.meshcat import RunButtons, start_meshcat, wait_for_browser
from iga_drake.viewing.policy_views import show_text
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

# The words of the texts that are loaded and seen.
TEXT_NODES = (
    "viewer.scene_tree.find(['Cameras', 'default', 'rotated', '<object>', 'text']).children"
)
TEXTS = f"""
Object.values({TEXT_NODES})
  .filter(text => text.object.visible)
  .flatMap(text => Object.keys(text.children)).filter(name => name != '<object>')
"""


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    with Browser(tmp_path_factory.mktemp("browser"), width=640, height=400) as browser:
        yield browser


class Waits(Exception):
    """Takes the place of the module `time`: raised where it is slept."""

    @staticmethod
    def sleep(seconds: float) -> None:
        raise Waits


def has_shape(path: str) -> str:
    """Script: whether something with a surface, line or points hangs below `path`."""
    return (
        f"(() => {{ let found = false; const top = ({FIND})({json.dumps(path)});"
        " if (top) top.traverse(o => { found = found || !!o.geometry; }); return found; })()"
    )


def is_visible(path: str) -> str:
    return f"({FIND})({json.dumps(path)}).visible"


def test_live_page(browser, monkeypatch):
    meshcat = shown_run().meshcat
    buttons = RunButtons(meshcat)
    try:
        browser.open(meshcat.web_url())
        assert wait_for_browser(meshcat, 300.0)
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
        (text,) = browser.evaluate(TEXTS)
        assert "move grasp" in text
        # It hangs before the camera; the chosen mode is shown as such alone.
        browser.wait_for("viewer.camera.children.length")
        first, second = (
            f"predicted/grasp/modes/mode {k + 1} of 2, energy {ENERGIES[k]:.3f}, "
            f"probability {PROBABILITIES[k]:.2f}"
            for k in range(2)
        )
        assert not browser.evaluate(is_visible(first)) and browser.evaluate(is_visible(second))

        def press(name: str) -> None:
            before = meshcat.GetButtonClicks(name)
            click(browser, name)
            for _ in range(500):
                if meshcat.GetButtonClicks(name) > before:
                    return
                time.sleep(0.02)
            pytest.fail(f"a click on '{name}' didn't arrive")

        assert buttons.proceed()
        press(RunButtons.STEP)  # pauses, and lets one step through
        assert buttons.proceed()
        with monkeypatch.context() as patch, pytest.raises(Waits):
            patch.setattr("iga_drake.viewing.meshcat.time", Waits)
            buttons.proceed()
        press(RunButtons.PAUSE)
        assert buttons.proceed() and buttons.proceed()
        press(RunButtons.RESTART)
        assert buttons.restarts and not buttons.proceed()
    finally:
        buttons.remove()
    assert browser.errors == []


def test_of_texts_that_follow_each_other_quickly_the_last_is_seen(browser):
    meshcat = start_meshcat()
    browser.open(meshcat.web_url())
    assert wait_for_browser(meshcat, 300.0)
    for words in ("one", "two", "three"):
        show_text(meshcat, [words])
    loaded = f"Object.keys({TEXT_NODES}).length == 3 && " + " && ".join(
        f"{TEXT_NODES}[{number}].children.{words}.children['<object>']"
        for number, words in enumerate(("one", "two", "three"))
    )
    browser.wait_for(loaded)
    assert browser.evaluate(TEXTS) == ["three"]
    show_text(meshcat, [])
    browser.wait_for(f"({TEXTS}).length == 0")
    browser.open("about:blank")  # before the server ends
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
    assert page.stat().st_size < 0.6 * len(shown_run().meshcat.StaticHtml())
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
    browser.evaluate("iga.seek(2.0)")
    for path in ("observed/pan", "predicted/grasp/modes", "predicted/grasp/chosen"):
        assert browser.evaluate(is_visible(path)) is True, path
    assert "move grasp" in browser.evaluate("document.getElementById('iga-now').innerText")
    # The other modes go when the waypoint is reached.
    (reached,) = shown_run().status.times_reached
    browser.evaluate(f"iga.seek({reached + 0.1})")
    assert browser.evaluate(is_visible("predicted/grasp/modes")) is False
    assert browser.evaluate(is_visible("predicted/grasp/chosen")) is True
    assert browser.errors == []
