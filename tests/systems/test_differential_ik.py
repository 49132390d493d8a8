import numpy as np
import pytest
from control_fixtures import downward, panda_robot
from pydrake.math import RigidTransform
from pydrake.systems.analysis import Simulator

from iga_drake.errors import ConfigError
from iga_drake.planning.planning_robot import PlanningConfig
from iga_drake.station.panda.planning import make_panda_planning_robot
from iga_drake.station.scenario import Table
from iga_drake.systems.differential_ik import DifferentialIk, DifferentialIkConfig


class Run:
    """A differential inverse kinematics that steps from the robot's home."""

    def __init__(self, config=None):
        self.robot = panda_robot()
        self.system = DifferentialIk(self.robot, config, period=0.005)
        self.simulator = Simulator(self.system)
        self.context = self.simulator.get_mutable_context()
        self.system.GetInputPort("position_measured").FixValue(self.context, self.robot.home)
        self.ask(self.robot.pose(self.robot.home), self.robot.home)

    def ask(self, X_WE, posture):
        self.system.GetInputPort("desired_pose").FixValue(self.context, X_WE)
        self.system.GetInputPort("nominal_posture").FixValue(self.context, posture)

    def step(self, count):
        """The positions (count, 7) at each of the next steps."""
        positions = []
        first = round(self.context.get_time() / 0.005)
        for k in range(first, first + count):
            self.simulator.AdvanceTo((k + 0.5) * 0.005)  # between two updates
            positions.append(self.position)
        return np.array(positions)

    @property
    def position(self):
        return self.system.GetOutputPort("position").Eval(self.context).copy()

    @property
    def pose(self):
        return self.robot.pose(self.position)


@pytest.fixture
def run():
    return Run()


def test_stays_where_it_is_asked_to_be(run):
    positions = run.step(20)
    np.testing.assert_allclose(positions, np.tile(run.robot.home, (20, 1)), atol=1e-6)


def test_converges_on_a_pose_and_prints_nothing(run, capfd):
    X_WE = downward(0.5, 0.15, 0.25, yaw=0.4)
    run.ask(X_WE, run.robot.home)
    run.step(400)
    assert run.pose.IsNearlyEqualTo(X_WE, 1e-4)
    assert capfd.readouterr().out == ""


def test_error_decays_with_the_horizon_as_time_constant():
    run = Run(DifferentialIkConfig(horizon=0.05))
    X_WE = run.pose
    goal = RigidTransform(X_WE.rotation(), X_WE.translation() + np.array([0.0, 0.0, 0.01]))
    run.ask(goal, run.robot.home)
    run.step(10)  # one horizon: (1 - 0.1)^10 is left
    left = np.linalg.norm(goal.translation() - run.pose.translation())
    assert left == pytest.approx(0.01 * 0.9**10, rel=0.1)


def test_posture_moves_in_the_null_space_only(run):
    X_WE = run.pose
    posture = run.robot.home + np.array([0.3, 0, -0.3, 0, 0, 0, 0])
    run.ask(X_WE, posture)
    positions = run.step(400)
    assert np.abs(positions[-1] - run.robot.home).max() > 0.1
    assert np.linalg.norm(positions[-1] - posture) < np.linalg.norm(run.robot.home - posture)
    for q in positions[::20]:
        assert run.robot.pose(q).IsNearlyEqualTo(X_WE, 2e-3)


@pytest.mark.parametrize(
    "X_WE",
    [
        downward(0.5, 0.1, -0.3),  # into the table
        downward(0.0, 0.0, 0.3),  # into the base
        downward(1.5, 0.0, 0.5),  # out of reach
        downward(0.4, -0.5, 0.4, yaw=3.0),  # a long turn: joint 7 meets its limit
    ],
)
def test_limits_are_kept_whatever_is_asked(run, X_WE):
    limits = run.robot.limits
    truth = make_panda_planning_robot(
        Table(), PlanningConfig(safety_distance=0.0, table_distance=0.0)
    )
    start = run.position
    run.ask(X_WE, run.robot.home)
    positions = np.vstack([start, run.step(500)])
    velocity = np.diff(positions, axis=0) / 0.005
    # The scale of 0.9, and a hair for the solver where its last refinement fails.
    assert (np.abs(velocity) <= 0.901 * limits.velocity_upper()).all()
    assert (positions > limits.position_lower() + 0.029).all()
    assert (positions < limits.position_upper() - 0.029).all()
    assert min(truth.clearance(q) for q in positions[::5]) > 0.001


@pytest.mark.parametrize(
    ("changes", "period", "message"),
    [
        ({"velocity_scale": 1.5}, 0.005, r"DifferentialIkConfig\.velocity_scale: 1\.5"),
        ({"horizon": 0.01}, 0.02, r"horizon: 0\.01 .*at least the period.*0\.02"),
        ({"posture_gain": 0.0}, 0.005, "posture_gain"),
    ],
)
def test_bad_settings_are_refused(changes: dict, period: float, message: str):
    with pytest.raises(ConfigError, match=message):
        DifferentialIk(panda_robot(), DifferentialIkConfig(**changes), period=period)


def test_starts_from_the_measured_joints_again_with_a_new_context(run):
    elsewhere = run.robot.home + 0.1
    run.ask(downward(0.5, 0.1, 0.3), run.robot.home)
    run.step(20)
    again = run.system.CreateDefaultContext()
    for name, value in (
        ("desired_pose", run.robot.pose(elsewhere)),
        ("nominal_posture", elsewhere),
        ("position_measured", elsewhere),
    ):
        run.system.GetInputPort(name).FixValue(again, value)
    position = run.system.GetOutputPort("position")
    np.testing.assert_array_equal(position.Eval(again), elsewhere)
    run.simulator.reset_context(again)
    run.simulator.Initialize()
    run.simulator.AdvanceTo(0.1)
    np.testing.assert_allclose(position.Eval(run.simulator.get_context()), elsewhere, atol=1e-6)
