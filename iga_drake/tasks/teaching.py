"""Teaching: a person moves the hand, and what the cameras see becomes a demonstration.

`TeachingSession` is one demonstration in the making. It knows the station by the port contract
alone, so that it is the same in simulation, on the real arm, and on a stub in a test: an arm that
follows commands is jogged, one that is guided by hand is measured.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.geometry import Meshcat
from pydrake.math import RigidTransform
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, Diagram, DiagramBuilder

from iga_drake.demonstrations.demonstration import (
    HAND_OPENING_MAX,
    Demonstration,
    Observation,
    Provenance,
    Trajectory,
    Waypoint,
)
from iga_drake.demonstrations.plausibility import check_plausible
from iga_drake.errors import IgaDrakeError
from iga_drake.planning.inverse_kinematics import PoseSolver
from iga_drake.planning.routes import pose_error
from iga_drake.policy.motion import (
    MotionStep,
    ObservationPlan,
    Refusal,
    TaskMotion,
    WaypointMotion,
    check_cameras,
    check_observation,
    check_workspace,
    motion_steps,
    moved_steps,
)
from iga_drake.station.make import make_station
from iga_drake.station.panda.model import find_panda, gripper_cloud
from iga_drake.station.panda.planning import make_panda_planning_robot
from iga_drake.station.perception import add_fusion
from iga_drake.station.scenario import Scenario
from iga_drake.systems.differential_ik import DifferentialIk
from iga_drake.systems.external_force import ExternalForce
from iga_drake.systems.forward_kinematics import ForwardKinematics
from iga_drake.systems.jog import Jog
from iga_drake.systems.messages import FollowerStatus, JogGoal, SupervisorStatus
from iga_drake.systems.ports import ArmMode
from iga_drake.systems.supervisor import Supervisor
from iga_drake.tasks.distractors import with_distractors
from iga_drake.tasks.predicates import Verdict
from iga_drake.tasks.registry import scenario_task
from iga_drake.tasks.robot_diagram import WIRES
from iga_drake.tasks.snapshots import Snapshot, TaskError, read_snapshot
from iga_drake.version import code_version

TICK = 0.05  # s between two looks at the person's wishes
_SAMPLE_EVERY = 2  # ticks between two samples of a trajectory
_STILL = 0.2  # s for which a hand has to be still before the cameras' images count
_MOVED = (0.002, math.radians(1.0))  # m, rad that a still hand may move meanwhile
CONTACT_FORCE = 15.0  # N against the hand's motion at which it ends
# m, rad within which the hand still is at a waypoint: what it is told there is the waypoint's.
_AT_WAYPOINT = (0.01, math.radians(5.0))
_GUIDED = (ArmMode.GUIDING, ArmMode.IDLE)  # modes in which a person may move the arm
_AFTER = 3.0  # s for which the world goes on after a replay, before it is judged


class TeachingError(IgaDrakeError):
    """What the person asked for can't be done now; the message says why and what to do."""


@dataclass(frozen=True)
class PreviewPose:
    """One pose on the way around the recorded waypoints, and whether it can be reached."""

    name: str
    X_WE: RigidTransform
    at_waypoint: bool
    # Why the robot can't get there; empty if it can.
    problem: str = ""


@dataclass(frozen=True)
class _Moment:
    """What `undo` goes back to."""

    waypoints: tuple[Waypoint, ...]
    observations: Mapping[str, Observation]
    samples: tuple[tuple[float, np.ndarray, float], ...]
    snapshots: tuple[Snapshot, ...]
    goal: JogGoal
    # The simulation's state; None for a world that can't be put back.
    context: Context | None


class TeachingSession:
    """One demonstration in the making: jog, look, record, undo, preview, replay.

    Every motion is made through the controller of the episodes (differential inverse kinematics
    and supervisor). What can't be done raises `TeachingError` and changes nothing.
    """

    def __init__(
        self,
        scenario: Scenario,
        station: Diagram,
        *,
        motion: TaskMotion,
        provenance: Provenance,
        restores: bool,
        read_truth: Callable[[Context], Snapshot] | None = None,
        judge: Callable[[Sequence[Snapshot]], Verdict] | None = None,
    ) -> None:
        """
        Args:
          scenario: cameras, speeds, limits.
          station: exports the port contract for the scenario's cameras.
          motion: what the task observes, and its waypoints.
          provenance: of the demonstration.
          restores: whether the whole world is in the diagram's context, so that `undo` and `replay`
            can put it back.
          read_truth: of a simulation, to tell whether the task is done: the true state in a context
            of the diagram.
          judge: of a simulation: the verdict on such states.
        """
        self.scenario, self.motion, self.restores = scenario, motion, restores
        self.proceed: Callable[[], bool] = lambda: True
        self._provenance, self._read_truth, self._judge = provenance, read_truth, judge
        robot = make_panda_planning_robot(scenario.table, scenario.planning)
        self._solver = PoseSolver(robot, config=scenario.planning)
        period = scenario.control.period
        self._systems: dict[str, Any] = {
            "station": station,
            "forward_kinematics": ForwardKinematics(robot),
            "external_force": ExternalForce(robot),
            "follower": Jog(scenario.control),
            "differential_ik": DifferentialIk(robot, scenario.differential_ik, period=period),
            "supervisor": Supervisor(
                robot, scenario.supervisor, period=period, cameras=scenario.camera_names
            ),
        }
        self._diagram = self._build()
        self.simulator = Simulator(self._diagram)
        self._send(JogGoal(opening=motion.waypoints[0].opening_approach))
        self.simulator.Initialize()
        self._observations: dict[str, Observation] = {}
        self._waypoints: tuple[Waypoint, ...] = ()
        self._samples: list[tuple[float, np.ndarray, float]] = []
        self._snapshots: list[Snapshot] = []
        self._moments: list[_Moment] = []
        self._ticks, self._replays, self._began = 0, False, self.time
        self._touched_in = 0  # sequence of the goal that ended in contact last
        self._start = self._moment()

    def _build(self) -> Diagram:
        builder = DiagramBuilder()
        station = self._systems["station"]
        for name, system in self._systems.items():
            builder.AddNamedSystem(name, system)
        self._systems["fusion"] = add_fusion(builder, station, self.scenario)
        for source, sinks in WIRES.items():
            output, port = source.split(".", 1)
            for sink in sinks:
                into, name = sink.split(".", 1)
                if output in self._systems and into in self._systems:
                    builder.Connect(
                        self._systems[output].GetOutputPort(port),
                        self._systems[into].GetInputPort(name),
                    )
        supervisor = self._systems["supervisor"]
        for camera in self.scenario.camera_names:
            port = f"{camera}.time"
            builder.Connect(station.GetOutputPort(port), supervisor.GetInputPort(port))
        diagram = builder.Build()
        diagram.set_name("teaching")
        return diagram

    # What is now

    def _eval(self, system: str, port: str) -> Any:
        built = self._systems[system]
        context = built.GetMyContextFromRoot(self.simulator.get_context())
        return built.GetOutputPort(port).Eval(context)

    @property
    def time(self) -> float:
        """Time on the diagram's clock (s)."""
        return self.simulator.get_context().get_time()

    @property
    def pose(self) -> RigidTransform:
        """The measured X_WE."""
        return RigidTransform(self._eval("forward_kinematics", "pose"))

    @property
    def goal(self) -> RigidTransform:
        """X_WE where the hand has to go; the measured pose where there is no goal."""
        return self.pose if self._goal.X_WE is None else self._goal.X_WE

    @property
    def opening(self) -> float:
        """The opening (m) that the hand is told."""
        return self._goal.opening

    @property
    def opening_measured(self) -> float:
        """The measured opening (m)."""
        return float(self._eval("station", "hand.opening_measured")[0])

    @property
    def mode(self) -> ArmMode:
        """Whether the arm follows commands, and if not, why."""
        return ArmMode(int(self._eval("station", "panda.mode")[0]))

    @property
    def guided(self) -> bool:
        """Whether a person moves the arm by hand, or may: it doesn't follow commands."""
        return self.mode is not ArmMode.READY

    @property
    def moving(self) -> bool:
        """Whether the hand is on its way to a goal."""
        status: FollowerStatus = self._eval("follower", "status")
        return self._goal.X_WE is not None and status.sequence_reached < self._goal.sequence

    @property
    def touched(self) -> bool:
        """Whether contact ended the last motion."""
        return self._eval("follower", "status").touched

    @property
    def warning(self) -> str:
        """Why the hand shouldn't be where it is, or doesn't move; empty if all is well."""
        if not np.isfinite(self.pose.GetAsMatrix34()).all():
            return "the arm's joints aren't measured: look at its driver"
        if reason := check_workspace(self.pose, self._workspace):
            return f"the hand {reason}"
        if self.guided:
            return "" if self.mode in _GUIDED else self.mode.problem
        status: SupervisorStatus = self._eval("supervisor", "status")
        return f"the arm is held: {status.reason}" if status.holding else ""

    @property
    def _workspace(self) -> tuple[np.ndarray, np.ndarray]:
        limits = self.scenario.supervisor
        return np.array(limits.workspace_lower), np.array(limits.workspace_upper)

    @property
    def verdict(self) -> Verdict | None:
        """Whether the task is done by now; None where nobody knows the truth."""
        if self._judge is None:
            return None
        try:
            return self._judge(self._snapshots)
        except TaskError as error:
            return Verdict(False, str(error))

    @property
    def snapshots(self) -> tuple[Snapshot, ...]:
        """The true states so far, one a tick, but for what was taken back; empty where nobody knows
        the truth."""
        return tuple(self._snapshots)

    def clouds(self) -> dict[str, np.ndarray]:
        """What the cameras see now, points (P, 3) (m, in W) by role: "target" and "grasped"."""
        return {
            role: self._eval("fusion", f"{role}_cloud").xyzs().T.copy()
            for role in ("target", "grasped")
        }

    @property
    def observations(self) -> Mapping[str, Observation]:
        """The clouds looked at so far, by the names that the task gives them."""
        return dict(self._observations)

    @property
    def waypoints(self) -> tuple[Waypoint, ...]:
        """The waypoints recorded so far."""
        return self._waypoints

    @property
    def next_waypoint(self) -> WaypointMotion | None:
        """The waypoint to record next; None once all are."""
        index = len(self._waypoints)
        return self.motion.waypoints[index] if index < len(self.motion.waypoints) else None

    @property
    def complete(self) -> bool:
        """Whether all waypoints are recorded."""
        return self.next_waypoint is None

    @property
    def missing(self) -> tuple[str, ...]:
        """Observations that the next waypoint relates and that are still to be looked at."""
        following = self.next_waypoint
        needed = () if following is None else (following.target, following.grasped)
        return tuple(name for name in needed if name not in self._observations)

    # Motion

    def _send(self, goal: JogGoal) -> None:
        self._goal = goal
        jog = self._systems["follower"]
        context = jog.GetMyMutableContextFromRoot(self.simulator.get_mutable_context())
        jog.GetInputPort("goal").FixValue(context, AbstractValue.Make(goal))

    def advance(self, duration: float = TICK) -> None:
        """Goes on for `duration` (s), rounded to whole ticks of `TICK`."""
        for _ in range(max(1, round(duration / TICK))):
            self.simulator.AdvanceTo(TICK * (round(self.time / TICK) + 1))
            self._follow_the_arm()
            if self._read_truth is not None:
                self._snapshots.append(self._read_truth(self.simulator.get_context()))
            if not self._replays and self._ticks % _SAMPLE_EVERY == 0:
                pose, opening = self.pose.GetAsMatrix4(), self.opening_measured
                if np.isfinite(pose).all() and np.isfinite(opening):
                    self._samples.append((self.time - self._began, pose, opening))
            self._ticks += 1

    def _follow_the_arm(self) -> None:
        """Puts the goal to where the arm is, where that decides and not the goal."""
        if self._goal.X_WE is None:
            return
        if self.guided:
            self._send(replace(self._goal, X_WE=None))
        elif self.touched and self._touched_in != self._goal.sequence:
            self._touched_in = self._goal.sequence
            self._send(replace(self._goal, X_WE=self.pose))

    def move_to(
        self,
        X_WE: RigidTransform,
        *,
        contact_force: float | None = CONTACT_FORCE,
        speed_scale: float = 1.0,
    ) -> str:
        """Gives the hand a goal, to which `advance` moves it; a goal outside the workspace is moved
        to its border. Returns why it was moved; empty if it wasn't.

        The motion ends where a force resists it by more than `contact_force` (N; None: by any)."""
        self._check_follows()
        if not np.isfinite(X_WE.GetAsMatrix34()).all():
            raise TeachingError("the goal holds values that aren't finite")
        reason = check_workspace(X_WE, self._workspace)
        if reason:
            lower, upper = self._workspace
            inside = np.clip(X_WE.translation(), lower + 0.003, upper - 0.003)
            X_WE = RigidTransform(X_WE.rotation(), inside)
        self._send(
            JogGoal(
                sequence=self._goal.sequence + 1,
                X_WE=X_WE,
                opening=self._goal.opening,
                contact_force=contact_force,
                speed_scale=speed_scale,
            )
        )
        return f"the goal {reason}" if reason else ""

    def go(
        self,
        X_WE: RigidTransform,
        *,
        contact_force: float | None = CONTACT_FORCE,
        speed_scale: float = 1.0,
        limit: float = 30.0,
    ) -> bool:
        """Moves the hand to a pose and returns once it is there, or where it touched something,
        which is told by False. Not within `limit` (s) is an error."""
        if reason := check_workspace(X_WE, self._workspace):
            raise TeachingError(f"the pose {reason}")
        self.move_to(X_WE, contact_force=contact_force, speed_scale=speed_scale)
        end = self.time + limit
        while self.moving:
            if not self.proceed():
                self.stop()
                raise TeachingError("stopped")
            self._check_follows()
            if self.time >= end:
                self.stop()
                raise TeachingError(
                    f"the hand didn't get there within {limit:g} s: the way is blocked or out of "
                    "reach; move it on by hand"
                )
            self.advance()
        return not self.touched

    def stop(self) -> None:
        """Keeps the hand where it is."""
        if not self.guided:
            self._send(replace(self._goal, sequence=self._goal.sequence + 1, X_WE=self.pose))

    def release(self) -> None:
        """Lets the arm follow commands again after the supervisor has held it, from where it is.

        A hardware station's link to the arm stays ended; then the session has to be begun anew."""
        context = self.simulator.get_mutable_context()
        for name in ("follower", "differential_ik", "supervisor"):
            system = self._systems[name]
            own = system.GetMyMutableContextFromRoot(context)
            system.SetDefaultContext(own)
        self._send(replace(self._goal, X_WE=None))

    def _check_follows(self) -> None:
        if self.guided:
            raise TeachingError(f"the arm doesn't follow commands: {self.mode.problem}")
        status: SupervisorStatus = self._eval("supervisor", "status")
        if status.holding:
            raise TeachingError(
                f"the arm is held: {status.reason}: take back the last waypoint, or release it"
            )

    @property
    def openings(self) -> tuple[float, float]:
        """The openings (m) of a closed and of an open hand at the present waypoint."""
        motion = self.motion.waypoints[max(0, len(self._waypoints) - 1)]
        if not self._at_last_waypoint() and self.next_waypoint is not None:
            motion = self.next_waypoint
        low, high = sorted((motion.opening_approach, motion.opening_reached))
        if low < high:
            return low, high
        return (low, HAND_OPENING_MAX) if low < HAND_OPENING_MAX / 2 else (0.0, high)

    def toggle_hand(self) -> None:
        """Opens a closed hand, and closes an open one, as wide as the task does it there."""
        closed, opened = self.openings
        self.set_opening(opened if self.opening < (closed + opened) / 2 else closed)

    def set_opening(self, opening: float) -> None:
        """Tells the hand its opening (m). At the waypoint recorded last it becomes that
        waypoint's."""
        if not 0.0 <= opening <= HAND_OPENING_MAX:
            raise TeachingError(f"opening {opening:g} m: 0 to {HAND_OPENING_MAX} m expected")
        self._send(replace(self._goal, opening=opening))
        if self._at_last_waypoint():
            last = replace(self._waypoints[-1], opening=opening)
            self._waypoints = (*self._waypoints[:-1], last)

    def _at_last_waypoint(self) -> bool:
        if not self._waypoints:
            return False
        errors = pose_error(self.pose, RigidTransform(self._waypoints[-1].X_WE))
        return errors[0] <= _AT_WAYPOINT[0] and errors[1] <= _AT_WAYPOINT[1]

    # Observations and waypoints

    def look(self) -> tuple[str, ...]:
        """Looks at all that is due: what the next waypoints relate and no recorded one does.

        Where the task shows an object to the cameras, an arm that follows commands goes there
        first. Returns the names of what was seen.
        """
        self.advance(self.scenario.policy.observe_settle)
        relied = {name for w in self._waypoints for name in (w.grasped, w.target)}
        seen: dict[str, Observation] = {}
        for plan in self.motion.observations:
            if plan.after > len(self._waypoints) or plan.name in relied:
                continue
            if plan.present is not None and not self.guided:
                self.go(plan.present)
                self.advance(self.scenario.policy.observe_settle)
            seen[plan.name] = self._observe(plan)
        if not seen:
            raise TeachingError("there is nothing to look at: all that is due has been seen")
        self._observations.update(seen)
        return tuple(seen)

    def _observe(self, plan: ObservationPlan) -> Observation:
        self._check_still()
        X_EW = self.pose.inverse()
        if plan.role == "gripper":
            first = next(w for w in self.motion.waypoints if w.grasped == plan.name)
            points = gripper_cloud(first.opening_approach)
        else:
            policy = self.scenario.policy
            try:
                check_cameras(self._eval("fusion", "camera_counts"), policy.minimum_cameras)
                points = check_observation(
                    self._eval("fusion", f"{plan.role}_cloud").xyzs().T.copy(),
                    plan.name,
                    minimum=policy.minimum_points,
                    why=lambda: self._eval("fusion", "cloud_losses").get(plan.role, ""),
                )
            except Refusal as refusal:
                raise TeachingError(str(refusal)) from refusal
            if plan.frame == "E":
                points = X_EW.multiply(points.T).T
        down = np.array([0.0, 0.0, -1.0])
        return Observation(
            points=points,
            role=plan.role,
            frame=plan.frame,
            time=self.time - self._began,
            gravity=down if plan.frame == "W" else X_EW.rotation() @ down,
            upright=plan.upright and self.scenario.policy.up,
        )

    def _check_still(self) -> None:
        before = self.pose
        self.advance(_STILL)
        moved = pose_error(before, self.pose)
        if not (moved[0] <= _MOVED[0] and moved[1] <= _MOVED[1]):  # NaN as well
            raise TeachingError(
                f"the hand moved by {1000 * moved[0]:.0f} mm and {math.degrees(moved[1]):.0f} deg "
                f"within {_STILL} s: hold it still while the cameras look"
            )

    def record(self) -> Waypoint:
        """Records the next waypoint where the hand is measured now.

        Its opening is what the hand is told there, now or before it moves on.
        """
        following = self.next_waypoint
        if following is None:
            raise TeachingError(
                f"all {len(self._waypoints)} waypoints are recorded: save, or take one back"
            )
        if self.missing:
            raise TeachingError(
                f"waypoint '{following.name}': {', '.join(self.missing)} not seen yet: look first"
            )
        X_WE = self.pose
        if not np.isfinite(X_WE.GetAsMatrix34()).all():
            raise TeachingError(self.warning)
        if self.moving:
            raise TeachingError(
                f"waypoint '{following.name}': the hand is on its way: wait, or stop it"
            )
        if reason := check_workspace(X_WE, self._workspace):
            raise TeachingError(f"waypoint '{following.name}': the hand {reason}")
        waypoint = Waypoint(
            name=following.name,
            X_WE=X_WE.GetAsMatrix4(),
            opening=self.opening,
            grasped=following.grasped,
            target=following.target,
        )
        check_plausible(self._demonstration((*self._waypoints, waypoint)))
        self._moments.append(self._moment())
        self._waypoints = (*self._waypoints, waypoint)
        return waypoint

    def _moment(self) -> _Moment:
        return _Moment(
            waypoints=self._waypoints,
            observations=dict(self._observations),
            samples=tuple(self._samples),
            snapshots=tuple(self._snapshots),
            goal=self._goal,
            context=self.simulator.get_context().Clone() if self.restores else None,
        )

    def _restore(self, moment: _Moment) -> None:
        self._waypoints, self._observations = moment.waypoints, dict(moment.observations)
        if moment.context is None:
            return
        self._samples, self._snapshots = list(moment.samples), list(moment.snapshots)
        self.simulator.reset_context(moment.context.Clone())
        self._send(moment.goal)
        self.simulator.Initialize()

    def undo(self) -> str:
        """Takes back the last waypoint and returns its name. In simulation everything is as it was
        when it was recorded; where none was, as at the start."""
        if not self._waypoints:
            self.restart()
            return ""
        name = self._waypoints[-1].name
        self._restore(self._moments.pop())
        return name

    def restart(self) -> None:
        """Begins the demonstration anew; in simulation the scene as well."""
        self._moments.clear()
        self._restore(self._start)
        if not self.restores:
            self._samples.clear()
            self._began = self.time

    # What was taught

    def _steps(self, index: int) -> tuple[MotionStep, ...]:
        """The policy's way around a recorded waypoint, with what it shows to the cameras before."""
        waypoint, motion = self._waypoints[index], self.motion.waypoints[index]
        X_WE = RigidTransform(waypoint.X_WE)
        return motion_steps(X_WE, motion, first_sequence=0, opening_reached=waypoint.opening)

    def _presented(self, index: int) -> tuple[ObservationPlan, ...]:
        return tuple(
            plan
            for plan in self.motion.observations
            if plan.after == index and plan.present is not None
        )

    def preview(self) -> tuple[PreviewPose, ...]:
        """The poses that the robot would go through for the waypoints recorded so far, from where
        this demonstration began, and which of them it can't reach."""
        poses: list[PreviewPose] = []
        near: np.ndarray = np.array(self._eval("station", "panda.position_measured"))
        if self._samples:
            poses.append(PreviewPose("start", RigidTransform(self._samples[0][1]), False))
        for index in range(len(self._waypoints)):
            rows = [(f"show {p.name}", p.present, False) for p in self._presented(index)]
            rows += [(s.name, s.target.X_WE, s.at_waypoint) for s in self._steps(index)]
            for name, X_WE, at_waypoint in rows:
                assert X_WE is not None
                problem = check_workspace(X_WE, self._workspace)
                if not problem:
                    q = self._solver.solve(X_WE, near=near)
                    problem = "can't be reached" if q is None else ""
                    near = near if q is None else q
                poses.append(PreviewPose(name, X_WE, at_waypoint, problem))
        return tuple(poses)

    def replay(self) -> Verdict | None:
        """Lets the robot go through the recorded waypoints, as the policy will.

        In simulation from the scene's start, everything is as before afterwards, and the verdict
        of the task is returned. Elsewhere the arm goes from where it is and stays at the end.
        """
        if not self._waypoints:
            raise TeachingError("nothing is recorded yet: record a waypoint first")
        self._check_follows()
        now, verdict = self._moment(), None
        self._replays = True
        try:
            if self.restores:
                self._restore(replace(self._start, waypoints=now.waypoints))
            self._run_steps()
            if self._judge is not None:
                self.advance(_AFTER)
                verdict = self._judge(self._snapshots)
        except TaskError as error:
            raise TeachingError(f"replay: {error}") from error
        finally:
            self._replays = False
            self._restore(now)
        return verdict

    def _run_steps(self) -> None:
        for index in range(len(self._waypoints)):
            for plan in self._presented(index):
                assert plan.present is not None
                self.go(plan.present)
                self.advance(self.scenario.policy.observe_settle)
            steps = self._steps(index)
            for k in range(len(steps)):
                step, target = steps[k], steps[k].target
                self._send(replace(self._goal, opening=target.opening_moving))
                reached = self.go(
                    target.X_WE, contact_force=target.contact_force, speed_scale=target.speed_scale
                )
                if not reached and step.at_waypoint:
                    steps = moved_steps(steps, target.X_WE, self.pose)
                self._send(replace(self._goal, opening=target.opening_reached))
                if target.settle:
                    self.advance(target.settle)

    @property
    def trajectory(self) -> Trajectory | None:
        """The way of the hand so far, but for replays and what was taken back; None before the
        first sample."""
        if not self._samples:
            return None
        times, poses, openings = zip(*self._samples, strict=True)
        return Trajectory(times=np.array(times), X_WE=np.stack(poses), openings=np.array(openings))

    def _demonstration(self, waypoints: tuple[Waypoint, ...]) -> Demonstration:
        used = {name for w in waypoints for name in (w.grasped, w.target)}
        return Demonstration(
            observations={n: o for n, o in self._observations.items() if n in used},
            waypoints=waypoints,
            trajectory=self.trajectory,
            provenance=self._provenance,
        )

    def demonstration(self) -> Demonstration:
        """What was taught: records of cameras and arm alone, no true state."""
        following = self.next_waypoint
        if following is not None:
            raise TeachingError(
                f"{len(self._waypoints)} of {len(self.motion.waypoints)} waypoints are recorded: "
                f"'{following.name}' is next"
            )
        return self._demonstration(self._waypoints)


def begin_teaching(
    scenario: Scenario, *, seed: int = 0, meshcat: Meshcat | None = None
) -> TeachingSession:
    """A session with the scenario's station and task; in simulation with demonstration objects.

    Args:
      seed: of the scene and of the cameras' noise.
      meshcat: where a simulation shows its scene.
    """
    task = scenario_task(scenario)
    drawn = seed + scenario.seeds.scene
    scene = with_distractors(task.scene(drawn, "demonstration"), scenario.distractors, drawn)
    station = make_station(scenario, scene=scene, seed=seed, meshcat=meshcat)
    provenance = Provenance(
        source="taught on the arm",
        scenario=scenario.digest,
        sensors=scenario.camera_names,
        code=code_version(),
    )
    if not station.HasSubsystemNamed("plant"):
        return TeachingSession(
            scenario, station, motion=task.motion, provenance=provenance, restores=False
        )
    plant: Any = station.GetSubsystemByName("plant")
    panda, truth = find_panda(plant), scene.truth
    provenance = replace(
        provenance,
        source="taught in simulation",
        seed=seed,
        instances={name: f"{s.family} {truth.instance}" for name, s in truth.shapes.items()},
    )
    return TeachingSession(
        scenario,
        station,
        motion=task.motion,
        provenance=provenance,
        restores=True,
        read_truth=lambda context: read_snapshot(plant, plant.GetMyContextFromRoot(context), panda),
        judge=lambda snapshots: task.success(scene, snapshots),
    )
