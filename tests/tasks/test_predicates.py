"""Predicates on hand-made trajectories whose measures are known."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from pydrake.math import RigidTransform, RotationMatrix
from scipy.spatial.transform import Rotation

from iga_drake.shapes.instance import ShapeInstance, frame
from iga_drake.station.simulated.scene import Scene, SceneObject, SceneTruth
from iga_drake.tasks.predicates import (
    AllOf,
    AtRest,
    Below,
    CarriedStill,
    CountOf,
    HeldStill,
    Inside,
    Lifted,
    NearAxis,
    NotTouching,
    Predicate,
    Touching,
    Upright,
    Within,
)
from iga_drake.tasks.snapshots import ROBOT, TABLE, Snapshot, TaskError

TIMES = np.arange(0.0, 3.01, 0.05)
SIZE = np.array([0.2, 0.1, 0.3])  # of the box, m
CENTRE = np.array([0.03, 0.0, 0.15])  # of the box in its frame, m


def _box(size: np.ndarray, centre: np.ndarray, **frames: np.ndarray) -> ShapeInstance:
    """A box whose upper and lower halves are parts."""
    signs = np.array([[x, y, z] for z in (-1, 0, 1) for y in (-1, 1) for x in (-1, 1)])
    faces, labels = [(0, 2, 1), (1, 2, 3), (8, 9, 10), (9, 11, 10)], [0, 0, 1, 1]
    for low, label in ((0, 0), (4, 1)):
        for a, b in ((0, 1), (1, 3), (3, 2), (2, 0)):
            faces += [(low + a, low + b, low + 4 + b), (low + a, low + 4 + b, low + 4 + a)]
            labels += [label, label]
    return ShapeInstance(
        family="box",
        parameters={},
        vertices=centre + signs * size / 2,
        faces=np.array(faces),
        part_labels=np.array(labels),
        part_names=("lower", "upper"),
        frames=frames,
    )


def _pose(p: np.ndarray | list[float], rotvec: np.ndarray | list[float] = (0, 0, 0)):
    return RigidTransform(RotationMatrix(Rotation.from_rotvec(rotvec).as_matrix()), p)


def _random_pose(seed: int) -> RigidTransform:
    rng = np.random.default_rng(seed)
    return _pose(rng.uniform(-0.5, 0.5, 3), rng.normal(size=3))


START = {"box": _pose([0.5, 0.1, 0.0], [0, 0, 0.7]), "marble": _pose([0.4, -0.2, 0.01])}
SHAPES = {
    # The opening looks along the box' x axis, so that frames and object axes can't be confused.
    "box": _box(SIZE, CENTRE, opening=frame((0.13, 0.0, 0.15), x=(0.0, 1.0, 0.0), z=(1.0, 0, 0))),
    "marble": _box(np.full(3, 0.01), np.zeros(3), pole=frame((0.0, 0.0, 0.005))),
}
SCENE = Scene(
    objects=tuple(SceneObject(name, "other", "", X_WO) for name, X_WO in START.items()),
    panda_position=np.zeros(7),
    hand_opening=0.0,
    truth=SceneTruth(task="tidy", split="test", instance=0, shapes=SHAPES),
)


def _snapshots(
    contacts: Callable[[float], set[tuple[str, str]]] = lambda t: set(),
    X_WE: Callable[[float], RigidTransform] = lambda t: RigidTransform(),
    **poses: Callable[[float], RigidTransform],
) -> list[Snapshot]:
    return [
        Snapshot(
            t,
            START | {name: pose(t) for name, pose in poses.items()},
            X_WE(t),
            0.0,
            frozenset(frozenset(pair) for pair in contacts(t)),
        )
        for t in TIMES
    ]


def _holds(predicate: Predicate, snapshots: list[Snapshot]) -> bool:
    verdict = predicate.judge(SCENE, snapshots)
    assert verdict.success == (verdict.reason == "")
    return verdict.success


@pytest.mark.parametrize("pair", [("box", "marble"), ("marble", ROBOT), ("box", TABLE)])
def test_touching_is_for_the_whole_window_or_the_end(pair: tuple[str, str]) -> None:
    first, second = pair
    always = _snapshots(contacts=lambda t: {pair})
    never = _snapshots()
    late = _snapshots(contacts=lambda t: {pair} if t > 1.5 else set())
    for order in ({"first": first, "second": second}, {"first": second, "second": first}):
        for for_last in (0.0, 1.0, 2.0):
            touching = Touching(**order, for_last=for_last)
            free = NotTouching(**order, for_last=for_last)
            assert _holds(touching, always) and not _holds(free, always)
            assert not _holds(touching, never) and _holds(free, never)
            assert _holds(touching, late) == (for_last < 2.0) and not _holds(free, late)
    released = _snapshots(contacts=lambda t: {pair} if t < 1.5 else set())
    once = Touching(first=first, second=second, for_last=1.0, always=False)
    assert not _holds(once, released) and not _holds(once, never)
    assert _holds(once, _snapshots(contacts=lambda t: {pair} if 2.2 < t < 2.4 else set()))
    assert _holds(NotTouching(first=first, second=second, for_last=1.0), released)
    assert not _holds(NotTouching(first=first, second=second, for_last=2.0), released)


def _judged(predicate: Predicate, snapshots: list[Snapshot], measure: str) -> float:
    return predicate.judge(SCENE, snapshots).measures[measure]


def test_lift_is_the_centre_of_mass_s() -> None:
    # Turned over, the box' origin goes up by its height and its centre of mass stays.
    over = START["box"] @ _pose([0, 0, 0.3], [np.pi, 0, 0])
    snapshots = _snapshots(box=lambda t: over)
    assert _judged(Lifted(object="box", height=0.1), snapshots, "lift") == pytest.approx(0.0)
    raised = _snapshots(box=lambda t: _pose([0, 0, 0.1 * t]) @ START["box"])
    assert _judged(Lifted(object="box", height=0.1), raised, "lift") == pytest.approx(0.3)
    window = Lifted(object="box", height=0.21, for_last=1.0)
    assert _judged(window, raised, "lift") == pytest.approx(0.2)
    assert not _holds(window, raised) and _holds(replace(window, height=0.199), raised)


@pytest.mark.parametrize("angle", [0.0, 0.3, 2.0, np.pi])
def test_tilt_is_the_angle_of_the_z_axis(angle: float) -> None:
    rng = np.random.default_rng(int(10 * angle))
    yaw = rng.uniform(-np.pi, np.pi)
    direction = [np.cos(yaw), np.sin(yaw), 0.0]
    tilted = _pose([0, 0, 0], angle * np.array(direction)) @ _pose([0, 0, 0], [0, 0, yaw])
    snapshots = _snapshots(box=lambda t: tilted)
    assert _judged(Upright(object="box", tilt=0.1), snapshots, "tilt") == pytest.approx(angle)
    # Against another object, however both lie.
    X = _random_pose(3)
    both = _snapshots(box=lambda t: X @ tilted, marble=lambda t: X)
    against = Upright(object="box", other="marble", tilt=angle + 1e-6)
    assert _judged(against, both, "tilt") == pytest.approx(angle)
    assert _holds(against, both)
    assert angle == 0.0 or not _holds(replace(against, tilt=angle - 1e-6), both)


def test_the_largest_tilt_of_the_window_counts() -> None:
    swing = _snapshots(box=lambda t: _pose([0, 0, 0], [0.5 if 1.9 < t < 2.1 else 0.0, 0, 0]))
    assert _holds(Upright(object="box", tilt=0.4, for_last=0.5), swing)
    assert not _holds(Upright(object="box", tilt=0.4, for_last=1.5), swing)


def test_at_rest_is_how_far_it_was_from_its_last_place() -> None:
    moving = _snapshots(box=lambda t: _pose([0.3, 0.004 * t, 0.0]))
    rest = AtRest(object="box", motion=0.003, for_last=0.5)
    assert _judged(rest, moving, "motion") == pytest.approx(0.002)
    assert _holds(rest, moving) and not _holds(replace(rest, for_last=1.0), moving)
    # Back at the last place it still moved.
    there_and_back = _snapshots(box=lambda t: _pose([0.02 * np.sin(np.pi * (t - 2.0)), 0, 0]))
    assert _judged(rest, there_and_back, "motion") == pytest.approx(0.02)
    with pytest.raises(TaskError, match=r"for_last: 0\.0 s found"):
        AtRest(object="box", motion=0.003)


def test_slip_is_in_the_hand_whatever_the_hand_does() -> None:
    def hand(t: float) -> RigidTransform:
        return _pose([0.1 * t, 0.2, 0.3 + 0.1 * t], [0.5 * t, 0.3, t])

    X_EO = _random_pose(5)
    still = HeldStill(object="box", slip=0.01, for_last=1.0)
    carried = _snapshots(X_WE=hand, box=lambda t: hand(t) @ X_EO)
    assert _judged(still, carried, "slip") == pytest.approx(0.0, abs=1e-12)
    slipping = _snapshots(X_WE=hand, box=lambda t: hand(t) @ _pose([0, 0, 0.02 * t]) @ X_EO)
    assert _judged(still, slipping, "slip") == pytest.approx(0.02)
    # Since the start, however long that is.
    assert _judged(replace(still, for_last=np.inf), slipping, "slip") == pytest.approx(0.06)
    reason = replace(still, for_last=np.inf).judge(SCENE, slipping).reason
    assert "slipped in the hand since the start" in reason
    # Turning about its centre of mass is no slip.
    turning = _snapshots(
        X_WE=hand,
        box=lambda t: hand(t) @ X_EO @ _pose(CENTRE, [0, 0, t]) @ RigidTransform(-CENTRE),
    )
    assert _judged(still, turning, "slip") == pytest.approx(0.0, abs=1e-12)
    with pytest.raises(TaskError, match=r"for_last: 0\.0 s found"):
        HeldStill(object="box", slip=0.01)


def test_carrying_is_the_time_in_the_hand_alone() -> None:
    def slipping(first_touch: float, what: tuple[str, str] = ("box", "marble")) -> list[Snapshot]:
        hand = ("box", ROBOT)
        return _snapshots(
            contacts=lambda t: {hand} if t < first_touch - 1e-9 else {hand, what},
            box=lambda t: _pose([0, 0, 0.01 * t]) @ START["box"],
        )

    still = CarriedStill(object="box", slip=0.015)
    assert _judged(still, slipping(1.0), "carrying_slip") == pytest.approx(0.0095)
    assert _judged(still, slipping(9.0), "carrying_slip") == pytest.approx(0.03)
    assert _judged(still, slipping(0.0), "carrying_slip") == 0.0
    assert _holds(still, slipping(1.0)) and not _holds(still, slipping(2.0))
    # What the marble touches is not the box' business; the table is.
    assert not _holds(still, slipping(1.0, ("marble", TABLE)))
    assert _holds(still, slipping(1.0, ("box", TABLE)))
    # What was taken from the table at 1 s and meets the marble at 2 s was carried in between.
    others = [TABLE, ROBOT, "marble"]
    taken = _snapshots(
        contacts=lambda t: {("box", others[min(int(t), 2)])},
        box=lambda t: _pose([0, 0, 0.01 * t]) @ START["box"],
    )
    assert _judged(still, taken, "carrying_slip") == pytest.approx(0.0095)
    # What was never carried did not slip.
    lying = _snapshots(contacts=lambda t: {("box", TABLE)})
    assert _judged(still, lying, "carrying_slip") == 0.0
    with pytest.raises(TaskError, match="for_last"):
        CarriedStill(object="box", slip=0.01, for_last=1.0)
    with pytest.raises(TaskError, match="no snapshots"):
        still.judge(SCENE, [])


@pytest.mark.parametrize("seed", range(5))
def test_places_are_measured_in_the_other_s_frame(seed: int) -> None:
    """The box' opening: its z axis along the box' x, its x along the box' y, at x = 0.13."""
    rng = np.random.default_rng(seed)
    p_BM = rng.uniform(-0.2, 0.2, 3)
    X_WB = _random_pose(seed)
    snapshots = _snapshots(box=lambda t: X_WB, marble=lambda t: X_WB @ _pose(p_BM, [0.3, 1, 2]))
    pair = {"object": "marble", "other": "box"}
    offset = np.hypot(p_BM[1], p_BM[2] - 0.15)
    assert _judged(NearAxis(**pair, offset=0.1), snapshots, "offset") == pytest.approx(offset)
    depth = 0.13 - p_BM[0]
    assert _judged(Below(**pair, depth=0.1), snapshots, "depth") == pytest.approx(depth)
    distance = np.hypot(offset, depth)
    within = Within(**pair, frame="opening", distance=0.1)
    assert _judged(within, snapshots, "distance") == pytest.approx(distance)
    assert _holds(replace(within, distance=distance + 1e-9), snapshots)
    assert not _holds(replace(within, distance=distance - 1e-9), snapshots)
    # A named point of the object instead of its centre of mass.
    pole = p_BM + 0.005 * Rotation.from_rotvec([0.3, 1, 2]).as_matrix()[:, 2]
    to_pole = np.linalg.norm(pole - [0.13, 0.0, 0.15])
    assert _judged(replace(within, point="pole"), snapshots, "distance") == pytest.approx(to_pole)


@pytest.mark.parametrize("seed", range(20))
def test_inside_is_the_distance_to_the_hull_s_planes(seed: int) -> None:
    rng = np.random.default_rng(seed)
    X_WB = _random_pose(seed)
    p_BM = CENTRE + rng.uniform(-0.8, 0.8, 3) * SIZE
    snapshots = _snapshots(box=lambda t: X_WB, marble=lambda t: X_WB @ _pose(p_BM))
    inside = Inside(object="marble", other="box")
    margin = (SIZE / 2 - np.abs(p_BM - CENTRE)).min()
    assert _judged(inside, snapshots, "margin_inside") == pytest.approx(margin)
    assert _holds(inside, snapshots) == (margin > 0)
    assert _holds(replace(inside, margin=0.03), snapshots) == (margin > 0.03)
    upper = min(margin, p_BM[2] - CENTRE[2])
    found = _judged(replace(inside, parts=("upper",)), snapshots, "margin_inside")
    assert found == pytest.approx(upper)


def test_the_first_that_fails_gives_the_reason_and_all_are_measured() -> None:
    snapshots = _snapshots()
    lifted = Lifted(object="box", height=0.1)
    away = Within(object="marble", other="box", frame="opening", distance=0.01)
    upright = Upright(object="box", tilt=0.1)
    verdict = AllOf(predicates=(upright, lifted, away)).judge(SCENE, snapshots)
    assert not verdict.success
    assert verdict.reason == "box is not lifted enough: 0.000 m, at least 0.100 m asked for"
    assert set(verdict.measures) == {"tilt", "lift", "distance"}
    assert (
        AllOf(predicates=(upright, AllOf(predicates=(away, lifted))))
        .judge(SCENE, snapshots)
        .reason.startswith("marble is away from box's opening")
    )
    assert _holds(AllOf(predicates=(upright,)), snapshots)
    named = replace(lifted, otherwise="it stays where it is", height=0.25)
    reason = AllOf(predicates=(named,)).judge(SCENE, snapshots).reason
    assert reason == "it stays where it is: 0.000 m, at least 0.250 m asked for"


def test_two_measures_of_one_name_need_a_prefix() -> None:
    box, marble = (Upright(object=name, tilt=0.1) for name in ("box", "marble"))
    with pytest.raises(TaskError, match="two predicates measure 'tilt'"):
        AllOf(predicates=(box, marble)).judge(SCENE, _snapshots())
    both = AllOf(predicates=(box, replace(marble, name="marble")))
    assert set(both.judge(SCENE, _snapshots()).measures) == {"tilt", "marble_tilt"}


@pytest.mark.parametrize("at_least", [1, 2, 3])
def test_so_many_of_all_have_to_hold(at_least: int) -> None:
    tilts = (0.1, 0.3, 0.5)
    snapshots = _snapshots(box=lambda t: _pose([0, 0, 0], [0.2, 0, 0]))
    count = CountOf(
        predicates=tuple(Upright(object="box", tilt=tilt) for tilt in tilts), at_least=at_least
    )
    verdict = count.judge(SCENE, snapshots)
    assert verdict.measures == {"count": 2.0}
    assert verdict.success == (at_least <= 2)
    if at_least == 3:
        assert verdict.reason.startswith("too few hold (2 of 3, at least 3): box's axis is tilted")


@pytest.mark.parametrize(
    ("predicate", "message"),
    [
        (Touching(first="box", second="cup"), "no object 'cup': the scene has box, marble, robot"),
        (Lifted(object="cup", height=0.1), "no object 'cup': the scene has box, marble"),
        (Upright(object="cup", tilt=0.1), "no object 'cup'"),
        (Below(object="marble", other="box", depth=0.1, frame="lid"), "no frame 'lid': it has ope"),
        (NearAxis(object="marble", other="box", offset=0.1, point="top"), "no frame 'top': it has"),
        (Inside(object="marble", other="box", parts=("lid",)), "lid found, box has lower, upper"),
    ],
)
def test_unknown_names_are_refused_with_the_known_ones(predicate: Predicate, message: str) -> None:
    with pytest.raises(TaskError, match=message):
        predicate.judge(SCENE, _snapshots())


def test_too_few_snapshots_and_senseless_limits_are_refused() -> None:
    lifted = Lifted(object="box", height=0.1, for_last=4.0)
    with pytest.raises(TaskError, match=r"tidy: .*at least the last 4.0 s"):
        lifted.judge(SCENE, _snapshots())
    with pytest.raises(TaskError, match="no snapshots"):
        Upright(object="box", tilt=0.1).judge(SCENE, [])
    for value in (-0.1, np.nan):
        with pytest.raises(TaskError, match=r"Lifted.height: .* found, >= 0 expected"):
            Lifted(object="box", height=value)
    with pytest.raises(TaskError, match="0 found, 1 to 1 expected"):
        CountOf(predicates=(lifted,), at_least=0)
    with pytest.raises(TaskError, match=r"AllOf.predicates: none found"):
        AllOf(predicates=())
