"""Teaching on the hardware station: an arm behind LCM that is guided, and that is jogged."""

from pathlib import Path

import numpy as np
import pytest
from pydrake.lcm import DrakeLcm
from pydrake.math import RigidTransform
from pydrake.systems.framework import Diagram, DiagramBuilder
from rig import START, BadLinkServer, add_arm, clock, hardware_scenario
from robot_stub import BALL, HOME, RADIUS

from iga_drake.demonstrations.demonstration import Provenance
from iga_drake.station.hardware.station import build_hardware_station
from iga_drake.station.panda.client import PandaStart
from iga_drake.systems.ports import ArmMode
from iga_drake.tasks.grasp import Grasp
from iga_drake.tasks.holding import end_effector_pose
from iga_drake.tasks.teaching import TeachingError, TeachingSession


class Cell:
    """The hardware station, and behind its bus an arm, in one diagram with the port contract."""

    def __init__(self, folder: Path, control_mode: str) -> None:
        scenario = hardware_scenario(folder, None)
        scenario.model_drivers["panda"].control_mode = control_mode
        builder, lcm = DiagramBuilder(), DrakeLcm("memq://")
        hardware = build_hardware_station(
            scenario, start=PandaStart(START, 0.08), clock=clock, lcms={"default": lcm}
        )
        hardware.set_name("hardware")
        builder.AddSystem(hardware)
        self.faults: dict = {}
        self.arm, server, _ = add_arm(builder, scenario, lcm, faults=self.faults)
        self.server: BadLinkServer = server
        for i in range(hardware.num_input_ports()):
            port = hardware.get_input_port(i)
            builder.ExportInput(port, port.get_name())
        for i in range(hardware.num_output_ports()):
            builder.ExportOutput(
                hardware.get_output_port(i), hardware.get_output_port(i).get_name()
            )
        station: Diagram = builder.Build()
        station.set_name("station")
        self.session = TeachingSession(
            scenario,
            station,
            motion=Grasp.motion,
            provenance=Provenance(source="taught on the arm"),
            restores=False,
        )

    def told(self, port: str) -> np.ndarray:
        """What the arm behind the bus is told."""
        context = self.arm.GetMyContextFromRoot(self.session.simulator.get_context())
        return self.arm.GetInputPort(port).Eval(context)


def test_an_arm_that_is_only_measured_is_taught_by_guiding_it(tmp_path: Path):
    cell = Cell(tmp_path, "status_only")
    session = cell.session
    cell.server.robot_mode = ArmMode.GUIDING
    session.advance(0.5)
    assert session.guided and session.warning == ""
    session.look()
    pan = session.observations["pan"].points
    np.testing.assert_allclose(np.linalg.norm(pan - BALL, axis=1), RADIUS, atol=0.004)
    joints = HOME + [0.2, 0.3, 0.0, -0.2, 0.0, 0.1, 0.0]
    cell.faults["panda.position_measured"] = joints
    session.advance(0.2)
    waypoint = session.record()
    np.testing.assert_allclose(waypoint.X_WE, end_effector_pose(joints).GetAsMatrix4(), atol=1e-6)
    session.toggle_hand()  # commanded whatever the arm's mode is
    session.advance(0.3)
    assert cell.told("hand.opening")[0] == 0.0
    (recorded,) = session.demonstration().waypoints
    assert recorded.opening == 0.0
    # The arm itself is told nothing: it is held where it was when its driver began.
    np.testing.assert_allclose(cell.told("panda.position"), START, atol=1e-9)
    with pytest.raises(TeachingError, match="guided by hand"):
        session.go(RigidTransform(end_effector_pose(HOME)))
    cell.server.robot_mode = ArmMode.REFLEX
    session.advance(0.1)
    assert "reflex" in session.warning


def test_an_arm_that_follows_is_jogged_over_the_bus(tmp_path: Path):
    session = Cell(tmp_path, "position").session
    session.advance(0.3)
    goal = RigidTransform(session.pose.rotation(), session.pose.translation() + [0.03, 0.0, -0.03])
    assert session.go(goal) and session.warning == ""
    np.testing.assert_allclose(session.pose.translation(), goal.translation(), atol=3e-3)
