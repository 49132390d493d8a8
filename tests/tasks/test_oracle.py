"""The oracle's poses of objects, against clouds whose offset from the truth is known."""

import numpy as np
import pytest
import trimesh
from pydrake.math import RigidTransform, RollPitchYaw

from iga_drake.shapes.families import FAMILIES
from iga_drake.shapes.instance import ShapeInstance
from iga_drake.tasks.oracle import OracleInference, seen_pose
from iga_drake.tasks.snapshots import Snapshot
from iga_drake.tasks.sweep import HELD, TARGET, Sweep

X_WO = RigidTransform(RollPitchYaw(0.3, -0.2, 1.1), [0.5, -0.1, 0.2])
OFFSET = RigidTransform(RollPitchYaw(0.01, 0.015, -0.02), [0.004, -0.003, 0.005])


def _shape(family: str) -> ShapeInstance:
    parameters = FAMILIES[family].sample_parameters(np.random.default_rng(3))
    return FAMILIES[family].build(parameters)


def _cloud(shape: ShapeInstance, X_FO: RigidTransform, *, view=(0.6, 0.3, 0.7)) -> np.ndarray:
    """2,000 points (m) with 1 mm of noise of what looks towards `view` in O, and stray ones."""
    points, faces = trimesh.sample.sample_surface(shape.mesh, 6000, seed=1)
    seen = points[shape.mesh.face_normals[faces] @ np.array(view) > 0][:2000]
    rng = np.random.default_rng(2)
    stray = seen[:60] + rng.uniform(0.03, 0.06, size=(60, 3))
    return X_FO.multiply(np.vstack([seen + rng.normal(0, 0.001, seen.shape), stray]).T).T


def _distance(X: RigidTransform, Y: RigidTransform) -> tuple[float, float]:
    """In mm and degrees, at the objects' origins."""
    X_XY = X.inverse() @ Y
    turn = np.degrees(X_XY.rotation().ToAngleAxis().angle())
    return 1e3 * float(np.linalg.norm(X_XY.translation())), float(turn)


@pytest.mark.parametrize("family", ["dustpan", "brush"])
def test_a_displaced_cloud_shows_the_object_where_the_cloud_is(family: str) -> None:
    shape = _shape(family)
    there = X_WO @ OFFSET
    position, rotation = _distance(seen_pose(_cloud(shape, there), shape, X_WO), there)
    assert position < 1.0 and rotation < 0.5
    assert _distance(X_WO, there)[0] > 5.0


def test_what_a_turned_body_doesnt_show_stays_as_it_is() -> None:
    shape = _shape("bowl")
    cloud = _cloud(shape, X_WO @ RigidTransform(RollPitchYaw(0, 0, 0.5), [0, 0, 0.004]))
    position, rotation = _distance(
        seen_pose(cloud, shape, X_WO), X_WO @ RigidTransform([0, 0, 0.004])
    )
    assert position < 1.0 and rotation < 1.5


def test_an_empty_or_far_cloud_changes_nothing() -> None:
    shape = _shape("bowl")
    far = X_WO.translation() + np.full((20, 3), 1.0)
    assert seen_pose(far, shape, X_WO).IsNearlyEqualTo(X_WO, 1e-12)


def test_the_oracle_answers_with_the_expert_s_pose_for_what_is_seen(tmp_path) -> None:
    task = Sweep()
    scene = task.scene(2, mesh_folder=tmp_path)
    X_W = {item.name: item.X_WO for item in scene.objects}
    X_EO = scene.truth.X_EO[HELD]
    X_WE = X_W[HELD] @ X_EO.inverse()
    oracle = OracleInference(task, scene, lambda: Snapshot(0.0, X_W, X_WE, 0.02))
    shapes = scene.truth.shapes
    seen = X_W | {TARGET: X_W[TARGET] @ OFFSET, HELD: X_WE @ X_EO @ OFFSET.inverse()}
    for waypoint, expected in enumerate(task.expert(scene, seen, X_WE)):
        question = oracle.start(
            waypoint,
            _cloud(shapes[HELD], X_EO @ OFFSET.inverse(), view=(-0.3, 0.2, -0.9)),
            _cloud(shapes[TARGET], seen[TARGET]),
            0,
        )
        (pose,) = oracle.poll(question, 1.0).estimate.poses
        position, rotation = _distance(RigidTransform(pose), expected)
        assert position < 4.0 and rotation < 1.0
        unseen = task.expert(scene, X_W, X_WE)[waypoint]
        assert _distance(unseen, expected)[0] > 2 * position
