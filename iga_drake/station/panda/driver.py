"""The Panda's driver as configuration, in the manner of Drake's own (`ApplyDriverConfigs`)."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
from pydrake.lcm import DrakeLcm, DrakeLcmInterface
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import DiagramBuilder, InputPort, LeafSystem, OutputPort
from pydrake.systems.lcm import LcmBuses
from pydrake.systems.primitives import MatrixGain

from iga_drake.errors import check_bounds, check_range
from iga_drake.station.contract import StationError
from iga_drake.station.panda.command import Panda, PandaCommand
from iga_drake.station.panda.messages import CONTROL_MODES, ControlMode
from iga_drake.station.panda.model import PandaModel, find_panda
from iga_drake.station.panda.server import PandaServer, add_panda_server


@dataclass
class PandaDriver:
    """How the arm and its hand are driven.

    Over a bus whose URL is "memq://null" they are ports of the simulation. Over any other they are
    PANDA_COMMAND, PANDA_STATUS, PANDA_HAND_COMMAND and PANDA_HAND_STATUS, as
    RobotLocomotion/drake-franka-driver speaks them.
    """

    # Name in `lcm_buses`.
    lcm_bus: str = "default"
    # "position" or "velocity"; the driver's process must have been started in the same. Or
    # "status_only": the arm is guided by hand and measured, the hand alone is commanded.
    control_mode: str = "position"
    # A command whose stamp differs by more (s) from the robot's clock is dropped there.
    expiry: float = 0.05
    # Commands are sent only while the arm is within this of them (rad).
    tracking_error: float = 0.2
    # Largest distance (rad) of the arm's desired position from what was sent within so long (s). A
    # driver that smooths what it is sent follows later: `iga drive panda` by some 50 ms.
    following_error: float = 0.02
    following_time: float = 0.06
    # In velocity mode: how fast (1/s) the arm's distance to the commanded angles decays.
    velocity_gain: float = 5.0
    # Force (N) with which the hand closes.
    hand_force: float = 20.0

    def check(self, where: str = "PandaDriver") -> None:
        """Raises `ConfigError` for a value out of range."""
        modes, mode = ", ".join(CONTROL_MODES), self.control_mode
        check_range(mode in CONTROL_MODES, f"{where}.control_mode", mode, modes)
        check_bounds(
            self,
            where,
            {
                "expiry": (0.01, 1.0),
                "tracking_error": (1e-3, 1.0),
                "following_error": (1e-3, 1.0),
                "following_time": (0.01, 1.0),
                "velocity_gain": (0.0, 50.0),
                "hand_force": (1.0, 70.0),
            },
        )


def ApplyDriverConfig(
    driver_config: PandaDriver,
    model_instance_name: str,
    sim_plant: MultibodyPlant,
    models_from_directives_map: Mapping[str, Any],
    lcms: LcmBuses,
    builder: DiagramBuilder,
) -> None:
    """Drives a simulated Panda; Drake's `ApplyDriverConfigs` finds this function by its name.

    The model in the finalized `sim_plant` was added by `add_panda(controlled=True)`. Adds to
    `builder` the systems "panda.command" and, over LCM, "panda.server" and its subscribers. Without
    LCM the inputs of "panda.command" stay free.
    """
    driver_config.check()
    model = find_panda(sim_plant, sim_plant.GetModelInstanceByName(model_instance_name))
    ports = add_panda_ports(builder, model, Panda())
    lcm = _find_bus(builder, lcms, driver_config.lcm_bus, model_instance_name)
    if lcm.get_lcm_url() == LcmBuses.kLcmUrlMemqNull:
        return
    if lcm.get_lcm_url().startswith("memq://"):
        raise StationError(
            f"{model_instance_name}: bus '{driver_config.lcm_bus}' is '{lcm.get_lcm_url()}', which "
            f"stays in this process: state a udpm:// URL, or '{LcmBuses.kLcmUrlMemqNull}'"
        )
    server = PandaServer(
        DrakeLcm(lcm.get_lcm_url()),  # Drake's buses can't publish from Python
        control_mode=cast(ControlMode, driver_config.control_mode),
        expiry=driver_config.expiry,
    )
    add_panda_server(builder, server, lcm)
    connect_server(builder, server, ports)


def _find_bus(
    builder: DiagramBuilder, lcms: LcmBuses, bus: str, model_instance_name: str
) -> DrakeLcmInterface:
    """The bus by its name. With Drake 1.58, what `LcmBuses.Find` returns for a bus that is a system
    of the diagram ends the process at its first use, so the system itself is looked for first."""
    lcm = lcms.Find(f"driver of {model_instance_name}", bus)
    system = f"LcmInterfaceSystem(bus_name={bus})"
    if builder.HasSubsystemNamed(system):
        return cast(DrakeLcmInterface, builder.GetSubsystemByName(system))
    return lcm


def connect_server(
    builder: DiagramBuilder, server: LeafSystem, ports: Mapping[str, InputPort | OutputPort]
) -> None:
    """Connects a `PandaServer` or an `FciPort` to the arm's and the hand's ports by their names in
    the port contract."""
    for i in range(server.num_output_ports()):
        output = server.get_output_port(i)
        builder.Connect(output, cast(InputPort, ports[output.get_name()]))
    for i in range(server.num_input_ports()):
        name = server.get_input_port(i).get_name()
        if name in ports:
            builder.Connect(cast(OutputPort, ports[name]), server.get_input_port(i))


def add_panda_ports(
    builder: DiagramBuilder, model: PandaModel, config: Panda
) -> dict[str, InputPort | OutputPort]:
    """Adds the commands and measurements of a simulated Panda in a finalized plant; returns the
    arm's and the hand's ports by their names in the port contract (not `time` and `mode`)."""
    plant, instance = model.plant, model.instance
    command = builder.AddNamedSystem(
        "panda.command", PandaCommand(config, time_step=plant.time_step())
    )
    builder.Connect(
        command.GetOutputPort("desired_state"), plant.get_desired_state_input_port(instance)
    )
    ports: dict[str, InputPort | OutputPort] = {
        name: command.GetInputPort(name) for name in ("panda.position", "hand.opening")
    }

    # Where the joints stand in the robot's own state (q, v) and generalized force.
    nq, nv = plant.num_positions(instance), plant.num_velocities(instance)
    of_q = list(plant.GetPositionsFromArray(instance, np.arange(plant.num_positions())))
    of_v = list(plant.GetVelocitiesFromArray(instance, np.arange(plant.num_velocities())))
    arm_q = [of_q.index(joint.position_start()) for joint in model.arm_joints]
    arm_v = [of_v.index(joint.velocity_start()) for joint in model.arm_joints]
    opening = np.zeros((1, nq + nv))
    opening[0, [of_q.index(joint.position_start()) for joint in model.finger_joints]] = 1.0

    state = plant.get_state_output_port(instance)
    torque = plant.get_generalized_contact_forces_output_port(instance)
    for name, matrix, source in (
        ("panda.position_measured", np.eye(nq + nv)[arm_q], state),
        ("panda.velocity_measured", np.eye(nq + nv)[[nq + v for v in arm_v]], state),
        ("panda.torque_external", np.eye(nv)[arm_v], torque),
        ("hand.opening_measured", opening, state),
    ):
        gain = builder.AddNamedSystem(name, MatrixGain(matrix))
        builder.Connect(source, gain.get_input_port())
        ports[name] = gain.get_output_port()
    return ports
