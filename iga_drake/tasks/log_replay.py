"""Raw logs looked at again: played to Meshcat, or to the robot's diagram with any aligner."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from pydrake.geometry import Meshcat, SceneGraph
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import MatrixGain, Multiplexer
from pydrake.systems.rendering import MultibodyPositionToGeometryPose

from iga_drake.demonstrations.store import read_demonstrations
from iga_drake.policy.inference import WorkerInference
from iga_drake.policy.motion import Phase
from iga_drake.station.cameras.rgbd import camera_info
from iga_drake.station.log.player import LogPlayer, make_log_station
from iga_drake.station.log.reader import EpisodeLog
from iga_drake.station.panda.model import add_panda
from iga_drake.station.panda.planning import make_panda_planning_robot
from iga_drake.station.scenario import Scenario
from iga_drake.systems.forward_kinematics import ForwardKinematics
from iga_drake.systems.ports import PANDA_JOINTS
from iga_drake.tasks.episode import demonstrations_path
from iga_drake.tasks.registry import scenario_task
from iga_drake.tasks.robot_diagram import build_robot_diagram
from iga_drake.viewing.meshcat import Visualization, add_visualizers
from iga_drake.viewing.policy_views import CameraViews, ObservedClouds, PhaseText, PredictedPoses


def replay_log(log: EpisodeLog, meshcat: Meshcat) -> None:
    """Shows a log in Meshcat, which records: the arm as it was measured, images, observed clouds,
    the aligner's modes and the policy's phases, each at its time."""
    scenario = log.scenario()
    motion = scenario_task(scenario).motion
    builder = DiagramBuilder()
    scene_graph = builder.AddSystem(SceneGraph())
    plant = MultibodyPlant(0.0)  # for its geometry alone: nothing is simulated
    plant.RegisterAsSourceForSceneGraph(scene_graph)
    panda = add_panda(plant)
    plant.Finalize()
    player = builder.AddNamedSystem("player", LogPlayer(log, scenario))

    joints = np.zeros((plant.num_positions(), PANDA_JOINTS + 1))
    for k, joint in enumerate(panda.arm_joints):
        joints[joint.position_start(), k] = 1.0
    for joint in panda.finger_joints:
        joints[joint.position_start(), PANDA_JOINTS] = 0.5
    both = builder.AddSystem(Multiplexer([PANDA_JOINTS, 1]))
    gain = builder.AddSystem(MatrixGain(joints))
    pose = builder.AddSystem(MultibodyPositionToGeometryPose(plant))
    measured = player.GetOutputPort("panda.position_measured")
    builder.Connect(measured, both.get_input_port(0))
    builder.Connect(player.GetOutputPort("hand.opening_measured"), both.get_input_port(1))
    builder.Connect(both.get_output_port(), gain.get_input_port())
    builder.Connect(gain.get_output_port(), pose.get_input_port())
    builder.Connect(pose.get_output_port(), scene_graph.get_source_pose_port(plant.get_source_id()))
    shown = replace(scenario.visualization, contacts=False, proximity=False)
    add_visualizers(builder, config=shown, plant=plant, scene_graph=scene_graph, meshcat=meshcat)
    kinematics = builder.AddSystem(ForwardKinematics(make_panda_planning_robot(scenario.table)))
    builder.Connect(measured, kinematics.get_input_port())
    cameras = {name: camera_info(camera.intrinsics) for name, camera in scenario.cameras.items()}
    period = Visualization().publish_period
    for view in (
        ObservedClouds(meshcat, motion, period=period),
        PredictedPoses(meshcat, motion, period=period),
        CameraViews(meshcat, cameras, period=period),
        PhaseText(meshcat, motion, period=period),
    ):
        builder.AddSystem(view)
        for index in range(view.num_input_ports()):
            port = view.get_input_port(index)
            source = kinematics if port.get_name() == "pose_measured" else player
            name = "pose" if source is kinematics else port.get_name()
            builder.Connect(source.GetOutputPort(name), port)
    simulator = Simulator(builder.Build())
    simulator.Initialize()
    simulator.AdvanceTo(log.duration)


def log_row(log: EpisodeLog) -> Mapping[str, Any]:
    """The episode's outcome as plain JSON values, as far as the log goes."""
    if log.verdict is not None:
        return log.verdict
    status = log.last_status
    ended = status.phase.final
    return {
        "task": log.metadata.get("task", ""),
        "aligner": log.metadata.get("aligner", ""),
        "seed": log.metadata.get("seed", ""),
        "split": log.metadata.get("split", ""),
        "success": False,
        "cause": "" if status.cause is None else status.cause.value,
        "reason": status.reason if ended else "the log breaks off",
        "simulated_seconds": log.duration,
        "waypoints": [],
        "timeline": [e.row() for e in status.timeline],
    }


@dataclass(frozen=True)
class InferredAgain:
    """One waypoint's pose as it was inferred then and from the log now; None where it wasn't."""

    name: str
    X_WE_then: RigidTransform | None
    X_WE_now: RigidTransform | None

    @property
    def difference(self) -> tuple[float, float] | None:
        """Distance and angle between the two (m, rad)."""
        if self.X_WE_then is None or self.X_WE_now is None:
            return None
        X = self.X_WE_then.InvertAndCompose(self.X_WE_now)
        return (
            float(np.linalg.norm(X.translation())),
            float(abs(X.rotation().ToAngleAxis().angle())),
        )


def infer_again(
    log: EpisodeLog, *, aligner: str, scenario: Scenario | None = None
) -> tuple[tuple[InferredAgain, ...], str]:
    """Plays the log to the robot's diagram, from the images to the poses; nothing moves.

    What the policy asks for and the log doesn't have, images of another place say, ends it.

    Args:
      aligner: its name.
      scenario: how perception and policy are set; default: as they were.

    Returns the waypoints, and why the policy ended early (empty where it didn't).
    """
    scenario = scenario or log.scenario()
    scenario = replace(scenario, policy=replace(scenario.policy, inference="lockstep"))
    task = scenario_task(scenario)
    found = read_demonstrations(demonstrations_path(scenario), task=task.name)
    found = found.first(min(scenario.context_size, len(found)))
    own = scenario.aligner.options if aligner == scenario.aligner.name else {}
    inference = WorkerInference(aligner, own, found.contexts)
    try:
        built = build_robot_diagram(
            scenario,
            make_log_station(log, scenario),
            motion=task.motion,
            inference=inference,
            demonstrations=found,
            seed=int(log.metadata.get("draws", "0")),
        )
        simulator = Simulator(built.diagram)
        simulator.Initialize()

        def memory() -> Any:
            return built.policy.memory(built.policy.GetMyContextFromRoot(simulator.get_context()))

        count = len(task.motion.waypoints)
        while simulator.get_context().get_time() < log.duration - 1e-9:
            now = simulator.get_context().get_time()
            simulator.AdvanceTo(min(now + scenario.policy.period, log.duration))
            if memory().status.phase.final or len(memory().chosen) == count:
                break
        last = memory()
    finally:
        inference.close()
    then = log.chosen.values[-1] if log.chosen.values else ()
    waypoints = tuple(
        InferredAgain(
            waypoint.name,
            then[index].X_WE if index < len(then) else None,
            last.chosen[index].X_WE if index < len(last.chosen) else None,
        )
        for index, waypoint in enumerate(task.motion.waypoints)
    )
    ended = last.status.phase in (Phase.REFUSED, Phase.FAILED)
    return waypoints, last.status.reason if ended else ""
