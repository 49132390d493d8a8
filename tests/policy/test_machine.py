import threading
import time
from dataclasses import replace

import numpy as np
import pytest
from policy_fakes import (
    GRASP,
    GRIPPER,
    PICK_AND_PLACE,
    PUT,
    RNG,
    STACK,
    TARGET,
    X_GOAL,
    X_PRESENT,
    FakeAligner,
    FakeInputs,
    make_demonstrations,
    make_machine,
)
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix

from iga_drake.aligners.protocol import AlignerError, PoseEstimate
from iga_drake.demonstrations.demonstration import DemonstrationSet
from iga_drake.policy.inference import LocalInference
from iga_drake.policy.machine import PolicyMachine
from iga_drake.policy.motion import Phase, PolicyError, TaskMotion
from iga_drake.systems.fusion import CameraCounts
from iga_drake.systems.messages import Cause, FollowerStatus, SupervisorStatus


def run(machine, inputs, *, reach=True, limit=200.0):
    """Ticks until a final phase; every target is reached at the next tick while `reach`."""
    memory, now, targets = machine.start(), 0.0, {}
    while not memory.status.phase.final and now < limit:
        memory = machine.advance(memory, inputs, now)
        targets[memory.target.sequence] = memory.target
        if reach:
            inputs.X_WE = memory.target.X_WE if memory.target.sequence else inputs.X_WE
            inputs.follower_status = FollowerStatus(sequence_reached=memory.target.sequence)
        now += machine.config.period
    return memory, targets


def phases(memory):
    return [entry.phase for entry in memory.status.timeline]


def test_grasp_uses_the_gripper_and_runs_to_the_end():
    aligner, inputs = FakeAligner(), FakeInputs()
    memory, targets = run(make_machine(aligner=aligner, seed=7), inputs)
    assert phases(memory) == [Phase.OBSERVE, Phase.INFER, Phase.MOVE, Phase.DONE]
    assert [entry.subject for entry in memory.status.timeline] == ["pan", "grip", "grip", ""]
    ((context, grasped, target, seed),) = aligner.calls
    assert len(context) == 1 and seed == 7
    np.testing.assert_array_equal(grasped, GRIPPER)
    np.testing.assert_array_equal(target, TARGET)
    assert inputs.pulled == ["target"]
    assert sorted(targets) == list(range(5))
    openings = [targets[k].opening_reached for k in range(1, 5)]
    assert openings == [0.08, 0.08, 0.01, 0.01]  # the demonstrations' opening at the waypoint
    before = X_GOAL.inverse() @ targets[1].X_WE
    np.testing.assert_allclose(before.translation(), [0, 0, -0.1], atol=1e-12)
    np.testing.assert_allclose(
        targets[4].X_WE.translation() - X_GOAL.translation(), [0, 0, 0.15], atol=1e-12
    )
    assert memory.status.waypoints_reached[0].IsNearlyEqualTo(X_GOAL, 1e-12)


def test_a_waypoint_without_offsets_is_gone_to_at_once_and_not_left():
    still = replace(GRASP.waypoints[0], before_E=(0.0, 0.0, 0.0), after_W=(0.0, 0.0, 0.0))
    memory, targets = run(make_machine(replace(GRASP, waypoints=(still,))), FakeInputs())
    assert sorted(targets) == [0, 1, 2]
    assert all(targets[k].X_WE.IsNearlyEqualTo(X_GOAL, 1e-12) for k in (1, 2))
    assert [targets[k].opening_reached for k in (1, 2)] == [0.08, 0.01]
    assert targets[1].speed_scale == still.speed_scale
    assert len(memory.status.waypoints_reached) == 1


def test_stack_presents_the_held_object_and_carries_it_into_the_hand_frame():
    aligner, inputs = FakeAligner(), FakeInputs()
    points_E = RNG.normal(size=(80, 3)) * 0.05
    inputs.clouds = {"target": TARGET, "grasped": (X_PRESENT @ points_E.T).T}
    memory, targets = run(make_machine(STACK, aligner), inputs)
    assert phases(memory) == [
        Phase.OBSERVE, Phase.PRESENT, Phase.OBSERVE, Phase.INFER, Phase.MOVE, Phase.DONE
    ]  # fmt: skip
    assert targets[1].X_WE.IsExactlyEqualTo(X_PRESENT)
    np.testing.assert_allclose(aligner.calls[0][1], points_E, atol=1e-12)
    assert inputs.pulled == ["target", "grasped"]
    held = memory.observations["held"]
    np.testing.assert_allclose(X_PRESENT.rotation() @ held.gravity, [0, 0, -1], atol=1e-12)
    np.testing.assert_array_equal(memory.observations["goal"].gravity, [0, 0, -1])
    assert held.time > memory.observations["goal"].time == pytest.approx(0.5)


def _upright(motion: TaskMotion) -> TaskMotion:
    plans = tuple(replace(plan, upright=plan.role != "gripper") for plan in motion.observations)
    return replace(motion, observations=plans)


def test_ways_up_are_told_in_the_frames_of_the_clouds():
    aligner, inputs = FakeAligner(), FakeInputs()
    memory, _ = run(make_machine(_upright(PICK_AND_PLACE), aligner), inputs)
    (gripper_up, thing_up), (held_up, goal_up) = aligner.ups
    assert gripper_up is None
    np.testing.assert_array_equal(thing_up, [0, 0, 1])
    np.testing.assert_array_equal(goal_up, [0, 0, 1])
    # The hand showed it pointing down.
    np.testing.assert_allclose(held_up, X_PRESENT.rotation().inverse() @ [0, 0, 1], atol=1e-12)
    context = aligner.calls[1][0]
    np.testing.assert_array_equal(context[0].target_up, [0, 0, 1])
    assert {name: seen.upright for name, seen in memory.observations.items()} == {
        "gripper": False, "pan": True, "held": True, "goal": True
    }  # fmt: skip


@pytest.mark.parametrize(
    ("motion", "options"),
    [
        (STACK, {}),  # the task doesn't say that anything is upright
        (_upright(STACK), {"upright": (True, False)}),  # a demonstration doesn't
        (_upright(STACK), {"up": False}),  # switched off
    ],
)
def test_ways_up_are_not_told_where_one_is_not_known(motion: TaskMotion, options: dict):
    aligner = FakeAligner()
    memory, _ = run(make_machine(motion, aligner, **options), FakeInputs())
    assert aligner.ups == [(None, None)]
    seen_upright = motion != STACK and options.get("up", True)
    assert memory.observations["goal"].upright == seen_upright


def test_pick_and_place_goes_back_from_moving_to_observing():
    aligner, inputs = FakeAligner(), FakeInputs()
    machine = make_machine(PICK_AND_PLACE, aligner)
    memory, targets = run(machine, inputs)
    told = [(entry.phase, entry.subject) for entry in memory.status.timeline]
    assert told == [
        (Phase.OBSERVE, "pan"), (Phase.INFER, "grip"), (Phase.MOVE, "grip"),
        (Phase.PRESENT, "held"), (Phase.OBSERVE, "held"), (Phase.OBSERVE, "goal"),
        (Phase.INFER, "put"), (Phase.MOVE, "put"), (Phase.DONE, ""),
    ]  # fmt: skip
    assert inputs.pulled == ["grasped", "grasped", "target"]
    assert len(memory.estimates) == len(memory.chosen) == 2
    assert len(memory.status.waypoints_reached) == len(memory.status.times_reached) == 2
    assert memory.status.times_reached[0] < memory.status.times_reached[1]
    assert [len(call[0]) for call in aligner.calls] == [1, 1]
    # The hand closes at the first waypoint, stays so while it shows the thing, opens at the second.
    openings = [targets[k].opening_reached for k in sorted(targets)]
    assert openings == [0.08, 0.08, 0.08, 0.01, 0.01, 0.01, 0.0, 0.0, 0.06, 0.06]


@pytest.mark.parametrize("again", [False, True])
def test_postures_begin_where_the_arm_will_be(again: bool):
    """At its own joints, or at those of the waypoint before where that is still to be followed."""
    asked = []

    def solve(X_WE, near):
        asked.append(near[0])
        return near + 1.0

    twice = (GRASP.waypoints[0], replace(GRASP.waypoints[0], name="again"))
    motion = replace(GRASP, waypoints=twice) if again else PICK_AND_PLACE
    memory, _ = run(make_machine(motion, solve=solve), FakeInputs())
    assert memory.status.phase is Phase.DONE
    # Before, at and after each waypoint; the fake arm's joints are always at 0.
    second = [2.0, 3.0, 4.0] if again else [0.0, 1.0, 2.0]
    assert asked == [0.0, 1.0, 2.0, *second]


def test_waypoints_whose_clouds_are_known_are_inferred_before_any_motion():
    both = TaskMotion(
        observations=GRASP.observations,
        waypoints=(GRASP.waypoints[0], replace(GRASP.waypoints[0], name="again")),
    )
    aligner, inputs = FakeAligner(), FakeInputs()
    memory, _ = run(make_machine(both, aligner), inputs)
    assert phases(memory) == [
        Phase.OBSERVE, Phase.INFER, Phase.INFER, Phase.MOVE, Phase.MOVE, Phase.DONE
    ]  # fmt: skip
    assert len(aligner.calls) == 2


def test_a_better_second_look_is_taken():
    inputs = FakeInputs(clouds={"target": np.zeros((0, 3))})
    machine = make_machine()
    memory = machine.advance(machine.start(), inputs, 0.5)
    assert memory.status.phase is Phase.OBSERVE
    inputs.clouds = {"target": TARGET}
    memory = machine.advance(memory, inputs, 2.0)
    assert memory.status.phase is Phase.OBSERVE, "too early to look again"
    assert machine.advance(memory, inputs, 2.6).status.phase is Phase.INFER


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"clouds": {"target": np.zeros((0, 3))}}, "cloud of 'pan' is empty"),
        ({"clouds": {"target": np.full((400, 3), np.nan)}}, "'pan' has 0 usable points"),
        ({"clouds": {"target": TARGET[:20]}}, "20 usable points"),
        ({"counts": {"camera_1": CameraCounts(0, 0, 0, "is off")}}, "camera_1 is off"),
    ],
)
def test_bad_observations_are_refused_and_the_arm_held(changes, reason):
    aligner, inputs = FakeAligner(), FakeInputs(**changes)
    memory, targets = run(make_machine(aligner=aligner), inputs)
    assert memory.status.phase is Phase.REFUSED
    assert memory.status.cause is Cause.PERCEPTION
    assert reason in memory.status.reason
    assert not aligner.calls
    assert list(targets) == [0], "no motion was ever asked for"


@pytest.mark.parametrize(("share", "refused"), [(0.0, False), (0.25, False), (0.4, True)])
def test_a_mask_with_the_robot_in_it_is_refused(share: float, refused: bool):
    asked = []

    def on_robot(points, position, opening):
        asked.append((points, position, opening))
        return np.arange(len(points)) < share * len(points)

    inputs = FakeInputs()
    memory, targets = run(make_machine(on_robot=on_robot), inputs)
    np.testing.assert_array_equal(asked[0][0], TARGET)
    np.testing.assert_array_equal(asked[0][1], inputs.position())
    assert memory.status.phase is (Phase.REFUSED if refused else Phase.DONE)
    if refused:
        assert memory.status.cause is Cause.PERCEPTION and list(targets) == [0]
        assert "40 % of the points of 'pan' lie on the robot" in memory.status.reason


def test_what_it_waits_for_is_told_at_once():
    inputs = FakeInputs(clouds={"target": np.zeros((0, 3))}, lost="nothing is labelled")
    machine = make_machine()
    memory = machine.advance(machine.start(), inputs, 0.5)
    assert memory.status.phase is Phase.OBSERVE
    assert memory.status.waits_for == "the cloud of 'pan' is empty: nothing is labelled"
    inputs.clouds = {"target": TARGET}
    assert machine.advance(memory, inputs, 2.6).status.waits_for == ""


@pytest.mark.parametrize(("least", "refused"), [(None, True), (3, True), (2, False), (1, False)])
def test_wrong_cameras_are_left_out_where_enough_are_good(least: int | None, refused: bool):
    counts = {name: CameraCounts(9, 9, 9) for name in ("a", "b")}
    inputs = FakeInputs(counts=counts | {"c": CameraCounts(0, 0, 0, "is off")})
    memory, _ = run(make_machine(minimum_cameras=least), inputs)
    assert (memory.status.phase is Phase.REFUSED) == refused
    assert not refused or "c is off" in memory.status.reason


def test_poses_outside_the_workspace_are_refused_before_anything_moves():
    low, high = np.array([0.0, -1.0, 0.0]), np.array([1.0, 1.0, 1.0])
    inside, outside = X_GOAL, RigidTransform(X_GOAL.rotation(), [0.5, 0.1, -0.02])
    for poses, phase in (((outside,), Phase.REFUSED), ((outside, inside), Phase.DONE)):
        machine = make_machine(aligner=FakeAligner(poses=poses), workspace=(low, high))
        memory, targets = run(machine, FakeInputs())
        assert memory.status.phase is phase
    assert memory.chosen[0].mode == 1
    machine = make_machine(aligner=FakeAligner(poses=(outside,)), workspace=(low, high))
    memory, targets = run(machine, FakeInputs())
    assert list(targets) == [0] and memory.status.cause is Cause.IK
    reason = "the pose at grip lies outside the workspace: z = -0.020 m, allowed: 0 to 1 m"
    assert reason in memory.status.reason
    high = np.array([1.0, 1.0, 0.2])  # lower than where the held thing is shown
    memory, targets = run(make_machine(STACK, workspace=(low, high)), FakeInputs())
    assert (memory.status.phase, list(targets)) == (Phase.REFUSED, [0])
    assert "the pose that shows 'held' lies outside the workspace" in memory.status.reason


def test_some_nan_points_are_dropped():
    noisy = TARGET.copy()
    noisy[::7] = np.nan
    aligner = FakeAligner()
    memory, _ = run(make_machine(aligner=aligner), FakeInputs(clouds={"target": noisy}))
    assert memory.status.phase is Phase.DONE
    assert np.isfinite(aligner.calls[0][2]).all()


def test_an_unseen_grasped_object_is_refused_at_the_present_pose():
    inputs = FakeInputs(clouds={"target": TARGET, "grasped": np.zeros((0, 3))})
    memory, targets = run(make_machine(STACK), inputs)
    assert memory.status.phase is Phase.REFUSED
    assert "observe held: the cloud of 'held' is empty" in memory.status.reason
    assert memory.target.X_WE.IsExactlyEqualTo(X_PRESENT)
    assert sorted(targets) == [0, 1]


def test_aligner_errors_are_refused_with_their_message():
    aligner = FakeAligner(error=AlignerError("no correspondence"))
    memory, targets = run(make_machine(aligner=aligner), FakeInputs())
    assert (memory.status.phase, memory.status.cause) == (Phase.REFUSED, "alignment")
    assert "aligner fake: no correspondence" in memory.status.reason
    assert list(targets) == [0]


def test_poses_that_are_not_finite_are_refused():
    class Broken(FakeAligner):
        def align(self, *arguments, **options):
            return PoseEstimate(np.full((1, 4, 4), np.nan), np.zeros(1), np.ones(1))

    memory, _ = run(make_machine(aligner=Broken()), FakeInputs())
    assert (memory.status.phase, memory.status.cause) == (Phase.REFUSED, "alignment")
    assert "not finite" in memory.status.reason


def test_objects_that_look_like_none_of_the_demonstrations_are_refused_where_asked():
    for familiarity, least, refused in (
        ((0.9, 0.2), 0.0, ""), ((0.9, 0.2), 0.5, "the target object looks like none"),
        ((0.2, 0.9), 0.5, "the grasped object looks like none"), ((0.5, 0.5), 0.5, ""),
        (None, 0.5, ""),
    ):  # fmt: skip
        aligner = FakeAligner(familiarity=familiarity)
        machine = make_machine(aligner=aligner, minimum_familiarity=least)
        memory, targets = run(machine, FakeInputs())
        assert (memory.status.phase == Phase.REFUSED) == bool(refused)
        if refused:
            assert memory.status.cause == "alignment" and list(targets) == [0]
            assert refused in memory.status.reason and memory.status.reason.count("looks") == 1
            assert "(familiarity 0.20); at least 0.5 is asked for" in memory.status.reason


def test_answers_that_are_hardly_right_are_refused_where_asked():
    for confidence, least, refused in ((0.05, 0.1, True), (0.1, 0.1, False), (0.0, 0.0, False),
                                       (0.6, 0.7, True), (None, 0.9, False)):  # fmt: skip
        machine = make_machine(aligner=FakeAligner(confidence=confidence), minimum_confidence=least)
        memory, targets = run(machine, FakeInputs())
        assert (memory.status.phase == Phase.REFUSED) == refused
        if refused:
            assert memory.status.cause == "alignment" and list(targets) == [0]
            assert f"with a probability of {confidence:.2f} alone" in memory.status.reason


def test_unreachable_poses_are_refused():
    memory, targets = run(make_machine(solve=lambda X_WE, near: None), FakeInputs())
    assert (memory.status.phase, memory.status.cause) == (Phase.REFUSED, "IK")
    assert "none of 1 poses x 1 symmetries is reachable" in memory.status.reason
    assert list(targets) == [0]


def test_the_reachable_mode_of_lowest_energy_is_taken():
    poses = tuple(RigidTransform([x, 0, 0.3]) for x in (2.0, 0.5, 0.4))

    def solve(X_WE, near):
        return near if X_WE.translation()[0] < 1 else None

    memory, _ = run(make_machine(aligner=FakeAligner(poses=poses), solve=solve), FakeInputs())
    assert memory.status.phase is Phase.DONE
    (chosen,) = memory.chosen
    assert chosen.mode == 1 and chosen.energy == 1.0


def test_the_symmetry_near_the_present_posture_is_taken():
    flip = RigidTransform(RotationMatrix.MakeZRotation(np.pi), np.zeros(3))

    def solve(X_WE, near):  # the first joint turns with the yaw of E
        return np.full(7, abs(X_WE.rotation().ToRollPitchYaw().yaw_angle()))

    aligner = FakeAligner(poses=(RigidTransform(RollPitchYaw(0, 0, 3.0), [0.5, 0, 0.2]),))
    grip = replace(GRASP.waypoints[0], symmetries_E=(RigidTransform(), flip))
    motion = replace(GRASP, waypoints=(grip,))
    memory, _ = run(make_machine(motion, aligner, solve), FakeInputs())
    assert memory.chosen[0].symmetry == 1


@pytest.mark.parametrize("turned", [0.0, np.pi])
def test_the_hand_turns_between_waypoints_as_it_was_shown_to(turned: float):
    """Of modes half a turn apart the one that follows the waypoint before as in a demonstration."""
    flip = RigidTransform(RotationMatrix.MakeZRotation(np.pi), np.zeros(3))
    modes = {"first": (X_GOAL,), "second": (X_GOAL @ flip, X_GOAL)}

    class Both(FakeAligner):
        def align(self, *arguments, **options):
            self.poses = modes["second" if self.calls else "first"]
            return super().align(*arguments, **options)

    still = replace(PUT, before_W=(0.0, 0.0, 0.0), opening_reached=0.0)
    motion = replace(STACK, waypoints=(replace(still, name="over"), PUT))
    demonstrations = make_demonstrations(motion)
    (shown,) = demonstrations.demonstrations
    over, put = shown.waypoints
    X_WE = RigidTransform(RotationMatrix.MakeZRotation(turned), np.zeros(3)).GetAsMatrix4()
    shown = replace(shown, waypoints=(over, replace(put, X_WE=X_WE)))
    demonstrations = DemonstrationSet("stack", (shown,))
    machine = PolicyMachine(
        motion=motion,
        inference=LocalInference(Both(), demonstrations.contexts),
        demonstrations=demonstrations,
        gripper=lambda opening: GRIPPER,
        solve=lambda X_WE, near: near,
    )
    memory, _ = run(machine, FakeInputs())
    assert memory.status.phase is Phase.DONE, memory.status.reason
    assert memory.chosen[1].mode == (1 if turned == 0.0 else 0)
    assert memory.chosen[1].X_WE.IsNearlyEqualTo(modes["second"][memory.chosen[1].mode], 1e-12)


def test_a_descent_that_touches_goes_on_from_where_it_stopped():
    motion = replace(STACK, waypoints=(replace(PUT, contact_force=15.0),))
    machine, inputs = make_machine(motion), FakeInputs()
    stopped = RigidTransform(RollPitchYaw(np.pi, 0.02, 0.4), [0.5, 0.102, 0.07])
    memory, now, targets = machine.start(), 0.0, {}
    while not memory.status.phase.final and now < 100.0:
        memory = machine.advance(memory, inputs, now)
        sent = memory.target
        targets[sent.sequence] = sent
        touched = sent.contact_force is not None
        inputs.X_WE = stopped if touched else sent.X_WE
        inputs.follower_status = FollowerStatus(sequence_reached=sent.sequence, touched=touched)
        now += machine.config.period
    assert memory.status.phase is Phase.DONE
    assert [targets[k].contact_force for k in range(1, 6)] == [None, None, 15.0, None, None]
    assert targets[3].X_WE.IsNearlyEqualTo(X_GOAL, 1e-12)
    assert targets[4].X_WE.IsNearlyEqualTo(stopped, 1e-12)  # the hand opens where it is
    retreat = stopped.inverse() @ targets[5].X_WE
    assert retreat.IsNearlyEqualTo(RigidTransform([0, 0, -0.1]), 1e-9)
    assert memory.status.waypoints_reached[0].IsNearlyEqualTo(stopped, 1e-12)


def test_a_contact_force_is_positive():
    with pytest.raises(PolicyError, match=r"contact_force 0\.0 N found"):
        replace(PUT, contact_force=0.0)


def test_a_motion_that_never_arrives_fails_with_what_is_left_and_holds_where_it_is():
    inputs = FakeInputs(follower_status=FollowerStatus(0, 0.123, 0.1))
    memory, _ = run(make_machine(move_limit=5.0), inputs, reach=False)
    assert (memory.status.phase, memory.status.cause) == (Phase.FAILED, "time")
    assert "before grip: not reached within 5 s, 12.3 cm" in memory.status.reason
    assert memory.target.X_WE.IsExactlyEqualTo(inputs.X_WE)
    assert memory.target.opening_reached == 0.08


def test_a_present_pose_that_is_never_reached_fails():
    memory, _ = run(make_machine(STACK, present_limit=5.0), FakeInputs(), reach=False)
    assert memory.status.phase is Phase.FAILED
    assert "present held: not reached within 5 s" in memory.status.reason


@pytest.mark.parametrize(
    ("reason", "cause"),
    [
        ("external torque of 60.0 N m at joint 2 is above 40.0 N m for 0.05 s", Cause.CONTACT),
        ("measured velocity of joint 1 is 2.185 rad/s, outside [-2.175, 2.175]", Cause.IK),
    ],
)
def test_a_holding_supervisor_ends_the_episode_with_its_reason(reason: str, cause: Cause):
    inputs = FakeInputs(supervisor_status=SupervisorStatus(True, reason, cause))
    memory, _ = run(make_machine(), inputs)
    assert (memory.status.phase, memory.status.cause) == (Phase.FAILED, cause)
    assert f"supervisor: {reason}" in memory.status.reason


def test_slow_inference_is_refused():
    memory, _ = run(make_machine(infer_limit=1e-9), FakeInputs())
    assert (memory.status.phase, memory.status.cause) == (Phase.REFUSED, "time")


def test_final_phases_stay():
    machine, inputs = make_machine(), FakeInputs()
    memory, _ = run(machine, inputs)
    assert machine.advance(memory, inputs, 1e3) is memory


@pytest.mark.parametrize("error", [ValueError("odd"), KeyError("k"), SystemExit(3), OSError("x")])
def test_whatever_an_aligner_raises_is_refused(error: BaseException):
    memory, targets = run(make_machine(aligner=FakeAligner(error=error)), FakeInputs())
    assert (memory.status.phase, memory.status.cause) == (Phase.REFUSED, Cause.ALIGNMENT)
    assert f"aligner fake: {type(error).__name__}" in memory.status.reason
    assert list(targets) == [0]


@pytest.mark.parametrize("answer", [None, 3, (np.eye(4),), {"poses": 1}])
def test_whatever_an_aligner_returns_is_refused(answer):
    class Odd(FakeAligner):
        def align(self, *arguments, **options):
            return answer

    memory, _ = run(make_machine(aligner=Odd()), FakeInputs())
    assert (memory.status.phase, memory.status.cause) == (Phase.REFUSED, Cause.ALIGNMENT)
    assert f"returned {type(answer).__name__}, a PoseEstimate is expected" in memory.status.reason


def test_poses_that_are_not_rigid_are_refused():
    class Scaled(FakeAligner):
        def align(self, *arguments, **options):
            return PoseEstimate(2 * np.eye(4)[None], np.zeros(1), np.ones(1))

    memory, _ = run(make_machine(aligner=Scaled()), FakeInputs())
    assert (memory.status.phase, memory.status.cause) == (Phase.REFUSED, Cause.ALIGNMENT)
    assert "not rigid" in memory.status.reason


def test_the_answer_arrives_after_the_stated_delay():
    memory, _ = run(make_machine(inference="delay", infer_delay=1.5), FakeInputs())
    times = {entry.phase: entry.time for entry in memory.status.timeline}
    assert times[Phase.MOVE] - times[Phase.INFER] == pytest.approx(1.5 + 0.1, abs=0.11)
    assert memory.status.phase is Phase.DONE


def test_concurrent_inference_lets_time_go_on_and_holds():
    go = threading.Event()

    class Waiting(FakeAligner):
        def align(self, *arguments, **options):
            go.wait(10.0)
            return super().align(*arguments, **options)

    aligner = Waiting()
    inference = LocalInference(aligner, [()], beside=True)
    machine = make_machine(service=inference)
    machine.config.inference = "concurrent"
    memory, inputs, now = machine.start(), FakeInputs(), 0.0
    for _ in range(50):
        memory = machine.advance(memory, inputs, now)
        now += machine.config.period
    assert memory.status.phase is Phase.INFER and memory.target.sequence == 0
    go.set()
    while memory.status.phase is Phase.INFER and now < 1000.0:
        memory = machine.advance(memory, inputs, now)
        now += machine.config.period
        time.sleep(0.001)
    assert memory.status.phase is Phase.MOVE and memory.target.sequence == 1


def test_a_concurrent_inference_without_an_answer_is_given_up():
    class Hanging(FakeAligner):
        def align(self, *arguments, **options):
            time.sleep(5.0)

    inference = LocalInference(Hanging(), [()], beside=True)
    machine = make_machine(service=inference, infer_limit=0.05)
    machine.config.inference = "concurrent"
    memory, inputs, now = machine.start(), FakeInputs(), 0.0
    while not memory.status.phase.final and now < 1000.0:
        memory = machine.advance(memory, inputs, now)
        now += machine.config.period
        time.sleep(0.001)
    assert (memory.status.phase, memory.status.cause) == (Phase.REFUSED, Cause.TIME)
    assert "aligner fake: no answer after 0.1 s, the limit is 0.05 s" in memory.status.reason


def test_demonstrations_of_other_waypoints_are_refused():
    machine = make_machine(GRASP)
    with pytest.raises(PolicyError, match=r"'grip', 'gripper', 'pan'.*found, .*'put'"):
        PolicyMachine(
            motion=STACK,
            inference=machine.inference,
            demonstrations=machine._demonstrations,
            gripper=lambda opening: GRIPPER,
            solve=lambda X_WE, near: near,
        )


@pytest.mark.parametrize(
    ("observations", "waypoints", "message"),
    [
        (STACK.observations[:1], (PUT,), "relates the grasped 'held'"),
        (GRASP.observations, (replace(PUT, grasped="pan"),), "in frame E"),
        (
            (replace(STACK.observations[0], after=1), STACK.observations[1]),
            (PUT,),
            "after at most 0 waypoints",
        ),
        (STACK.observations, (), "at least one waypoint"),
        (STACK.observations, (PUT, PUT), "every name once"),
    ],
)
def test_motions_that_cannot_be_done_cannot_be_made(observations, waypoints, message: str):
    with pytest.raises(PolicyError, match=message):
        TaskMotion(observations=observations, waypoints=waypoints)
