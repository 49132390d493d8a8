"""Boxes on a table, seen by cameras whose depth follows from the rays' equations."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydrake.math import RigidTransform
from pydrake.multibody.parsing import Parser
from pydrake.planning import RobotDiagramBuilder
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.sensors import CameraInfo, ImageDepth32F

from iga_drake.errors import ConfigError
from iga_drake.station.cameras.rgbd import look_at
from iga_drake.systems.fusion import FusionConfig, PointCloudFusion, pixel_rays
from iga_drake.systems.geometric_segmentation import (
    CameraView,
    GeometricSegmentation,
    GeometricSegmenter,
    SegmentationConfig,
    ShapeLikeness,
    fit_table,
)
from iga_drake.systems.ports import Role
from iga_drake.systems.self_filter import SelfFilter

INFO = CameraInfo(320, 240, 308.0, 308.0, 159.5, 119.5)
RAYS = pixel_rays(INFO)
CAMERAS = {
    "front": look_at(np.array([1.2, 0.0, 0.8]), np.array([0.5, 0.0, 0.1])),
    "left": look_at(np.array([0.2, 0.9, 0.8]), np.array([0.5, 0.0, 0.1])),
    "right": look_at(np.array([0.2, -0.9, 0.8]), np.array([0.5, 0.0, 0.1])),
}
# Centres in the hand's frame E and sizes (m) of a gantry's hand and its two fingers.
HAND = (
    ((0.0, 0.0, 0.10), (0.06, 0.20, 0.06)),
    ((0.0, 0.025, 0.03), (0.02, 0.01, 0.09)),
    ((0.0, -0.025, 0.03), (0.02, 0.01, 0.09)),
)
OPENING = 0.04
AT = np.array([0.40, -0.05, 0.35])  # of E
CUP = ((0.55, 0.15, 0.04), (0.08, 0.08, 0.08))
HELD = ((0.40, -0.05, 0.31), (0.04, 0.03, 0.12))
BACKGROUND, TARGET, GRASPED, ROBOT = Role


@pytest.fixture(scope="module")
def gantry() -> SelfFilter:
    """A hand that three prismatic joints carry anywhere; its E doesn't turn."""
    joints = "".join(
        f'<joint name="{axis}" type="prismatic"><parent link="l{i}"/><child link="l{i + 1}"/>'
        f'<axis xyz="{" ".join(str(int(i == k)) for k in range(3))}"/>'
        '<limit effort="1" velocity="1" lower="-9" upper="9"/></joint>'
        for i, axis in enumerate("xyz")
    )
    shapes = "".join(
        f'<collision name="c{i}"><origin xyz="{" ".join(map(str, centre))}"/><geometry>'
        f'<box size="{" ".join(map(str, size))}"/></geometry></collision>'
        for i, (centre, size) in enumerate(HAND)
    )
    links = '<link name="l0"/><link name="l1"/><link name="l2"/>' + (
        f'<link name="l3"><inertial><mass value="1"/></inertial>{shapes}</link>'
    )
    builder = RobotDiagramBuilder(time_step=0.0)
    plant = builder.plant()
    (model,) = Parser(plant).AddModelsFromString(
        f'<robot name="gantry">{links}{joints}</robot>', "urdf"
    )
    plant.WeldFrames(plant.world_frame(), plant.GetFrameByName("l0"))
    plant.Finalize()
    return SelfFilter(
        builder.Build(),
        instances=[model],
        frame_E=plant.GetFrameByName("l3"),
        positions=lambda position, opening: position,
    )


def render(boxes, X_WC: RigidTransform, table: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Depth (H, W) (m) and roles (H, W) of upright boxes (role, centre, size) on the table."""
    rays = np.stack([*RAYS, np.ones_like(RAYS[0])]).astype(float)
    d = np.einsum("ij,jhw->ihw", X_WC.rotation().matrix(), rays)
    p = X_WC.translation()
    depth = np.where(d[2] < 0, (table - p[2]) / np.minimum(d[2], -1e-9), np.inf)
    role = np.full(depth.shape, Role.BACKGROUND, np.int16)
    for kind, centre, size in boxes:
        ends = [
            (np.array(centre) + sign * np.array(size) / 2)[:, None, None] for sign in (-1.0, 1.0)
        ]
        near, far = np.sort([(end - p[:, None, None]) / d for end in ends], axis=0)
        first, last = near.max(axis=0), far.min(axis=0)
        hit = (first < last) & (first > 0) & (first < depth)
        depth[hit], role[hit] = first[hit], kind
    return depth.astype(np.float32), role


def hand_boxes(at=AT):
    return [(Role.ROBOT, np.array(centre) + at, size) for centre, size in HAND]


def segment(
    gantry,
    boxes,
    *,
    at=AT,
    cameras=CAMERAS,
    examples=(),
    pairs=(),
    noise=0.0,
    table=0.0,
    **options,
):
    """The result, and true and found roles (P,) of all pixels."""
    rng = np.random.default_rng(0)
    images = {name: render(boxes, X_WC, table) for name, X_WC in cameras.items()}
    views = {
        name: CameraView(
            (depth + noise * rng.normal(size=depth.shape)).astype(np.float32), RAYS, cameras[name]
        )
        for name, (depth, _) in images.items()
    }
    config = SegmentationConfig(**options)
    segmenter = GeometricSegmenter(gantry, config, examples=examples, pairs=pairs)
    found = segmenter.segment(views, at, OPENING)
    truth = np.concatenate([role.ravel() for _, role in images.values()])
    label = np.concatenate([found.labels[name].ravel() for name in images])
    return found, truth, label


def shares(truth: np.ndarray, label: np.ndarray, role: int) -> tuple[float, float]:
    """Precision and recall."""
    both = ((truth == role) & (label == role)).sum()
    return both / max(1, (label == role).sum()), both / (truth == role).sum()


def surface(centre, size, spacing=0.004) -> np.ndarray:
    """Points (P, 3) on the top and the sides of a box that stands on the table."""
    axes = [np.arange(-s / 2, s / 2 + 1e-9, spacing) for s in size]
    grid = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 3)
    limit = np.array(size) / 2 - spacing
    outer = (np.abs(grid[:, :2]) >= limit[:2]).any(axis=1) | (grid[:, 2] >= limit[2])
    return grid[outer] + centre


@pytest.mark.parametrize("noise", [0.0, 0.0015])
def test_target_and_held_object_are_labelled(gantry, noise):
    boxes = [(TARGET, *CUP), (GRASPED, *HELD), *hand_boxes()]
    found, truth, label = segment(gantry, boxes, noise=noise)
    assert found.problems == {}
    for role in (TARGET, GRASPED):
        precision, recall = shares(truth, label, role)
        # What is within 8 mm of the fingers counts as robot, the lowest 6 mm as table.
        assert precision > 0.99
        assert recall > (0.9 if role == TARGET else 0.8)
    assert shares(truth, label, ROBOT)[1] > 0.97
    assert not np.isin(label[truth == ROBOT], [TARGET]).any()


@settings(max_examples=4)
@given(
    angle=st.floats(-2.5, 2.5),
    distance=st.floats(0.7, 1.0),
    height=st.floats(0.5, 1.0),
    low=st.floats(-0.008, 0.008),
)
def test_labels_follow_the_scene_wherever_the_cameras_are(gantry, angle, distance, height, low):
    """A camera moved anywhere, or calibrated too low or high, gives the same objects' labels."""
    place = np.array([0.5 + distance * np.cos(angle), distance * np.sin(angle), height])
    camera = look_at(place, np.array([0.5, 0.0, 0.1]))
    boxes = [(TARGET, *CUP), *hand_boxes(AT + [0.0, -0.1, 0.2])]
    images = render(boxes, camera)
    exported = RigidTransform([0.0, 0.0, low]) @ camera
    segmenter = GeometricSegmenter(gantry)
    at = AT + [0.0, -0.1, 0.2 + low]  # the robot is where the camera believes it is
    found = segmenter.segment({"moved": CameraView(images[0], RAYS, exported)}, at, OPENING)
    truth, label = images[1], found.labels["moved"]
    precision, recall = shares(truth, label, TARGET)
    assert precision > 0.99
    assert recall > 0.85


@settings(max_examples=5)
@given(
    x=st.floats(0.3, 0.7),
    y=st.floats(-0.3, 0.3),
    z=st.floats(0.05, 0.5),
    noise=st.floats(0.0, 0.002),
)
def test_no_point_of_the_robot_survives(gantry, x, y, z, noise):
    at = np.array([x, y, z])
    found, _, label = segment(gantry, hand_boxes(at), at=at, noise=noise)
    assert not np.isin(label, [TARGET, GRASPED]).any()
    assert set(found.problems) == {"target", "grasped"}


def test_measured_joints_decide_what_the_robot_is(gantry):
    """With joints that are 10 cm off, the hand is seen as something else."""
    _, truth, label = segment(gantry, hand_boxes(), at=AT + [0.0, 0.0, 0.1])
    assert (label[truth == ROBOT] == ROBOT).mean() < 0.9


def test_two_equal_objects_are_refused_with_their_places(gantry):
    other = ((0.45, -0.2, 0.04), (0.08, 0.08, 0.08))
    far = AT + [0.0, 0.3, 0.2]
    boxes = [(TARGET, *CUP), (TARGET, *other), *hand_boxes(far)]
    found, _, label = segment(gantry, boxes, at=far)
    assert "two objects" in found.problems["target"]
    assert "0.55, 0.15" in found.problems["target"]
    assert "0.45, -0.2" in found.problems["target"]
    assert not (label == TARGET).any()
    narrow, truth, label = segment(gantry, boxes, at=far, region_lower=[0.2, 0.0])
    assert "target" not in narrow.problems
    assert (label == TARGET).sum() < 0.7 * (truth == TARGET).sum()


def test_the_largest_object_is_the_target_unless_demonstrations_tell_its_shape(gantry):
    large = ((0.45, -0.2, 0.03), (0.24, 0.18, 0.06))
    far = AT + [0.0, 0.3, 0.2]
    small_first = [(TARGET, *CUP), (BACKGROUND, *large), *hand_boxes(far)]
    large_first = [(BACKGROUND, *CUP), (TARGET, *large), *hand_boxes(far)]
    for boxes, examples in (
        (large_first, ()),
        (large_first, [surface(*large)]),
        (small_first, [surface((0.3, 0.3, 0.045), (0.09, 0.08, 0.09))]),
    ):
        found, truth, label = segment(gantry, boxes, at=far, examples=examples)
        assert "target" not in found.problems
        precision, recall = shares(truth, label, TARGET)
        assert precision > 0.99
        assert recall > 0.85


def test_nothing_of_the_demonstrated_shape_is_refused(gantry):
    example = surface((0.4, 0.0, 0.02), (0.3, 0.06, 0.04))
    found, _, label = segment(gantry, [(TARGET, *CUP)], examples=[example])
    assert "looks like the demonstrations' target" in found.problems["target"]
    assert not (label == TARGET).any()


FAR = AT + [0.0, 0.35, 0.2]
BOX = ((0.45, -0.2, 0.03), (0.20, 0.14, 0.06))
SEEN_TOGETHER = (surface((0.3, 0.3, 0.045), (0.09, 0.08, 0.09)), surface(*BOX))


def test_what_is_grasped_from_the_table_is_told_from_the_target(gantry):
    crate = ((0.72, 0.0, 0.02), (0.05, 0.3, 0.04))
    boxes = [(GRASPED, *CUP), (TARGET, *BOX), (BACKGROUND, *crate), *hand_boxes(FAR)]
    found, truth, label = segment(
        gantry, boxes, at=FAR, examples=SEEN_TOGETHER[1:], pairs=[SEEN_TOGETHER]
    )
    assert found.problems == {}
    for role in (TARGET, GRASPED):
        precision, recall = shares(truth, label, role)
        assert precision > 0.99
        assert recall > 0.85
    # In the hand it isn't looked for on the table.
    boxes = [(GRASPED, *HELD), (TARGET, *BOX), *hand_boxes()]
    found, truth, label = segment(gantry, boxes, examples=SEEN_TOGETHER[1:], pairs=[SEEN_TOGETHER])
    assert found.problems == {}
    assert min(shares(truth, label, GRASPED)) > 0.6
    assert min(shares(truth, label, TARGET)) > 0.85


def test_size_beside_each_other_tells_objects_of_one_shape_apart(gantry):
    small, large = ((0.5, 0.2, 0.03), (0.06,) * 3), ((0.5, -0.2, 0.05), (0.10,) * 3)
    pair = (surface((0.3, 0.3, 0.04), (0.08,) * 3), surface((0.6, 0.0, 0.065), (0.13,) * 3))
    for one, other, seen in ((small, large, pair), (large, small, pair[::-1])):
        boxes = [(GRASPED, *one), (TARGET, *other), *hand_boxes(FAR)]
        found, truth, label = segment(gantry, boxes, at=FAR, examples=pair[1:], pairs=[seen])
        assert found.problems == {}
        assert min(*shares(truth, label, GRASPED), *shares(truth, label, TARGET)) > 0.8


def test_of_two_equal_objects_a_region_says_which_is_grasped(gantry):
    one, other = CUP, ((0.45, -0.2, 0.04), (0.08, 0.08, 0.08))
    boxes = [(GRASPED, *one), (TARGET, *other), *hand_boxes(FAR)]
    pairs = [(surface(*one), surface(*other))]
    found, _, label = segment(gantry, boxes, at=FAR, pairs=pairs)
    for role in ("grasped", "target"):
        assert "grasped_region_lower" in found.problems[role]
        assert "0.45, -0.2" in found.problems[role]
    assert not np.isin(label, (TARGET, GRASPED)).any()
    found, truth, label = segment(
        gantry, boxes, at=FAR, pairs=pairs, grasped_region_lower=[0.2, 0.0]
    )
    assert found.problems == {}
    assert min(*shares(truth, label, GRASPED), *shares(truth, label, TARGET)) > 0.85
    found, _, _ = segment(gantry, boxes, at=FAR, pairs=pairs, grasped_region_lower=[0.8, 0.0])
    assert "no two" in found.problems["grasped"]


def test_pairs_of_another_shape_are_refused(gantry):
    boxes = [(GRASPED, *CUP), (TARGET, *BOX), *hand_boxes(FAR)]
    pole = surface((0.5, 0.1, 0.12), (0.03, 0.03, 0.24))
    found, _, label = segment(gantry, boxes, at=FAR, pairs=[(pole, pole)])
    assert "looks like the demonstrations' grasped object" in found.problems["grasped"]
    assert not np.isin(label, (TARGET, GRASPED)).any()


def test_objects_outside_the_region_are_refused(gantry):
    found, _, label = segment(gantry, [(TARGET, *CUP)], region_upper=[0.45, 0.5])
    assert "region" in found.problems["target"]
    assert not (label == TARGET).any()


@pytest.mark.parametrize("thickness", [0.003, 0.0045])
def test_thin_floors_between_walls_belong_to_the_target(gantry, thickness):
    x, y, depth, width = 0.55, 0.1, 0.16, 0.14
    tray = [
        (TARGET, (x, y, thickness / 2), (depth, width, thickness)),
        (TARGET, (x, y + width / 2, 0.015), (depth, 0.008, 0.03)),
        (TARGET, (x, y - width / 2, 0.015), (depth, 0.008, 0.03)),
        (TARGET, (x - depth / 2, y, 0.015), (0.008, width, 0.03)),
    ]
    far = AT + [0.0, -0.1, 0.2]
    boxes = [*tray, *hand_boxes(far)]
    recalls = []
    for option in ({}, {"thin_clearance": 0.006}):
        _, truth, label = segment(gantry, boxes, at=far, noise=0.0015, **option)
        precision, recall = shares(truth, label, TARGET)
        assert precision > 0.95
        recalls.append(recall)
    assert recalls[0] > max(0.9, recalls[1] + 0.2)


def test_marbles_are_not_taken_for_the_target(gantry):
    marbles = [(BACKGROUND, (0.4, 0.1 + 0.03 * k, 0.0075), (0.015,) * 3) for k in range(3)]
    far = AT + [0.0, -0.1, 0.2]
    found, truth, label = segment(
        gantry, [(TARGET, *CUP), *marbles, *hand_boxes(far)], at=far, examples=[surface(*CUP)]
    )
    assert "target" not in found.problems
    assert shares(truth, label, TARGET)[0] > 0.99


def test_a_table_at_another_height_names_the_cameras(gantry):
    higher = [(TARGET, np.array(CUP[0]) + [0.0, 0.0, 0.04], CUP[1])]
    found, _, label = segment(gantry, higher, table=0.04)
    for role in ("target", "grasped"):
        assert "front, left, right" in found.problems[role]
        assert "table_height" in found.problems[role]
    assert (label == BACKGROUND).all()
    found, truth, label = segment(gantry, higher, table=0.04, table_height=0.04)
    assert "target" not in found.problems
    assert shares(truth, label, TARGET)[1] > 0.85


def test_what_the_hand_is_about_to_grasp_is_not_held(gantry):
    at = np.array([0.5, 0.0, 0.03])
    box = (TARGET, (0.5, 0.0, 0.03), (0.12, 0.03, 0.06))
    found, _, label = segment(gantry, [box, *hand_boxes(at)], at=at)
    assert "stands on the table" in found.problems["grasped"]
    assert not (label == GRASPED).any()


def test_an_empty_hand_holds_nothing(gantry):
    found, _, label = segment(gantry, [(TARGET, *CUP), *hand_boxes()])
    assert "between the pads" in found.problems["grasped"]
    assert not (label == GRASPED).any()


def test_joints_that_are_not_finite_give_no_label(gantry):
    found, _, label = segment(gantry, [(TARGET, *CUP)], at=np.array([0.4, np.nan, 0.3]))
    assert "not finite" in found.problems["target"]
    assert (label == BACKGROUND).all()


@given(
    x_slope=st.floats(-0.01, 0.01), y_slope=st.floats(-0.01, 0.01), height=st.floats(-0.01, 0.01)
)
def test_the_table_is_fitted_beside_what_stands_on_it(x_slope, y_slope, height):
    rng = np.random.default_rng(1)
    x, y = rng.uniform([0.1, -0.6], [0.9, 0.6], (2000, 2)).T
    z = x_slope * (x - 0.5) + y_slope * y + height + 0.001 * rng.normal(size=2000)
    z[:500] += rng.uniform(0.02, 0.09, 500)
    plane = fit_table(np.stack([x, y, z]), SegmentationConfig())
    assert plane is not None
    np.testing.assert_allclose(plane[:2], [x_slope, y_slope], atol=2e-3)
    assert abs(plane.height + 0.5 * plane.x_slope - height) < 1e-3


def test_likeness_ignores_place_and_turn_and_knows_shapes():
    box = surface((0.5, 0.1, 0.05), (0.10, 0.08, 0.10))
    likeness = ShapeLikeness([[box]])
    c, s = np.cos(0.7), np.sin(0.7)
    turned = box @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]).T + [0.1, -0.4, 0.0]
    larger = 1.4 * box
    slab = surface((0.5, 0.1, 0.02), (0.20, 0.10, 0.04))
    pole = surface((0.5, 0.1, 0.12), (0.03, 0.03, 0.24))
    differences = [
        likeness.difference([likeness.describe(points)]) for points in (turned, larger, slab, pole)
    ]
    assert max(differences[:2]) < 0.06
    assert min(differences[2:]) > 0.15
    assert likeness.difference([likeness.describe(box)]) < 1e-9
    assert ShapeLikeness([]).difference([likeness.describe(box)]) == 0.0


def _fix(system, context, name, boxes, X_WC) -> None:
    depth = ImageDepth32F(INFO.width(), INFO.height())
    depth.mutable_data[:, :, 0] = render(boxes, X_WC)[0]
    system.GetInputPort(f"{name}.depth_image").FixValue(context, depth)
    system.GetInputPort(f"{name}.pose").FixValue(context, X_WC)


class _Padded(SelfFilter):
    """The gantry behind seven joints, as the port contract has them."""

    def __init__(self, gantry: SelfFilter) -> None:
        self.__dict__ = {**vars(gantry), "_positions": lambda position, opening: position[:3]}


def test_the_system_leaves_out_cameras_with_a_problem(gantry):
    boxes = [(TARGET, *CUP), (GRASPED, *HELD), *hand_boxes()]
    system = GeometricSegmentation(
        dict.fromkeys(CAMERAS, INFO), GeometricSegmenter(_Padded(gantry)), maximum_age=0.5
    )
    context = system.CreateDefaultContext()
    context.SetTime(10.0)
    for name, X_WC in CAMERAS.items():
        _fix(system, context, name, boxes, X_WC)
    system.GetInputPort("panda.position_measured").FixValue(context, [*AT, 0, 0, 0, 0])
    system.GetInputPort("hand.opening_measured").FixValue(context, [OPENING])

    def labels(name: str) -> np.ndarray:
        return system.GetOutputPort(f"{name}.label_image").Eval(context).data[:, :, 0].copy()

    for name, X_WC in CAMERAS.items():
        truth = render(boxes, X_WC)[1]
        assert shares(truth.ravel(), labels(name).ravel(), TARGET)[1] > 0.85
    assert system.GetOutputPort("label_problems").Eval(context) == {}
    system.GetInputPort("left.time").FixValue(context, [9.0])
    assert not labels("left").any()
    assert (labels("right") == TARGET).any()
    bad = RigidTransform([np.nan, 0.0, 0.0])
    system.GetInputPort("right.pose").FixValue(context, bad)
    assert not labels("right").any()
    assert (labels("front") == TARGET).any()


def test_the_fusion_passes_the_reason_on(gantry):
    builder = DiagramBuilder()
    cameras = {"front": INFO}
    segmentation = builder.AddSystem(
        GeometricSegmentation(cameras, GeometricSegmenter(_Padded(gantry)))
    )
    fusion = builder.AddSystem(PointCloudFusion(cameras, FusionConfig()))
    for port in ("front.label_image", "label_problems"):
        builder.Connect(segmentation.GetOutputPort(port), fusion.GetInputPort(port))
    diagram = builder.Build()
    root = diagram.CreateDefaultContext()
    boxes = [(TARGET, *CUP), *hand_boxes()]
    for system in (segmentation, fusion):
        context = system.GetMyMutableContextFromRoot(root)
        _fix(system, context, "front", boxes, CAMERAS["front"])
    context = segmentation.GetMyMutableContextFromRoot(root)
    segmentation.GetInputPort("panda.position_measured").FixValue(context, [*AT, 0, 0, 0, 0])
    segmentation.GetInputPort("hand.opening_measured").FixValue(context, [OPENING])
    context = fusion.GetMyContextFromRoot(root)
    cloud = fusion.GetOutputPort("target_cloud").Eval(context).xyzs()
    low, high = (np.array(CUP[0]) + sign * np.array(CUP[1]) / 2 for sign in (-1, 1))
    assert cloud.shape[1] > 100
    assert (cloud.T > low - 0.003).all()
    assert (cloud.T < high + 0.003).all()
    losses = fusion.GetOutputPort("cloud_losses").Eval(context)
    assert "between the pads" in losses["grasped"]


@pytest.mark.parametrize(
    ("option", "value"),
    [
        ("source", "guess"),
        ("gap", 0.0),
        ("robot_margin", -0.01),
        ("table_clearance", 1.0),
        ("distinctness", 0.5),
        ("region_lower", [0.9, -0.5]),
        ("region_upper", [0.5]),
        ("grasped_region_lower", [0.2, 0.6]),
    ],
)
def test_settings_out_of_range_are_named(option, value):
    with pytest.raises(ConfigError, match=f"segmentation.{option.replace('upper', 'lower')}"):
        SegmentationConfig(**{option: value}).check()
