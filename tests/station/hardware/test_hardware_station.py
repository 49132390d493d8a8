"""The whole robot around the hardware station: the same task as on a stub, over LCM."""

from pathlib import Path

import numpy as np
import pytest
from pydrake.lcm import DrakeLcm, DrakeLcmParams
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from rig import START, add_arm, clock, hardware_scenario
from robot_stub import BALL, RADIUS

from iga_drake.aligners.protocol import PoseEstimate
from iga_drake.errors import ConfigError
from iga_drake.policy.inference import LocalInference
from iga_drake.policy.motion import Phase
from iga_drake.station.contract import StationError
from iga_drake.station.hardware.calibration import CalibrationFileError
from iga_drake.station.hardware.station import build_hardware_station
from iga_drake.station.make import make_station
from iga_drake.station.panda.client import PandaStart
from iga_drake.station.scenario import Scenario
from iga_drake.station.simulated.scene import Scene
from iga_drake.tasks.grasp import Grasp
from iga_drake.tasks.robot_diagram import build_robot_diagram


class Above:
    """Wants the hand 12 cm above the middle of the target's cloud."""

    name = "above"

    def align(self, context, grasped, target, *, grasped_up=None, target_up=None, seed=0):
        X = np.diag([1.0, -1.0, -1.0, 1.0])
        X[:3, 3] = target.mean(0) + [0, 0, 0.12]
        return PoseEstimate(X[None], np.zeros(1), np.ones(1))


def test_does_the_task_over_lcm(tmp_path: Path):
    scenario = hardware_scenario(tmp_path, None)
    scenario.control.period = 0.01
    scenario.supervisor.acceleration_scale = 1.0
    lcm = DrakeLcm("memq://")
    builder = DiagramBuilder()
    start = PandaStart(START, 0.08)
    station = build_hardware_station(scenario, start=start, clock=clock, lcms={"default": lcm})
    robot = build_robot_diagram(
        scenario,
        station,
        motion=Grasp.motion,
        inference=LocalInference(Above(), [()]),
        demonstrations=None,
    )
    builder.AddSystem(robot.diagram)
    arm, _, _ = add_arm(builder, scenario, lcm)
    diagram = builder.Build()
    simulator = Simulator(diagram)

    def status():
        policy = robot.policy
        return policy.memory(policy.GetMyContextFromRoot(simulator.get_context())).status

    for k in range(1, 16):
        simulator.AdvanceTo(float(k))
        if status().phase.final:
            break
    assert status().phase is Phase.DONE, status().reason
    (reached,) = status().waypoints_reached
    np.testing.assert_allclose(reached.translation()[:2], BALL[:2], atol=RADIUS / 2)
    context = arm.GetMyContextFromRoot(simulator.get_context())
    moved = arm.GetOutputPort("panda.position_measured").Eval(context) - START
    assert np.abs(moved).max() > 0.1


def test_a_camera_without_calibration_is_refused(tmp_path: Path):
    scenario = hardware_scenario(tmp_path)
    (tmp_path / "right.yaml").unlink()
    with pytest.raises(CalibrationFileError, match=r"right\.yaml: can't be read"):
        build_hardware_station(scenario, start=PandaStart(START, 0.08), clock=clock)


def test_a_station_without_drivers_is_refused(tmp_path: Path):
    scenario = hardware_scenario(tmp_path)
    scenario.hardware.boot_limit = 0.0
    with pytest.raises(StationError, match="PANDA_STATUS: 0 of 5 messages"):
        make_station(scenario)
    scenario.lcm_buses = Scenario().lcm_buses
    with pytest.raises(StationError, match=r"lcm_buses\.default\.lcm_url: 'memq://null' is no bus"):
        make_station(scenario)


def test_commands_slower_than_their_expiry_are_refused(tmp_path: Path):
    scenario = hardware_scenario(tmp_path)
    scenario.control.period = 0.03
    with pytest.raises(ConfigError, match=r"control\.period: 0\.03"):
        build_hardware_station(scenario, start=PandaStart(START, 0.08), clock=clock)


def test_the_simulated_station_has_ports_and_no_bus(tmp_path: Path):
    scenario = hardware_scenario(tmp_path)
    scenario.station = "simulated"
    scenario.lcm_buses = {"default": DrakeLcmParams(lcm_url="memq://")}
    scene = Scene(objects=(), panda_position=START, hand_opening=0.04)
    with pytest.raises(StationError, match=r"model_drivers\.panda: .* choose station 'hardware'"):
        make_station(scenario, scene=scene)
