"""Follows random reachable poses with differential inverse kinematics and watches every limit."""

import argparse
import json as json_format
import math
import time
from dataclasses import asdict, dataclass

import numpy as np
from pydrake.common.value import Value
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, DiagramBuilder, EventStatus
from pydrake.systems.primitives import ConstantVectorSource

from iga_drake.errors import IgaDrakeError
from iga_drake.planning.inverse_kinematics import PoseSolver
from iga_drake.planning.planning_robot import PlanningConfig, PlanningRobot
from iga_drake.progress import progress
from iga_drake.station.panda.planning import make_panda_planning_robot
from iga_drake.station.scenario import Scenario
from iga_drake.systems.differential_ik import DifferentialIk
from iga_drake.systems.forward_kinematics import ForwardKinematics
from iga_drake.systems.messages import NO_TARGET, EndEffectorTarget
from iga_drake.systems.waypoint_follower import WaypointFollower, WaypointFollowerConfig

_TIME_LIMIT = 20.0  # simulated s for one pose
# Quicker than the scenario's: limits are more likely to be met.
_CONTROL = WaypointFollowerConfig(period=0.005, linear_speed=0.25, angular_speed=math.radians(90))

_MOST_POSES = 1000  # tried for one that can be reached


@dataclass(frozen=True)
class IkBenchmark:
    """Totals over the motions to all poses. A limit was broken if its count isn't zero."""

    count: int
    reached: int
    # Steps at which a joint was outside of its position limits, moved faster than its velocity
    # limit, or two links (or a link and the table) were in contact.
    position_violations: int
    velocity_violations: int
    collision_violations: int
    # Largest joint velocity as a share of its limit; least distance (rad) to a position limit and
    # (m) between two bodies.
    max_velocity_ratio: float
    min_position_margin: float
    min_distance: float
    steps: int
    simulated_seconds: float
    seconds: float
    milliseconds_per_step: float

    @property
    def reached_fraction(self) -> float:
        """Share of the poses that were reached within the follower's tolerances."""
        return self.reached / self.count

    @property
    def limits_kept(self) -> bool:
        """Whether no limit was broken at any step."""
        return not (
            self.position_violations or self.velocity_violations or self.collision_violations
        )


class _Watch:
    """Notes how near each simulated step came to a limit."""

    def __init__(self, robot: PlanningRobot, diagram, position_port, period: float) -> None:
        self._robot, self._diagram, self._period = robot, diagram, period
        self._position_port = position_port
        limits = robot.limits
        self._lower, self._upper = limits.position_lower(), limits.position_upper()
        self._velocity = limits.velocity_upper()
        self._last: np.ndarray | None = None
        self._last_time = 0.0
        self.seconds = 0.0  # spent in here
        self.steps = self.position = self.velocity = self.collision = 0
        self.ratio, self.margin, self.distance = 0.0, np.inf, np.inf

    def __call__(self, root_context: Context) -> EventStatus:
        start, now = time.perf_counter(), root_context.get_time()
        if self._last is not None and now < self._last_time + 0.5 * self._period:
            return EventStatus.DidNothing()
        q = self._position_port.Eval(self._diagram.GetMyContextFromRoot(root_context)).copy()
        margin = float(np.minimum(q - self._lower, self._upper - q).min())
        distance = self._robot.clearance(q, influence=0.05)
        ratio = 0.0
        if self._last is not None:
            ratio = float((np.abs(q - self._last) / (now - self._last_time) / self._velocity).max())
        self.steps += 1
        self.position += margin < 0
        self.velocity += ratio > 1
        self.collision += distance <= 0
        self.ratio = max(self.ratio, ratio)
        self.margin, self.distance = min(self.margin, margin), min(self.distance, distance)
        self._last, self._last_time = q, now
        self.seconds += time.perf_counter() - start
        return EventStatus.Succeeded()


def random_reachable_pose(
    solver: PoseSolver, random: np.random.Generator, near: np.ndarray
) -> tuple[np.ndarray, RigidTransform]:
    """A random pose X_WE in front of the robot and joint angles (rad) that reach it.

    E lies in a box of 0.4 m x 0.8 m x 0.5 m above the table; it points down, tilted by up to 60
    degrees to any side, at any angle about its own axis. Raises `IgaDrakeError` where none can be
    reached.
    """
    for _ in range(_MOST_POSES):
        p_WE = random.uniform([0.3, -0.4, 0.02], [0.7, 0.4, 0.52])
        tilt, side, turn = random.uniform([0, -np.pi, -np.pi], [np.pi / 3, np.pi, np.pi])
        R_WE = (
            RotationMatrix.MakeZRotation(side)
            @ RotationMatrix.MakeYRotation(tilt)
            @ RotationMatrix.MakeZRotation(turn - side)
            @ RotationMatrix.MakeXRotation(np.pi)
        )
        X_WE = RigidTransform(R_WE, p_WE)
        q = solver.solve(X_WE, near=near)
        if q is not None:
            return q, X_WE
    raise IgaDrakeError(f"{_MOST_POSES} random poses in a row can't be reached from {near}")


def benchmark_ik(count: int = 1000, seed: int = 0, json: bool = False) -> IkBenchmark:
    """Follows `count` random reachable poses one after the other and prints what was seen.

    Each is followed from where the arm stands, through the waypoint follower and differential
    inverse kinematics; the joint angles that the solver finds for it are the nominal posture.
    """
    if count < 1:
        raise IgaDrakeError(f"count {count}: at least one pose is needed")
    scenario = Scenario()
    robot = make_panda_planning_robot(scenario.table, scenario.planning)
    # The watch measures distances to the table where it really is.
    truth = make_panda_planning_robot(
        scenario.table, PlanningConfig(safety_distance=0.0, table_distance=0.0)
    )
    solver = PoseSolver(robot)
    builder = DiagramBuilder()
    follower = builder.AddSystem(WaypointFollower(solver=solver, config=_CONTROL))
    controller = builder.AddSystem(
        DifferentialIk(robot, scenario.differential_ik, period=_CONTROL.period)
    )
    start_posture = builder.AddSystem(ConstantVectorSource(robot.home))
    builder.Connect(start_posture.get_output_port(), controller.GetInputPort("position_measured"))
    kinematics = builder.AddSystem(ForwardKinematics(robot))
    for name in ("desired_pose", "nominal_posture"):
        builder.Connect(follower.GetOutputPort(name), controller.GetInputPort(name))
    position = controller.GetOutputPort("position")
    builder.Connect(position, kinematics.GetInputPort("position"))
    builder.Connect(position, follower.GetInputPort("position_measured"))
    builder.Connect(kinematics.GetOutputPort("pose"), follower.GetInputPort("pose_measured"))
    builder.ExportInput(follower.GetInputPort("target"), "target")
    diagram = builder.Build()

    simulator = Simulator(diagram)
    context = simulator.get_mutable_context()
    watch = _Watch(truth, controller, position, _CONTROL.period)
    target_port, status_port = diagram.GetInputPort("target"), follower.GetOutputPort("status")
    target_port.FixValue(context, Value[object](NO_TARGET))
    simulator.set_monitor(watch)
    simulator.Initialize()

    random = np.random.default_rng(seed)
    start, reached = time.perf_counter(), 0
    solve_seconds = 0.0
    for sequence in progress(range(1, count + 1), "poses"):
        solve_start = time.perf_counter()
        posture, X_WE = random_reachable_pose(solver, random, near=robot.home)
        solve_seconds += time.perf_counter() - solve_start
        target = EndEffectorTarget(
            sequence=sequence,
            X_WE=X_WE,
            opening_moving=0.08,
            opening_reached=0.08,
            nominal_posture=posture,
        )
        target_port.FixValue(context, Value[object](target))
        end = context.get_time() + _TIME_LIMIT
        last_error, stalled = np.inf, 0
        while context.get_time() < end and stalled < 20:
            simulator.AdvanceTo(context.get_time() + 0.1)
            status = status_port.Eval(follower.GetMyContextFromRoot(context))
            if status.sequence_reached == sequence:
                reached += 1
                break
            error = status.position_error + status.rotation_error
            stalled = stalled + 1 if abs(last_error - error) < 1e-4 else 0
            last_error = error
    seconds = time.perf_counter() - start
    result = IkBenchmark(
        count=count,
        reached=reached,
        position_violations=watch.position,
        velocity_violations=watch.velocity,
        collision_violations=watch.collision,
        max_velocity_ratio=watch.ratio,
        min_position_margin=watch.margin,
        min_distance=watch.distance,
        steps=watch.steps,
        simulated_seconds=context.get_time(),
        seconds=seconds,
        milliseconds_per_step=1e3 * (seconds - watch.seconds - solve_seconds) / watch.steps,
    )
    print(json_format.dumps(asdict(result)) if json else _describe(result))
    return result


def _describe(result: IkBenchmark) -> str:
    return "\n".join(
        [
            f"poses followed          {result.count}",
            f"reached                 {result.reached} ({100 * result.reached_fraction:.1f} %)",
            f"position limits broken  {result.position_violations} of {result.steps} steps "
            f"(least margin {result.min_position_margin:.4f} rad)",
            f"velocity limits broken  {result.velocity_violations} of {result.steps} steps "
            f"(largest share {result.max_velocity_ratio:.3f})",
            f"collisions              {result.collision_violations} of {result.steps} steps "
            f"(least distance {1e3 * result.min_distance:.1f} mm)",
            f"time                    {result.seconds:.0f} s for {result.simulated_seconds:.0f} s "
            f"simulated, {result.milliseconds_per_step:.2f} ms per step",
        ]
    )


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `iga benchmark ik`."""
    parser.add_argument("--count", type=int, default=1000, help="number of poses")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", action="store_true", help="print one JSON object")


def run(arguments: argparse.Namespace) -> int:
    """Exit status 0 only if no limit was broken."""
    result = benchmark_ik(arguments.count, arguments.seed, arguments.json)
    return 0 if result.limits_kept else 1
