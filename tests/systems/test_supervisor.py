import numpy as np
import pytest
from control_fixtures import downward, panda_robot, panda_solver
from pydrake.systems.analysis import Simulator

from iga_drake.errors import IgaDrakeError
from iga_drake.systems.supervisor import Supervisor, SupervisorConfig

STEP = 0.005
HOME = panda_robot().home


class Run:
    def __init__(self, **config):
        self.system = Supervisor(panda_robot(), SupervisorConfig(**config), period=0.005)
        self.simulator = Simulator(self.system)
        self.context = self.simulator.get_mutable_context()
        self.steps = 0
        self.set(
            position_commanded=HOME,
            position_measured=HOME,
            velocity_measured=np.zeros(7),
            torque_external=np.zeros(7),
        )

    def set(self, **values):
        for name, value in values.items():
            self.system.GetInputPort(name).FixValue(self.context, value)

    def step(self, count=1):
        for _ in range(count):
            self.simulator.AdvanceTo((self.steps + 0.5) * STEP)
            self.steps += 1

    @property
    def position(self):
        return self.system.GetOutputPort("position").Eval(self.context)

    @property
    def status(self):
        return self.system.GetOutputPort("status").Eval(self.context)


def change(joint, by):
    value = np.zeros(7)
    value[joint - 1] = by
    return value


def test_passes_good_commands_on():
    run = Run()
    np.testing.assert_allclose(run.position, HOME)
    for k in range(1, 100):
        command = HOME + change(7, 0.001 * k)
        run.set(position_commanded=command, position_measured=command)
        run.step()
        np.testing.assert_allclose(run.position, command)
    assert not run.status.holding and run.status.reason == ""


def test_every_limit_holds_the_arm_and_is_named():
    nan = np.full(7, np.nan)
    cases = [
        (dict(position_commanded=nan), "position_commanded isn't finite"),
        (dict(position_measured=nan), "position_measured isn't finite"),
        (dict(velocity_measured=nan), "velocity_measured isn't finite"),
        (dict(torque_external=nan), "torque_external isn't finite"),
        (dict(position_commanded=HOME + change(4, 3.0)), "commanded position of joint 4"),
        (dict(position_commanded=HOME + change(2, 0.02)), "commanded velocity of joint 2"),
        (dict(position_measured=HOME + change(5, 0.3)), "tracking error of joint 5"),
        (dict(velocity_measured=change(3, -2.3)), "measured velocity of joint 3"),
    ]
    for values, reason in cases:
        run = Run()
        run.step(2)
        run.set(**values)
        run.step(2)
        assert run.status.holding and reason in run.status.reason, (reason, run.status.reason)
        np.testing.assert_allclose(run.position, HOME)


def test_holding_is_latched():
    run = Run()
    run.step(2)
    run.set(velocity_measured=change(1, 3.0))
    run.step(2)
    run.set(velocity_measured=np.zeros(7), position_commanded=HOME + 0.001)
    run.step(10)
    assert run.status.holding
    np.testing.assert_allclose(run.position, HOME)


def test_velocity_limit_is_the_joints_own():
    for speed, holds in ((2.1, False), (2.25, True)):
        run = Run()
        run.step(2)
        run.set(position_commanded=HOME + change(1, speed * STEP))
        run.step(1)
        assert run.status.holding is holds


def test_first_command_that_is_nan_holds_the_measured_position():
    run = Run()
    run.set(position_commanded=np.full(7, np.nan))
    run.step(2)
    assert "isn't finite" in run.status.reason
    np.testing.assert_allclose(run.position, HOME)


def test_end_effector_stays_in_the_workspace():
    q = panda_solver().solve(downward(0.5, 0.0, 0.2))
    for box, holds in (((0.6, 0.75, 1.0), False), ((0.45, 0.75, 1.0), True)):
        run = Run(workspace_upper=box)
        run.set(position_commanded=q, position_measured=q)
        run.step(2)
        assert run.status.holding is holds
    assert "x = 0.500 m is outside" in run.status.reason


def test_contact_torque_holds_only_if_it_lasts():
    run = Run(torque_time=0.05)
    run.step(2)
    for _ in range(5):  # knocks of 40 ms
        run.set(torque_external=change(2, 60.0))
        run.step(8)
        run.set(torque_external=np.zeros(7))
        run.step(8)
    assert not run.status.holding
    run.set(torque_external=change(2, 60.0))
    run.step(15)
    assert "torque of 60.0 N m at joint 2" in run.status.reason


def test_wrong_number_of_torque_limits_is_refused():
    with pytest.raises(IgaDrakeError, match=r"torque_limit: .*7 numbers, one a joint"):
        Supervisor(panda_robot(), SupervisorConfig(torque_limit=[1.0]), period=0.005)
