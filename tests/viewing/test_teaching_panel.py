"""The teaching page's controls, driven by the messages that a browser would send."""

import math

import numpy as np
import pytest
from meshcat_page import click, gamepad, slide
from pydrake.math import RigidTransform, RollPitchYaw

from iga_drake.viewing.meshcat import start_meshcat
from iga_drake.viewing.teaching_panel import (
    TeachingAction,
    TeachingPanel,
    hand_coordinates,
    hand_pose,
)

DOWN = np.diag([1.0, -1.0, -1.0])
GOAL = hand_pose(np.array([0.4567, -0.1234, 0.3003, 0.0, 0.0, math.radians(30.4)]))


@pytest.fixture
def panel() -> TeachingPanel:
    panel = TeachingPanel(start_meshcat())
    assert panel.poll(GOAL, 0.08, elapsed=0.05).X_WE is None
    return panel


def test_coordinates_of_a_hand():
    straight = hand_pose(np.array([0.5, 0.1, 0.2, 0.0, 0.0, 0.0]))
    np.testing.assert_allclose(straight.rotation().matrix(), DOWN, atol=1e-12)
    tilted = hand_pose(np.array([0.5, 0.1, 0.2, 0.3, 0.0, 0.0]))
    expected = RollPitchYaw(0.3, 0.0, 0.0).ToRotationMatrix().matrix() @ DOWN
    np.testing.assert_allclose(tilted.rotation().matrix(), expected, atol=1e-12)
    rng = np.random.default_rng(0)
    for _ in range(20):
        numbers = rng.uniform([-0.2, -0.7, 0.0, -3.1, -1.5, -3.1], [0.8, 0.7, 1.0, 3.1, 1.5, 3.1])
        np.testing.assert_allclose(hand_coordinates(hand_pose(numbers)), numbers, atol=1e-9)


def test_sliders_show_the_goal_and_change_what_is_slid_alone(panel: TeachingPanel):
    meshcat = panel._meshcat
    assert meshcat.GetSliderValue("x (m)") == pytest.approx(0.457)
    assert meshcat.GetSliderValue("yaw (deg)") == pytest.approx(30.0)
    assert meshcat.GetSliderValue("opening (m)") == pytest.approx(0.08)
    slide(meshcat, "z (m)", 0.25)
    wish = panel.poll(GOAL, 0.08, elapsed=0.05).X_WE
    assert wish is not None
    # The others aren't rounded to their sliders' steps.
    expected = hand_coordinates(GOAL)
    expected[2] = 0.25
    np.testing.assert_allclose(hand_coordinates(wish), expected, atol=1e-12)
    assert panel.poll(wish, 0.08, elapsed=0.05).X_WE is None
    slide(meshcat, "yaw (deg)", -90.0)
    wish = panel.poll(wish, 0.08, elapsed=0.05).X_WE
    assert wish is not None
    np.testing.assert_allclose(hand_coordinates(wish)[5], -math.pi / 2, atol=1e-12)
    slide(meshcat, "opening (m)", 0.02)
    wishes = panel.poll(wish, 0.08, elapsed=0.05)
    assert wishes.X_WE is None and wishes.opening == pytest.approx(0.02)
    # A goal that others change, or that was cut, is shown.
    panel.poll(GOAL, 0.02, elapsed=0.05)
    assert meshcat.GetSliderValue("z (m)") == pytest.approx(0.300)


def test_buttons_are_heeded_once_and_in_vain_while_something_is_under_way(panel: TeachingPanel):
    meshcat = panel._meshcat
    for action in TeachingAction:
        click(meshcat, action.value)
    assert panel.poll(GOAL, 0.08, elapsed=0.05).actions == tuple(TeachingAction)
    assert panel.poll(GOAL, 0.08, elapsed=0.05).actions == ()
    assert panel.goes_on()
    for action in (TeachingAction.RECORD, TeachingAction.STOP, TeachingAction.END):
        click(meshcat, action.value)
    assert not panel.goes_on() and panel.goes_on()
    panel.discard()
    assert panel.poll(GOAL, 0.08, elapsed=0.05).actions == (TeachingAction.END,)


def test_a_gamepad_moves_the_hand_at_a_limited_speed(panel: TeachingPanel):
    meshcat = panel._meshcat
    rest = [0.05, -0.1, 0.0, 0.1]  # sticks that nobody touches
    gamepad(meshcat, axes=rest, buttons=[0.0] * 16)
    assert panel.poll(GOAL, 0.08, elapsed=0.1).X_WE is None
    gamepad(meshcat, axes=[0.0, -1.0, 0.5, 0.0], buttons=[0.0] * 16)
    wish = panel.poll(GOAL, 0.08, elapsed=0.1).X_WE
    assert wish is not None
    change = hand_coordinates(wish) - hand_coordinates(GOAL)
    # Forward: away from the base; right stick to the right: clockwise, seen from above.
    np.testing.assert_allclose(change, [0.01, 0, 0, 0, 0, -0.025], atol=1e-9)
    wish = panel.poll(GOAL, 0.08, elapsed=100.0).X_WE  # after a long look: no leap
    assert wish is not None
    assert np.linalg.norm(wish.translation() - GOAL.translation()) < 0.051
    buttons = [0.0] * 16
    buttons[0] = 1.0
    gamepad(meshcat, axes=rest, buttons=buttons)
    assert panel.poll(GOAL, 0.08, elapsed=0.1).actions == (TeachingAction.HAND,)
    assert panel.poll(GOAL, 0.08, elapsed=0.1).actions == ()  # while it is held
    buttons[0], buttons[5] = 0.0, 1.0
    gamepad(meshcat, axes=rest, buttons=buttons)
    wish = panel.poll(GOAL, 0.08, elapsed=0.1).X_WE
    assert wish is not None
    np.testing.assert_allclose(hand_coordinates(wish)[3], 0.05, atol=1e-9)


def test_what_is_recorded_and_the_way_are_drawn_and_go(panel: TeachingPanel):
    meshcat = panel._meshcat
    poses = [(GOAL, True), (RigidTransform(GOAL.rotation(), [0.5, 0.0, 0.1]), False)]
    panel.show_way(poses)
    assert meshcat.HasPath("/drake/teaching/way/line")
    panel.show_way(())
    assert not meshcat.HasPath("/drake/teaching/way")
    panel.show_seen({"target": np.random.default_rng(0).normal(size=(50, 3))})
    assert meshcat.HasPath("/drake/teaching/seen/target")
    panel.show_seen({"target": np.zeros((0, 3))})
    assert not meshcat.HasPath("/drake/teaching/seen/target")
