import numpy as np
import pytest
from control_fixtures import downward, panda_robot, panda_solver
from pydrake.systems.analysis import Simulator

from iga_drake.errors import IgaDrakeError
from iga_drake.systems.messages import Cause
from iga_drake.systems.ports import ArmMode
from iga_drake.systems.supervisor import Supervisor, SupervisorConfig

STEP = 0.005
HOME = panda_robot().home


class Run:
    def __init__(self, **config):
        self.system = self.make(SupervisorConfig(**config))
        self.simulator = Simulator(self.system)
        self.context = self.simulator.get_mutable_context()
        self.steps = 0
        self.set(
            position_commanded=HOME,
            position_measured=HOME,
            velocity_measured=np.zeros(7),
            torque_external=np.zeros(7),
        )

    def make(self, config):
        return Supervisor(panda_robot(), config, period=STEP)

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


class Watched(Run):
    """With everything connected that tells of the arm, its link and a camera."""

    def __init__(self, **config):
        super().__init__(**config)
        self.ages = {"arm_time": 0.0, "hand_time": 0.0, "left.time": 0.0}
        self.set(mode=[0.0])

    def make(self, config):
        return Supervisor(panda_robot(), config, period=STEP, cameras=("left",))

    def step(self, count=1):
        for _ in range(count):
            now = (self.steps + 0.5) * STEP
            self.set(**{name: [now - STEP / 2 - age] for name, age in self.ages.items()})
            super().step()


def test_the_arms_mode_holds_the_arm():
    for mode in ArmMode:
        run = Watched()
        run.step(2)
        run.set(mode=[float(mode)])
        run.step(2)
        assert run.status.holding is (mode is not ArmMode.READY)
        assert run.status.reason == mode.problem
    for unknown in (99.0, -1.0, 0.5, np.nan):
        run = Watched()
        run.set(mode=[unknown])
        run.step(2)
        assert run.status.reason == ArmMode.OTHER.problem


def test_old_measurements_hold_the_arm():
    for name, age, holds in (
        ("arm_time", 0.04, False), ("arm_time", 0.06, True), ("arm_time", np.nan, True),
        ("hand_time", 0.4, False), ("hand_time", 0.6, True), ("left.time", 9.0, False),
    ):  # fmt: skip
        run = Watched()
        run.step(2)
        run.ages[name] = age
        run.step(2)
        assert run.status.holding is holds, (name, age)
        if holds:
            assert run.status.cause is Cause.ROBOT
            assert f"the {name.partition('_')[0]}'s last measurement" in run.status.reason


def test_a_lagging_diagram_and_a_lost_camera_hold_an_arm_that_moves():
    for name, age, cause in (
        ("arm_time", -0.1, Cause.ROBOT),
        ("left.time", 2.0, Cause.PERCEPTION),
        ("left.time", np.nan, Cause.PERCEPTION),
    ):
        run = Watched(camera_age=1.0)
        run.step(2)
        run.ages[name] = age
        run.step(5)
        assert not run.status.holding, run.status
        run.set(position_commanded=HOME + 0.001)
        run.step(2)
        assert run.status.holding and run.status.cause is cause
        np.testing.assert_allclose(run.position, HOME)


def test_acceleration_is_limited_where_it_is_asked_for():
    # Joint 2 may change its velocity by 7.5 rad/s^2: 0.0375 rad/s within a step.
    for scale, change_of_velocity, holds in ((1.0, 0.036, False), (1.0, 0.04, True),
                                             (0.5, 0.02, True), (None, 1.0, False)):  # fmt: skip
        run = Run(acceleration_scale=scale)
        run.step(2)
        run.set(position_commanded=HOME + change(2, change_of_velocity * STEP))
        run.step()
        assert run.status.holding is holds, (scale, change_of_velocity)
    assert run.status.reason == ""


class Gripping(Run):
    """With the hand's openings, sampled at its 10 Hz."""

    def __init__(self, **config):
        super().__init__(**config)
        self.hand(0.08, 0.08)
        self.step(2)

    def hand(self, commanded, measured, seconds=0.0):
        self.set(opening_commanded=[commanded], opening_measured=[measured])
        self.step(round(seconds / STEP))

    def close(self, to, *, commanded=0.0, start=0.08):
        """The fingers close at 0.1 m/s, and stay for a while."""
        self.hand(commanded, start, 0.4)  # a real hand takes its time to begin
        for opening in np.arange(start, to, -0.01):
            self.hand(commanded, opening, 0.1)
        self.hand(commanded, to, 0.6)


def test_a_lost_object_holds_the_arm():
    run = Gripping(grip_margin=0.003)
    run.close(0.032)
    run.set(position_commanded=HOME + 0.001)
    run.step(2)
    assert not run.status.holding, run.status
    run.hand(0.0, 0.001, 2 * STEP)
    assert run.status.holding and run.status.cause is Cause.CONTACT
    assert "lost what it held: its fingers closed from 3.2 cm to 0.1 cm" in run.status.reason
    np.testing.assert_allclose(run.position, HOME + 0.001)


def test_what_was_held_before_the_start_can_be_lost():
    run = Run(grip_margin=0.003)
    for opening, steps in ((0.02, 220), (0.0, 2)):
        run.set(opening_commanded=[0.0], opening_measured=[opening])
        run.step(steps)
    assert run.status.holding


def test_a_hand_that_does_what_it_is_told_has_lost_nothing():
    lost = Gripping(grip_margin=0.003)
    lost.close(0.0)  # on nothing
    lost.hand(0.08, 0.0, 0.5)  # slow to open
    lost.hand(0.08, 0.08, 0.5)
    lost.close(0.04, commanded=0.04)  # as far as it was told
    lost.hand(0.08, 0.08, 0.5)
    lost.close(0.03)  # holds,
    lost.hand(0.0, 0.029, 0.5)  # settles,
    lost.hand(0.08, 0.029, 0.3)  # lets go,
    lost.hand(0.08, 0.08, 0.5)
    lost.hand(0.06, 0.08, 0.5)  # and closes a bit, late
    lost.hand(0.06, 0.06, 0.5)
    assert not lost.status.holding, lost.status
    unchecked = Gripping()
    unchecked.close(0.03)
    unchecked.hand(0.0, 0.0, 0.1)
    assert not unchecked.status.holding
