import numpy as np
import pytest
from pydrake.geometry import Box, Capsule, Convex, Cylinder, Ellipsoid, Sphere
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.plant import CoulombFriction
from pydrake.planning import RobotDiagramBuilder

from iga_drake.station.panda.model import HOME_POSITION, add_panda
from iga_drake.station.panda.self_filter import make_panda_self_filter
from iga_drake.systems.self_filter import SelfFilter, SelfFilterError


def drake_distances(robot, position: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Least signed distance (P,) (m) of points (P, 3) to anything, by Drake's scene graph."""
    context = robot.CreateDefaultContext()
    robot.plant().SetPositions(robot.mutable_plant_context(context), position)
    query = robot.scene_graph().get_query_output_port().Eval(robot.scene_graph_context(context))
    return np.array(
        [
            min(found.distance for found in query.ComputeSignedDistanceToPoint(point))
            for point in points
        ]
    )


def one_body(*shapes):
    """A body at the origin with these collision shapes, side by side, and its filter."""
    builder = RobotDiagramBuilder(time_step=0.0)
    plant = builder.plant()
    model = plant.AddModelInstance("robot")
    body = plant.AddRigidBody("body", model)
    plant.WeldFrames(plant.world_frame(), body.body_frame())
    for i, shape in enumerate(shapes):
        X_BG = RigidTransform(RollPitchYaw(0.3, -0.5, 0.9), [0.3 * i, 0.1, 0.0])
        plant.RegisterCollisionGeometry(body, X_BG, shape, f"g{i}", CoulombFriction(1.0, 1.0))
    plant.Finalize()
    robot = builder.Build()
    return robot, SelfFilter(
        robot,
        instances=[model],
        frame_E=body.body_frame(),
        positions=lambda position, opening: position,
    )


@pytest.mark.parametrize("margin", [0.0, 0.02])
def test_points_near_the_panda_are_those_that_drake_finds(margin):
    builder = RobotDiagramBuilder(time_step=0.0)
    add_panda(builder.plant(), visuals="none")
    builder.plant().Finalize()
    robot = builder.Build()
    own = make_panda_self_filter()
    rng = np.random.default_rng(0)
    for _ in range(2):
        position = np.array(HOME_POSITION) + rng.uniform(-0.5, 0.5, 7)
        opening = rng.uniform(0.0, 0.08)
        hand = own.pose(position, opening).translation()
        points = np.concatenate(
            [rng.uniform([-0.3, -0.6, 0.0], [0.8, 0.6, 1.2], (300, 3)),
             hand + rng.uniform(-0.12, 0.12, (300, 3))]
        )  # fmt: skip
        full = [*position, opening / 2, opening / 2]
        distance = drake_distances(robot, full, points)
        near = own.near(points.T, position, opening, margin=margin)
        clear = np.abs(distance - margin) > 1e-6
        assert near.any()
        np.testing.assert_array_equal(near[clear], distance[clear] <= margin)


def test_each_kind_of_shape_is_as_drake_has_it():
    shapes = Sphere(0.1), Capsule(0.05, 0.1), Cylinder(0.06, 0.12), Box(0.1, 0.05, 0.2)
    robot, own = one_body(*shapes)
    points = np.random.default_rng(1).uniform([-0.2, -0.1, -0.2], [1.1, 0.3, 0.2], (1500, 3))
    distance = drake_distances(robot, np.zeros(0), points)
    for margin in (0.0, 0.01, 0.04):
        near = own.near(points.T, np.zeros(0), 0.0, margin=margin)
        clear = np.abs(distance - margin) > 1e-6
        np.testing.assert_array_equal(near[clear], distance[clear] <= margin)


def test_of_a_mesh_no_point_within_the_margin_is_missed(tmp_path):
    corners = np.array([[0, 0, 0], [0.2, 0, 0], [0, 0.2, 0], [0, 0, 0.2]])
    file = tmp_path / "corner.obj"
    lines = [f"v {' '.join(map(str, corner))}" for corner in corners]
    file.write_text("\n".join([*lines, "f 1 3 2", "f 1 2 4", "f 1 4 3", "f 2 3 4"]) + "\n")
    robot, own = one_body(Convex(str(file)))
    points = np.random.default_rng(2).uniform(-0.1, 0.4, (400, 3))
    distance = drake_distances(robot, np.zeros(0), points)
    for margin in (0.0, 0.02):
        near = own.near(points.T, np.zeros(0), 0.0, margin=margin)
        assert near[distance <= margin - 1e-6].all()
        assert not near[distance > 3 * margin + 1e-6].any()


def test_what_cannot_be_filtered_is_refused():
    with pytest.raises(SelfFilterError, match="no collision geometry"):
        one_body()
    with pytest.raises(SelfFilterError, match="Ellipsoid"):
        one_body(Ellipsoid(0.1, 0.2, 0.3))
