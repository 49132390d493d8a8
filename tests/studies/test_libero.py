"""The parts of the LIBERO-PRO study that need no LIBERO-PRO: perception, ways, expert, episodes."""

import argparse
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from iga_drake import cli
from iga_drake.aligners.protocol import AlignerError, PoseEstimate
from iga_drake.demonstrations.demonstration import DemonstrationSet
from iga_drake.errors import ConfigError
from iga_drake.evaluation.task_success import wilson_interval
from iga_drake.studies import libero
from iga_drake.studies.libero import episode, expert, motion, perception, study
from iga_drake.studies.libero.benchmark import HEIGHT, WIDTH
from iga_drake.studies.libero.episode import LiberoResult, demonstrate, run_episode
from iga_drake.studies.libero.perception import LabelledView, UnseenError

OPEN_HAND = np.array(  # points of an open hand, in E
    [[x, y, z] for x in (-0.05, 0.05) for y in (-0.01, 0.01) for z in np.linspace(-0.1, 0.009, 20)]
)


def test_it_needs_no_drake() -> None:
    folder = Path(libero.__file__).parent
    modules = [f"iga_drake.studies.libero.{path.stem}" for path in sorted(folder.glob("*.py"))]
    code = (
        "import importlib, sys; sys.modules['pydrake'] = None\n"
        f"for name in {modules!r}: importlib.import_module(name)\n"
        "import iga_drake.cli.evaluate\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_a_missing_benchmark_is_told(monkeypatch, capsys) -> None:
    monkeypatch.setitem(sys.modules, "libero", None)
    assert cli.main(["evaluate", "libero", "--tasks", "0"]) == cli.BAD_INPUT
    error = capsys.readouterr().err
    assert "docs/libero.md" in error and "libero-requirements.txt" in error


@pytest.mark.parametrize(
    ("option", "value"),
    [("tasks", "10"), ("tasks", "a"), ("episodes", 0), ("demonstrations", 17), ("seed", -1)],
)
def test_options_out_of_range_are_told_by_name(option: str, value: object) -> None:
    arguments = {"suite": "libero_object", "variant": "none", "tasks": "", "episodes": 20}
    arguments |= {"demonstrations": 5, "aligner": "iga", "seed": 0, "results": None, option: value}
    with pytest.raises(ConfigError, match=f"--{option}"):
        study.run(argparse.Namespace(**arguments))


# -- perception

CENTRE, RADIUS = np.array([0.1, -0.05, 0.06]), 0.06


def sphere_view(eye: np.ndarray, label: int = 1) -> LabelledView:
    """A sphere before nothing, by rays in the convention of MuJoCo's cameras: -z ahead, y up."""
    H, W, view = HEIGHT, WIDTH, np.radians(45)
    R = perception.looking_at(eye, CENTRE + [0.02, 0.01, 0.0])
    top = np.tan(view / 2)
    y = np.linspace(top, -top, 2 * H + 1)[1::2]
    x = np.linspace(-top * W / H, top * W / H, 2 * W + 1)[1::2]
    rays = np.stack([*np.meshgrid(x, y), -np.ones((H, W))], axis=-1) @ R.T  # in W
    a = (rays**2).sum(-1)
    b = rays @ (eye - CENTRE)
    root = b**2 - a * (((eye - CENTRE) ** 2).sum() - RADIUS**2)
    depth = np.where(root > 0, (-b - np.sqrt(np.maximum(root, 0))) / a, 5.0)
    labels = np.where(root > 0, label, 0)
    pose = perception.optical_frame(R, eye)
    return LabelledView("camera", np.zeros((H, W, 3), np.uint8), depth, labels, view, pose)


def test_a_cloud_lies_on_the_surface_that_two_cameras_see() -> None:
    views = [sphere_view(np.array(eye)) for eye in ([0.9, 0.0, 0.6], [-0.4, -0.6, 0.5])]
    cloud = perception.object_cloud(views, 1, "ball")
    distances = np.linalg.norm(cloud - CENTRE, axis=1)
    assert np.abs(distances - RADIUS).max() < 1e-3 and len(cloud) > 400
    # From both sides, and no nearer than a voxel to each other in the mean.
    assert (cloud[:, 0] > CENTRE[0] + 0.04).any() and (cloud[:, 0] < CENTRE[0] - 0.03).any()


def test_what_isn_t_seen_is_named() -> None:
    view = sphere_view(np.array([0.9, 0.0, 0.6]))
    with pytest.raises(UnseenError, match="butter_1: 0 points of 0 pixels"):
        perception.object_cloud([view], 2, "butter_1")


def test_the_depth_of_a_buffer_inverts_the_projection() -> None:
    near, far = 0.02, 40.0
    z = np.geomspace(near, far, 20)
    # OpenGL's perspective: clip z over w, from -1 to 1, and the buffer from 0 to 1.
    clip = ((far + near) * z - 2 * far * near) / (far - near) / z
    np.testing.assert_allclose(perception.metric_depth((clip + 1) / 2, near, far), z, rtol=1e-9)


# -- ways


def pose(rng: np.random.Generator) -> np.ndarray:
    X = np.eye(4)
    X[:3, :3] = Rotation.random(random_state=int(rng.integers(1 << 30))).as_matrix()
    X[:3, 3] = rng.uniform(-0.5, 0.5, 3)
    return X


def moved(X: np.ndarray, action: np.ndarray, share: float = 1.0) -> np.ndarray:
    """Where a controller that does this share of what it is asked for brings the hand."""
    X = X.copy()
    X[:3, 3] += share * motion.ACTION_SHIFT * action[:3]
    X[:3, :3] = (
        Rotation.from_rotvec(share * motion.ACTION_TURN * action[3:6]).as_matrix() @ X[:3, :3]
    )
    return X


@pytest.mark.parametrize("seed", range(5))
def test_actions_lead_straight_to_the_goal(seed: int) -> None:
    rng = np.random.default_rng(seed)
    start, goal = pose(rng), pose(rng)
    X, line = start, goal[:3, 3] - start[:3, 3]
    for _ in range(80):
        action = motion.osc_action(X, goal, motion.OPEN)
        assert np.abs(action).max() <= 1 and action[6] == motion.OPEN
        X = moved(X, action, 0.3)
        off = np.cross(X[:3, 3] - start[:3, 3], line / np.linalg.norm(line))
        assert np.linalg.norm(off) < 1e-9
    shift, turn = motion.distance(X, goal)
    assert shift < 1e-4 and turn < 1e-3


@pytest.mark.parametrize("seed", range(5))
def test_a_half_turn_of_the_hand_is_as_good(seed: int) -> None:
    rng = np.random.default_rng(seed)
    X, goal = pose(rng), pose(rng)
    found = motion.nearest_turn(X, goal)
    np.testing.assert_allclose(found[:3, 2:], goal[:3, 2:])  # approach and place are kept
    np.testing.assert_allclose(np.abs(found[:3, 0] @ goal[:3, 0]), 1)
    assert motion.distance(X, found)[1] <= motion.distance(X, found @ motion.HALF_TURN)[1]


def test_a_grasp_is_approached_along_the_hand_and_closed_at_its_end() -> None:
    X = pose(np.random.default_rng(0))
    way = motion.grasp_way(X, 0.2, 0.3)
    closed = [stretch.hand == motion.CLOSED for stretch in way]
    assert closed == sorted(closed)  # never opened again
    first = closed.index(True)
    np.testing.assert_array_equal(way[first].X_WE, X)
    before = np.linalg.inv(X) @ way[first - 2].X_WE
    np.testing.assert_allclose(before[:3, 3], [0, 0, -motion.CLEARANCE], atol=1e-12)
    assert way[0].X_WE[2, 3] >= 0.2
    for carry in (0.3, -1.0):
        lifted = motion.grasp_way(X, 0.2, carry)[-1].X_WE[2, 3]
        assert lifted >= max(carry, X[2, 3] + motion.CLEARANCE)
    placed = motion.place_way(X, 0.3)
    assert placed[0].X_WE[2, 3] >= max(0.3, X[2, 3] + motion.CLEARANCE)
    assert [s.hand == motion.OPEN for s in placed] == [False, False, True, True]


# -- the expert


def box(size: tuple[float, float, float], centre: tuple[float, float, float], yaw: float):
    """Points on a grid through a box that is turned about z."""
    axes = [np.linspace(-s / 2, s / 2, 21) for s in size]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    return points @ Rotation.from_euler("z", yaw).as_matrix().T + centre


@pytest.mark.parametrize("yaw", [0.0, 0.4, 1.5, 2.6])
def test_the_expert_grasps_across_the_narrow_side(yaw: float) -> None:
    centre = (0.1, -0.2, 0.08)
    X = expert.grasp_across(box((0.05, 0.12, 0.16), centre, yaw))
    np.testing.assert_allclose(X[:2, 3], centre[:2], atol=2e-3)
    narrow = np.array([np.cos(yaw), np.sin(yaw), 0])
    assert abs(X[:3, 0] @ narrow) > np.cos(np.radians(3.1))
    np.testing.assert_allclose(X[:3, 2], [0, 0, -1])
    assert np.isclose(np.linalg.det(X[:3, :3]), 1)
    assert 0.16 - X[2, 3] <= 0.04  # no more than the fingers are long
    with pytest.raises(expert.ExpertError, match=r"0\.09\d m wide"):
        expert.grasp_across(box((0.09, 0.12, 0.16), centre, 0.0))


def test_the_expert_takes_a_bowl_at_its_rim() -> None:
    angles = np.linspace(0, 2 * np.pi, 200)
    bowl = np.concatenate(
        [
            np.stack([r * np.cos(angles) + 0.1, r * np.sin(angles), np.full(200, z)], -1)
            for r, z in zip(np.linspace(0.03, 0.06, 30), np.linspace(0, 0.05, 30), strict=True)
        ]
    )
    X = expert.grasp_rim(bowl, np.array([0.0, -1.0]))
    np.testing.assert_allclose(X[:2, 3], [0.1, -0.056], atol=2e-3)
    np.testing.assert_allclose(X[:3, 0], [0, -1, 0], atol=1e-12)


def test_the_expert_places_the_middle_over_the_middle() -> None:
    X_WE = expert.grasp_across(box((0.04, 0.06, 0.10), (0.1, 0.1, 0.35), 0.3))
    held, basket = (
        box((0.04, 0.06, 0.10), (0.1, 0.1, 0.35), 0.3),
        box((0.2, 0.2, 0.14), (0, 0.3, 0.07), 0),
    )
    X = expert.place_in(X_WE, held, basket)
    at = held @ (X[:3, :3] @ X_WE[:3, :3].T).T + X[:3, 3] - X_WE[:3, 3]
    np.testing.assert_allclose((at.min(0) + at.max(0))[:2] / 2, [0, 0.3], atol=1e-6)
    assert at[:, 2].min() > 0.01 and X[2, 3] + 0.045 > 0.14
    plate = box((0.2, 0.2, 0.02), (0.2, 0.0, 0.01), 0)
    X = expert.place_on(X_WE, held, plate)
    assert 0.02 < held[:, 2].min() + X[2, 3] - X_WE[2, 3] < 0.03


# -- episodes, in a scene of a few lines


@dataclass
class Scene:
    """A hand that goes where it is told, a box, and a region in which it counts as done."""

    box_at: np.ndarray
    region_at: np.ndarray
    task: SimpleNamespace = field(
        default_factory=lambda: SimpleNamespace(suite="libero_object", name="box in a region")
    )
    taken: str = "box_1"
    goal: str = "region_1"
    relation: str = "in"
    ground: float = 0.0
    seen: bool = True
    slips: bool = False
    far: bool = False

    def start(self, state: int) -> None:
        self.X_WE = np.eye(4)
        self.X_WE[:3, :3] = np.diag([1.0, -1.0, -1.0])
        self.X_WE[:3, 3] = [-0.1, 0.0, 0.3]
        self.opening, self.held, self.box = 0.08, False, self.box_at.copy()

    def step(self, action: np.ndarray) -> bool:
        before = self.X_WE
        self.X_WE = moved(before, action, 0.4)
        closing = action[6] == motion.CLOSED
        if closing and not self.held and not self.slips:
            self.held = np.linalg.norm(self.box - before[:3, 3]) < 0.03
        self.held &= closing
        self.opening = 0.08 if not closing else 0.04 if self.held else 0.0
        if self.held:
            self.box = self.box + self.X_WE[:3, 3] - before[:3, 3]
        return bool(np.abs(self.box - self.region_at).max() < 0.07)

    def reachable(self, X_WE: np.ndarray) -> bool:
        return not self.far

    def gripper_cloud(self) -> np.ndarray:
        return OPEN_HAND

    def true_surface(self, name: str) -> np.ndarray:
        if name == self.taken:
            return box((0.04, 0.06, 0.05), tuple(self.box), 0.0)
        return box((0.2, 0.2, 0.14), tuple(self.region_at), 0.0)

    def views(self) -> "Scene":
        return self


class Offset:
    """Keeps the demonstrated offset of the centres, and the demonstrated orientation."""

    name = "offset"

    def align(self, context, grasped, target, *, grasped_up=None, target_up=None, seed=0):
        shown = context[0].grasped.mean(0) - context[0].target.mean(0)
        X = np.eye(4)
        X[:3, :3] = np.diag([1.0, -1.0, -1.0])
        X[:3, 3] = target.mean(0) + shown - X[:3, :3] @ grasped.mean(0)
        return PoseEstimate(X[None], np.zeros(1), np.ones(1), np.array([0.9, 0.8]))


class Confused:
    name = "confused"

    def align(self, context, grasped, target, *, grasped_up=None, target_up=None, seed=0):
        raise AlignerError("confused: no idea")


@pytest.fixture
def seen(monkeypatch) -> None:
    """Clouds come from the scene itself."""

    def cloud(scene: Scene, label: int, name: str) -> np.ndarray:
        if not scene.seen:
            raise UnseenError(f"{name}: 0 points")
        return scene.true_surface(scene.taken if label == episode.TAKEN else scene.goal)

    monkeypatch.setattr(episode, "object_cloud", cloud)


SHOWN = Scene(np.array([0.1, -0.2, 0.03]), np.array([0.0, 0.3, 0.07]))
MOVED = Scene(np.array([-0.05, 0.1, 0.03]), np.array([0.1, 0.28, 0.07]))


@pytest.mark.usefixtures("seen")
def test_what_the_expert_shows_is_done_elsewhere() -> None:
    shown = DemonstrationSet("box", (demonstrate(SHOWN, 49),))  # type: ignore[arg-type]
    assert shown.waypoints == ("grasp", "place")
    grasp, place = shown.demonstrations[0].waypoints
    np.testing.assert_allclose(grasp.X_WE[:2, 3], [0.1, -0.2], atol=4e-3)
    np.testing.assert_allclose(place.X_WE[:2, 3], [0.0, 0.3], atol=4e-3)
    (alignment,) = shown.context(1)
    np.testing.assert_allclose(alignment.grasped_up, [0, 0, 1], atol=1e-6)
    result = run_episode(MOVED, 0, shown, Offset())  # type: ignore[arg-type]
    assert result.success and result.stays and not result.cause
    assert result.mode == [0, 0] and result.familiarity == [[0.9, 0.8]] * 2
    assert 20 < result.steps < 280


@pytest.mark.usefixtures("seen")
@pytest.mark.parametrize(
    ("changes", "aligner", "limit", "cause"),
    [
        ({"seen": False}, Offset, 280, "perception"),
        ({}, Confused, 280, "alignment"),
        ({"far": True}, Offset, 280, "alignment"),
        ({"slips": True}, Offset, 280, "grasp"),
        ({}, Offset, 20, "time"),
    ],
)
def test_failures_have_a_cause(changes: dict, aligner: Callable, limit: int, cause: str) -> None:
    shown = DemonstrationSet("box", (demonstrate(SHOWN, 49),))  # type: ignore[arg-type]
    scene = replace(MOVED, **changes)
    result = run_episode(scene, 0, shown, aligner(), limit=limit)  # type: ignore[arg-type]
    assert not result.success and result.cause == cause and result.reason
    assert result.steps <= limit


@pytest.mark.usefixtures("seen")
def test_an_expert_that_drops_shows_nothing() -> None:
    with pytest.raises(expert.ExpertError, match="initial state 3"):
        demonstrate(replace(SHOWN, slips=True), 3)  # type: ignore[arg-type]


def test_the_table_counts_and_gives_wilson_s_interval() -> None:
    done = LiberoResult(True, "", "", 100, True, wall_seconds=10)
    failed = LiberoResult(False, "grasp", "empty", 60, False, wall_seconds=20)
    rows = [({"task": "a"}, done)] * 3 + [({"task": "b"}, failed), ({"task": "b"}, done)]
    text = study.libero_table(rows)
    low, high = wilson_interval(4, 5)
    assert f"success 0.80, 95 % (Wilson) {low:.2f} to {high:.2f}" in text
    lines = [line.split() for line in text.splitlines()]
    assert ["b", "1", "/", "2", "100", "15.0", "1", "grasp"] in lines
