"""What the server tells an arm before the first command comes."""

import numpy as np
from pydrake.lcm import DrakeLcm

from iga_drake.station.panda.server import PandaServer


def opening_told(**options: float) -> np.ndarray:
    server = PandaServer(DrakeLcm("memq://"), **options)
    context = server.CreateDefaultContext()
    server.GetInputPort("hand.opening_measured").FixValue(context, [0.03])
    return server.GetOutputPort("hand.opening").Eval(context)


def test_the_hand_rests_or_goes_on_to_hold():
    np.testing.assert_array_equal(opening_told(), [0.03])
    np.testing.assert_array_equal(opening_told(opening=0.0), [0.0])


def test_the_arm_rests():
    server = PandaServer(DrakeLcm("memq://"))
    context = server.CreateDefaultContext()
    position = np.linspace(-1, 1, 7)
    server.GetInputPort("panda.position_measured").FixValue(context, position)
    np.testing.assert_array_equal(server.GetOutputPort("panda.position").Eval(context), position)
