"""What the views show of a policy at work on a station without physics."""

import numpy as np
import pytest
from pydrake.math import RigidTransform
from view_fixtures import END, ENERGIES, PROBABILITIES, build_shown, shown_run

from iga_drake.viewing.meshcat import RunButtons, start_meshcat, wait_for_browser
from iga_drake.viewing.policy_views import show_text, show_verdict, shown_text

FRAMES = 32  # of the recording, 1/s


def visible(path: str, time: float):
    """Whether the recording has something at `path` appear or go at `time`."""
    recording = shown_run().meshcat.get_mutable_recording()
    return recording.get_key_frame(round(FRAMES * time), f"/drake/{path}", "visible")


def time_of(phase: str) -> float:
    return next(e.time for e in shown_run().status.timeline if e.phase.value == phase)


def test_the_observed_cloud_appears_when_it_is_observed():
    assert shown_run().meshcat.HasPath("/drake/observed/pan")
    assert visible("observed/pan", 0.0) is False
    assert visible("observed/pan", time_of("infer")) is True


def test_every_mode_is_shown_with_its_energy_and_probability():
    meshcat, at = shown_run().meshcat, time_of("move")
    for mode, (energy, share) in enumerate(zip(ENERGIES, PROBABILITIES, strict=True)):
        words = f"mode {mode + 1} of 2: energy {energy:.3f}, probability {share:.2f}"
        assert meshcat.HasPath(f"/drake/predicted/grasp/modes/{words}")
    assert meshcat.HasPath("/drake/predicted/grasp/chosen/hand")
    for part in ("modes", "chosen"):
        assert visible(f"predicted/grasp/{part}", 0.0) is False
        assert visible(f"predicted/grasp/{part}", at) is True


def test_what_is_ahead_is_shown_and_what_was_reached_goes():
    """The targets of the motion are shown with their way; the names tell their order."""
    shown = shown_run()
    for name in ("1 before grasp", "2 at grasp", "3 hand at grasp", "4 after grasp"):
        for part in ("X_WE", "way"):
            assert shown.meshcat.HasPath(f"/drake/ahead/{name}/{part}"), name
    assert visible("ahead/1 before grasp", time_of("move")) is True


def test_cameras_are_shown_with_their_image_of_the_last_observation():
    seen = time_of("infer")
    for camera in ("left", "right"):
        assert shown_run().meshcat.HasPath(f"/drake/cameras/{camera}/frustum")
        assert shown_run().meshcat.HasPath(f"/drake/cameras/{camera}/image at {seen:.2f} s")


def test_the_text_tells_phase_step_and_mode():
    text = " ".join(shown_text(shown_run().meshcat))
    status = shown_run().status
    assert f"{time_of('move'):.2f} s move grasp" in " ".join(text.split())
    assert f"step: {status.step}" in text
    assert "mode 1 of 2, energy -2.500" in text


def test_a_view_changes_no_number():
    """The same joints at the same time, watched or not."""
    robot, simulator = build_shown(None)
    simulator.AdvanceTo(END)
    joints = []
    for station, root in (
        (robot.station, simulator.get_context()),
        (shown_run().robot.station, shown_run().simulator.get_context()),
    ):
        port = station.GetOutputPort("panda.position_measured")
        joints.append(port.Eval(station.GetMyContextFromRoot(root)).copy())
    np.testing.assert_array_equal(*joints)


@pytest.fixture(scope="module")
def meshcat():
    return start_meshcat()


def test_text_replaces_text_and_leaves_buttons(meshcat):
    buttons = RunButtons(meshcat)
    try:
        show_text(meshcat, ["one", "one", 'it\'s "two" \\ three\n' + "word " * 30])
        shown = shown_text(meshcat)
        assert shown[:2] == ["one", "one"] and shown[2].startswith("it\u2019s \u201dtwo\u201d / ")
        assert " ".join(shown).count("word") == 30 and max(map(len, shown)) <= 40
        show_text(meshcat, [])
        assert shown_text(meshcat) == []
        assert RunButtons.PAUSE in meshcat.GetButtonNames()
    finally:
        buttons.remove()


def test_the_verdict_stands_beside_the_scene_and_the_expert_s_hand_in_it(meshcat):
    show_verdict(meshcat, "SUCCESS\n  grasp: 0.4 cm", {"grasp": RigidTransform([0.5, 0, 0.1])}, 3.0)
    assert shown_text(meshcat) == ["SUCCESS", "grasp: 0.4 cm"]
    assert meshcat.HasPath("/drake/expert/grasp")
    show_verdict(meshcat, "FAILURE", {}, 3.0)
    assert not meshcat.HasPath("/drake/expert")


def test_a_browser_is_waited_for_no_longer_than_asked(meshcat):
    assert not wait_for_browser(meshcat, 0.1)
