import numpy as np
import pytest
from control_fixtures import downward, panda_robot, panda_solver
from pydrake.math import RigidTransform

from iga_drake.errors import IgaDrakeError


def test_answers_reach_the_pose_within_limits_and_free_of_collisions():
    solver, limits = panda_solver(), panda_robot().limits
    random = np.random.default_rng(3)
    asked = found = 0
    while asked < 30:
        q_random = random.uniform(limits.position_lower(), limits.position_upper())
        if not solver.is_valid(q_random):
            continue
        asked += 1
        X_WE = solver.pose(q_random)
        q = solver.solve(X_WE)
        if q is None:
            continue
        found += 1
        assert solver.pose(q).IsNearlyEqualTo(X_WE, 2e-4)
        assert (q > limits.position_lower() + 0.0499).all()
        assert (q < limits.position_upper() - 0.0499).all()
        assert panda_robot().clearance(q) >= panda_robot().safety_distance
    assert found >= 27


def test_work_area_is_reachable_and_answers_are_repeatable():
    for x, y, z in [(0.35, -0.3, 0.05), (0.65, 0.3, 0.02), (0.5, 0.0, 0.3), (0.35, 0.3, 0.2)]:
        X_WE = downward(x, y, z, yaw=0.3)
        first = panda_solver().solve(X_WE)
        assert first is not None and panda_solver().is_reachable(X_WE)
        np.testing.assert_array_equal(first, panda_solver().solve(X_WE))


def test_answer_lies_near_the_wanted_posture():
    q = panda_solver().solve(downward(0.5, 0.1, 0.3))
    again = panda_solver().solve(downward(0.5, 0.1, 0.31), near=q)
    assert np.abs(again - q).max() < 0.1


@pytest.mark.parametrize(
    "X_WE",
    [
        downward(1.2, 0.0, 0.3),  # too far
        downward(0.5, 0.0, -0.05),  # in the table
        downward(0.05, 0.0, 0.2),  # in the robot's own base
    ],
)
def test_there_is_no_answer_where_the_arm_cannot_be(X_WE):
    assert panda_solver().solve(X_WE) is None
    assert not panda_solver().is_reachable(X_WE)


def test_pose_with_nan_is_refused():
    with pytest.raises(IgaDrakeError, match="finite"):
        panda_solver().solve(RigidTransform([np.nan, 0.0, 0.0]))
