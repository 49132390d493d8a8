"""Pictures of an episode: what they show, and the file."""

from pathlib import Path

import numpy as np
from pydrake.math import RigidTransform

from iga_drake.station.scenario import load_scenario
from iga_drake.tasks.episode import Episode
from iga_drake.tasks.frames import FrameStrip
from iga_drake.tasks.grasp import TARGET


def test_frames_show_the_target_where_it_is_and_are_written(tmp_path: Path) -> None:
    scenario = load_scenario("grasp", overrides=["panda.visuals=primitives"])
    with Episode(scenario, seed=3, aligner="expert") as episode:
        strip = FrameStrip(episode)
        strip.add("start")
        strip.add("again")
        plant = episode.robot.station.GetSubsystemByName("plant")
        context = plant.GetMyMutableContextFromRoot(episode.simulator.get_mutable_context())
        body = plant.GetBodyByName(TARGET, plant.GetModelInstanceByName(TARGET))
        plant.SetFreeBodyPose(context, body, RigidTransform([0.0, 0.0, -5.0]))
        strip.add("gone")
    captions, (start, again, gone) = zip(*strip.frames, strict=True)
    assert captions == ("start", "again", "gone") and start.shape == (360, 480, 3)
    np.testing.assert_array_equal(start, again)
    changed = np.argwhere((start != gone).any(axis=2))
    assert len(changed) > 500  # px
    assert (np.abs(changed.mean(axis=0) - [180, 240]) < [90, 120]).all()
    strip.write(tmp_path / "deep" / "strip.png")
    assert (tmp_path / "deep" / "strip.png").read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
