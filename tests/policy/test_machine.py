from dataclasses import replace

import numpy as np
import pytest
from policy_fakes import (
    GRASP,
    GRIPPER,
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
from iga_drake.policy.motion import Phase, PolicyError, TaskMotion
from iga_drake.systems.messages import FollowerStatus, SupervisorStatus


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
    assert phases(memory) == [Phase.OBSERVE_TARGET, Phase.INFER, Phase.EXECUTE, Phase.DONE]
    ((context, grasped, target, seed),) = aligner.calls
    assert len(context) == 1 and seed == 7
    np.testing.assert_array_equal(grasped, GRIPPER)
    np.testing.assert_array_equal(target, TARGET)
    assert inputs.pulls == 1
    assert sorted(targets) == list(range(5))
    openings = [targets[k].opening_reached for k in range(1, 5)]
    assert openings == [0.08, 0.08, 0.01, 0.01]  # the demonstrations' opening at the waypoint
    before = X_GOAL.inverse() @ targets[1].X_WE
    np.testing.assert_allclose(before.translation(), [0, 0, -0.1], atol=1e-12)
    np.testing.assert_allclose(
        targets[4].X_WE.translation() - X_GOAL.translation(), [0, 0, 0.15], atol=1e-12
    )
    assert memory.status.waypoints_reached[0].IsNearlyEqualTo(X_GOAL, 1e-12)


def test_stack_presents_the_held_object_and_carries_it_into_the_hand_frame():
    aligner, inputs = FakeAligner(), FakeInputs()
    points_E = RNG.normal(size=(80, 3)) * 0.05
    inputs.grasped = (X_PRESENT @ points_E.T).T
    memory, targets = run(make_machine(STACK, aligner), inputs)
    assert phases(memory) == [
        Phase.OBSERVE_TARGET, Phase.PRESENT_GRASPED, Phase.OBSERVE_GRASPED, Phase.INFER,
        Phase.EXECUTE, Phase.DONE,
    ]  # fmt: skip
    assert targets[1].X_WE.IsExactlyEqualTo(X_PRESENT)
    np.testing.assert_allclose(aligner.calls[0][1], points_E, atol=1e-12)
    assert inputs.pulls == 2


def test_a_better_second_look_is_taken():
    inputs = FakeInputs(target=np.zeros((0, 3)))
    machine = make_machine()
    memory = machine.advance(machine.start(), inputs, 0.5)
    assert memory.status.phase is Phase.OBSERVE_TARGET
    inputs.target = TARGET
    memory = machine.advance(memory, inputs, 2.0)
    assert memory.status.phase is Phase.OBSERVE_TARGET, "too early to look again"
    assert machine.advance(memory, inputs, 2.6).status.phase is Phase.INFER


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"target": np.zeros((0, 3))}, "target cloud is empty"),
        ({"target": np.full((400, 3), np.nan)}, "target cloud has 0 usable points"),
        ({"target": TARGET[:20]}, "20 usable points"),
        ({"silent": ("camera_1",)}, "camera_1 delivered no depth"),
    ],
)
def test_bad_observations_are_refused_and_the_arm_held(changes, reason):
    aligner, inputs = FakeAligner(), FakeInputs(**changes)
    memory, targets = run(make_machine(aligner=aligner), inputs)
    assert memory.status.phase is Phase.REFUSED
    assert memory.status.cause == "perception"
    assert reason in memory.status.reason
    assert not aligner.calls
    assert list(targets) == [0], "no motion was ever asked for"


def test_some_nan_points_are_dropped():
    noisy = TARGET.copy()
    noisy[::7] = np.nan
    aligner = FakeAligner()
    memory, _ = run(make_machine(aligner=aligner), FakeInputs(target=noisy))
    assert memory.status.phase is Phase.DONE
    assert np.isfinite(aligner.calls[0][2]).all()


def test_an_unseen_grasped_object_is_refused_at_the_present_pose():
    inputs = FakeInputs(grasped=np.zeros((0, 3)))
    memory, targets = run(make_machine(STACK), inputs)
    assert memory.status.phase is Phase.REFUSED
    assert "observe grasped: grasped cloud is empty" in memory.status.reason
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


def test_objects_that_look_like_none_of_the_demonstrations_are_refused_where_asked():
    for familiarity, least, refused in ((0.2, 0.0, False), (0.2, 0.5, True), (None, 0.5, False)):
        aligner = FakeAligner(familiarity=familiarity)
        machine = make_machine(aligner=aligner, minimum_familiarity=least)
        memory, targets = run(machine, FakeInputs())
        assert (memory.status.phase == Phase.REFUSED) == refused
        if refused:
            assert memory.status.cause == "alignment" and list(targets) == [0]
            assert "familiarity 0.20, 0.5 is asked for" in memory.status.reason


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
    assert memory.chosen.mode == 1 and memory.chosen.energy == 1.0


def test_the_symmetry_near_the_present_posture_is_taken():
    flip = RigidTransform(RotationMatrix.MakeZRotation(np.pi), np.zeros(3))

    def solve(X_WE, near):  # the first joint turns with the yaw of E
        return np.full(7, abs(X_WE.rotation().ToRollPitchYaw().yaw_angle()))

    aligner = FakeAligner(poses=(RigidTransform(RollPitchYaw(0, 0, 3.0), [0.5, 0, 0.2]),))
    motion = replace(GRASP, symmetries_E=(RigidTransform(), flip))
    memory, _ = run(make_machine(motion, aligner, solve), FakeInputs())
    assert memory.chosen.symmetry == 1


def test_a_descent_that_touches_goes_on_from_where_it_stopped():
    motion = replace(STACK, contact_force=15.0)
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
    with pytest.raises(PolicyError, match=r"contact_force: 0\.0 N found"):
        replace(STACK, contact_force=0.0)


def test_a_motion_that_never_arrives_fails_with_what_is_left_and_holds_where_it_is():
    inputs = FakeInputs(follower_status=FollowerStatus(0, 0.123, 0.1))
    memory, _ = run(make_machine(execute_limit=5.0), inputs, reach=False)
    assert (memory.status.phase, memory.status.cause) == (Phase.FAILED, "time")
    assert "before waypoint: not reached within 5 s, 12.3 cm" in memory.status.reason
    assert memory.target.X_WE.IsExactlyEqualTo(inputs.X_WE)
    assert memory.target.opening_reached == 0.08


def test_a_present_pose_that_is_never_reached_fails():
    memory, _ = run(make_machine(STACK, present_limit=5.0), FakeInputs(), reach=False)
    assert memory.status.phase is Phase.FAILED
    assert "present grasped: not reached within 5 s" in memory.status.reason


@pytest.mark.parametrize(
    ("reason", "cause"),
    [
        ("external torque of 60.0 N m at joint 2 is above 40.0 N m for 0.05 s", "contact"),
        ("tracking error of joint 1 is 0.300 rad, outside [-0.200, 0.200]", "contact"),
        ("measured velocity of joint 1 is 2.185 rad/s, outside [-2.175, 2.175]", "IK"),
    ],
)
def test_a_holding_supervisor_ends_the_episode_with_its_reason(reason: str, cause: str):
    inputs = FakeInputs(supervisor_status=SupervisorStatus(True, reason))
    memory, _ = run(make_machine(), inputs)
    assert (memory.status.phase, memory.status.cause) == (Phase.FAILED, cause)
    assert f"supervisor: {reason}" in memory.status.reason


def test_slow_inference_is_refused():
    memory, _ = run(make_machine(infer_limit=0.0), FakeInputs())
    assert (memory.status.phase, memory.status.cause) == (Phase.REFUSED, "time")


def test_final_phases_stay():
    machine, inputs = make_machine(), FakeInputs()
    memory, _ = run(machine, inputs)
    assert machine.advance(memory, inputs, 1e3) is memory


def test_more_than_one_waypoint_is_refused():
    with pytest.raises(PolicyError, match="2 waypoints found, 1 expected"):
        make_machine(demonstrations=make_demonstrations(("a", "b")))


def test_a_presenting_task_needs_a_present_pose():
    with pytest.raises(PolicyError, match="present: None found"):
        TaskMotion(observes_grasped=True, opening_approach=0.0, opening_reached=0.08)
