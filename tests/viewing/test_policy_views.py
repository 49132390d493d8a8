"""What the views show of a policy at work on a station without physics."""

import numpy as np
import pytest
from pydrake.math import RigidTransform
from view_fixtures import END, ENERGIES, PROBABILITIES, build_shown, shown_run

from iga_drake.viewing.meshcat import start_meshcat
from iga_drake.viewing.policy_views import show_text, show_verdict


def has_text(meshcat, words: str) -> bool:
    """Whether a text was shown on the page, the last one or one before."""
    path = "/Cameras/default/rotated/<object>/text"
    return any(meshcat.HasPath(f"{path}/{number}/{words}") for number in range(50))


def time_of(phase: str) -> float:
    return next(e.time for e in shown_run().status.timeline if e.phase.value == phase)


def test_the_observed_cloud_is_shown():
    assert shown_run().meshcat.HasPath("/drake/observed/pan")


def test_every_mode_is_shown_with_its_energy_and_probability():
    meshcat = shown_run().meshcat
    for mode, (energy, share) in enumerate(zip(ENERGIES, PROBABILITIES, strict=True)):
        words = f"mode {mode + 1} of 2, energy {energy:.3f}, probability {share:.2f}"
        assert meshcat.HasPath(f"/drake/predicted/grasp/modes/{words}")
    assert meshcat.HasPath("/drake/predicted/grasp/chosen/hand")


def test_what_is_ahead_is_shown():
    """The targets of the motion are shown with their way; the names tell their order."""
    shown = shown_run()
    for name in ("1 before grasp", "2 at grasp", "3 hand at grasp", "4 after grasp"):
        for part in ("X_WE", "way"):
            assert shown.meshcat.HasPath(f"/drake/ahead/{name}/{part}"), name


def test_cameras_are_shown_with_their_image_of_the_last_observation():
    seen = time_of("infer")
    for camera in ("left", "right"):
        assert shown_run().meshcat.HasPath(f"/drake/cameras/{camera}/frustum")
        assert shown_run().meshcat.HasPath(f"/drake/cameras/{camera}/image at {seen:.2f} s")


def test_the_text_tells_phase_step_and_mode():
    """Its words are the name of what is drawn."""
    status = shown_run().status
    words = (
        f"{time_of('move'):.2f} s  move grasp | step: {status.step}"
        " | grasp: mode 1 of 2, energy -2.500, probability 0.75, chosen"
        " | grasp: mode 2 of 2, energy -1.250, probability 0.25"
    )
    assert has_text(shown_run().meshcat, words)


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


def test_text_is_named_by_its_words(meshcat):
    show_text(meshcat, ["1/2 m", "word " * 60])
    assert has_text(meshcat, f"1\u22152 m | {'word ' * 60}")
    show_text(meshcat, ["two"])
    assert has_text(meshcat, "two") and not has_text(meshcat, "three")


def test_the_verdict_stands_beside_the_scene_and_the_expert_s_hand_in_it(meshcat):
    show_verdict(meshcat, "SUCCESS\n  grasp: 0.4 cm", {"grasp": RigidTransform([0.5, 0, 0.1])}, 3.0)
    assert has_text(meshcat, "SUCCESS |   grasp: 0.4 cm")
    assert meshcat.HasPath("/drake/expert/grasp")
    show_verdict(meshcat, "FAILURE", {}, 3.0)
    assert not meshcat.HasPath("/drake/expert")
