"""One whole episode looked at in a browser, live and as a replay.

With IGA_PICTURES=DIR the pictures of the documentation are written there.
"""

import os
from pathlib import Path

import numpy as np
from browser import ROBOT, Browser, first_paint, is_drawn, needs_browser, open_replay
from PIL import Image

from iga_drake import Episode, load_scenario
from iga_drake.policy.motion import Phase
from iga_drake.tasks.frames import replay_poster
from iga_drake.viewing.meshcat import start_meshcat
from iga_drake.viewing.replay import begin_recording, end_recording, replay_html

JPEG = {"format": "jpeg", "quality": 80}
# Of a picture, s: the bowl is on its way.
MOMENT = 3.2


def has_table(picture: Path) -> bool:
    """Whether a tenth of a picture has the table's colour, in any light."""
    red, _, blue = np.moveaxis(np.asarray(Image.open(picture).convert("RGB")).astype(int), -1, 0)
    return bool((red - blue > 40).mean() > 0.1)


@needs_browser
def test_an_episode_is_looked_at_live_and_as_a_replay(tmp_path: Path):
    pictures = Path(os.environ.get("IGA_PICTURES", tmp_path))
    scenario = load_scenario("stack", overrides=["policy.infer_limit=600"])
    meshcat = start_meshcat(scenario.visualization)
    begin_recording(meshcat, live=True)
    with Episode(scenario, seed=3, meshcat=meshcat) as episode:
        poster = replay_poster(episode)
        status = episode.step(MOMENT)
        assert status.phase is Phase.MOVE, status.reason
        with Browser(tmp_path / "live", width=1280, height=720) as browser:
            browser.open(meshcat.web_url())
            browser.wait_for("typeof viewer == 'object' && viewer.scene_tree.children.drake")
            seen = max(observation.time for observation in episode.memory.observations.values())
            image = ["drake", "cameras", "camera_0", f"image at {seen:.2f} s"]
            text = ["Cameras", "default", "rotated", "<object>", "text"]
            for path in (image, text, ROBOT):
                browser.wait_for(is_drawn(path))
            browser.picture(pictures / "live.jpg", **JPEG)
            assert browser.errors == []
        result = episode.run()
        row = result.row()
        end_recording(meshcat)
    page = tmp_path / "stack.html"
    page.write_text(replay_html(meshcat, row, poster), encoding="utf-8")
    (tmp_path / "poster.jpg").write_bytes(poster)
    assert has_table(tmp_path / "poster.jpg")
    assert result.success and page.stat().st_size <= 4e6
    with Browser(tmp_path / "replay", width=1280, height=720) as browser:
        open_replay(browser, page, tmp_path / "first.png", at=MOMENT)
        assert has_table(tmp_path / "first.png")
        # The still picture was on the screen before the recording was, and is gone now.
        begins = browser.evaluate("performance.getEntriesByName('iga-begins')[0].startTime / 1000")
        assert first_paint(browser) < begins
        browser.wait_for("document.getElementById('iga-poster') === null")
        assert "SUCCESS" in browser.evaluate("document.body.innerText")
        browser.picture(pictures / "replay.jpg", **JPEG)
        assert browser.errors == []
