"""A demonstration in the making, on a stub that exports the port contract and nothing else."""

from collections.abc import Callable

import numpy as np
import pytest
from pydrake.math import RigidTransform
from robot_stub import BALL, HOME, RADIUS, START, make_scenario, stub_station

from iga_drake.demonstrations.demonstration import DemonstrationError, DemonstrationSet, Provenance
from iga_drake.demonstrations.store import read_demonstrations, write_demonstrations
from iga_drake.planning.routes import pose_error
from iga_drake.station.panda.model import gripper_cloud
from iga_drake.systems.ports import ArmMode
from iga_drake.tasks.grasp import LIFT, Grasp
from iga_drake.tasks.holding import end_effector_pose
from iga_drake.tasks.teaching import TeachingError, TeachingSession

DOWN = np.diag([1.0, -1.0, -1.0, 1.0])


def above_ball(height: float) -> RigidTransform:
    X_WE = DOWN.copy()
    X_WE[:3, 3] = BALL + [0, 0, height]
    return RigidTransform(X_WE)


class Taught:
    """A session around the stub, whose ports may be changed from outside."""

    def __init__(self, *, restores: bool = True, **options) -> None:
        self.faults: dict = {}
        scenario = make_scenario()
        scenario.control.period, scenario.control.linear_speed = 0.02, 0.5
        self.station = stub_station(scenario, faults=self.faults, **options)
        self.session = TeachingSession(
            scenario,
            self.station,
            motion=Grasp.motion,
            provenance=Provenance(source="a test"),
            restores=restores,
        )

    def set_mode(self, mode: ArmMode) -> None:
        self.faults["panda.mode"] = np.array([float(mode)])
        self.session.advance()

    def guide(self, joints: np.ndarray) -> None:
        """Moves the guided arm by hand."""
        self.faults["panda.position_measured"] = joints
        self.session.advance()

    def told_opening(self) -> float:
        context = self.session.simulator.get_context()
        port = self.station.GetInputPort("hand.opening")
        return float(port.Eval(self.station.GetMyContextFromRoot(context))[0])


def samples_of(session: TeachingSession) -> np.ndarray:
    """Times (K,) of the trajectory so far."""
    assert session.trajectory is not None
    return session.trajectory.times


def teach(session: TeachingSession, height: float = 0.12) -> None:
    session.look()
    assert session.go(above_ball(height))
    session.record()
    session.toggle_hand()


def test_what_is_recorded_is_what_was_seen_and_where_the_hand_was(tmp_path):
    session = Taught().session
    assert session.opening == 0.08 and session.missing == ("pan", "gripper")
    assert session.look() == ("gripper", "pan")
    assert session.missing == ()
    assert session.go(above_ball(0.12))
    following = session.next_waypoint
    assert following is not None and following.name == "grasp" and not session.complete
    session.record()
    session.toggle_hand()  # at the waypoint, so it is the waypoint's
    session.go(above_ball(0.2))
    session.toggle_hand()  # elsewhere
    assert session.complete and session.opening == 0.08
    write_demonstrations(tmp_path / "set", DemonstrationSet("grasp", (session.demonstration(),)))
    (shown,) = read_demonstrations(tmp_path / "set", task="grasp").demonstrations
    assert shown.relations == Grasp.motion.relations
    (waypoint,) = shown.waypoints
    assert max(pose_error(RigidTransform(waypoint.X_WE), above_ball(0.12))) < 2e-3
    assert waypoint.opening == 0.0
    pan, gripper = shown.observations["pan"], shown.observations["gripper"]
    distances = np.linalg.norm(pan.points - BALL, axis=1)
    np.testing.assert_allclose(distances, RADIUS, atol=0.004)  # voxels of 5 mm
    assert pan.frame == "W" and pan.upright and pan.role == "target"
    np.testing.assert_allclose(gripper.points, gripper_cloud(0.08), atol=1e-6)
    track = shown.trajectory
    assert track is not None and track.times[0] <= 0.1 and np.diff(track.times).max() < 0.11
    np.testing.assert_allclose(track.X_WE[0], end_effector_pose(START).GetAsMatrix4(), atol=1e-3)
    nearest = np.linalg.norm(track.X_WE[:, :3, 3] - waypoint.X_WE[:3, 3], axis=1).min()
    assert nearest < 2e-3
    assert shown.provenance.source == "a test"


def refused(wish: Callable[[], object], *words: str) -> None:
    with pytest.raises((TeachingError, DemonstrationError)) as error:
        wish()
    for word in words:
        assert word in str(error.value)


def test_what_cannot_be_recorded_is_refused_and_changes_nothing():
    taught = Taught()
    session = taught.session
    refused(session.record, "waypoint 'grasp': pan, gripper not seen yet: look first")
    refused(session.demonstration, "0 of 1 waypoints are recorded: 'grasp' is next")
    refused(session.replay, "nothing is recorded yet")
    refused(lambda: session.set_opening(0.2), "0 to 0.08 m expected")
    session.look()
    session.go(above_ball(0.6))
    refused(session.record, "0.5", "away from 'pan'")  # the hand is far above
    session.move_to(above_ball(0.12))
    session.advance()
    refused(session.record, "the hand is on its way")
    assert session.waypoints == () and set(session.observations) == {"pan", "gripper"}
    session.go(above_ball(0.12))
    session.record()
    refused(session.record, "all 1 waypoints are recorded")
    refused(session.look, "nothing to look at")


def test_the_goal_stays_inside_the_workspace():
    session = Taught().session
    lower = session.scenario.supervisor.workspace_lower
    reason = session.move_to(RigidTransform(above_ball(0).rotation(), [0.5, 0.1, -0.5]))
    assert "outside the workspace: z = -0.500 m" in reason
    np.testing.assert_allclose(session.goal.translation(), [0.5, 0.1, lower[2] + 0.003])
    refused(lambda: session.move_to(RigidTransform([np.nan, 0, 0])), "aren't finite")
    refused(lambda: session.go(RigidTransform([5.0, 0, 0.3])), "x = 5.000 m")


def test_undo_takes_the_world_back_to_where_the_waypoint_was_recorded():
    session = Taught().session
    session.look()
    session.go(above_ball(0.12))
    time, pose, samples = session.time, session.pose, len(samples_of(session))
    session.record()
    session.toggle_hand()
    session.go(above_ball(0.3))
    assert session.undo() == "grasp"
    assert session.waypoints == () and session.opening == 0.08
    assert session.time == time and session.pose.IsNearlyEqualTo(pose, 1e-12)
    assert len(samples_of(session)) == samples
    session.advance(0.5)
    assert session.pose.IsNearlyEqualTo(pose, 1e-3)  # its goal is that of then as well
    session.record()
    assert session.complete
    # With nothing recorded the demonstration begins anew.
    session.undo()
    assert session.undo() == "" and session.time == 0.0 and session.observations == {}
    assert session.pose.IsNearlyEqualTo(end_effector_pose(START), 1e-9)


def test_a_world_that_cannot_be_put_back_loses_the_waypoint_alone():
    session = Taught(restores=False).session
    teach(session)
    session.go(above_ball(0.3))
    time, pose = session.time, session.pose
    assert session.undo() == "grasp" and session.waypoints == ()
    assert session.time == time and session.pose.IsNearlyEqualTo(pose, 1e-9)
    session.restart()
    assert session.time == time and session.observations == {}


@pytest.mark.parametrize("restores", [True, False])
def test_a_replay_goes_the_policys_way_and_what_was_taught_stays(restores: bool):
    session = Taught(restores=restores).session
    teach(session)
    session.go(above_ball(0.3))
    before, times = session.demonstration(), samples_of(session)
    way: list[tuple[np.ndarray, float]] = []

    def watch() -> bool:
        way.append((session.pose.translation(), session.opening))
        return True

    session.proceed = watch
    time, pose = session.time, session.pose
    assert session.replay() is None
    points, openings = np.array([p for p, _ in way]), np.array([o for _, o in way])
    height = points[:, 2] - BALL[2]
    low = int(height.argmin())
    np.testing.assert_allclose(height[low], 0.12, atol=2e-3)
    assert openings[: low - 5].min() == 0.08  # the approach
    np.testing.assert_allclose(height[-1], 0.12 + LIFT, atol=0.02)
    assert openings[-1] == 0.0
    after = session.demonstration()
    np.testing.assert_array_equal(after.waypoints[0].X_WE, before.waypoints[0].X_WE)
    assert after.waypoints[0].opening == 0.0
    if restores:
        np.testing.assert_array_equal(samples_of(session), times)
        assert session.time == time and session.pose.IsNearlyEqualTo(pose, 1e-9)


def test_a_replay_can_be_stopped():
    session = Taught(restores=False).session
    teach(session)
    session.proceed = lambda: False
    refused(session.replay, "stopped")
    assert session.complete
    stayed = session.pose
    session.advance(0.5)
    assert session.pose.IsNearlyEqualTo(stayed, 2e-3)


def test_a_preview_says_what_is_out_of_reach():
    session = Taught().session
    teach(session)
    poses = {pose.name: pose for pose in session.preview()}
    assert list(poses) == ["start", "before grasp", "at grasp", "hand at grasp", "after grasp"]
    assert not any(pose.problem for pose in poses.values())
    lifted = poses["after grasp"].X_WE.translation() - poses["at grasp"].X_WE.translation()
    np.testing.assert_allclose(lifted, [0, 0, LIFT], atol=1e-9)
    session.scenario.supervisor.workspace_upper[2] = 0.3
    problems = {pose.name: pose.problem for pose in session.preview()}
    assert "z = 0.350 m" in problems["after grasp"] and not problems["at grasp"]


def test_an_arm_that_is_guided_by_hand():
    taught = Taught(restores=False)
    session = taught.session
    taught.set_mode(ArmMode.GUIDING)
    assert session.guided and session.warning == ""
    taught.guide(HOME)
    session.look()
    # Where the guided arm is, not where anything was commanded.
    joints = HOME + [0.1, 0.25, 0.0, -0.2, 0.0, 0.1, 0.0]
    taught.guide(joints)
    assert session.goal.IsNearlyEqualTo(end_effector_pose(joints), 1e-9)
    waypoint = session.record()
    np.testing.assert_allclose(waypoint.X_WE, end_effector_pose(joints).GetAsMatrix4(), atol=1e-9)
    assert taught.told_opening() == 0.08
    session.toggle_hand()  # the hand follows commands all the same
    session.advance()
    assert taught.told_opening() == 0.0
    assert session.demonstration().waypoints[0].opening == 0.0
    refused(lambda: session.move_to(above_ball(0.1)), "guided by hand: let go of the guiding")
    refused(session.replay, "guided by hand")
    assert session.undo() == "grasp"


def test_a_guided_arm_is_warned_at_the_virtual_walls():
    taught = Taught(restores=False)
    session = taught.session
    taught.set_mode(ArmMode.GUIDING)
    session.look()
    taught.guide(HOME + [1.57, 1.7, 0.0, 1.9, 0.0, 0.0, 0.0])
    assert "the hand lies outside the workspace" in session.warning
    refused(session.record, "waypoint 'grasp'", "outside the workspace")
    taught.guide(np.full(7, np.nan))
    assert "aren't measured" in session.warning
    refused(session.record, "aren't measured")


def test_a_moving_hand_is_not_looked_at():
    taught = Taught(restores=False)
    taught.set_mode(ArmMode.GUIDING)

    def swinging(_, context):
        return HOME + 0.05 * np.sin(3.0 * context.get_time())

    taught.faults["panda.position_measured"] = swinging
    refused(taught.session.look, "hold it still while the cameras look")
    assert taught.session.observations == {}


def test_an_arm_that_was_held_follows_again_once_released():
    taught = Taught()
    session = taught.session
    session.look()
    taught.set_mode(ArmMode.GUIDING)
    taught.guide(HOME)
    del taught.faults["panda.position_measured"]
    taught.set_mode(ArmMode.READY)
    assert "the arm is held" in session.warning
    refused(lambda: session.move_to(above_ball(0.2)), "the arm is held", "release it")
    session.release()
    assert session.warning == ""
    assert session.go(above_ball(0.2))
    assert max(pose_error(session.pose, above_ball(0.2))) < 2e-3


def test_cameras_that_see_nothing_are_told():
    refused(Taught(age=1.5).session.look, "left delivered its last image 1.5 s ago")
