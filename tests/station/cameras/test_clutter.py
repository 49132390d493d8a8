"""Clutter against a table seen from straight above, where rings and patches are known."""

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.systems.sensors import CameraInfo, ImageDepth32F, ImageLabel16I

from iga_drake.errors import ConfigError
from iga_drake.station.cameras.clutter import CameraClutter, Clutter, View, cluttered, lost_behind
from iga_drake.systems.ports import Role

WIDTH, HEIGHT, FOCAL = 160, 120, 200.0
INFO = CameraInfo(WIDTH, HEIGHT, FOCAL, FOCAL, 79.5, 59.5)
U, V = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))


def _table() -> tuple[np.ndarray, np.ndarray]:
    """Depth and labels of an empty table 1 m below the camera: a pixel is 5 mm wide."""
    return np.ones((HEIGHT, WIDTH), np.float32), np.zeros((HEIGHT, WIDTH), np.int16)


def _images(height: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """A square of 20 px on the table, its top `height` (m) above it."""
    depth, label = _table()
    depth[40:60, 50:70] -= height
    label[40:60, 50:70] = Role.TARGET
    return depth, label


def _clutter(images, seed: int = 0, **options) -> tuple[np.ndarray, np.ndarray]:
    return cluttered(*images, Clutter(**options), np.random.default_rng(seed), info=INFO)


def _distance(u: tuple[int, int], v: tuple[int, int]) -> np.ndarray:
    """(H, W) from each pixel of the table to the nearest of a rectangle of it (m)."""
    du = np.maximum(np.maximum(u[0] - U, U - u[1]), 0)
    dv = np.maximum(np.maximum(v[0] - V, V - v[1]), 0)
    return np.hypot(du, dv) / FOCAL


@pytest.mark.parametrize("ring", [0.012, 0.0612])
def test_the_ring_is_what_lies_within_its_width_of_the_object(ring: float) -> None:
    depth, label = _clutter(_images(), ring=ring)
    np.testing.assert_array_equal(label == Role.TARGET, _distance((50, 69), (40, 59)) <= ring)
    np.testing.assert_array_equal(depth, _images()[0])


def test_what_is_far_below_or_no_background_is_not_in_the_ring() -> None:
    depth, label = _images(height=0.3)
    depth[40, 50:70] = 0.97  # between the object and the table
    held = _clutter((depth, label), ring=0.0612)[1]
    np.testing.assert_array_equal(held, label)
    depth, label = _images()
    label[:, 70:] = Role.ROBOT
    depth[:40] = 0  # lost
    leaked = _clutter((depth, label), ring=0.0612)[1]
    np.testing.assert_array_equal(leaked[:, 70:], label[:, 70:])
    assert not (leaked[:40, :70] == Role.TARGET).any()
    assert (leaked[60:, :70] == Role.TARGET).any()


def test_between_two_objects_the_nearer_one_gets_the_table() -> None:
    depth, label = _images()
    label[40:60, 80:100] = Role.GRASPED
    leaked = _clutter((depth, label), ring=0.0612)[1]
    to_target, to_grasped = _distance((50, 69), (40, 59)), _distance((80, 99), (40, 59))
    wanted = {Role.TARGET: to_target < to_grasped, Role.GRASPED: to_grasped < to_target}
    within = np.minimum(to_target, to_grasped) <= 0.0612
    for role, closer in wanted.items():
        assert (leaked[within & closer] == role).all()
    assert (leaked[~within] == Role.BACKGROUND).all()


@pytest.mark.parametrize(("patch", "sizes"), [(0.001, (1, 1)), (0.03, (10, 29))])
def test_the_share_of_stray_pixels_is_exact_and_they_come_in_patches(patch, sizes) -> None:
    depth, label = _images()
    depth[40:45, 50:70] = np.nan
    strayed, same = _clutter((depth, label), stray=0.2, patch=patch, spread=0.25)
    np.testing.assert_array_equal(same, label)
    offset = np.nan_to_num(strayed) - np.nan_to_num(depth)
    assert (offset[label != Role.TARGET] == 0).all() and np.isnan(strayed[40:45, 50:70]).all()
    moved = offset[offset != 0]
    assert len(moved) == 60  # of 300 with a depth
    assert np.abs(moved).max() <= 0.25 and moved.min() < 0 < moved.max()
    # Discs of 6 px across hold 29 pixels, fewer at the border and where patches meet.
    counts = np.unique(np.round(moved, 5), return_counts=True)[1]
    assert sizes[0] <= np.median(counts) and counts.max() <= sizes[1]


def test_nothing_is_changed_by_default() -> None:
    depth, label = _images()
    for found, given in zip(_clutter((depth, label)), (depth, label), strict=True):
        np.testing.assert_array_equal(found, given)
    assert not Clutter().in_images and not Clutter(neighbours=1).in_images
    for name in ("ring", "stray", "lost_target", "lost_grasped"):
        assert Clutter(**{name: 0.01}).in_images


def test_images_without_objects_and_without_depth_stay() -> None:
    for depth in (_table()[0], np.zeros((HEIGHT, WIDTH), np.float32)):
        for label in (_table()[1], _images()[1]):
            found = _clutter((depth, label), ring=0.06, stray=0.5)
            if not depth.any() or not label.any():
                np.testing.assert_array_equal(found[0], depth)
                np.testing.assert_array_equal(found[1], label)


def _tilted(roll: float, p_WC: tuple[float, float, float]) -> View:
    """The square seen from a pose of the camera, as an image alone."""
    return View(*_images(height=0.1), RigidTransform(RollPitchYaw(roll, 0, 0), p_WC), INFO)


@pytest.mark.parametrize("share", [0.25, 0.5])
def test_a_part_is_lost_on_one_side_of_a_plane_of_all_cameras(share: float) -> None:
    views = {"a": _tilted(np.pi, (0.5, 0.1, 1.0)), "b": _tilted(2.6, (0.52, -0.3, 1.1))}
    direction = np.array([0.6, 0.64, -0.48])
    lost = lost_behind(views, Role.TARGET, share, direction)
    kept_points, lost_points = [], []
    for name, view in views.items():
        # Drake's own transform of each pixel's point.
        for v, u in np.argwhere(view.label == Role.TARGET):
            z = float(view.depth[v, u])
            point = view.X_WC @ np.array([(u - 79.5) / FOCAL * z, (v - 59.5) / FOCAL * z, z])
            (lost_points if lost[name][v, u] else kept_points).append(point @ direction)
    assert max(lost_points) < min(kept_points)
    assert len(lost_points) == pytest.approx(share * 800, abs=1)


def test_nothing_is_lost_of_what_is_not_seen() -> None:
    view = View(*_table(), RigidTransform(), INFO)
    assert not lost_behind({"a": view}, Role.TARGET, 0.5, np.array([1.0, 0, 0]))["a"].any()
    unmeasured = View(np.full_like(view.depth, np.nan), _images()[1], RigidTransform(), INFO)
    assert not lost_behind({"a": unmeasured}, Role.TARGET, 0.5, np.array([1.0, 0, 0]))["a"].any()


def _evaluate(
    seed: int, time: float = 0.0, **options: float
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Depth and labels of two cameras at one place."""
    clutter = Clutter(**(options or {"ring": 0.03, "stray": 0.1}))
    system = CameraClutter(clutter, {"a": INFO, "b": INFO}, seed=seed)
    context = system.CreateDefaultContext()
    context.SetTime(time)
    depth, label = ImageDepth32F(WIDTH, HEIGHT), ImageLabel16I(WIDTH, HEIGHT)
    depth.mutable_data[:, :, 0], label.mutable_data[:, :, 0] = _images()
    for name in ("a", "b"):
        for port, value in (
            ("depth_image", depth), ("label_image", label), ("pose", RigidTransform()),
        ):  # fmt: skip
            system.GetInputPort(f"{name}.{port}").FixValue(context, value)
    return {
        name: tuple(
            system.GetOutputPort(f"{name}.{port}").Eval(context).data[:, :, 0].copy()
            for port in ("depth_image", "label_image")
        )
        for name in ("a", "b")
    }


def test_the_system_is_a_function_of_seed_and_images() -> None:
    found = _evaluate(3)
    for index, name in enumerate(("a", "b")):
        rng = np.random.default_rng((3, index, 2))
        wanted = cluttered(*_images(), Clutter(ring=0.03, stray=0.1), rng, info=INFO)
        for image, right in zip(found[name], wanted, strict=True):
            np.testing.assert_array_equal(image, right)
    np.testing.assert_array_equal(found["a"][0], _evaluate(3, time=1.7)["a"][0])
    assert (found["a"][0] != found["b"][0]).any() and (found["a"][0] != _evaluate(4)["a"][0]).any()


def test_the_system_loses_the_same_part_in_all_cameras() -> None:
    depth, label = _images()
    found = _evaluate(3, lost_target=0.5)
    for name in ("a", "b"):
        np.testing.assert_array_equal(found[name][0], depth)
        assert set(found[name][1][label == Role.BACKGROUND]) == {Role.BACKGROUND}
        kept = np.count_nonzero(found[name][1] == Role.TARGET)
        assert kept == pytest.approx(200, abs=20)  # of 400; a row or so of them is as far
    np.testing.assert_array_equal(found["a"][1], found["b"][1])
    np.testing.assert_array_equal(_evaluate(3, lost_grasped=0.5)["a"][1], label)
    # Of the table that leaks into the mask as well.
    both = _evaluate(3, lost_target=0.5, ring=0.05)["a"][1]
    ring = _evaluate(3, ring=0.05)["a"][1]
    assert 0 < np.count_nonzero(both) < 0.7 * np.count_nonzero(ring)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"ring": -0.01}, r"clutter.ring: -0.01.*0 to 1"),
        ({"stray": 1.0}, r"clutter.stray: 1.0"),
        ({"stray": -0.1}, r"clutter.stray: -0.1"),
        ({"lost_target": 1.0}, r"clutter.lost_target: 1.0"),
        ({"lost_grasped": float("nan")}, r"clutter.lost_grasped: nan"),
        ({"neighbours": -1}, r"clutter.neighbours: -1.*0 to 20"),
        ({"patch": 0.0}, r"clutter.patch: 0.0.*0.0001 to 1"),
        ({"spread": 0.0}, r"clutter.spread: 0.0.*0.0001 to 10"),
    ],
)
def test_values_out_of_range_are_refused(options: dict, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        Clutter(**options).check()
