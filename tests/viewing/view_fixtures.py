"""A small robot whose thoughts are shown, shared by the tests of views and of pages."""

import functools
from dataclasses import dataclass

import numpy as np
from pydrake.geometry import Meshcat
from pydrake.systems.analysis import Simulator
from robot_stub import make_scenario, stub_station

from iga_drake.aligners.protocol import PoseEstimate
from iga_drake.policy.inference import LocalInference
from iga_drake.policy.motion import Phase, PolicyStatus
from iga_drake.tasks.grasp import Grasp
from iga_drake.tasks.robot_diagram import RobotDiagram, build_robot_diagram
from iga_drake.viewing.meshcat import start_meshcat
from iga_drake.viewing.replay import begin_recording, end_recording

# Of the two modes that the stub's aligner answers with.
ENERGIES, PROBABILITIES = (-2.5, -1.25), (0.75, 0.25)
END = 4.0  # s, in the middle of the motion: the waypoint was just reached


class TwoModes:
    """Wants the hand 12 cm above the middle of the target's cloud, or beside that."""

    name = "two modes"

    def align(self, context, grasped, target, *, grasped_up=None, target_up=None, seed=0):
        poses = np.tile(np.diag([1.0, -1.0, -1.0, 1.0]), (2, 1, 1))
        poses[:, :3, 3] = target.mean(0) + [[0.0, 0.0, 0.12], [0.1, 0.0, 0.12]]
        return PoseEstimate(poses, np.array(ENERGIES), np.array(PROBABILITIES))


def build_shown(meshcat: Meshcat | None) -> tuple[RobotDiagram, Simulator]:
    """The robot's diagram on a station without physics, not begun yet."""
    scenario = make_scenario()
    built = build_robot_diagram(
        scenario,
        stub_station(scenario),
        motion=Grasp.motion,
        inference=LocalInference(TwoModes(), [()]),
        demonstrations=None,
        meshcat=meshcat,
    )
    return built, Simulator(built.diagram)


@dataclass(frozen=True)
class Shown:
    """A run that was shown and recorded until `END`."""

    meshcat: Meshcat
    robot: RobotDiagram
    simulator: Simulator

    @property
    def status(self) -> PolicyStatus:
        policy = self.robot.policy
        return policy.memory(policy.GetMyContextFromRoot(self.simulator.get_context())).status


@functools.cache
def shown_run() -> Shown:
    """The same run for all tests of a process."""
    meshcat = start_meshcat()
    begin_recording(meshcat, live=True)
    robot, simulator = build_shown(meshcat)
    simulator.AdvanceTo(END)
    end_recording(meshcat)
    shown = Shown(meshcat, robot, simulator)
    assert shown.status.phase is Phase.MOVE, shown.status
    return shown
