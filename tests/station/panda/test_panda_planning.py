import numpy as np
import pytest
from pydrake.math import RigidTransform, RotationMatrix

from iga_drake.planning.inverse_kinematics import PoseSolver
from iga_drake.planning.planning_robot import PlanningConfig
from iga_drake.station.panda.model import HOME_POSITION, VELOCITY_LIMIT
from iga_drake.station.panda.planning import make_panda_planning_robot
from iga_drake.station.scenario import Table


def test_limits_home_and_indices():
    robot = make_panda_planning_robot(Table())
    np.testing.assert_allclose(robot.limits.velocity_upper(), VELOCITY_LIMIT)
    np.testing.assert_allclose(robot.home, HOME_POSITION)
    np.testing.assert_allclose(robot.full(np.zeros(7)), [0] * 7 + [0.04] * 2)
    assert robot.clearance(robot.home, influence=0.02) == 0.02


@pytest.mark.parametrize("height", [0.02, 0.04])
def test_clearance_to_the_table_is_the_height_of_the_finger_tips(height):
    # Pointing down, the pads' lower edge is the lowest: 54 mm into the finger, 58.4 mm from the
    # hand, whose end effector frame is at 103.4 mm.
    tip = 0.0584 + 0.054 - 0.1034
    X_WE = RigidTransform(RotationMatrix.MakeXRotation(np.pi), [0.5, 0, height])
    q = PoseSolver(make_panda_planning_robot(Table())).solve(X_WE)
    truth = make_panda_planning_robot(
        Table(), PlanningConfig(safety_distance=0.0, table_distance=0.0)
    )
    assert truth.clearance(q) == pytest.approx(height - tip, abs=1e-4)
    lowered = make_panda_planning_robot(Table(), PlanningConfig(table_distance=0.003))
    assert lowered.clearance(q) == pytest.approx(height - tip + 0.007, abs=1e-4)
    assert make_panda_planning_robot(None).clearance(q) > 0.03


def test_clearance_gradients_agree_with_finite_differences():
    robot = make_panda_planning_robot(Table())
    random = np.random.default_rng(0)
    limits = robot.limits
    agreed = compared = 0
    while compared < 300:
        q = random.uniform(limits.position_lower(), limits.position_upper())
        change = random.normal(size=7) * 1e-5
        before = robot.checker.CalcRobotClearance(robot.full(q), 0.1)
        after = robot.checker.CalcRobotClearance(robot.full(q + change), 0.1)
        if before.size() != after.size():
            continue
        predicted = before.jacobians()[:, :7] @ change
        actual = after.distances() - before.distances()
        close = np.abs(predicted - actual) < 0.1 * np.abs(actual) + 2e-7
        agreed, compared = agreed + close.sum(), compared + len(close)
    # Where two shapes have parallel faces, the nearest points may jump.
    assert agreed > 0.95 * compared
