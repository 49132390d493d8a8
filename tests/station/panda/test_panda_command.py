import numpy as np
import pytest
from pydrake.systems.analysis import Simulator

from iga_drake.station.panda.command import PandaCommand

STEP = 0.002


@pytest.fixture
def started():
    system = PandaCommand(time_step=STEP)
    simulator = Simulator(system)
    context = simulator.get_mutable_context()
    system.GetInputPort("panda.position").FixValue(context, np.arange(7) / 10)
    system.GetInputPort("hand.opening").FixValue(context, [0.08])
    return system, simulator, context


def desired_state(system, context):
    return system.GetOutputPort("desired_state").Eval(context)


def test_starts_at_the_first_command_at_rest(started):
    system, simulator, context = started
    expected = np.concatenate([np.arange(7) / 10, [0.04, 0.04], np.zeros(9)])
    np.testing.assert_allclose(desired_state(system, context), expected)
    simulator.AdvanceTo(0.1)
    np.testing.assert_allclose(desired_state(system, context), expected, atol=1e-12)


def test_follows_a_step_as_a_first_order_lag_whose_velocity_is_its_derivative(started):
    system, simulator, context = started
    simulator.AdvanceTo(STEP)
    start = np.arange(7) / 10
    goal = start + 0.1
    system.GetInputPort("panda.position").FixValue(context, goal)
    last = desired_state(system, context)[:7]
    for k in range(1, 30):
        simulator.AdvanceTo(STEP * (1 + k))
        now = desired_state(system, context)
        expected = goal - 0.1 * np.exp(-k * STEP / 0.01)
        np.testing.assert_allclose(now[:7], expected, atol=1e-9)
        np.testing.assert_allclose(now[9:16], (now[:7] - last) / STEP, atol=1e-9)
        last = now[:7]


def test_opening_moves_at_its_speed_and_is_shared(started):
    system, simulator, context = started
    simulator.AdvanceTo(STEP)
    system.GetInputPort("hand.opening").FixValue(context, [-1.0])  # clipped to closed
    simulator.AdvanceTo(STEP + 0.2)
    opening = system.GetOutputPort("hand.opening_commanded").Eval(context)[0]
    assert opening == pytest.approx(0.06, abs=2e-4)
    state = desired_state(system, context)
    np.testing.assert_allclose(state[7:9], opening / 2)
    np.testing.assert_allclose(state[16:18], -0.05)
    simulator.AdvanceTo(1.0)
    np.testing.assert_allclose(desired_state(system, context)[[7, 8, 16, 17]], 0.0, atol=1e-12)
