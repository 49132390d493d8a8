"""The teaching page in a browser: its controls work, and what is seen and taught is drawn.

With IGA_PICTURES=DIR the picture of the documentation is written there.
"""

import os
from collections.abc import Callable
from pathlib import Path

from browser import Browser, needs_browser
from test_live_episode import JPEG, is_drawn

from iga_drake import load_scenario
from iga_drake.policy.motion import offset_pose
from iga_drake.tasks.stack import Stack
from iga_drake.tasks.teaching import TeachingSession, begin_teaching
from iga_drake.tasks.teaching_loop import TeachingLoop
from iga_drake.viewing.meshcat import start_meshcat
from iga_drake.viewing.teaching_panel import TeachingAction, TeachingPanel


def tick_until(loop: TeachingLoop, done: Callable[[], bool]) -> None:
    """Serves the page until something asked for there is done."""
    for _ in range(200):
        if done():
            return
        loop.tick()
    raise AssertionError("the page's key is not heeded")


@needs_browser
def test_a_waypoint_is_taught_from_the_page(tmp_path: Path):
    pictures = Path(os.environ.get("IGA_PICTURES", tmp_path))
    scenario = load_scenario("stack")
    meshcat = start_meshcat(scenario.visualization)

    def begin(seed: int) -> TeachingSession:
        return begin_teaching(scenario, seed=seed, meshcat=meshcat)

    loop = TeachingLoop(
        begin, TeachingPanel(meshcat), task="stack", out=tmp_path / "taught", tell=lambda line: None
    )
    session = loop.session
    assert loop.do(TeachingAction.LOOK)
    truth = session.snapshots[-1]
    task = Stack()
    (X_WE,) = task.expert(task.scene(0, "demonstration"), truth.X_WO, truth.X_WE)
    above = offset_pose(X_WE, (0, 0, 0), (0, 0, 0.1))
    assert session.go(above)
    session.go(X_WE, speed_scale=0.5)
    with Browser(tmp_path / "page", width=1280, height=720) as browser:
        browser.open(meshcat.web_url())
        browser.wait_for("typeof viewer == 'object' && viewer.scene_tree.children.drake", 240.0)
        browser.wait_for("document.body.innerText.includes('record waypoint')", 240.0)
        browser.press("KeyR")
        tick_until(loop, lambda: session.complete)
        browser.press("KeyP")
        tick_until(loop, lambda: meshcat.HasPath("/drake/teaching/way/line"))
        session.go(above)
        loop.tick()
        text = ["Cameras", "default", "rotated", "<object>", "text"]
        drawn = (["seen", "target"], ["seen", "grasped"], ["recorded", "stack"], ["way", "line"])
        for path in (text, *(["drake", "teaching", *names] for names in drawn)):
            browser.wait_for(is_drawn(path), 240.0)
        words = browser.evaluate("document.body.innerText")
        for control in ("x (m)", "yaw (deg)", "opening (m)", *TeachingAction):
            assert control in words, control
        browser.evaluate("Object.values(viewer.gui.__folders).map(f => f.close()).length")
        browser.evaluate("viewer.gui.open(), 0")
        browser.picture(pictures / "teach.jpg", **JPEG)
        assert browser.errors == []
