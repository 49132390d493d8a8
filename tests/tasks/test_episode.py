"""Episodes with bad input: refused with a reason, the arm held. Good ones: test_regression.py."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from demonstration_fakes import make_set
from pydrake.math import RigidTransform, RollPitchYaw

from iga_drake.aligners.protocol import AlignerError, PoseEstimate
from iga_drake.demonstrations.demonstration import DemonstrationError, write_demonstrations
from iga_drake.paths import diagrams_dir
from iga_drake.policy.motion import Phase
from iga_drake.station.scenario import LookAt, Scenario, load_scenario
from iga_drake.tasks.episode import (
    EpisodeResult,
    _name_alignment,
    record_demonstrations,
    run_episode,
    to_demonstration,
)
from iga_drake.tasks.snapshots import TaskError


@dataclass
class FixedAligner:
    """Always answers with the same pose."""

    X_WE: RigidTransform
    name: str = "fixed"

    def align(self, context, grasped, target, *, seed=0):
        return PoseEstimate(self.X_WE.GetAsMatrix4()[None], np.zeros(1), np.ones(1))


@pytest.fixture
def scenario() -> Scenario:
    """The grasp scenario, quick to build and to refuse."""
    scenario = load_scenario(diagrams_dir() / "grasp.yaml")
    scenario.panda.visuals = "primitives"
    scenario.time_limits.observe_target = 1.0
    return scenario


def refused(scenario: Scenario, **options) -> EpisodeResult:
    lines: list[str] = []
    options = {"aligner": FixedAligner(RigidTransform([0.5, 0, 0.3]))} | options
    result = run_episode(scenario, seed=3, on_event=lines.append, **options)
    assert not result.success
    assert result.timeline[-1].phase is Phase.REFUSED
    assert any("FAILURE" in line for line in lines)
    assert not result.waypoints_reached
    return result


def test_an_object_out_of_view_is_refused(scenario: Scenario):
    for camera in scenario.cameras.values():
        camera.pose = LookAt(position=[1.0, 0.0, 0.6], target=[2.0, 0.0, 0.0])
    result = refused(scenario)
    assert result.cause == "perception"
    assert "target cloud is empty" in result.reason or "delivered no depth" in result.reason


def test_a_camera_that_delivers_nothing_is_refused(scenario: Scenario):
    scenario.cameras["camera_1"].near = 0.300
    scenario.cameras["camera_1"].far = 0.301
    result = refused(scenario)
    assert result.cause == "perception"
    assert "camera_1 delivered no depth" in result.reason


def test_an_unreachable_pose_is_refused_by_its_name(scenario: Scenario):
    far = RigidTransform(RollPitchYaw(np.pi, 0, 0), [1.6, 0.0, 0.1])
    result = refused(scenario, aligner=FixedAligner(far))
    # Far from the expert's pose too, and that comes first.
    assert result.cause == "alignment"
    assert "none of 1 poses x 2 symmetries is reachable" in result.reason


def test_causes_follow_the_evidence():
    good = EpisodeResult(
        task="grasp", aligner="icp", seed=0, split="test", success=False, cause="IK", reason="far",
        position_error=0.01, rotation_error=0.1,
    )  # fmt: skip
    assert _name_alignment(good).cause == "IK"
    for change in ({"position_error": 0.05}, {"rotation_error": 1.0}):
        named = _name_alignment(replace(good, **change))
        assert named.cause == "alignment"
        assert named.reason.endswith("then: far")
    unseen = replace(good, cause="perception", position_error=None, rotation_error=None)
    assert _name_alignment(unseen) is unseen


def test_demonstrations_of_another_task_are_refused_before_anything_is_built(
    scenario: Scenario, tmp_path: Path
):
    write_demonstrations(tmp_path / "demos", make_set())
    scenario.demonstrations = str(tmp_path / "demos")
    scenario.task.name = "stack"
    with pytest.raises(DemonstrationError, match="'grasp' found, 'stack' expected"):
        run_episode(scenario, seed=0, aligner="icp")


def test_unknown_aligners_and_options_are_refused(scenario: Scenario):
    with pytest.raises(AlignerError, match=r"one of: .*icp, iga"):
        run_episode(scenario, seed=0, aligner="oracle")
    scenario.aligner.name = "icp"
    scenario.aligner.options = {"speed": 3.0}
    with pytest.raises(AlignerError, match="'icp' does not take them"):
        run_episode(scenario, seed=0)


def test_no_demonstrations_are_refused(scenario: Scenario):
    with pytest.raises(TaskError, match="0 asked for"):
        record_demonstrations(scenario, count=0)


def test_a_demonstration_holds_what_was_measured():
    X_WE = RigidTransform([0.4, 0.1, 0.2])
    result = EpisodeResult(
        task="grasp", aligner="expert", seed=5, split="demonstration", success=True,
        waypoints_reached=(X_WE,), target_points=np.ones((20, 3)), grasped_points=np.zeros((20, 3)),
        opening_reached=0.02,
    )  # fmt: skip
    demonstration = to_demonstration(result)
    np.testing.assert_array_equal(demonstration.X_WE[0], X_WE.GetAsMatrix4())
    assert demonstration.openings.tolist() == [0.02]
    assert demonstration.metadata["seed"] == 5
