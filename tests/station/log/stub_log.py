"""Episodes on the stub that tests of the log record and play."""

from pathlib import Path
from typing import Any

import numpy as np
from pydrake.systems.analysis import Simulator
from robot_stub import make_scenario, stub_station

from iga_drake.aligners.protocol import PoseEstimate
from iga_drake.policy.inference import LocalInference
from iga_drake.station.log.writer import EpisodeLogWriter
from iga_drake.station.scenario import Scenario
from iga_drake.tasks.grasp import Grasp
from iga_drake.tasks.robot_diagram import RobotDiagram, build_robot_diagram

START, END = 1.7e9, 1.2  # s


class Above:
    """An aligner that wants the hand above the target's middle, turned as its points lie."""

    name = "above"

    def align(self, context, grasped, target, *, grasped_up=None, target_up=None, seed=0):
        X = np.diag([1.0, -1.0, -1.0, 1.0])
        X[:3, 3] = target.mean(0) + [0, 0, 0.12]
        poses = np.stack([X, X])
        poses[1, 2, 3] += float(np.std(target))
        return PoseEstimate(poses, np.array([-1.0, 0.5]), np.array([0.7, 0.3]))


def build(scenario: Scenario, station: Any, **options: Any) -> tuple[RobotDiagram, Simulator]:
    built = build_robot_diagram(
        scenario,
        station,
        motion=Grasp.motion,
        inference=LocalInference(Above(), [()]),
        demonstrations=None,
        **options,
    )
    simulator = Simulator(built.diagram)
    simulator.Initialize()
    return built, simulator


def memory(built: RobotDiagram, simulator: Simulator) -> Any:
    return built.policy.memory(built.policy.GetMyContextFromRoot(simulator.get_context()))


def short_scenario() -> Scenario:
    scenario = make_scenario()
    scenario.policy.observe_settle = 0.3
    return scenario


def record(path: Path, until: float, **options: Any) -> tuple[Scenario, Any]:
    """Records up to `until` (s); returns the scenario and the policy's memory then."""
    scenario = short_scenario()
    metadata = {"scenario": scenario.to_yaml(), "task": "grasp", "start": repr(START)}
    with EpisodeLogWriter(path, metadata=metadata, start=START) as log:
        built, simulator = build(scenario, stub_station(scenario), log=log, **options)
        simulator.AdvanceTo(until)
    assert (log.problem, log.dropped) == ("", 0)
    return scenario, memory(built, simulator)
