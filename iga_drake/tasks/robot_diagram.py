"""The diagram of an episode: station, perception, policy, motion and supervisor, wired together."""

from dataclasses import dataclass

from pydrake.geometry import Meshcat
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Diagram, DiagramBuilder

from iga_drake.aligners.protocol import Aligner
from iga_drake.demonstrations.demonstration import DemonstrationSet
from iga_drake.planning.inverse_kinematics import PoseSolver
from iga_drake.policy.iga_policy import IgaPolicy
from iga_drake.policy.machine import PolicyConfig, PolicyMachine, PolicyMemory
from iga_drake.station.panda.model import PandaModel, find_panda, gripper_cloud
from iga_drake.station.panda.planning import make_panda_planning_robot
from iga_drake.station.perception import add_fusion
from iga_drake.station.scenario import Scenario
from iga_drake.station.simulated.scene import Scene
from iga_drake.station.simulated.station import build_simulation_station
from iga_drake.systems.differential_ik import DifferentialIk, DifferentialIkConfig
from iga_drake.systems.external_force import ExternalForce
from iga_drake.systems.forward_kinematics import ForwardKinematics
from iga_drake.systems.fusion import PointCloudFusion
from iga_drake.systems.supervisor import Supervisor, SupervisorConfig
from iga_drake.systems.waypoint_follower import WaypointFollower, WaypointFollowerConfig
from iga_drake.tasks.task import Snapshot, Task, read_snapshot


@dataclass(frozen=True, kw_only=True)
class EpisodeDiagram:
    """A built diagram with its simulator at time 0, and the parts that one looks at."""

    scene: Scene
    diagram: Diagram
    simulator: Simulator
    station: Diagram
    plant: MultibodyPlant
    panda: PandaModel
    fusion: PointCloudFusion
    policy: IgaPolicy

    def snapshot(self) -> Snapshot:
        """The true state now; nothing of it reaches the policy."""
        context = self.plant.GetMyContextFromRoot(self.simulator.get_context())
        return read_snapshot(self.plant, context, self.panda)

    def policy_memory(self) -> PolicyMemory:
        """What the policy remembers now."""
        return self.policy.memory(self.policy.GetMyContextFromRoot(self.simulator.get_context()))


def build_episode_diagram(
    scenario: Scenario,
    *,
    task: Task,
    scene: Scene,
    seed: int,
    aligner: Aligner,
    demonstrations: DemonstrationSet | None,
    meshcat: Meshcat | None = None,
) -> EpisodeDiagram:
    """Builds the whole diagram for one scene.

    Args:
      scenario: cameras, speeds and limits.
      task: gives the motion around the waypoint.
      scene: what lies where at the start.
      seed: of camera noise and of the aligner.
      aligner: finds the waypoint.
      demonstrations: the aligner's context; None gives it an empty one.
      meshcat: where to show the scene.
    """
    builder = DiagramBuilder()
    station = builder.AddNamedSystem(
        "station", build_simulation_station(scenario, scene, seed=seed, meshcat=meshcat)
    )
    fusion = add_fusion(builder, station, scenario)
    robot = make_panda_planning_robot()
    control = scenario.control
    kinematics = builder.AddNamedSystem("forward_kinematics", ForwardKinematics(robot))
    force = builder.AddNamedSystem("external_force", ExternalForce(robot))
    solver = PoseSolver(robot)
    opening = scene.hand_opening if scene.hand_command is None else scene.hand_command
    follower = builder.AddNamedSystem(
        "follower",
        WaypointFollower(
            home=scene.panda_position,
            initial_opening=opening,
            config=WaypointFollowerConfig(
                time_step=control.period,
                linear_speed=control.linear_speed,
                angular_speed=control.angular_speed,
            ),
            solver=solver,
        ),
    )
    ik = builder.AddNamedSystem(
        "differential_ik",
        DifferentialIk(
            robot,
            DifferentialIkConfig(
                time_step=control.period, velocity_scale=control.joint_speed_scale
            ),
        ),
    )
    supervisor = builder.AddNamedSystem(
        "supervisor", Supervisor(robot, SupervisorConfig(time_step=control.period))
    )
    limits = scenario.time_limits
    policy = builder.AddNamedSystem(
        "policy",
        IgaPolicy(
            PolicyMachine(
                motion=task.motion,
                aligner=aligner,
                demonstrations=demonstrations,
                gripper_points=gripper_cloud(task.motion.opening_approach),
                solve=lambda X_WE, near: solver.solve(X_WE, near=near),
                config=PolicyConfig(
                    observe_target_limit=limits.observe_target,
                    observe_grasped_limit=limits.observe_grasped,
                    present_limit=limits.present,
                    infer_limit=limits.infer,
                    execute_limit=limits.execute,
                    minimum_familiarity=scenario.aligner.minimum_familiarity,
                    seed=seed + scenario.seeds.aligner,
                ),
            )
        ),
    )

    def connect(source, output: str, sink, port: str) -> None:
        builder.Connect(source.GetOutputPort(output), sink.GetInputPort(port))

    for name in ("target_cloud", "grasped_cloud", "camera_counts"):
        connect(fusion, name, policy, name)
    connect(station, "panda.position_measured", kinematics, "position")
    connect(kinematics, "pose", policy, "pose_measured")
    connect(station, "panda.position_measured", policy, "panda.position_measured")
    connect(follower, "status", policy, "follower.status")
    connect(supervisor, "status", policy, "supervisor.status")
    connect(policy, "target", follower, "target")
    connect(kinematics, "pose", follower, "pose_measured")
    connect(station, "panda.position_measured", follower, "position_measured")
    connect(station, "panda.position_measured", force, "position")
    connect(station, "panda.torque_external", force, "torque_external")
    connect(force, "force", follower, "force_measured")
    connect(follower, "desired_pose", ik, "desired_pose")
    connect(follower, "nominal_posture", ik, "nominal_posture")
    connect(ik, "position", supervisor, "position_commanded")
    connect(station, "panda.position_measured", supervisor, "position_measured")
    connect(station, "panda.velocity_measured", supervisor, "velocity_measured")
    connect(station, "panda.torque_external", supervisor, "torque_external")
    connect(supervisor, "position", station, "panda.position")
    connect(follower, "hand.opening", station, "hand.opening")

    diagram = builder.Build()
    diagram.set_name(f"{task.name}_episode")
    simulator = Simulator(diagram)
    ik.set_initial_position(simulator.get_mutable_context(), scene.panda_position)
    simulator.Initialize()
    plant = station.GetSubsystemByName("plant")
    return EpisodeDiagram(
        scene=scene,
        diagram=diagram,
        simulator=simulator,
        station=station,
        plant=plant,
        panda=find_panda(plant),
        fusion=fusion,
        policy=policy,
    )
