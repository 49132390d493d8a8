from dataclasses import replace

import numpy as np
import pytest
from demonstration_fakes import (
    make_demonstration,
    make_observations,
    make_set,
    make_waypoints,
)
from scipy.spatial.transform import Rotation

from iga_drake.demonstrations.demonstration import (
    DemonstrationError,
    DemonstrationSet,
    Observation,
    Trajectory,
)


def test_the_context_carries_the_grasped_cloud_into_the_world():
    demonstrations = make_set()
    for index in range(2):
        for alignment, demonstration in zip(
            demonstrations.context(index), demonstrations.demonstrations, strict=True
        ):
            waypoint = demonstration.waypoints[index]
            grasped = demonstration.observations[waypoint.grasped].points
            R = Rotation.from_matrix(waypoint.X_WE[:3, :3])
            expected = R.apply(grasped) + waypoint.X_WE[:3, 3]
            np.testing.assert_allclose(alignment.grasped, expected, atol=1e-12)
            target = demonstration.observations[waypoint.target].points
            np.testing.assert_array_equal(alignment.target, target)
    with pytest.raises(DemonstrationError, match="waypoint 2 asked for, 0 to 1 exist"):
        demonstrations.context(2)


def test_ways_up_are_carried_with_their_clouds():
    """One demonstration and the same with everything turned: the ways up turn along."""
    made = {
        name: replace(seen, upright=name != "gripper") for name, seen in make_observations().items()
    }
    (_, one), (_, other) = (
        DemonstrationSet("t", (make_demonstration(observations=made, waypoints=way),)).contexts
        for way in (make_waypoints(), make_waypoints(5))
    )
    for context in (one, other):
        np.testing.assert_array_equal(context[0].target_up, [0, 0, 1])
    # The held thing hung from a hand whose z axis pointed down: its up is against that axis.
    for context, seed in ((one, 0), (other, 5)):
        X_WE = make_waypoints(seed)[1].X_WE
        np.testing.assert_allclose(context[0].grasped_up, -X_WE[:3, 2], atol=1e-12)
        # Fixed to the cloud: heights along it are those above the hand.
        heights = context[0].grasped @ context[0].grasped_up
        seen = -made["thing in the hand"].points[:, 2]
        np.testing.assert_allclose(np.diff(heights), np.diff(seen), atol=1e-7)


def test_what_may_be_any_way_up_has_no_way_up():
    assert all(seen.up is None for seen in make_observations().values())
    for context in make_set().contexts:
        assert context[0].grasped_up is None and context[0].target_up is None


def test_contexts_are_made_once():
    demonstrations = make_set()
    assert demonstrations.context(1) is demonstrations.contexts[1]


def test_first_takes_some_and_refuses_more_than_there_are():
    assert len(make_set(3).first(2)) == 2
    with pytest.raises(DemonstrationError, match="4 demonstrations asked for, 1 to 3 exist"):
        make_set(3).first(4)


def test_the_opening_of_a_set_is_the_median():
    openings = (0.01, 0.02, 0.07)
    made = []
    for opening in openings:
        first, second = make_waypoints()
        made.append(make_demonstration(waypoints=(first, replace(second, opening=opening))))
    demonstrations = DemonstrationSet("grasp", tuple(made))
    assert demonstrations.opening(1) == 0.02


def test_arrays_are_copies():
    points = make_observations()["goal"].points.copy()
    observation = Observation(points=points, role="target", frame="W")
    points[:] = 7.0
    assert observation.points.max() < 1


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: replace(make_observations()["goal"], points=np.zeros((4, 2))), "shape"),
        (lambda: replace(make_observations()["goal"], points=[["a"]]), "not an array of numbers"),
        (lambda: replace(make_observations()["goal"], role="lid"), "role: 'lid' found, one of"),
        (lambda: replace(make_observations()["goal"], gravity=[0, 0, 9.81]), "unit vector"),
        (lambda: replace(make_observations()["goal"], upright="yes"), "upright: 'yes' found"),
        (lambda: replace(make_waypoints()[0], X_WE=2 * np.eye(4)), "not a rigid transform"),
        (lambda: replace(make_waypoints()[0], X_WE=np.diag([1.0, 1, -1, 1])), "not a rigid"),
        (lambda: replace(make_waypoints()[0], opening=np.inf), "finite"),
        (lambda: make_demonstration(waypoints=()), "none found, at least 1"),
        (lambda: make_demonstration(waypoints=make_waypoints(names=("a", "a"))), "name must be"),
        (lambda: make_demonstration(waypoints=make_waypoints()[:1]), "no waypoint relates"),
        (
            lambda: make_demonstration(
                waypoints=(replace(make_waypoints()[0], grasped="goal"), make_waypoints()[1])
            ),
            "'goal' is in frame W, E expected",
        ),
        (
            lambda: Trajectory(np.array([0.0, 2.0, 1.0]), np.zeros((3, 4, 4)), np.zeros(3)),
            "times fall",
        ),
        (lambda: Trajectory(np.zeros(3), np.zeros((2, 4, 4)), np.zeros(3)), "X_WE: shape"),
    ],
)
def test_bad_values_cannot_be_made(make, message: str):
    with pytest.raises(DemonstrationError, match=message):
        make()


def test_sets_of_mixed_waypoints_cannot_be_made():
    other = make_demonstration(waypoints=make_waypoints(names=("a", "b")))
    with pytest.raises(DemonstrationError, match="different waypoints"):
        DemonstrationSet(task="grasp", demonstrations=(make_demonstration(), other))


def test_turns_lead_from_the_rotation_before():
    shown = make_set(3)
    turns = shown.turns(1)
    assert turns.shape == (3, 3, 3)
    for turn, demonstration in zip(turns, shown.demonstrations, strict=True):
        before, at = (w.X_WE[:3, :3] for w in demonstration.waypoints)
        np.testing.assert_allclose(before @ turn, at, atol=1e-12)
