"""Jogging: goals that change at any time, at limited speed and acceleration, and contact."""

from itertools import pairwise

import numpy as np
import pytest
from pydrake.common.value import AbstractValue, Value
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.systems.analysis import Simulator

from iga_drake.planning.routes import pose_error
from iga_drake.systems.jog import Jog
from iga_drake.systems.messages import JogGoal
from iga_drake.systems.waypoint_follower import WaypointFollowerConfig

CONFIG = WaypointFollowerConfig(period=0.01, linear_speed=0.2, angular_speed=0.8, ramp=0.2)
X_START = RigidTransform(RollPitchYaw(np.pi, 0.0, 0.0), [0.4, 0.0, 0.4])
HOME = np.linspace(-0.3, 0.3, 7)


class Hand:
    """A hand that always is where it should be, or stuck."""

    def __init__(self, config: WaypointFollowerConfig = CONFIG) -> None:
        self.jog = Jog(config)
        self.simulator = Simulator(self.jog)
        self.context = self.simulator.get_mutable_context()
        self.goal = JogGoal()
        self.stuck, self.steps = False, 0
        self.put(X_START)
        self.jog.GetInputPort("position_measured").FixValue(self.context, HOME)
        self.force(np.zeros(3))
        self.want()
        self.simulator.Initialize()

    def put(self, X_WE: RigidTransform) -> None:
        self.measured = X_WE
        self.jog.GetInputPort("pose_measured").FixValue(self.context, Value(X_WE))

    def force(self, force: np.ndarray) -> None:
        self.jog.GetInputPort("force_measured").FixValue(self.context, force)

    def want(self, X_WE: RigidTransform | None = None, **options) -> None:
        sequence = self.goal.sequence + (X_WE is not None)
        self.goal = JogGoal(sequence=sequence, X_WE=X_WE, **options)
        self.jog.GetInputPort("goal").FixValue(self.context, AbstractValue.Make(self.goal))

    @property
    def desired(self) -> RigidTransform:
        return RigidTransform(self.jog.GetOutputPort("desired_pose").Eval(self.context))

    @property
    def status(self):
        return self.jog.GetOutputPort("status").Eval(self.context)

    def run(self, duration: float) -> list[RigidTransform]:
        """The desired pose at each step."""
        poses = [self.desired]
        for _ in range(round(duration / CONFIG.period)):
            self.steps += 1  # between two updates
            self.simulator.AdvanceTo(CONFIG.period * (self.steps + 0.5))
            poses.append(self.desired)
            if not self.stuck:
                self.put(poses[-1])
        return poses


def speeds(poses: list[RigidTransform]) -> tuple[np.ndarray, np.ndarray]:
    """Linear velocities (K, 3) (m/s) and angular speeds (K,) (rad/s)."""
    steps = np.diff([pose.translation() for pose in poses], axis=0)
    turns = np.array([pose_error(a, b)[1] for a, b in pairwise(poses)])
    return steps / CONFIG.period, turns / CONFIG.period


def check_limits(poses: list[RigidTransform]) -> None:
    linear, angular = speeds(poses)
    assert np.linalg.norm(linear, axis=1).max() <= CONFIG.linear_speed * 1.001
    assert angular.max() <= CONFIG.angular_speed * 1.001
    # The last step before the goal is cut short.
    changes = np.linalg.norm(np.diff(linear, axis=0), axis=1) / CONFIG.period
    assert changes.max() <= 1.5 * CONFIG.linear_speed / CONFIG.ramp


def test_it_reaches_the_goal_and_both_motions_end_together():
    hand = Hand()
    assert hand.run(0.1)[-1].IsNearlyEqualTo(X_START, 1e-12)  # stays before there is a goal
    goal = RigidTransform(RollPitchYaw(np.pi, 0.0, 0.4), [0.4, 0.2, 0.3])
    hand.want(goal, opening=0.03)
    assert hand.jog.GetOutputPort("hand.opening").Eval(hand.context)[0] == 0.03
    poses = hand.run(0.6)
    assert hand.status.sequence_reached == 0
    left = np.divide(pose_error(poses[-1], goal), pose_error(X_START, goal))
    np.testing.assert_allclose(left[0], left[1], atol=0.05)
    poses += hand.run(2.0)[1:]
    assert hand.desired.IsExactlyEqualTo(goal) and hand.status.sequence_reached == 1
    check_limits(poses)
    # A straight line.
    way = goal.translation() - X_START.translation()
    off = np.cross([p.translation() - X_START.translation() for p in poses], way)
    assert np.linalg.norm(off, axis=1).max() / np.linalg.norm(way) < 1e-9
    posture = hand.jog.GetOutputPort("nominal_posture").Eval(hand.context)
    np.testing.assert_array_equal(posture, HOME)


def test_goals_that_change_on_the_way_never_jerk_the_hand():
    hand = Hand()
    rng = np.random.default_rng(0)
    poses = []
    for _ in range(30):  # as a person who drags a slider
        offset = rng.uniform(-0.2, 0.2, 3)
        turn = RollPitchYaw(rng.uniform(-0.5, 0.5, 3)).ToRotationMatrix()
        hand.want(RigidTransform(turn @ X_START.rotation(), X_START.translation() + offset))
        poses += hand.run(0.1)[:-1]
    hand.run(3.0)
    check_limits(poses)
    assert hand.desired.IsExactlyEqualTo(hand.goal.X_WE)


def test_slower_where_the_goal_says_so():
    hand = Hand()
    hand.want(RigidTransform(X_START.rotation(), [0.4, 0.2, 0.4]), speed_scale=0.25)
    linear, _ = speeds(hand.run(1.5))
    np.testing.assert_allclose(np.linalg.norm(linear, axis=1).max(), 0.05, rtol=1e-3)


def test_it_waits_for_a_hand_that_is_left_behind():
    hand = Hand()
    hand.stuck = True
    hand.want(RigidTransform(X_START.rotation(), [0.4, 0.2, 0.4]))
    hand.run(2.0)
    assert 0.05 < pose_error(hand.desired, X_START)[0] < 0.08
    assert hand.status.sequence_reached == 0
    # A new goal begins where the hand is.
    hand.stuck = False
    hand.want(RigidTransform(X_START.rotation(), [0.4, -0.1, 0.4]))
    assert hand.run(0.05)[-1].translation()[1] < 0.01
    hand.run(2.0)
    assert hand.status.sequence_reached == 2


@pytest.mark.parametrize("limit", [15.0, None])
def test_a_force_against_the_motion_ends_it(limit: float | None):
    hand = Hand()
    hand.force(np.array([0.0, 0.0, -3.0]))  # what it carries
    hand.want(RigidTransform(X_START.rotation(), [0.4, 0.0, 0.2]), contact_force=limit)
    hand.run(0.5)
    assert not hand.status.touched
    hand.force(np.array([0.0, 0.0, 14.0 - 3.0]))
    hand.run(0.05)
    assert not hand.status.touched
    hand.force(np.array([0.0, 0.0, 16.0 - 3.0]))
    hand.run(0.05)
    assert hand.status.touched == (limit is not None)
    if limit is None:
        return
    stayed = hand.desired
    assert stayed.translation()[2] > 0.25 and hand.status.sequence_reached == 1
    hand.run(1.0)
    assert hand.desired.IsExactlyEqualTo(stayed)
    # Away from there the same force is no hindrance.
    hand.want(X_START, contact_force=limit)
    hand.run(2.0)
    assert not hand.status.touched and hand.desired.IsExactlyEqualTo(X_START)


def test_it_stays_where_nothing_is_measured():
    hand = Hand()
    hand.want(RigidTransform(X_START.rotation(), [0.4, 0.2, 0.4]))
    stayed = hand.run(0.3)[-1]
    hand.put(RigidTransform(X_START.rotation(), np.full(3, np.nan)))
    hand.stuck = True
    assert hand.run(0.3)[-1].IsExactlyEqualTo(stayed)
