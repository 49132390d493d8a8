"""The station's client of the arm and of the hand, on a bus on which others talk as well."""

import numpy as np
from pydrake.lcm import DrakeLcm
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.lcm import LcmInterfaceSystem
from pydrake.systems.primitives import ConstantVectorSource
from rig import EPOCH, START, clock

from iga_drake.station.lcm import utime_of
from iga_drake.station.panda import messages
from iga_drake.station.panda.client import PandaClient, PandaStart, add_panda_client
from iga_drake.station.panda.driver import PandaDriver
from iga_drake.systems.ports import ArmMode


def test_a_minute_of_foreign_messages_changes_nothing():
    """Noise, torn messages, those of other types, and the right ones in between."""
    lcm, rng = DrakeLcm("memq://"), np.random.default_rng(0)
    builder = DiagramBuilder()
    builder.AddSystem(LcmInterfaceSystem(lcm))
    client = PandaClient(
        PandaDriver(), lcm, start=PandaStart(START, 0.04), period=0.02, clock=clock
    )
    add_panda_client(builder, client, lcm)
    for port, value in (("panda.position", START), ("hand.opening", [0.04])):
        source = builder.AddSystem(ConstantVectorSource(value))
        builder.Connect(source.get_output_port(), client.GetInputPort(port))
    diagram = builder.Build()
    simulator = Simulator(diagram)
    simulator.Initialize()
    for k in range(1, 3_000):
        now = 0.02 * k
        opening = 0.04 + 0.01 * np.sin(now)
        hand = messages.hand_status(opening, utime=utime_of(EPOCH + now)).encode()
        arm = messages.arm_status(
            position=START + 0.01 * np.sin(now),
            velocity=np.zeros(7),
            torque_external=np.zeros(7),
            position_desired=START,
            mode=ArmMode.READY,
            utime=utime_of(EPOCH + now),
        ).encode()
        for channel, own, other in (
            (messages.STATUS_CHANNEL, arm, hand),
            (messages.HAND_STATUS_CHANNEL, hand, arm),
        ):
            junk = (rng.bytes(50), b"", own[: rng.integers(len(own))], other, own + b"\x00")
            lcm.Publish(channel, own)
            for data in (*junk, own[:8] + rng.bytes(len(own) - 8)):
                lcm.Publish(channel, data)
            lcm.Publish(channel, own)
        simulator.AdvanceTo(now)
    context = client.GetMyContextFromRoot(simulator.get_context())

    def read(name: str) -> np.ndarray:
        return client.GetOutputPort(name).Eval(context)

    np.testing.assert_allclose(read("panda.position_measured"), START + 0.01 * np.sin(now),
                               atol=4e-4)  # fmt: skip
    np.testing.assert_allclose(read("hand.opening_measured"), opening, atol=4e-4)
    assert ArmMode(int(read("panda.mode")[0])) is ArmMode.READY
