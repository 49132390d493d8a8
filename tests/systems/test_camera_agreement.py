"""Cameras that look at a box on a table, rendered by intersecting rays: whose pose is wrong?"""

import numpy as np
import pytest
from pydrake.common.value import Value
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.sensors import CameraInfo, ImageDepth32F, ImageLabel16I

from iga_drake.systems.camera_agreement import DepthView, disagreeing, disagreement
from iga_drake.systems.fusion import FusionConfig, PointCloudFusion
from iga_drake.systems.ports import Role

INFO = CameraInfo(160, 120, 154.0, 154.0, 79.5, 59.5)
HALF = np.array([0.05, 0.08, 0.06])  # m, of the box
CENTRE = np.array([0.5, 0.0, 0.06])
PLACES = {"left": (0.5, 0.8, 0.6), "right": (0.5, -0.8, 0.6), "front": (1.3, 0.1, 0.7)}
LIMIT = 0.05


def _pose(eye: tuple[float, float, float]) -> RigidTransform:
    z = CENTRE - eye
    z /= np.linalg.norm(z)
    x = np.cross(z, [0, 0, 1.0])
    x /= np.linalg.norm(x)
    return RigidTransform(RotationMatrix(np.stack((x, np.cross(z, x), z), 1)), eye)


def _depth(X_WC: RigidTransform) -> tuple[np.ndarray, np.ndarray]:
    """Depth (H, W) of the table z = 0 and the box, and which pixels show the box."""
    v, u = np.mgrid[: INFO.height(), : INFO.width()]
    x, y = (u - INFO.center_x()) / INFO.focal_x(), (v - INFO.center_y()) / INFO.focal_y()
    ray = np.stack((x, y, np.ones_like(x)), -1)
    direction = ray @ X_WC.rotation().matrix().T
    eye = X_WC.translation()
    table = -eye[2] / direction[..., 2]
    sides = np.stack([(CENTRE + s * HALF - eye) / direction for s in (-1, 1)])
    near, far = sides.min(0).max(-1), sides.max(0).min(-1)
    box = (near <= far) & (near > 0) & (near < table)
    return np.where(box, near, table).astype(np.float32), box


def _views(**moved: RigidTransform) -> dict[str, DepthView]:
    """What the cameras measure, and the poses that they are said to have: moved ones are off by
    X_WV."""
    views = {}
    for name, eye in PLACES.items():
        X_WC = _pose(eye)
        depth, box = _depth(X_WC)
        said = moved.get(name, RigidTransform()).multiply(X_WC)
        views[name] = DepthView(depth, said, INFO, box, np.isfinite(depth))
    return views


def test_cameras_with_right_poses_agree() -> None:
    views = _views()
    assert disagreeing(views, 0.005) == {}
    # An error of the size of a good calibration's changes nothing.
    assert disagreeing(_views(left=RigidTransform([0.003, -0.002, 0.002])), LIMIT) == {}


@pytest.mark.parametrize("name", PLACES)
@pytest.mark.parametrize("offset", [(0.04, 0, 0), (0, 0.05, 0), (0, 0, 0.03), (-0.1, 0.1, 0)])
def test_the_camera_that_is_off_is_named(name: str, offset: tuple[float, float, float]) -> None:
    found = disagreeing(_views(**{name: RigidTransform(offset)}), LIMIT)
    assert list(found) == [name] and set(found[name]) <= set(PLACES) - {name}


def test_of_two_cameras_both_are_named() -> None:
    views = _views(left=RigidTransform([0, 0, 0.05]))
    del views["front"]
    assert set(disagreeing(views, LIMIT)) == {"left", "right"}


def test_the_share_is_of_both_directions_and_grows_with_the_offset() -> None:
    shares = []
    for x in (0.0, 0.03, 0.06, 0.12):
        views = _views(front=RigidTransform([x, 0, 0]))
        share = disagreement(views["front"], views["left"])
        assert share == disagreement(views["left"], views["front"])
        shares.append(share)
    assert shares == sorted(shares) and shares[0] < 0.01 < LIMIT < shares[-1]


def test_cameras_that_share_nothing_tell_nothing() -> None:
    views = _views()
    blind = views["left"].depth * np.nan
    views["left"] = DepthView(blind, views["left"].X_WC, INFO, blind > 0, blind > 0)
    assert disagreement(views["left"], views["right"]) == 0


@pytest.mark.parametrize(("limit", "named"), [(LIMIT, ["right"]), (1.0, [])])
def test_the_fusion_leaves_the_camera_out_and_says_why(limit: float, named: list[str]) -> None:
    views = _views(right=RigidTransform([0, 0.06, 0]))
    fusion = PointCloudFusion(dict.fromkeys(views, INFO), FusionConfig(maximum_disagreement=limit))
    context = fusion.CreateDefaultContext()
    for name, view in views.items():
        depth = ImageDepth32F(INFO.width(), INFO.height())
        depth.mutable_data[:, :, 0] = view.depth
        label = ImageLabel16I(INFO.width(), INFO.height())
        label.mutable_data[:, :, 0] = np.where(view.objects, Role.TARGET, Role.BACKGROUND)
        for port, value in (("depth_image", depth), ("label_image", label), ("pose", view.X_WC)):
            fusion.GetInputPort(f"{name}.{port}").FixValue(context, Value(value))
    counts = fusion.GetOutputPort("camera_counts").Eval(context)
    assert [name for name, count in counts.items() if count.problem] == named
    for name in named:
        assert counts[name].target == 0
        assert "sees through" in counts[name].problem and "left" in counts[name].problem
    cloud = fusion.GetOutputPort("target_cloud").Eval(context).xyzs()
    assert cloud.shape[1] > 100
