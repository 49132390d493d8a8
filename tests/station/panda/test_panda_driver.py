"""Drake's own `ApplyDriverConfigs` with a Panda, in process and over LCM."""

import time
from types import SimpleNamespace

import numpy as np
import pytest
from drake import lcmt_panda_status
from pydrake.lcm import DrakeLcm, DrakeLcmParams
from pydrake.manipulation import ApplyDriverConfigs
from pydrake.multibody.plant import (
    AddMultibodyPlant,
    AddMultibodyPlantSceneGraph,
    MultibodyPlantConfig,
)
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.lcm import ApplyLcmBusConfig, LcmBuses

from iga_drake.station.contract import StationError
from iga_drake.station.lcm import utime_of
from iga_drake.station.panda import messages
from iga_drake.station.panda.driver import ApplyDriverConfig, PandaDriver
from iga_drake.station.panda.model import HOME_POSITION, add_panda
from iga_drake.systems.ports import ArmMode

HOME = np.array(HOME_POSITION)


def simulated(url: str):
    """A Panda at home in a plant of its own, driven as `url` says; the diagram and its plant."""
    builder = DiagramBuilder()
    config = MultibodyPlantConfig(time_step=0.002, discrete_contact_approximation="sap")
    plant, _ = AddMultibodyPlant(config=config, builder=builder)
    panda = add_panda(plant, visuals="none", controlled=True)
    plant.Finalize()
    for joint, angle in zip(panda.arm_joints, HOME, strict=True):
        joint.set_default_positions([angle])
    ApplyDriverConfigs(
        driver_configs={"panda": PandaDriver()},
        sim_plant=plant,
        models_from_directives=[],
        lcm_buses=ApplyLcmBusConfig({"default": DrakeLcmParams(lcm_url=url)}, builder),
        builder=builder,
    )
    return builder, panda


def test_in_process_the_ports_stay_free():
    builder, panda = simulated(LcmBuses.kLcmUrlMemqNull)
    command = builder.GetSubsystemByName("panda.command")
    builder.ExportInput(command.GetInputPort("panda.position"), "position")
    builder.ExportInput(command.GetInputPort("hand.opening"), "opening")
    simulator = Simulator(builder.Build())
    context = simulator.get_mutable_context()
    simulator.get_system().GetInputPort("position").FixValue(context, HOME + 0.1)
    simulator.get_system().GetInputPort("opening").FixValue(context, [0.04])
    simulator.AdvanceTo(0.3)
    plant = panda.plant
    q = panda.get_position(plant.GetMyContextFromRoot(context))
    np.testing.assert_allclose(q, HOME + 0.1, atol=1e-3)


def test_a_bus_within_the_process_is_refused():
    # Drake's own bus of this kind can't be asked for its URL with Drake 1.58, which crashes.
    builder = DiagramBuilder()
    plant, _ = AddMultibodyPlantSceneGraph(builder, time_step=0.002)
    add_panda(plant, visuals="none", controlled=True)
    plant.Finalize()
    buses = SimpleNamespace(Find=lambda *_: DrakeLcm("memq://"))
    with pytest.raises(StationError, match="stays in this process"):
        ApplyDriverConfig(PandaDriver(), "panda", plant, {}, buses, builder)


def test_over_lcm_the_simulated_arm_speaks_as_the_real_one():
    url = "udpm://239.255.76.68:7699?ttl=0"
    lcm = DrakeLcm(url)
    lcm.Subscribe("test", lambda data: None)
    lcm.Publish("test", b"x")
    # A container may have no network that carries multicast; no driver works there either. The same
    # messages are tested without a network in test_rehearsal.py.
    if not lcm.HandleSubscriptions(500):
        pytest.skip("no UDP multicast on this machine")
    builder, panda = simulated(url)
    simulator = Simulator(builder.Build())
    got: list[bytes] = []
    lcm.Subscribe(messages.STATUS_CHANNEL, got.append)
    target = HOME + 0.05
    for k in range(200):
        command = messages.arm_command(
            HOME + 0.05 * min(k / 100, 1.0), mode="position", utime=utime_of(time.time())
        )
        lcm.Publish(messages.COMMAND_CHANNEL, command.encode())
        simulator.AdvanceTo(0.005 * (k + 1))
        lcm.HandleSubscriptions(0)
    q = panda.get_position(panda.plant.GetMyContextFromRoot(simulator.get_context()))
    np.testing.assert_allclose(q, target, atol=5e-3)
    status = lcmt_panda_status.decode(got[-1])
    np.testing.assert_allclose(status.joint_position, q, atol=5e-3)
    assert messages.arm_mode(status) is ArmMode.READY
