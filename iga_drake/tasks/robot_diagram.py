"""The robot's diagram: perception, policy, motion and supervisor around any station.

It is built on the port contract alone (`systems.ports`): the same in simulation, on the real arm,
and on a stub in a test.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from pydrake.geometry import Meshcat
from pydrake.systems.framework import Diagram, DiagramBuilder

from iga_drake.demonstrations.demonstration import DemonstrationSet
from iga_drake.planning.inverse_kinematics import PoseSolver
from iga_drake.policy.iga_policy import IgaPolicy
from iga_drake.policy.inference import Inference
from iga_drake.policy.machine import OnRobot, PolicyMachine
from iga_drake.policy.motion import TaskMotion
from iga_drake.station.cameras.rgbd import camera_info
from iga_drake.station.log.recorder import EpisodeRecorder, add_recorder
from iga_drake.station.log.writer import EpisodeLogWriter
from iga_drake.station.panda.model import gripper_cloud
from iga_drake.station.panda.planning import make_panda_planning_robot
from iga_drake.station.panda.self_filter import make_panda_self_filter
from iga_drake.station.perception import add_fusion
from iga_drake.station.scenario import Scenario
from iga_drake.systems.differential_ik import DifferentialIk
from iga_drake.systems.external_force import ExternalForce
from iga_drake.systems.forward_kinematics import ForwardKinematics
from iga_drake.systems.fusion import PointCloudFusion
from iga_drake.systems.supervisor import Supervisor
from iga_drake.systems.waypoint_follower import WaypointFollower
from iga_drake.viewing.policy_views import add_policy_views

_ON_ROBOT = 0.003  # m from the robot's shapes: what a depth camera is off at its surface
# Every wire of the robot but the cameras': "system.port" of the source -> those of
# the sinks. The station's own ports have names with a dot as well: the system is the first part.
WIRES: Mapping[str, tuple[str, ...]] = {
    "station.panda.position_measured": (
        "forward_kinematics.position",
        "external_force.position",
        "policy.panda.position_measured",
        "follower.position_measured",
        "differential_ik.position_measured",
        "supervisor.position_measured",
    ),
    "station.panda.velocity_measured": ("supervisor.velocity_measured",),
    "station.panda.torque_external": (
        "external_force.torque_external",
        "supervisor.torque_external",
    ),
    "station.panda.time": ("supervisor.arm_time",),
    "station.hand.time": ("supervisor.hand_time",),
    "station.panda.mode": ("supervisor.mode",),
    "station.hand.opening_measured": ("supervisor.opening_measured",),
    "fusion.target_cloud": ("policy.target_cloud",),
    "fusion.grasped_cloud": ("policy.grasped_cloud",),
    "fusion.camera_counts": ("policy.camera_counts",),
    "fusion.cloud_losses": ("policy.cloud_losses",),
    "forward_kinematics.pose": ("policy.pose_measured", "follower.pose_measured"),
    "external_force.force": ("follower.force_measured",),
    "policy.target": ("follower.target",),
    "follower.status": ("policy.follower.status",),
    "follower.desired_pose": ("differential_ik.desired_pose",),
    "follower.nominal_posture": ("differential_ik.nominal_posture",),
    "follower.hand.opening": ("station.hand.opening", "supervisor.opening_commanded"),
    "differential_ik.position": ("supervisor.position_commanded",),
    "supervisor.position": ("station.panda.position",),
    "supervisor.status": ("policy.supervisor.status",),
}


@dataclass(frozen=True, kw_only=True)
class RobotDiagram:
    """The built diagram and the parts of it that one looks at."""

    diagram: Diagram
    station: Diagram
    fusion: PointCloudFusion
    policy: IgaPolicy


def build_robot_diagram(
    scenario: Scenario,
    station: Diagram,
    *,
    motion: TaskMotion,
    inference: Inference,
    demonstrations: DemonstrationSet | None,
    seed: int = 0,
    meshcat: Meshcat | None = None,
    log: EpisodeLogWriter | None = None,
    image_period: float | None = None,
) -> RobotDiagram:
    """Builds the whole robot around a station.

    Args:
      scenario: cameras, speeds, limits.
      station: exports the port contract for the scenario's cameras.
      motion: what the task observes and how it moves around its waypoints.
      inference: finds the waypoints.
      demonstrations: give the hand's openings, and the geometric segmenter the target's shape;
        None takes the openings from `motion`.
      seed: of the aligner, with `scenario.seeds.aligner` added.
      meshcat: where to show what the policy sees, infers and is about to do; None shows nothing.
      log: where to record it; None records nothing.
      image_period: how often (s) to record images that nobody looks at, of cameras that make them
        when they are asked for; None records those that the policy looks at.

    Where the arm starts is not asked: everything begins with the joints as first measured.
    """
    builder = DiagramBuilder()
    builder.AddNamedSystem("station", station)
    fusion = add_fusion(builder, station, scenario, demonstrations)
    robot = make_panda_planning_robot(scenario.table, scenario.planning)
    solver = PoseSolver(robot, config=scenario.planning)
    period = scenario.control.period
    policy = IgaPolicy(
        PolicyMachine(
            motion=motion,
            inference=inference,
            demonstrations=demonstrations,
            gripper=gripper_cloud,
            solve=lambda X_WE, near: solver.solve(X_WE, near=near),
            config=scenario.policy,
            workspace=(
                np.array(scenario.supervisor.workspace_lower),
                np.array(scenario.supervisor.workspace_upper),
            ),
            on_robot=_on_robot(),
            seed=seed + scenario.seeds.aligner,
        )
    )
    systems: dict[str, Any] = {"station": station, "fusion": fusion}
    for name, system in (
        ("forward_kinematics", ForwardKinematics(robot)),
        ("external_force", ExternalForce(robot)),
        ("policy", policy),
        ("follower", WaypointFollower(solver=solver, config=scenario.control)),
        ("differential_ik", DifferentialIk(robot, scenario.differential_ik, period=period)),
        (
            "supervisor",
            Supervisor(robot, scenario.supervisor, period=period, cameras=scenario.camera_names),
        ),
    ):
        systems[name] = builder.AddNamedSystem(name, system)
    for source, sinks in WIRES.items():
        output, port = source.split(".", 1)
        for sink in sinks:
            into, name = sink.split(".", 1)
            builder.Connect(systems[output].GetOutputPort(port), systems[into].GetInputPort(name))
    if meshcat is not None:
        _add_views(builder, scenario, systems, meshcat, motion, demonstrations)
    for camera in scenario.camera_names:
        port = f"{camera}.time"
        builder.Connect(station.GetOutputPort(port), systems["supervisor"].GetInputPort(port))
    if log is not None:
        _add_recorder(builder, scenario, systems, motion, log, image_period)
    diagram = builder.Build()
    diagram.set_name("robot")
    return RobotDiagram(diagram=diagram, station=station, fusion=fusion, policy=policy)


def _on_robot() -> OnRobot:
    """Tells which points lie on the Panda."""
    own = make_panda_self_filter()

    def on_robot(points: np.ndarray, position: np.ndarray, opening: float) -> np.ndarray:
        return own.near(points.T, position, opening, margin=_ON_ROBOT)

    return on_robot


def _add_views(
    builder: DiagramBuilder,
    scenario: Scenario,
    systems: Mapping[str, Any],
    meshcat: Meshcat,
    motion: TaskMotion,
    demonstrations: DemonstrationSet | None,
) -> None:
    """Adds the views of `viewing.policy_views`."""
    policy = systems["policy"]
    names = [policy.get_output_port(i).get_name() for i in range(policy.num_output_ports())]
    outputs = {name: policy.GetOutputPort(name) for name in names}
    outputs["pose_measured"] = systems["forward_kinematics"].GetOutputPort("pose")
    outputs["path"] = systems["follower"].GetOutputPort("path")
    for camera in scenario.camera_names:
        for kind in ("color_image", "pose"):
            outputs[f"{camera}.{kind}"] = systems["station"].GetOutputPort(f"{camera}.{kind}")
    add_policy_views(
        builder,
        meshcat,
        outputs=outputs,
        motion=motion,
        cameras={n: camera_info(camera.intrinsics) for n, camera in scenario.cameras.items()},
        demonstrations=demonstrations,
        period=scenario.visualization.publish_period,
    )


def _add_recorder(
    builder: DiagramBuilder,
    scenario: Scenario,
    systems: Mapping[str, Any],
    motion: TaskMotion,
    log: EpisodeLogWriter,
    image_period: float | None,
) -> None:
    """Adds the recorder of the raw log."""
    outputs = {}
    for system in (systems["station"], systems["policy"]):
        for i in range(system.num_output_ports()):
            outputs[system.get_output_port(i).get_name()] = system.get_output_port(i)
    outputs["panda.position"] = systems["supervisor"].GetOutputPort("position")
    outputs["hand.opening"] = systems["follower"].GetOutputPort("hand.opening")
    outputs["supervisor.status"] = systems["supervisor"].GetOutputPort("status")
    outputs["pose_measured"] = systems["forward_kinematics"].GetOutputPort("pose")
    recorder = EpisodeRecorder(
        log,
        {name: camera.intrinsics for name, camera in scenario.cameras.items()},
        motion,
        control_period=scenario.control.period,
        policy_period=scenario.policy.period,
        image_period=image_period,
    )
    add_recorder(builder, recorder, outputs)
