import numpy as np
import pytest
from pydrake.geometry import (
    GeometryInstance,
    PerceptionProperties,
    RenderLabel,
    SceneGraph,
    Sphere,
)
from pydrake.math import RigidTransform
from pydrake.perception import DepthImageToPointCloud
from pydrake.systems.framework import DiagramBuilder

from iga_drake.station.cameras.rgbd import (
    LookAt,
    Pose,
    RgbdCamera,
    add_renderer,
    camera_info,
    look_at,
    true_pose,
)
from iga_drake.station.scenario import Scenario

# Shoulder of the Panda in W, and how far the hand's tip gets from it at most (m).
SHOULDER = np.array([0.0, 0.0, 0.333])
REACH = 0.316 + 0.384 + 0.088 + 0.107 + 0.1034


def _pixel(camera: RgbdCamera, p_W: np.ndarray) -> np.ndarray:
    k = camera.intrinsics
    x, y, z = true_pose(camera).inverse().multiply(p_W)
    assert z > 0
    return np.array([k.fx * x / z + k.cx, k.fy * y / z + k.cy])


def _sees(camera: RgbdCamera, p_W: np.ndarray, margin: float) -> bool:
    k = camera.intrinsics
    pixel = _pixel(camera, p_W)
    return bool((pixel > margin).all() and (pixel < [k.width - margin, k.height - margin]).all())


@pytest.mark.parametrize("position", [[1.0, 0.2, 0.5], [0.0, -1.0, 0.3], [-2.0, 1.0, -0.5]])
def test_look_at(position):
    target = np.array([0.4, 0.1, 0.2])
    X_WC = look_at(np.array(position), target)
    assert X_WC.rotation().IsValid()
    p_C = X_WC.inverse().multiply(target)
    np.testing.assert_allclose(p_C, [0, 0, np.linalg.norm(target - position)], atol=1e-12)
    x, y, _ = X_WC.rotation().matrix().T
    assert abs(x[2]) < 1e-12  # the horizon is level
    assert y[2] < 0  # image "down" points down


def test_pose_given_outright():
    X_WC = true_pose(RgbdCamera(pose=Pose(translation=[0.5, 0, 1.4], rpy=[np.pi, 0, 0])))
    np.testing.assert_allclose(X_WC.multiply([0, 0, 1.4]), [0.5, 0, 0], atol=1e-12)


def test_default_intrinsics_are_those_of_a_d415():
    info = camera_info(RgbdCamera().intrinsics)
    assert (info.width(), info.height()) == (640, 480)
    # The data sheet's colour field of view, 69.4 x 42.5 deg +- 3 deg at 16:9; 4:3 cuts the sides.
    assert np.degrees(info.fov_y()) == pytest.approx(42.5, abs=1.0)
    assert info.fov_x() == pytest.approx(2 * np.arctan(np.tan(np.radians(34.7)) * 3 / 4), abs=0.02)


def test_default_cameras_see_the_work_area_from_above_and_out_of_reach():
    cameras = Scenario().cameras
    grid = np.meshgrid(np.linspace(0.35, 0.65, 5), np.linspace(-0.3, 0.3, 5), [0.0, 0.08])
    table = np.stack([g.ravel() for g in grid], axis=1)
    corners = 0.08 * np.array(np.meshgrid(*[[-1, 1]] * 3)).reshape(3, -1).T
    presented = corners + np.array([0.45, 0.0, 0.4])
    for points, margin in ((table, 10), (presented, 10)):
        for p_W in points:
            assert sum(_sees(camera, p_W, margin) for camera in cameras.values()) == 3
    azimuths = []
    for camera in cameras.values():
        assert isinstance(camera.pose, LookAt)
        position = np.array(camera.pose.position)
        assert np.linalg.norm(position - SHOULDER) > REACH
        to_center = np.array([0.5, 0.0, 0.0]) - position
        elevation = np.degrees(np.arctan2(-to_center[2], np.hypot(*to_center[:2])))
        assert 35 <= elevation <= 55
        azimuths.append(np.degrees(np.arctan2(-to_center[1], -to_center[0])))
    gaps = np.diff(np.sort(azimuths), append=np.min(azimuths) + 360)
    assert gaps.max() < 160


def test_a_rendered_image_back_projects_to_where_things_are():
    """A ball's visible cap, seen straight on, is centred on the line of sight; Drake's own
    back-projection says where its points lie."""
    camera = RgbdCamera(pose=Pose(translation=[0.0, 0.0, 0.0], rpy=[0.0, 0.0, 0.0]))
    camera.noisy = False
    builder = DiagramBuilder()
    scene_graph = builder.AddSystem(SceneGraph())
    add_renderer(scene_graph)
    ball = GeometryInstance(RigidTransform([0.05, -0.03, 0.8]), Sphere(0.1), "ball")
    properties = PerceptionProperties()
    properties.AddProperty("label", "id", RenderLabel(1))
    ball.set_perception_properties(properties)
    scene_graph.RegisterAnchoredGeometry(scene_graph.RegisterSource("ball"), ball)
    ports = camera.add(builder, scene_graph, name="camera", seed=(0,))
    project = builder.AddSystem(DepthImageToPointCloud(camera_info(camera.intrinsics)))
    builder.Connect(ports["depth_image"], project.depth_image_input_port())
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()
    cloud = project.point_cloud_output_port().Eval(project.GetMyContextFromRoot(context))
    points = cloud.xyzs().T
    points = points[np.isfinite(points).all(1) & (points[:, 2] < 1.0)]
    assert len(points) > 5000
    radius = np.linalg.norm(points - [0.05, -0.03, 0.8], axis=1)
    assert abs(np.median(radius) - 0.1) < 2e-4  # the mesh of the ball is a little inside
    # The fit of a sphere to the points finds the middle: half a pixel would be 0.65 mm.
    A = np.column_stack((2 * points, np.ones(len(points))))
    middle = np.linalg.lstsq(A, (points**2).sum(1), rcond=None)[0][:3]
    np.testing.assert_allclose(middle[:2], [0.05, -0.03], atol=1e-4)
