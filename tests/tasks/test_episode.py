"""Episodes with bad input: refused with a reason, the arm held. Good ones: test_regression.py."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import psutil
import pytest
from demonstration_fakes import make_set
from outside_package import install
from pydrake.math import RigidTransform, RollPitchYaw

from iga_drake.aligners.protocol import AlignerError, PoseEstimate
from iga_drake.demonstrations.demonstration import DemonstrationError
from iga_drake.demonstrations.plausibility import check_plausible
from iga_drake.demonstrations.store import write_demonstrations
from iga_drake.errors import ConfigError
from iga_drake.policy.motion import Phase
from iga_drake.station.cameras.rgbd import LookAt
from iga_drake.station.scenario import Scenario, load_scenario
from iga_drake.systems.messages import Cause
from iga_drake.tasks.episode import (
    Episode,
    EpisodeResult,
    WaypointResult,
    _name_alignment,
    record_demonstrations,
)
from iga_drake.tasks.snapshots import TaskError


@dataclass
class FixedAligner:
    """Always answers with the same pose."""

    X_WE: RigidTransform
    name: str = "fixed"

    def align(self, context, grasped, target, *, grasped_up=None, target_up=None, seed=0):
        return PoseEstimate(self.X_WE.GetAsMatrix4()[None], np.zeros(1), np.ones(1))


@pytest.fixture
def scenario() -> Scenario:
    """The grasp scenario, quick to build and to refuse."""
    scenario = load_scenario("grasp", overrides=["panda.visuals=primitives"])
    scenario.policy.observe_limit = 1.0
    return scenario


def refused(scenario: Scenario, **options) -> EpisodeResult:
    lines: list[str] = []
    options = {"aligner": FixedAligner(RigidTransform([0.5, 0, 0.3]))} | options
    with Episode(scenario, seed=3, **options) as episode:
        start = episode.snapshot().X_WE
        result = episode.run(lines.append)
        assert episode.snapshot().X_WE.IsNearlyEqualTo(start, 1e-3), "the arm was held"
    assert not result.success
    assert result.timeline[-1].phase is Phase.REFUSED
    assert any("FAILURE" in line for line in lines)
    assert not any(waypoint.X_WE_reached for waypoint in result.waypoints)
    return result


def test_an_object_out_of_view_is_refused(scenario: Scenario):
    for camera in scenario.cameras.values():
        camera.pose = LookAt(position=[1.0, 0.0, 0.6], target=[2.0, 0.0, 0.0])
    result = refused(scenario)
    assert result.cause == "perception"
    assert "cloud of 'pan' is empty" in result.reason or "delivered no depth" in result.reason


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


def waypoint(name: str, position: float, rotation: float) -> WaypointResult:
    X = RigidTransform()
    return WaypointResult(
        name=name, estimate=PoseEstimate(np.eye(4)[None], np.zeros(1), np.ones(1)),
        X_WE_predicted=X, energy=0.0, X_WE_expert=X, position_error=position,
        rotation_error=rotation, inference_seconds=0.5,
    )  # fmt: skip


def test_causes_follow_the_evidence():
    good = EpisodeResult(
        task="grasp", aligner="icp", seed=0, split="test", scenario="", success=False,
        cause=Cause.IK, reason="far", waypoints=(waypoint("a", 0.01, 0.1), waypoint("b", 0, 0)),
    )  # fmt: skip
    assert _name_alignment(good).cause is Cause.IK
    for bad in (waypoint("b", 0.05, 0.0), waypoint("b", 0.0, 1.0)):
        named = _name_alignment(replace(good, waypoints=(good.waypoints[0], bad)))
        assert named.cause is Cause.ALIGNMENT
        assert named.reason.startswith("b: predicted") and named.reason.endswith("then: far")
    unseen = replace(good, cause=Cause.PERCEPTION, waypoints=())
    assert _name_alignment(unseen) is unseen


def test_a_row_tells_of_all_waypoints():
    result = EpisodeResult(
        task="grasp", aligner="icp", seed=0, split="test", scenario="abc", success=False,
        cause=Cause.TIME, waypoints=(waypoint("a", 0.01, 0.1), waypoint("b", 0.2, 0.0)),
    )  # fmt: skip
    row = result.row()
    assert [w["name"] for w in row["waypoints"]] == ["a", "b"]
    assert (row["position_error"], row["inference_seconds"], row["cause"]) == (0.2, 1.0, "time")


def test_demonstrations_of_another_task_are_refused_before_anything_is_built(
    scenario: Scenario, tmp_path: Path
):
    write_demonstrations(tmp_path / "demos", make_set())
    scenario.demonstrations = str(tmp_path / "demos")
    scenario.task.name = "stack"
    with pytest.raises(DemonstrationError, match="'grasp' found, 'stack' expected"):
        Episode(scenario, aligner="icp")


def test_unknown_aligners_and_options_are_refused(scenario: Scenario):
    with pytest.raises(AlignerError, match=r"one of: .*icp, iga"):
        Episode(scenario, aligner="orakel")


def test_a_scenario_changed_in_python_is_refused_for_its_own_reason(scenario: Scenario):
    scenario.control.linear_speed = 5.0  # what a file would not be read with
    with pytest.raises(ConfigError, match=r"linear_speed.* 5"):
        Episode(scenario, aligner="expert")


def test_no_demonstrations_are_refused(scenario: Scenario):
    with pytest.raises(TaskError, match="0 asked for"):
        record_demonstrations(scenario, count=0)


UNRULY = """
import os, signal, sys, time


class Unruly:
    name = "unruly"

    def __init__(self, way):
        self.way = way

    def align(self, context, grasped, target, *, grasped_up=None, target_up=None, seed=0):
        if self.way == "hangs":
            time.sleep(600.0)
        if self.way == "crashes":
            os.kill(os.getpid(), signal.SIGSEGV)
        sys.exit(7)
"""


@pytest.mark.parametrize(
    ("way", "cause", "reason"),
    [
        ("hangs", Cause.TIME, "no answer after 4.0 s, the limit is 4 s"),
        ("crashes", Cause.ALIGNMENT, "its worker process was ended by signal 11"),
        ("exits", Cause.ALIGNMENT, "its worker process exited with status 7"),
    ],
)
def test_an_unruly_aligner_is_refused_and_leaves_no_process(
    scenario: Scenario, tmp_path: Path, monkeypatch, way: str, cause: Cause, reason: str
):
    monkeypatch.syspath_prepend(str(tmp_path))
    install(tmp_path, UNRULY, {"iga_drake.aligners": {"unruly": "Unruly"}})
    scenario.aligner.name, scenario.aligner.options = "unruly", {"way": way}
    scenario.policy.infer_limit = 4.0
    before = set(psutil.Process().children(recursive=True))
    result = refused(scenario, aligner=None)
    assert result.cause is cause and f"infer grasp: aligner unruly: {reason}" in result.reason
    assert set(psutil.Process().children(recursive=True)) <= before


def test_options_that_the_aligner_does_not_take_are_refused(scenario: Scenario):
    scenario.aligner.name, scenario.aligner.options = "icp", {"speed": 3.0}
    result = refused(scenario, aligner=None)
    assert result.cause is Cause.ALIGNMENT and "'icp' does not take them" in result.reason


def test_the_expert_steps_restarts_and_leaves_a_demonstration(scenario: Scenario):
    with Episode(scenario, seed=5, aligner="expert", split="demonstration") as episode:
        with pytest.raises(TaskError, match="0 of 1 waypoints were reached"):
            episode.demonstration()
        status = episode.step(0.4)
        assert status.phase is Phase.OBSERVE and episode.time == pytest.approx(0.4)
        episode.step(1.0)
        first = [snapshot.X_WE.GetAsMatrix4() for snapshot in episode.snapshots]
        assert len(first) == 29 and not episode.over
        early = episode.judge()
        assert not early.success and early.cause is Cause.TIME
        episode.restart()
        assert episode.time == 0.0
        result = episode.run()
        again = [snapshot.X_WE.GetAsMatrix4() for snapshot in episode.snapshots[:29]]
        np.testing.assert_array_equal(first, again)
        assert result.success and result.scenario == scenario.digest
        demonstration = episode.demonstration()
    check_plausible(demonstration)
    (reached,) = demonstration.waypoints
    np.testing.assert_array_equal(reached.X_WE, result.waypoints[0].X_WE_reached.GetAsMatrix4())
    assert demonstration.relations == episode.task.motion.relations
    assert demonstration.provenance.seed == 5
    assert demonstration.provenance.sensors == scenario.camera_names
    assert demonstration.provenance.instances["target"].startswith("pan ")
    pan = demonstration.observations["pan"]
    np.testing.assert_array_equal(pan.points, result.observations["pan"].points)
    assert pan.upright and not demonstration.observations["gripper"].upright
    # The trajectory passes the waypoint, and ends lifted.
    gaps = np.linalg.norm(demonstration.trajectory.X_WE[:, :3, 3] - reached.X_WE[:3, 3], axis=1)
    assert gaps.min() < 0.01 and gaps[-1] > 0.1
