"""Each mistake that people make when they record demonstrations is found and named."""

from dataclasses import replace

import numpy as np
import pytest
from demonstration_fakes import ball, make_demonstration, make_observations, make_waypoints

from iga_drake.demonstrations.demonstration import DemonstrationError
from iga_drake.demonstrations.plausibility import check_plausible

RNG = np.random.default_rng(0)


def seen(name: str, points: np.ndarray, **changes):
    """A demonstration in which one observation has other points."""
    observations = make_observations()
    observations[name] = replace(observations[name], points=points, **changes)
    return make_demonstration(observations=observations)


def moved(index: int, **changes):
    """A demonstration in which one waypoint is another."""
    waypoints = list(make_waypoints())
    waypoints[index] = replace(waypoints[index], **changes)
    return make_demonstration(waypoints=tuple(waypoints))


def goal() -> np.ndarray:
    return make_observations()["goal"].points


def table() -> np.ndarray:
    return np.concatenate([goal(), RNG.uniform((0, -0.6, 0), (0.9, 0.6, 0.001), (400, 3))])


def in_camera_frame() -> np.ndarray:
    """The cloud as a camera sees it that stands 1 m in front of it and looks at it."""
    return (goal() - [1.4, -0.2, 0.05]) @ np.array([[0.0, 0, -1], [-1, 0, 0], [0, -1, 0]])


def test_a_good_one_passes():
    check_plausible(make_demonstration())


def test_one_stray_point_does_no_harm():
    check_plausible(seen("goal", np.vstack([goal(), [[0.4, -0.2, 5000.0]]])))


@pytest.mark.parametrize("size", [0.02, 0.9])
def test_sizes_within_the_limits_pass(size: float):
    check_plausible(seen("goal", ball(3, (0.4, -0.2, 0.05), size / 2 / 1.7)))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: seen("goal", 1000 * goal()), "'goal': .* m large.*millimetres"),
        (lambda: seen("goal", goal() / 1000), "'goal': .* m large.*kilometres"),
        (lambda: seen("goal", goal()[:10]), "'goal': 10 points of which 10 are distinct"),
        (lambda: seen("goal", np.repeat(goal()[:20], 20, 0)), "of which 20 are distinct"),
        (lambda: seen("goal", np.zeros((0, 3))), "'goal': 0 points"),
        (
            lambda: seen("goal", np.concatenate([goal(), np.zeros((30, 3))])),
            r"'goal': 30 of 110 points lie at \[0.0, 0.0, 0.0\]: invalid pixels",
        ),
        (lambda: seen("goal", table()), "'goal': .* m large.*table"),
        (lambda: seen("goal", in_camera_frame()), "waypoint 'place'.* m away from 'goal'"),
        (
            lambda: seen("goal", goal(), gravity=np.array([0.0, 1.0, 0.0])),
            "'goal': gravity .* another observation says",
        ),
        (
            lambda: seen("gripper", make_observations()["goal"].points + [0.5, 0, 0]),
            "'gripper': its middle is .* m from the end effector",
        ),
        (lambda: moved(0, opening=-1.0), "waypoint 'grasp': opening -1 m"),
        (lambda: moved(1, opening=80.0), "waypoint 'place': opening 80 m .*units"),
        (
            lambda: moved(0, X_WE=np.linalg.inv(make_waypoints()[0].X_WE)),
            "waypoint 'grasp': .*inverted",
        ),
    ],
)
def test_mistakes_are_named(make, message: str):
    with pytest.raises(DemonstrationError, match=message):
        check_plausible(make())
