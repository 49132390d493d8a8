import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.perception import DepthImageToPointCloud
from pydrake.systems.sensors import CameraInfo, ImageDepth32F, ImageLabel16I
from scipy.spatial import KDTree

from iga_drake.errors import ConfigError
from iga_drake.geometry.voxels import voxel_cloud
from iga_drake.systems.fusion import (
    CameraCounts,
    FusionConfig,
    FusionError,
    PointCloudFusion,
    pixel_rays,
    unreliable_pixels,
)

INFO = CameraInfo(160, 120, 150.0, 155.0, 79.5, 59.5)
SHAPE = (120, 160)
WIDE = {"crop_lower": [-1.0, -1.0, -1.0], "crop_upper": [1.5, 1.0, 1.5]}
# From 0.8 m above, looking straight down at the plane z = 0 of W; x right, y down in the image.
ABOVE = RigidTransform(RollPitchYaw(np.pi, 0, 0), [0.4, 0.1, 0.8])


def _depth(array: np.ndarray) -> ImageDepth32F:
    image = ImageDepth32F(array.shape[1], array.shape[0])
    image.mutable_data[:, :, 0] = array
    return image


def _label(array: np.ndarray) -> ImageLabel16I:
    image = ImageLabel16I(array.shape[1], array.shape[0])
    image.mutable_data[:, :, 0] = array
    return image


def _fuse(cameras: dict, **options):
    """Clouds of target and grasped object (P, 3), counts; `cameras`: name -> (depth, label, X)."""
    fusion = PointCloudFusion(dict.fromkeys(cameras, INFO), FusionConfig(**(WIDE | options)))
    context = fusion.CreateDefaultContext()
    for name, (depth, label, X_WC) in cameras.items():
        fusion.GetInputPort(f"{name}.depth_image").FixValue(context, _depth(depth))
        fusion.GetInputPort(f"{name}.label_image").FixValue(context, _label(label))
        fusion.GetInputPort(f"{name}.pose").FixValue(context, X_WC)
    clouds = [fusion.GetOutputPort(f"{n}_cloud").Eval(context) for n in ("target", "grasped")]
    for cloud in clouds:
        assert cloud.xyzs().dtype == np.float32
    counts = fusion.GetOutputPort("camera_counts").Eval(context)
    return clouds[0].xyzs().T, clouds[1].xyzs().T, counts


def _plane_depth(X_WC: RigidTransform) -> np.ndarray:
    """Analytic depth of the plane z = 0 of W."""
    x, y = pixel_rays(INFO)
    rays = np.stack([x, y, np.ones_like(x)], axis=-1) @ X_WC.rotation().matrix().T
    return (-X_WC.translation()[2] / rays[:, :, 2]).astype(np.float32)


def _square() -> np.ndarray:
    label = np.zeros(SHAPE, dtype=np.int16)
    label[40:80, 50:110] = 1
    return label


@pytest.mark.parametrize("rpy", [(np.pi, 0, 0), (np.pi - 0.6, 0.2, 0.5), (np.pi + 0.5, -0.3, 2)])
def test_a_plane_is_unprojected_to_the_plane(rpy):
    X_WC = RigidTransform(RollPitchYaw(rpy), [0.4, 0.1, 0.8])
    cloud, grasped, counts = _fuse({"c": (_plane_depth(X_WC), _square(), X_WC)}, depth_jump=0.1)
    assert len(grasped) == 0
    assert np.abs(cloud[:, 2]).max() < 1e-6
    # The square without its border of one pixel.
    assert counts == {"c": CameraCounts(valid=120 * 160, target=38 * 58, grasped=0)}


def test_the_square_is_where_the_pinhole_says():
    cloud, _, _ = _fuse(
        {"c": (_plane_depth(ABOVE), _square(), ABOVE)}, voxel_size=0.002, min_cluster=1
    )
    # Pixel centres 51..108 and 41..78; y of the image is -y of W.
    assert cloud[:, 0].min() == pytest.approx(0.4 + 0.8 * (51 - 79.5) / 150, abs=1e-6)
    assert cloud[:, 0].max() == pytest.approx(0.4 + 0.8 * (108 - 79.5) / 150, abs=1e-6)
    assert cloud[:, 1].max() == pytest.approx(0.1 - 0.8 * (41 - 59.5) / 155, abs=1e-6)
    assert cloud[:, 1].min() == pytest.approx(0.1 - 0.8 * (78 - 59.5) / 155, abs=1e-6)


def test_same_points_as_drake():
    rng = np.random.default_rng(0)
    depth = rng.uniform(0.5, 1.0, SHAPE).astype(np.float32)
    depth[rng.random(SHAPE) < 0.1] = np.inf
    depth[rng.random(SHAPE) < 0.1] = 0.0
    theirs = DepthImageToPointCloud(INFO)
    context = theirs.CreateDefaultContext()
    theirs.depth_image_input_port().FixValue(context, _depth(depth))
    theirs.GetInputPort("camera_pose").FixValue(context, ABOVE)
    points = theirs.point_cloud_output_port().Eval(context).xyzs().T
    points = points[np.isfinite(points).all(axis=1)]
    ours, _, counts = _fuse(
        {"c": (depth, np.ones(SHAPE, np.int16), ABOVE)}, erosion=0, min_cluster=1
    )
    assert counts["c"].target == counts["c"].valid == len(points)
    np.testing.assert_allclose(ours.mean(axis=0), points.mean(axis=0), atol=1e-3)
    # The points' last bits differ, so a few lie in another voxel.
    distance, _ = KDTree(voxel_cloud(points, 0.005)).query(ours)
    assert (distance < 1e-6).mean() > 0.995


def test_roles_are_kept_apart():
    label = _square()
    label[10:30, 20:60] = 2
    label[90:110, 20:60] = 3  # the robot
    target, grasped, counts = _fuse({"c": (_plane_depth(ABOVE), label, ABOVE)})
    assert counts["c"].target == 38 * 58
    assert counts["c"].grasped == 18 * 38
    assert target[:, 1].max() < grasped[:, 1].min()


def test_invalid_pixels_leave_no_points():
    depth = _plane_depth(ABOVE)
    depth[50, 60] = np.nan
    depth[55, 65] = np.inf
    depth[60, 70] = -np.inf
    depth[65, 75] = 0.0
    depth[70, 80] = -1.0
    cloud, _, counts = _fuse({"c": (depth, _square(), ABOVE)})
    assert np.isfinite(cloud).all()
    assert np.abs(cloud[:, 2]).max() < 1e-6
    assert counts["c"] == CameraCounts(valid=120 * 160 - 5, target=38 * 58 - 5, grasped=0)


@pytest.mark.parametrize("nothing", [np.nan, np.inf, 0.0])
def test_a_camera_that_delivers_nothing_is_recognised_and_the_others_work(nothing):
    dead = np.full(SHAPE, nothing, dtype=np.float32)
    alone, _, _ = _fuse({"a": (_plane_depth(ABOVE), _square(), ABOVE)})
    cloud, _, counts = _fuse(
        {"a": (_plane_depth(ABOVE), _square(), ABOVE), "b": (dead, _square(), ABOVE)}
    )
    np.testing.assert_array_equal(cloud, alone)
    assert counts["a"].valid == 120 * 160
    problem = "delivered no depth: check the camera and its connection"
    assert counts["b"] == CameraCounts(valid=0, target=0, grasped=0, problem=problem)


def test_nothing_in_view_gives_empty_clouds():
    none = np.zeros(SHAPE, dtype=np.int16)
    target, grasped, counts = _fuse({"c": (_plane_depth(ABOVE), none, ABOVE)})
    assert target.shape == grasped.shape == (0, 3)
    assert counts["c"] == CameraCounts(valid=120 * 160, target=0, grasped=0)


def test_flying_pixels_are_dropped():
    """Pixels half-way between the object and the ground, along the object's outline."""
    depth = _plane_depth(ABOVE)
    depth[40:80, 50:110] -= 0.3
    depth[40, 50:110] += 0.15
    depth[40:80, 109] += 0.15
    cloud, _, _ = _fuse({"c": (depth, _square(), ABOVE)}, depth_jump=0.02)
    np.testing.assert_allclose(cloud[:, 2], 0.3, atol=1e-5)
    rough, _, _ = _fuse({"c": (depth, _square(), ABOVE)}, erosion=0, min_cluster=1)
    assert rough[:, 2].min() < 0.2


@pytest.mark.parametrize("erosion", [1, 2, 3])
def test_erosion_is_in_pixels(erosion):
    _, _, counts = _fuse({"c": (_plane_depth(ABOVE), _square(), ABOVE)}, erosion=erosion)
    assert counts["c"].target == (40 - 2 * erosion) * (60 - 2 * erosion)


def test_a_missing_pixel_is_no_jump():
    depth = np.full((20, 20), 0.5, dtype=np.float32)
    depth[10, 10] = np.nan
    label = np.zeros((20, 20), dtype=np.int16)
    assert not unreliable_pixels(depth, label, jump=0.02, erosion=2).any()


def test_specks_and_points_outside_the_crop_box_are_dropped():
    depth, label = _plane_depth(ABOVE), _square()
    depth[60:62, 70:72] = 0.4  # a speck floating above
    crop = {"crop_lower": [-1, -1, -0.1], "crop_upper": [0.4, 1, 1]}
    cloud, _, _ = _fuse({"c": (depth, label, ABOVE)}, erosion=0, min_cluster=8)
    assert np.abs(cloud[:, 2]).max() < 1e-6
    assert cloud[:, 0].max() > 0.5
    with_specks, _, _ = _fuse({"c": (depth, label, ABOVE)}, erosion=0, min_cluster=1)
    assert with_specks[:, 2].max() == pytest.approx(0.4, abs=1e-5)
    cropped, _, counts = _fuse({"c": (depth, label, ABOVE)}, **crop)
    assert cropped[:, 0].max() <= 0.4
    assert counts["c"].valid == 120 * 160


def test_two_cameras_see_one_plane_in_one_place():
    other = RigidTransform(RollPitchYaw(np.pi - 0.5, 0.2, 1.0), [0.3, 0.2, 0.9])
    cameras = {n: (_plane_depth(X), _square(), X) for n, X in (("a", ABOVE), ("b", other))}
    both, _, _ = _fuse(cameras, depth_jump=0.1)
    single = [_fuse({n: c}, depth_jump=0.1)[0] for n, c in cameras.items()]
    cells = [{tuple(v) for v in np.floor(c[:, :2] / 0.005).astype(int)} for c in single]
    assert {tuple(v) for v in np.floor(both[:, :2] / 0.005).astype(int)} == cells[0] | cells[1]


def test_outputs_follow_the_inputs():
    fusion = PointCloudFusion({"c": INFO})
    context = fusion.CreateDefaultContext()
    fusion.GetInputPort("c.label_image").FixValue(context, _label(_square()))
    fusion.GetInputPort("c.pose").FixValue(context, ABOVE)
    sizes = []
    for factor in (1.0, np.nan, 1.0):
        depth = _depth(_plane_depth(ABOVE) * np.float32(factor))
        fusion.GetInputPort("c.depth_image").FixValue(context, depth)
        sizes.append(fusion.GetOutputPort("target_cloud").Eval(context).size())
    assert sizes[0] == sizes[2] > sizes[1] == 0


def test_an_image_that_is_too_old_is_no_image():
    cameras = {name: (_plane_depth(ABOVE), _square(), ABOVE) for name in ("new", "old", "never")}
    fusion = PointCloudFusion(dict.fromkeys(cameras, INFO), FusionConfig(**WIDE, maximum_age=0.5))
    context = fusion.CreateDefaultContext()
    context.SetTime(10.0)
    for name, time in (("new", 9.6), ("old", 9.4), ("never", np.nan)):
        depth, label, X_WC = cameras[name]
        fusion.GetInputPort(f"{name}.depth_image").FixValue(context, _depth(depth))
        fusion.GetInputPort(f"{name}.label_image").FixValue(context, _label(label))
        fusion.GetInputPort(f"{name}.pose").FixValue(context, X_WC)
        fusion.GetInputPort(f"{name}.time").FixValue(context, [time])
    counts = fusion.GetOutputPort("camera_counts")
    target = fusion.GetOutputPort("target_cloud")
    found = counts.Eval(context)
    assert found["new"] == CameraCounts(valid=120 * 160, target=38 * 58, grasped=0)
    assert (found["old"].valid, found["never"].valid) == (0, 0)
    assert "last image 0.6 s ago, at most 0.5 s" in found["old"].problem
    assert "no image yet" in found["never"].problem
    size = target.Eval(context).size()
    context.SetTime(10.2)  # nothing but time has changed
    assert counts.Eval(context)["new"].valid == 0
    assert target.Eval(context).size() == 0 < size


def _losses(cameras: dict, **options) -> dict[str, str]:
    fusion = PointCloudFusion(dict.fromkeys(cameras, INFO), FusionConfig(**(WIDE | options)))
    context = fusion.CreateDefaultContext()
    for name, (depth, label, X_WC) in cameras.items():
        fusion.GetInputPort(f"{name}.depth_image").FixValue(context, _depth(depth))
        fusion.GetInputPort(f"{name}.label_image").FixValue(context, _label(label))
        fusion.GetInputPort(f"{name}.pose").FixValue(context, X_WC)
    return fusion.GetOutputPort("cloud_losses").Eval(context)


def test_an_empty_cloud_names_its_true_cause():
    depth, square = _plane_depth(ABOVE), _square()
    lost = depth.copy()
    lost[square == 1] = np.nan
    stripes = np.where(np.arange(SHAPE[1]) % 3 == 0, square, 0).astype(np.int16)
    away = ABOVE @ RigidTransform([0, 0, -5])
    for options, cameras, reason in (
        ({}, {"c": (depth, 0 * square, ABOVE)}, "no camera has pixels labelled 'target'"),
        ({}, {"c": (lost, square, ABOVE)}, "2400 of 2400 pixels labelled 'target' have no depth"),
        ({}, {"c": (depth, stripes, ABOVE)}, "800 of 800 pixels .* within 1 px of a jump"),
        ({}, {"c": (depth, square, away)}, r"2204 of 2204 pixels .* outside fusion.crop_lower "
         r".* at \[.*5.0\] to \[.*5.0\] m"),
        ({"min_cluster": 10_000}, {"c": (depth, square, ABOVE)}, "groups of fewer than .* = 10000"),
        ({"voxel_size": 0.1, "min_cluster": 1}, {"c": (depth, square, ABOVE)}, "2204 of 2204 "
         "pixels .* fall into [0-9]+ voxels: fusion.voxel_size is 0.1 m"),
    ):  # fmt: skip
        assert re.search(reason, _losses(cameras, **options)["target"]), reason
    small = np.zeros_like(square)
    small[10:20, 10:20] = 1
    losses = _losses({"c": (depth, small, ABOVE)}, voxel_size=0.002, erosion=0, min_cluster=1)
    assert "only 100 pixels are labelled 'target'" in losses["target"]
    assert "no camera has pixels labelled 'grasped'" in losses["grasped"]


PROBLEMS = {
    "millimetres": (lambda d, i, X: (1000 * d, i, X), "are they in mm"),
    "twice": (lambda d, i, X: (d / 1000, i, X), "scaled twice"),
    "nothing": (lambda d, i, X: (0 * d, i, X), "delivered no depth"),
    "nearly": (
        lambda d, i, X: (np.where(np.arange(160) < 0.6, d, 0), i, X),
        "delivered a depth in",
    ),
    "small": (
        lambda d, i, X: (d[::2], i, X),
        "160 x 60 px, the scenario's intrinsics say 160 x 120",
    ),
    "mask": (lambda d, i, X: (d, 255 * i, X), r"labels \[255\] that are no roles"),
    "NaN": (lambda d, i, X: (d, i, RigidTransform([np.nan, 0, 0])), "pose that isn't finite"),
    "scaled": (
        lambda d, i, X: (d, i, RigidTransform(RotationMatrix(1.01 * np.eye(3)), [0, 0, 0])),
        "pose whose rotation is no rotation matrix",
    ),
    "mirrored": (
        lambda d, i, X: (d, i, RigidTransform(RotationMatrix(-np.eye(3)), [0, 0, 0])),
        "pose whose rotation is no rotation matrix",
    ),
}


@pytest.mark.parametrize("name", PROBLEMS)
def test_a_camera_with_a_problem_is_named_and_the_others_are_as_without_it(name: str):
    change, reason = PROBLEMS[name]
    depth = _plane_depth(ABOVE)
    good = (depth, _square(), ABOVE)
    alone, _, _ = _fuse({"a": good})
    cloud, _, counts = _fuse({"a": good, "b": change(depth, _square(), ABOVE)}, minimum_valid=0.01)
    np.testing.assert_array_equal(cloud, alone)
    assert counts["a"].problem == "" and counts["b"].target == counts["b"].valid == 0
    assert re.search(reason, counts["b"].problem), counts["b"].problem


VALUES = st.sampled_from([0.0, -1.0, np.nan, np.inf, -np.inf, 1e-9, 0.5, 0.8, 20.1, 812.0, 3e38])


@given(
    arrays.arrays(np.float32, SHAPE, elements=VALUES, fill=VALUES),
    arrays.arrays(np.int16, SHAPE, elements=st.integers(-2, 5), fill=st.integers(0, 2)),
    arrays.arrays(np.float64, (3, 4), elements=st.floats()) | st.just(ABOVE.GetAsMatrix34()),
    st.floats(),
)
def test_whatever_a_camera_delivers_clouds_are_finite_and_in_the_box(depth, label, pose, time):
    X_WC = RigidTransform(RotationMatrix(np.ascontiguousarray(pose[:, :3])), pose[:, 3])
    fusion = PointCloudFusion({"c": INFO}, FusionConfig(**WIDE))
    context = fusion.CreateDefaultContext()
    for port, value in (("depth_image", _depth(depth)), ("label_image", _label(label))):
        fusion.GetInputPort(f"c.{port}").FixValue(context, value)
    fusion.GetInputPort("c.pose").FixValue(context, X_WC)
    fusion.GetInputPort("c.time").FixValue(context, [time])
    counts = fusion.GetOutputPort("camera_counts").Eval(context)["c"]
    for name in ("target", "grasped"):
        points = fusion.GetOutputPort(f"{name}_cloud").Eval(context).xyzs().T
        assert np.isfinite(points).all()
        assert (points >= np.array(WIDE["crop_lower"]) - 1e-5).all()
        assert (points <= np.array(WIDE["crop_upper"]) + 1e-5).all()
        if len(points) == 0:
            assert counts.problem or fusion.GetOutputPort("cloud_losses").Eval(context)[name]


def test_bad_settings_and_images_are_refused():
    with pytest.raises(FusionError, match="camera"):
        PointCloudFusion({})
    with pytest.raises(ConfigError, match=r"FusionConfig\.voxel_size: 0\.0"):
        PointCloudFusion({"c": INFO}, FusionConfig(voxel_size=0.0))
    with pytest.raises(ConfigError, match="crop"):
        PointCloudFusion({"c": INFO}, FusionConfig(crop_lower=[1, 1, 1], crop_upper=[0, 0, 0]))
