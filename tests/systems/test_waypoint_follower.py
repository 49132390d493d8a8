import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from control_fixtures import downward, panda_robot, panda_solver
from hypothesis import given
from hypothesis import strategies as st
from pydrake.common.value import Value
from pydrake.math import RigidTransform
from pydrake.systems.analysis import Simulator

from iga_drake.errors import IgaDrakeError
from iga_drake.planning.routes import pose_error
from iga_drake.systems.messages import NO_TARGET, EndEffectorTarget
from iga_drake.systems.waypoint_follower import WaypointFollower, WaypointFollowerConfig

STEP = 0.005
X_START = downward(0.5, 0.0, 0.3)


class Run:
    """A follower whose measured pose is its own desired pose, unless it is held back."""

    def __init__(self, solver=None, **config):
        self.system = WaypointFollower(
            solver=solver,
            config=WaypointFollowerConfig(
                **{
                    "period": STEP,
                    "linear_speed": 0.25,
                    "angular_speed": math.radians(90),
                    **config,
                }
            ),
        )
        self.simulator = Simulator(self.system)
        self.context = self.simulator.get_mutable_context()
        self.steps = 0
        self.measure(X_START)
        self.system.GetInputPort("position_measured").FixValue(self.context, panda_robot().home)
        self.send(replace(NO_TARGET, opening_moving=0.06))

    def measure(self, X_WE):
        self.system.GetInputPort("pose_measured").FixValue(self.context, X_WE)

    def push(self, force):
        self.system.GetInputPort("force_measured").FixValue(self.context, force)

    def send(self, target):
        self.system.GetInputPort("target").FixValue(self.context, Value[object](target))

    def get(self, port):
        return self.system.GetOutputPort(port).Eval(self.context)

    def step(self, count=1, *, moves=True):
        """The desired poses after each of the next steps."""
        poses = []
        for _ in range(count):
            self.simulator.AdvanceTo((self.steps + 0.5) * STEP)
            self.steps += 1
            poses.append(RigidTransform(self.get("desired_pose")))
            if moves:
                self.measure(poses[-1])
        return poses


def target(X_WE, sequence=1, **fields):
    fields = {"opening_moving": 0.08, "opening_reached": 0.0, **fields}
    return EndEffectorTarget(sequence=sequence, X_WE=X_WE, **fields)


def test_holds_the_first_measured_pose_before_any_target():
    run = Run()
    assert run.get("desired_pose").IsNearlyEqualTo(X_START, 1e-12)
    for X_WE in run.step(5):
        assert X_WE.IsNearlyEqualTo(X_START, 1e-12)
    run.measure(downward(0.5, 0.0, 0.29))  # sagging doesn't pull the command along
    assert run.step(5, moves=False)[-1].IsNearlyEqualTo(X_START, 1e-12)
    assert run.get("hand.opening") == pytest.approx(0.06)
    np.testing.assert_allclose(run.get("nominal_posture"), panda_robot().home)
    assert run.get("status").sequence_reached == 0


def test_goes_straight_at_constant_speed_and_comes_to_rest():
    run = Run(linear_speed=0.25, ramp=0.2)
    X_WGoal = downward(0.5, 0.3, 0.3, yaw=0.2)
    run.send(target(X_WGoal))
    poses = [X_START, *run.step(400)]
    p = np.array([X.translation() for X in poses])
    np.testing.assert_allclose(p[:, [0, 2]], np.tile([0.5, 0.3], (len(p), 1)), atol=1e-9)
    speed = np.linalg.norm(np.diff(p, axis=0), axis=1) / STEP
    assert speed.max() == pytest.approx(0.25, rel=1e-3)
    assert (speed > 0.249).mean() * len(speed) * STEP > 0.9  # s at cruising speed, of 1.4
    acceleration = np.diff(speed) / STEP
    assert np.abs(acceleration).max() < 2 * 0.25 / 0.2
    assert poses[-1].IsNearlyEqualTo(X_WGoal, 1e-9)
    assert speed[-1] == 0.0


def test_turns_at_constant_speed():
    run = Run(angular_speed=math.radians(90))
    run.send(target(downward(0.5, 0.0, 0.3, yaw=math.radians(120))))
    poses = [X_START, *run.step(400)]
    rates = np.array([pose_error(a, b)[1] for a, b in pairwise(poses)]) / STEP
    assert rates.max() == pytest.approx(math.radians(90), rel=1e-3)
    assert run.get("status").rotation_error == pytest.approx(0.0, abs=1e-6)


def test_speed_scale_slows_down():
    run = Run(linear_speed=0.25)
    run.send(target(downward(0.5, 0.2, 0.3), speed_scale=0.2))
    p = np.array([X.translation() for X in run.step(400)])
    assert np.linalg.norm(np.diff(p, axis=0), axis=1).max() / STEP == pytest.approx(0.05, rel=1e-3)


def test_opens_and_closes_the_hand_and_settles():
    run = Run()
    run.send(target(downward(0.5, 0.02, 0.3), sequence=7, settle=0.5))
    run.step(2)
    assert run.get("hand.opening") == pytest.approx(0.08)
    while run.get("hand.opening")[0] > 0.0:
        run.step()
    assert run.get("status").position_error < 0.003
    run.step(97)
    assert run.get("status").sequence_reached == 0
    run.step(5)
    assert run.get("status").sequence_reached == 7


def test_a_pose_not_reached_is_never_reported():
    run = Run()
    run.send(target(downward(0.5, 0.1, 0.3)))
    run.step(400, moves=False)
    status = run.get("status")
    assert status.sequence_reached == 0
    assert status.position_error == pytest.approx(0.1)
    assert run.get("hand.opening") == pytest.approx(0.08)
    # Within tolerance in place, but not in angle.
    run.measure(downward(0.5, 0.1, 0.3, yaw=math.radians(2)))
    run.step(10, moves=False)
    assert run.get("status").sequence_reached == 0
    run.measure(downward(0.5, 0.102, 0.3, yaw=math.radians(1)))
    run.step(2, moves=False)
    assert run.get("status").sequence_reached == 1


def test_next_target_starts_from_the_last_command():
    run = Run()
    run.send(target(downward(0.5, 0.2, 0.3)))
    X_WBetween = run.step(60)[-1]
    run.send(target(downward(0.5, 0.0, 0.5), sequence=2))
    assert pose_error(X_WBetween, run.step()[-1])[0] < 0.0015
    run.step(400)
    assert run.get("status").sequence_reached == 2


def test_an_arm_left_behind_starts_from_where_it_is():
    run = Run()
    run.send(target(downward(0.5, 0.3, 0.3)))
    run.step(400, moves=False)
    run.send(target(downward(0.5, 0.0, 0.4), sequence=2))
    assert pose_error(X_START, run.step(moves=False)[-1])[0] < 0.0015


def test_posture_of_a_target_is_passed_on():
    run = Run()
    posture = panda_robot().home + 0.1
    run.send(target(downward(0.5, 0.1, 0.3), nominal_posture=posture))
    run.step(2)
    np.testing.assert_allclose(run.get("nominal_posture"), posture)
    run.send(target(downward(0.5, 0.0, 0.3), sequence=2))
    run.step(2)
    np.testing.assert_allclose(run.get("nominal_posture"), posture)


def test_contact_ends_a_motion_that_asks_for_it():
    run = Run(linear_speed=0.25)
    weight = np.array([0.0, 0.0, -8.0])  # of what is held: more than the contact force
    run.push(weight)
    guarded = {"contact_force": 6.0, "settle": 0.2, "opening_moving": 0.0, "opening_reached": 0.03}
    run.send(target(downward(0.5, 0.0, 0.2), **guarded))
    run.step(60)
    run.push(weight + [0.0, 3.0, 4.0])
    free = run.step()[-1]
    assert 0.21 < free.translation()[2] < 0.29
    run.push(weight + [0.0, 3.0, 5.5])
    for X_WE in run.step(20):
        assert X_WE.IsNearlyEqualTo(free, 1e-12)
    assert run.get("hand.opening") == pytest.approx(0.03)
    assert run.get("status").sequence_reached == 0
    run.push(weight)  # it comes off again, but stays there
    assert run.step(30)[-1].IsNearlyEqualTo(free, 1e-12)
    status = run.get("status")
    assert status.sequence_reached == 1 and status.touched
    assert status.position_error == pytest.approx(free.translation()[2] - 0.2)
    # The next target moves on from there and knows nothing of it.
    run.push(10 * weight)
    run.send(target(downward(0.5, 0.0, 0.3), sequence=2))
    assert pose_error(free, run.step()[-1])[0] < 0.0015
    run.step(200)
    assert run.get("status").sequence_reached == 2 and not run.get("status").touched


def test_a_guarded_motion_without_contact_gets_to_its_pose():
    run = Run()
    run.push(np.array([0.0, 0.0, -3.0]))
    run.send(target(downward(0.5, 0.0, 0.2), contact_force=6.0))
    assert run.step(300)[-1].IsNearlyEqualTo(downward(0.5, 0.0, 0.2), 1e-9)
    assert run.get("status").sequence_reached == 1 and not run.get("status").touched


def test_with_a_solver_it_goes_around_the_base():
    run = Run(solver=panda_solver())
    home = panda_robot().home
    q = panda_solver().solve(downward(0.05, 0.5, 0.3), near=[np.pi / 2, *home[1:]])
    run.measure(panda_solver().pose(q))
    run.system.GetInputPort("position_measured").FixValue(run.context, q)
    run.step()
    goal = panda_solver().solve(downward(0.05, -0.5, 0.3), near=[-np.pi / 2, *home[1:]])
    run.send(target(panda_solver().pose(goal), nominal_posture=goal))
    poses = [panda_solver().pose(q), *run.step(2000)]
    assert poses[-1].IsNearlyEqualTo(panda_solver().pose(goal), 1e-6)
    p = np.array([X.translation() for X in poses])
    assert np.linalg.norm(p[:, :2], axis=1).min() > 0.2
    assert np.linalg.norm(np.diff(p, axis=0), axis=1).max() / STEP < 0.26


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        (target(RigidTransform([np.nan, 0, 0])), "finite"),
        (target(X_START, speed_scale=0.0), "speed_scale"),
        (target(X_START, nominal_posture=np.zeros(6)), "nominal_posture"),
        (target(X_START, contact_force=0.0), "contact_force 0.0 N has to be"),
        (target(X_START, contact_force=5.0), "needs the input port force_measured"),
    ],
)
def test_bad_targets_are_refused(bad, message):
    run = Run()
    run.send(bad)
    with pytest.raises(IgaDrakeError, match=message):
        run.step()


@pytest.mark.parametrize("scale", [1e-12, 1e-6, 1e-3])
def test_the_slowest_motion_does_not_jump(scale: float):
    run = Run(linear_speed=0.25)
    goal = RigidTransform(X_START.rotation(), X_START.translation() + np.array([0.3, 0, 0]))
    run.send(EndEffectorTarget(1, goal, 0.08, 0.08, speed_scale=scale))
    poses = run.step(50)
    moved = np.linalg.norm(poses[-1].translation() - X_START.translation())
    assert moved <= 0.25 * scale * 50 * STEP + 1e-12


@given(st.floats(-4, 0), st.floats(-3, 1), st.floats(0.001, 0.5))
def test_a_motion_keeps_its_speed_and_arrives(scale: float, ramp: float, distance: float):
    speed = 0.25 * 10**scale
    run = Run(linear_speed=2.0, ramp=10**ramp)
    goal = RigidTransform(X_START.rotation(), X_START.translation() + [distance, 0, 0])
    run.send(EndEffectorTarget(1, goal, 0.08, 0.08, speed_scale=speed / 2.0))
    steps = min(400, int(distance / speed / STEP + 2 * 10**ramp / STEP) + 10)
    places = np.array([pose.translation()[0] for pose in run.step(steps)])
    changes = np.diff(places)
    assert (changes >= -1e-12).all() and (changes <= speed * STEP + 2e-6 * distance).all()
    if steps < 400:
        assert places[-1] == pytest.approx(goal.translation()[0], abs=1e-9)


def test_bad_settings_are_refused():
    with pytest.raises(IgaDrakeError, match="linear_speed"):
        WaypointFollower(config=WaypointFollowerConfig(linear_speed=0.0))
