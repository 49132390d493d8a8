from itertools import pairwise

import numpy as np
import pytest
from control_fixtures import downward, panda_robot, panda_solver
from pydrake.common.eigen_geometry import AngleAxis
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix

from iga_drake.planning.routes import (
    JointPath,
    LinePath,
    can_follow,
    interpolate_pose,
    plan_path,
    pose_error,
)

X_WA = RigidTransform(RollPitchYaw(0.1, 0.2, 0.3), [0.4, 0.1, 0.2])
X_WB = RigidTransform(RollPitchYaw(1.0, -0.5, 2.0), [0.6, -0.3, 0.5])


def test_pose_error_is_distance_and_angle():
    turned = RigidTransform(RollPitchYaw(0, 0, 0.7), [3.0, 0.0, 4.0])
    assert pose_error(RigidTransform(), turned) == pytest.approx((5.0, 0.7))
    assert pose_error(X_WA, X_WA) == pytest.approx((0.0, 0.0), abs=1e-7)
    assert pose_error(X_WA, X_WB) == pytest.approx(pose_error(X_WB, X_WA))


@pytest.mark.parametrize("share", [0.0, 0.25, 0.5, 1.0])
def test_interpolation_divides_distance_and_angle(share):
    X_WM = interpolate_pose(X_WA, X_WB, share)
    whole, part = pose_error(X_WA, X_WB), pose_error(X_WA, X_WM)
    np.testing.assert_allclose(part, share * np.array(whole), atol=1e-7)
    rest = pose_error(X_WM, X_WB)
    np.testing.assert_allclose(rest, (1 - share) * np.array(whole), atol=1e-7)


def test_line_takes_the_longer_of_moving_and_turning():
    distance, angle = pose_error(X_WA, X_WB)
    path = LinePath(X_WA, X_WB)
    assert path.duration(0.1, 100.0) == pytest.approx(distance / 0.1)
    assert path.duration(100.0, 0.5) == pytest.approx(angle / 0.5)


def test_a_line_that_the_arm_can_follow_is_kept():
    solver = panda_solver()
    q = solver.solve(downward(0.5, -0.1, 0.3))
    X_WStart, X_WGoal = solver.pose(q), downward(0.5, 0.1, 0.1)
    path = plan_path(solver, q=q, X_WStart=X_WStart, X_WGoal=X_WGoal)
    assert isinstance(path, LinePath)
    assert path.pose(1.0).IsNearlyEqualTo(X_WGoal, 1e-9)
    assert can_follow(panda_robot(), q, path)


def test_a_line_through_the_base_is_replaced_by_a_joint_path():
    solver, robot = panda_solver(), panda_robot()
    q = solver.solve(downward(0.05, 0.5, 0.3), near=[np.pi / 2, *robot.home[1:]])
    X_WGoal = downward(0.05, -0.5, 0.3)
    goal = solver.solve(X_WGoal, near=[-np.pi / 2, *robot.home[1:]])
    line = LinePath(solver.pose(q), X_WGoal, goal)
    assert not can_follow(robot, q, line)
    path = plan_path(solver, q=q, X_WStart=line.X_WStart, X_WGoal=X_WGoal, nominal=goal)
    assert isinstance(path, JointPath) and path.is_free()
    assert path.pose(0.0).IsNearlyEqualTo(line.X_WStart, 1e-6)
    assert path.pose(1.0).IsNearlyEqualTo(X_WGoal, 1e-3)
    # Neither the joints nor the end effector are faster than they may be.
    duration = path.duration(0.25, 1.5)
    shares = np.linspace(0, 1, 400)
    rates = np.abs(np.diff([path.posture(s) for s in shares], axis=0)) * 399 / duration
    assert (rates <= 0.51 * robot.limits.velocity_upper()).all()
    poses = [path.pose(s) for s in shares]
    errors = [pose_error(a, b) for a, b in pairwise(poses)]
    speeds = np.array(errors) * 399 / duration
    assert speeds[:, 0].max() < 0.26 and speeds[:, 1].max() < 1.55


def test_a_goal_out_of_reach_leaves_the_line():
    solver = panda_solver()
    X_WGoal = downward(2.0, 0.0, 0.3)
    q = panda_robot().home
    path = plan_path(solver, q=q, X_WStart=solver.pose(q), X_WGoal=X_WGoal)
    assert isinstance(path, LinePath)
    assert not can_follow(panda_robot(), q, path)


def test_a_line_moves_the_nominal_posture_evenly_from_its_start():
    start, nominal = np.zeros(7), np.linspace(-1.0, 1.0, 7)
    line = LinePath(RigidTransform(), RigidTransform([0.1, 0, 0]), nominal, start)
    for share in (0.0, 0.25, 1.0):
        np.testing.assert_allclose(line.posture(share), share * nominal, atol=1e-12)
    assert LinePath(RigidTransform(), RigidTransform(), nominal).posture(0.0) is nominal


def test_a_wide_turn_whose_short_way_ends_at_a_limit_goes_through_the_joints():
    """From q7 = -2 to 2 rad the short way is -2.28 rad, far beyond the joint's limit of -2.90."""
    robot, solver = panda_robot(), panda_solver()
    start, end = robot.home.copy(), robot.home.copy()
    start[6], end[6] = -2.0, 2.0
    X_WGoal = robot.pose(end)
    path = plan_path(solver, q=start, X_WStart=robot.pose(start), X_WGoal=X_WGoal)
    assert isinstance(path, JointPath)
    assert max(pose_error(path.pose(1.0), X_WGoal)) < 2e-3
    lower, upper = robot.limits.position_lower(), robot.limits.position_upper()
    for share in np.linspace(0, 1, 21):
        posture = path.posture(share)
        assert (posture > lower).all() and (posture < upper).all()


def test_a_line_on_which_a_joint_would_be_held_at_its_limit_goes_through_the_joints():
    """A turn of 2.2 rad leads q7 to its limit; the rest of the line would fold the arm."""
    robot, solver = panda_robot(), panda_solver()
    q = np.array([0.0, -0.378, 0.0, -2.228, 0.0, 1.851, -0.785])
    axis = np.array([0.046, -0.047, 0.998])
    turn = RotationMatrix(AngleAxis(2.21, axis / np.linalg.norm(axis)))
    X_WStart = robot.pose(q)
    X_WGoal = RigidTransform(turn @ X_WStart.rotation(), [0.665, -0.181, 0.186])
    line = LinePath(X_WStart, X_WGoal, solver.solve(X_WGoal, near=q), q)
    assert not can_follow(robot, q, line)
    path = plan_path(solver, q=q, X_WStart=X_WStart, X_WGoal=X_WGoal)
    assert isinstance(path, JointPath)
    assert max(pose_error(path.pose(1.0), X_WGoal)) < 2e-3
