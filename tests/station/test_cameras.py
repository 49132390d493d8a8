import numpy as np
import pytest

from iga_drake.station.cameras import camera_info, look_at, true_pose
from iga_drake.station.scenario import Camera, LookAt, Pose, Scenario

# Shoulder of the Panda in W, and how far the hand's tip gets from it at most (m).
SHOULDER = np.array([0.0, 0.0, 0.333])
REACH = 0.316 + 0.384 + 0.088 + 0.107 + 0.1034


def _pixel(camera: Camera, p_W: np.ndarray) -> np.ndarray:
    k = camera.intrinsics
    x, y, z = true_pose(camera).inverse().multiply(p_W)
    assert z > 0
    return np.array([k.fx * x / z + k.cx, k.fy * y / z + k.cy])


def _sees(camera: Camera, p_W: np.ndarray, margin: float) -> bool:
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
    X_WC = true_pose(Camera(pose=Pose(translation=[0.5, 0, 1.4], rpy=[np.pi, 0, 0])))
    np.testing.assert_allclose(X_WC.multiply([0, 0, 1.4]), [0.5, 0, 0], atol=1e-12)


def test_default_intrinsics_are_those_of_a_d415():
    info = camera_info(Camera().intrinsics)
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
