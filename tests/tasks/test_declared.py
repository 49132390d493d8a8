"""Tasks that a file declares: scenes, expert, success, and what is refused."""

import dataclasses
import shutil
from pathlib import Path

import numpy as np
import pytest
import trimesh
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix

from iga_drake.errors import IgaDrakeError
from iga_drake.station.scenario import Scenario, load_scenario
from iga_drake.tasks.declared import DeclaredTask
from iga_drake.tasks.episode import Episode, demonstrations_path
from iga_drake.tasks.predicates import CountOf, Lifted, NotTouching, Upright, Within
from iga_drake.tasks.registry import scenario_task
from iga_drake.tasks.snapshots import ROBOT, TABLE, Snapshot, TaskError

FILE = """
task:
  name: crate_on_plinth
  time_limit: 30.0
  declared:
    objects:
      plinth:
        role: target
        files: [plinth.sdf]
        frames: {seat: {xyz: [0.0, 0.0, 0.02]}}
        place: {lower: [0.5, 0.1], upper: [0.6, 0.25], reach: [0.45, 0.65]}
      crate:
        role: grasped
        files: [meshes/crate.obj]
        test_files: [meshes/tall.obj]
        unit: 0.001
        up: y
        mass: 0.1
        place: {lower: [0.4, -0.2], upper: [0.5, -0.05], yaw_deg: [-30, 30]}
      puck:
        family: mug
        parameters: {height: [0.08, 0.09]}
        place: {stands_on: plinth.seat, lower: [-0.01, -0.01], upper: [0.01, 0.01]}
    waypoints:
      - name: pick
        target: crate
        before_E: [0, 0, -0.1]
        after_W: [0, 0, 0.12]
        expert: {at: top, xyz: [0, 0, -0.02], rpy_deg: [180, 0, 90]}
      - name: place
        grasped: crate
        target: plinth
        before_W: [0, 0, 0.1]
        opening_approach: 0.0
        opening_reached: 0.08
        expert: {of: base, at: seat, turns: 4}
    success:
      - Lifted: {object: crate, height: 0.08, for_last: 0.5}
      - NotTouching: {first: crate, second: table, for_last: 0.5}
      - Upright: {object: crate, tilt_deg: 20, for_last: always}
demonstrations: own_demonstrations
"""
PLINTH = """<sdf version="1.9"><model name="plinth"><link name="plinth">
<inertial><mass>1</mass><inertia><ixx>0.01</ixx><iyy>0.01</iyy><izz>0.01</izz></inertia></inertial>
<visual name="v"><geometry><box><size>0.16 0.16 0.04</size></box></geometry></visual>
<collision name="block"><geometry><box><size>0.16 0.16 0.04</size></box></geometry></collision>
</link></model></sdf>"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A user's folder: the scenario, a model and two meshes in mm, y up."""
    folder = tmp_path_factory.mktemp("mine")
    (folder / "meshes").mkdir()
    trimesh.creation.box((60, 50, 30)).export(folder / "meshes" / "crate.obj")
    trimesh.creation.box((60, 70, 30)).export(folder / "meshes" / "tall.obj")
    (folder / "plinth.sdf").write_text(PLINTH)
    (folder / "own_demonstrations").mkdir()
    (folder / "mine.yaml").write_text(FILE)
    return folder


@pytest.fixture(scope="module")
def task(folder: Path) -> DeclaredTask:
    found = scenario_task(load_scenario(folder / "mine.yaml"))
    assert isinstance(found, DeclaredTask)
    return found


def test_scenes_are_drawn_as_declared(task: DeclaredTask, tmp_path: Path):
    assert task.name == "crate_on_plinth"
    for seed in range(6):
        scene = task.scene(seed, mesh_folder=tmp_path)
        plinth, crate, puck = scene.objects
        assert [item.role for item in scene.objects] == ["target", "grasped", "other"]
        x, y, z = plinth.X_WO.translation()
        assert 0.5 <= x <= 0.6 and 0.1 <= y <= 0.25 and 0.45 <= np.hypot(x, y) <= 0.65
        assert 0.02 < z < 0.021  # the box's middle is its origin: it stands on its lower side
        yaw = crate.X_WO.rotation().ToRollPitchYaw().yaw_angle()
        assert abs(yaw) <= np.radians(30)
        np.testing.assert_allclose(crate.X_WO.rotation().matrix()[:, 2], [0, 0, 1], atol=1e-12)
        p_TP = plinth.X_WO.inverse() @ puck.X_WO.translation()
        assert np.abs(p_TP[:2]).max() <= 0.01 and 0.02 < p_TP[2] < 0.021
        assert 0.08 <= scene.truth.shapes["puck"].parameters["height"] <= 0.09
        assert scene.truth.shapes["crate"].mesh.extents[2] == pytest.approx(0.07)
        again = task.scene(seed, mesh_folder=tmp_path)
        assert [o.model for o in again.objects] == [o.model for o in scene.objects]
        assert all(
            a.X_WO.IsExactlyEqualTo(b.X_WO)
            for a, b in zip(scene.objects, again.objects, strict=True)
        )
    shown = task.scene(0, "demonstration", mesh_folder=tmp_path)
    assert shown.truth.shapes["crate"].mesh.extents[2] == pytest.approx(0.05)
    assert len(task.instances("demonstration")) == 6 and len(task.instances("test")) == 8
    with pytest.raises(TaskError, match="split 'train'"):
        task.instances("train")


def test_the_motion_relates_what_the_waypoints_name(task: DeclaredTask):
    plans = {plan.name: plan for plan in task.motion.observations}
    assert [(p.role, p.frame, p.after) for p in plans.values()] == [
        ("grasped", "W", 0), ("gripper", "E", 0), ("target", "W", 0), ("grasped", "E", 1),
    ]  # fmt: skip
    assert plans["held crate"].present is not None
    assert task.motion.relations == (
        ("pick", "gripper", "crate"), ("place", "held crate", "plinth"),
    )  # fmt: skip
    assert [len(w.symmetries_E) for w in task.motion.waypoints] == [2, 1]


def test_the_expert_brings_frame_to_frame(task: DeclaredTask, tmp_path: Path):
    scene = task.scene(1, mesh_folder=tmp_path)
    X_WO = {item.name: item.X_WO for item in scene.objects}
    X_WE = X_WO["crate"] @ RigidTransform(RollPitchYaw(np.pi, 0, np.pi / 2), [0, 0, 0.05])
    pick, place = task.expert(scene, X_WO, X_WE)
    np.testing.assert_allclose(
        pick.translation(), X_WO["crate"].translation() + [0, 0, 0.07 - 0.02], atol=1e-9
    )
    np.testing.assert_allclose(pick.rotation().matrix()[:, 2], [0, 0, -1], atol=1e-9)
    # Its fingers close along the crate's y or, which is the same, its -y.
    across = pick.rotation().matrix()[:, 1] @ X_WO["crate"].rotation().matrix()[:, 0]
    assert abs(across) == pytest.approx(1.0)
    X_WA = place @ X_WE.inverse() @ X_WO["crate"]  # where the crate gets to
    X_WF = X_WO["plinth"] @ RigidTransform([0, 0, 0.02])
    np.testing.assert_allclose(X_WA.translation(), X_WF.translation(), atol=1e-9)
    turn = (X_WF.inverse() @ X_WA).rotation().ToRollPitchYaw().yaw_angle()
    assert np.isclose(np.sin(2 * turn), 0, atol=1e-9)  # a multiple of 90 deg


def test_success_is_the_declared_predicates(task: DeclaredTask, tmp_path: Path):
    scene = task.scene(0, mesh_folder=tmp_path)
    lifted, apart, upright = task.goal(scene.truth).predicates  # type: ignore[attr-defined]
    assert lifted == Lifted(object="crate", height=0.08, for_last=0.5)
    assert apart == NotTouching(first="crate", second=TABLE, for_last=0.5)
    assert upright == Upright(object="crate", tilt=np.radians(20), for_last=np.inf)
    start = {item.name: item.X_WO for item in scene.objects}

    def verdict(lift: float, tilt: float):
        up = RigidTransform(RotationMatrix.MakeXRotation(tilt), [0, 0, 0])
        X = RigidTransform([0, 0, lift]) @ start["crate"] @ up
        shots = [Snapshot(t, {**start, "crate": X}, X, 0.03) for t in np.arange(0, 1.05, 0.1)]
        return task.success(scene, shots)

    assert verdict(0.1, 0.0).success
    assert "not lifted enough" in verdict(0.05, 0.0).reason
    assert "tilted" in verdict(0.1, 0.5).reason


def test_success_may_be_asked_of_some_of_several_objects(folder: Path, tmp_path: Path):
    path = folder / "some.yaml"
    stated = "      - Within: {object: 'crate, puck', other: plinth, frame: seat, distance: 0.1"
    path.write_text(FILE.replace("success:\n", f"success:\n{stated}, at_least: 1}}\n", 1))
    task = scenario_task(load_scenario(path))
    scene = task.scene(0, "demonstration", mesh_folder=tmp_path)
    some = task.goal(scene.truth).predicates[0]  # type: ignore[attr-defined]
    assert some == CountOf(
        predicates=tuple(
            Within(object=name, other="plinth", frame="seat", distance=0.1)
            for name in ("crate", "puck")
        ),
        at_least=1,
    )


HELD = """
task:
  name: held_crate
  declared:
    objects:
      crate:
        role: grasped
        files: [meshes/crate.obj]
        unit: 0.001
        up: y
        held: {frame: top, xyz: [0.004, 0, -0.015], rpy_deg: [180, 0, 90]}
      plinth: {role: target, files: [plinth.sdf]}
    waypoints:
      - {name: place, grasped: crate, target: plinth, opening_approach: 0.0, opening_reached: 0.05}
    success:
      - Touching: {first: crate, second: plinth}
"""


def test_what_is_held_is_between_the_pads(folder: Path, tmp_path: Path):
    path = folder / "held.yaml"
    path.write_text(HELD)
    scene = scenario_task(load_scenario(path)).scene(0, mesh_folder=tmp_path)
    assert scene.hand_opening == pytest.approx(0.06, abs=1e-3)  # the crate's edge along its x
    X_EO = scene.truth.X_EO["crate"]
    # Centred: the offset along the fingers' way is gone; 15 mm below the top, 50 mm high.
    np.testing.assert_allclose(X_EO.translation(), [0, 0, 0.05 - 0.015], atol=1e-6)


def test_the_digest_knows_the_files_but_not_their_folder(folder: Path, tmp_path: Path):
    moved = tmp_path / "elsewhere"
    shutil.copytree(folder, moved)
    first, second = (load_scenario(place / "mine.yaml") for place in (folder, moved))
    assert first.digest == second.digest
    trimesh.creation.box((61, 50, 30)).export(moved / "meshes" / "crate.obj")
    assert first.digest != load_scenario(moved / "mine.yaml").digest
    assert demonstrations_path(second) == moved / "own_demonstrations"
    # As text it says where it is, so that another process finds the files.
    (tmp_path / "copy.yaml").write_text(first.to_yaml())
    assert load_scenario(tmp_path / "copy.yaml").digest == first.digest


REFUSED = {
    "no such file": ("meshes/crate.obj", "meshes/crat.obj", r"crate\.files.*crat\.obj.*mend"),
    "a free unit": ("unit: 0.001", "unit: 1.0", r"crate\.obj.*60 x 30 x 50 m.*unit: 0.001"),
    "unit of a model": ("[plinth.sdf]", "[plinth.sdf]\n        unit: 0.1", "plinth.*leave them"),
    "family": ("family: mug", "family: mog", "puck.family: 'mog' is none of"),
    "parameter": ("height: [0.08", "hight: [0.08", "mug.hight"),
    "both": ("family: mug", "family: mug\n        files: [a.obj]", "a family or files"),
    "role": ("role: target", "role: other", "plinth.role: 'other' found.*target or grasped"),
    "not held": ("grasped: crate", "grasped: puck", "puck.role: 'other' found"),
    "target": ("target: plinth", "target: plint", r"waypoints\[1\].target.*plinth, crate, puck"),
    "frame": ("at: seat", "at: seet", r"waypoints\[1\].expert.at: .*no frame 'seet': it has"),
    "of gripper": ("expert: {at: top", "expert: {of: tip, at: top", "gripper has no frames but"),
    "predicate": ("Lifted:", "Lofted:", "'Lofted' is no predicate: one of Touching"),
    "its key": ("height: 0.08,", "hight: 0.08,", "Lifted: unknown key 'hight'; valid: for_last"),
    "its field": ("height: 0.08,", "", "Lifted: height not stated"),
    "its object": ("{object: crate, height", "{object: crote, height", "'crote' found, one of"),
    "its number": ("height: 0.08", "height: high", "Lifted.height: 'high' found, a number"),
    "how many": (
        "{object: crate, height",
        "{object: crate, at_least: 2, height",
        "1 to 1 expected",
    ),
    "how many, a number": (
        "{object: crate, height",
        "{object: crate, at_least: some, height",
        "at_least: 'some' found, a whole number",
    ),
    "name": ("name: crate_on_plinth", "name: stack", "'stack' is a task that there is already"),
    "object's name": ("      puck:", "      robot:", "'robot' is out of range.*and not world"),
    "upon": (
        "stands_on: plinth.seat",
        "stands_on: chair.seat",
        "'chair.seat' found, an object that is stated",
    ),
    "place": ("reach: [0.45, 0.65]", "reach: [1.5, 1.6]", r"plinth\.place: .*none of 10000"),
    "suffix": ("[plinth.sdf]", "[mine.yaml]", r"mine\.yaml: no mesh of a known kind; use one of"),
    "no success": ("success:\n", "success: []\n    packages: {}\nx:\n", "unknown key 'x'"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_makes_no_task_is_refused(folder: Path, tmp_path: Path, name: str):
    old, new, reason = REFUSED[name]
    assert old in FILE
    path = folder / "changed.yaml"
    path.write_text(FILE.replace(old, new, 1))
    with pytest.raises(IgaDrakeError, match=f"(?s){reason}"):
        scenario_task(load_scenario(path)).scene(
            0, "demonstration", mesh_folder=tmp_path, instance=0
        )


LIFT = """
task:
  name: lift_crate
  time_limit: 15.0
  declared:
    objects:
      crate:
        role: target
        files: [meshes/crate.obj]
        unit: 0.001
        up: y
        density: 400
        friction: 1.0
        place: {lower: [0.5, 0.0], upper: [0.5, 0.0], yaw_deg: [20, 20]}
    waypoints:
      - name: pick
        target: crate
        before_E: [0, 0, -0.05]
        after_W: [0, 0, 0.06]
        settle: 0.5
        expert: {at: top, xyz: [0, 0, -0.02], rpy_deg: [180, 0, 0]}
    success:
      - Lifted: {object: crate, height: 0.05}
      - Touching: {first: crate, second: robot}
"""


def test_a_declared_task_is_done_by_its_expert(folder: Path):
    """Perception, policy and physics: the whole diagram, with one small camera."""
    path = folder / "lift.yaml"
    path.write_text(LIFT)
    scenario: Scenario = load_scenario(path)
    camera = dataclasses.replace(scenario.cameras["camera_0"])
    scenario.cameras = {"camera_0": camera}
    scenario.control.linear_speed *= 2
    with Episode(scenario, seed=0, aligner="expert") as episode:
        result = episode.run()
    assert result.success, result.reason
    assert result.measures["lift"] == pytest.approx(0.06, abs=0.01)
    assert ROBOT in {name for pair in episode.snapshots[-1].contacts for name in pair}
