"""A grasp taught in simulation: it is as good as the scripted expert's."""

from pathlib import Path

import numpy as np
import pytest
from pydrake.math import RigidTransform
from scipy.spatial import cKDTree

from iga_drake.demonstrations.demonstration import DemonstrationSet
from iga_drake.demonstrations.store import read_demonstrations, write_demonstrations
from iga_drake.planning.routes import pose_error
from iga_drake.policy.motion import Phase, offset_pose
from iga_drake.station.scenario import load_scenario
from iga_drake.tasks.episode import Episode, demonstrations_path
from iga_drake.tasks.grasp import Grasp
from iga_drake.tasks.teaching import begin_teaching

SEED = 0


@pytest.fixture(scope="module")
def taught(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with one demonstration, taught by going to the expert's pose."""
    session = begin_teaching(load_scenario("grasp"), seed=SEED)
    task = Grasp()
    session.look()
    truth = session.snapshots[-1]
    (X_WE,) = task.expert(task.scene(SEED, "demonstration"), truth.X_WO, truth.X_WE)
    motion = task.motion.waypoints[0]
    assert session.go(offset_pose(X_WE, motion.before_E, motion.before_W))
    assert session.go(X_WE, speed_scale=motion.speed_scale)
    session.record()
    session.toggle_hand()
    session.advance(motion.settle)
    assert session.go(offset_pose(X_WE, motion.after_E, motion.after_W))
    session.advance(1.2)
    verdict = session.verdict
    assert verdict is not None and verdict.success, verdict
    demonstration = session.demonstration()

    # Undo: the pan stands on the table again, untouched by the closing hand.
    lifted = session.snapshots[-1].X_WO["target"].translation()[2]
    assert session.undo() == "grasp"
    session.advance(0.1)
    stands = session.snapshots[-1].X_WO["target"]
    assert lifted - stands.translation()[2] > 0.1
    assert max(pose_error(stands, truth.X_WO["target"])) < 2e-3

    folder = tmp_path_factory.mktemp("taught") / "set"
    write_demonstrations(folder, DemonstrationSet("grasp", (demonstration,)))
    return folder


def test_it_equals_the_experts(taught: Path):
    (mine,) = read_demonstrations(taught, task="grasp").demonstrations
    shown = read_demonstrations(demonstrations_path(load_scenario("grasp"))).demonstrations
    expert = next(d for d in shown if d.provenance.seed == SEED)
    assert mine.relations == expert.relations
    assert mine.provenance.instances == expert.provenance.instances
    assert mine.provenance.sensors == expert.provenance.sensors
    distance, angle = pose_error(
        RigidTransform(mine.waypoints[0].X_WE), RigidTransform(expert.waypoints[0].X_WE)
    )
    assert distance < 0.004 and angle < np.radians(2.0)
    assert mine.waypoints[0].opening == expert.waypoints[0].opening
    for name, seen in expert.observations.items():
        found = mine.observations[name]
        assert (found.role, found.frame, found.upright) == (seen.role, seen.frame, seen.upright)
        np.testing.assert_allclose(found.gravity, seen.gravity, atol=1e-3)
        distances = cKDTree(seen.points).query(found.points)[0]
        assert np.median(distances) < 0.005 and len(found.points) > 0.8 * len(seen.points)


def test_the_policy_uses_it(taught: Path):
    scenario = load_scenario("grasp", overrides=["policy.infer_limit=600"])
    demonstrations = read_demonstrations(taught, task="grasp")
    with Episode(scenario, seed=3, demonstrations=demonstrations) as episode:
        episode.step(0.7)
        assert episode.status.phase is Phase.MOVE, episode.status.reason
        (waypoint,) = episode.judge().waypoints
    assert waypoint.aligned, (waypoint.position_error, waypoint.rotation_error)
