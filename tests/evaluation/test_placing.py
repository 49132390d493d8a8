"""Placing judged by physics: boxes whose fate is known; R-NDF's relations, put right and wrong."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from iga_drake.aligners.protocol import PoseEstimate
from iga_drake.errors import IgaDrakeError
from iga_drake.evaluation.placing import judge_placing
from iga_drake.evaluation.relation_objects import (
    PLACING_RELATIONS,
    TEST,
    RelationObjectError,
    RelationObjects,
    handle_hole,
    lowered,
    lowered_floor,
    placed_pose,
)
from iga_drake.evaluation.relations import (
    MOST_TILT,
    RelationTest,
    placing_relation,
    run_relation_trials,
    summarise_relation,
)
from iga_drake.evaluation.results import ResultsStore
from iga_drake.shapes.instance import ShapeInstance


def _solid(*meshes: trimesh.Trimesh) -> ShapeInstance:
    """Convex meshes as one object."""
    mesh = trimesh.util.concatenate(meshes)
    return ShapeInstance(
        family="solid",
        parameters={},
        vertices=mesh.vertices,
        faces=mesh.faces,
        part_labels=np.zeros(len(mesh.faces), int),
        part_names=("surface",),
        convex_pieces=tuple(each.vertices for each in meshes),
        density=500.0,
    )


def _box(*extents: float, at: tuple[float, float, float] = (0, 0, 0)) -> trimesh.Trimesh:
    return trimesh.creation.box(extents).apply_translation(at)


def _tray() -> ShapeInstance:
    """Inside 10 x 10 cm and 6 cm high; the floor 1 cm thick."""
    walls = [
        _box(*((0.01, 0.12) if x else (0.12, 0.01)), 0.06, at=(0.055 * x, 0.055 * y, 0.03))
        for x, y in ((1, 0), (-1, 0), (0, 1), (0, -1))
    ]
    return _solid(_box(0.12, 0.12, 0.01, at=(0, 0, 0.005)), *walls)


def _at(x: float, y: float, z: float) -> np.ndarray:
    X = np.eye(4)
    X[:3, 3] = x, y, z
    return X


BLOCK = _solid(_box(0.05, 0.05, 0.08))


@pytest.mark.parametrize(
    ("X_BA", "lift", "cause"),
    [
        (_at(0, 0, 0.052), 0.0, ""),
        (_at(0.3, 0, 0.05), 0.0, "on the table"),
        (_at(0, 0, 0.042), 0.02, ""),  # into the floor, out of which it is lifted
        (_at(0.05, 0, 0.05), 0.0, "stuck"),  # in a wall
    ],
    ids=["inside", "beside", "lifted", "in the wall"],
)
def test_a_block_in_a_tray(X_BA: np.ndarray, lift: float, cause: str) -> None:
    placing = judge_placing(BLOCK, _tray(), X_BA, most_tilt=MOST_TILT, lift=lift)
    if cause == "stuck":  # or pushed out of the wall to the other side
        assert not placing.success
    else:
        assert (placing.success, placing.cause) == (not cause, cause)
    if placing.success:
        assert placing.tilt < 0.02 and placing.moved == pytest.approx(
            abs(0.05 - X_BA[2, 3]), abs=0.002
        )


def test_what_lies_is_tilted_and_what_floats_falls() -> None:
    base = _solid(_box(0.2, 0.2, 0.02, at=(0, 0, 0.01)))
    lying = np.array([[0.0, 0, 1, 0], [0, 1, 0, 0], [-1, 0, 0, 0.046], [0, 0, 0, 1]])
    placing = judge_placing(BLOCK, base, lying, most_tilt=MOST_TILT)
    assert placing.cause == "tilted" and placing.tilt == pytest.approx(np.pi / 2, abs=0.02)
    assert judge_placing(BLOCK, base, lying).success  # any way up is right
    placing = judge_placing(BLOCK, base, _at(0, 0, 0.08), most_tilt=MOST_TILT)
    assert placing.success and placing.moved == pytest.approx(0.02, abs=0.002)


def test_things_are_let_down_as_far_as_they_go() -> None:
    """To the tray's floor or, where it is too wide, onto its walls; from the block's middle."""
    assert lowered(BLOCK, _tray()) == pytest.approx(0.01 + 0.04, abs=1e-3)
    wide = _solid(_box(0.115, 0.05, 0.08))
    assert lowered(wide, _tray()) == pytest.approx(0.06 + 0.04, abs=1e-3)
    assert lowered_floor(_tray()) == pytest.approx(0.01, abs=1e-3)
    relation = placing_relation("bottle_in_container")
    assert placed_pose(relation, wide, _tray()) is None


def test_the_hole_of_a_handle_is_found_whichever_way_it_points() -> None:
    """A handle of three bars: a hole of 3 x 4 cm, 5.5 cm from the axis and 5 cm high."""
    turn = np.radians(70)
    body = trimesh.creation.cylinder(0.04, 0.1).apply_translation((0, 0, 0.05))
    bars = [_box(0.04, 0.01, 0.01, at=(0.06, 0, z)) for z in (0.025, 0.075)]
    bars += [_box(0.01, 0.01, 0.06, at=(0.075, 0, 0.05))]
    mesh = trimesh.util.concatenate([body, *bars])
    mesh.apply_transform(trimesh.transformations.rotation_matrix(turn, [0, 0, 1]))
    found = handle_hole(_solid(mesh))
    assert found is not None
    X_AH, outwards = found
    out = np.array([np.cos(turn), np.sin(turn), 0.0])
    assert X_AH[:3, 0] @ out > np.cos(np.radians(6))
    assert abs(X_AH[:3, 3] @ [-out[1], out[0], 0.0]) < 0.004
    place = X_AH[:3, 3] @ out
    assert 0.048 < place < 0.062 and place + outwards == pytest.approx(0.07, abs=0.004)
    assert X_AH[2, 3] == pytest.approx(0.05, abs=0.008)
    assert handle_hole(BLOCK) is None


class _Answers:
    """The right pose, moved in the test pair's frame W."""

    name = "answers"

    def __init__(self, test: RelationTest, dz: float = 0.0) -> None:
        self.test, self.dz, self.asked = test, dz, []

    def align(self, context, grasped, target, *, grasped_up=None, target_up=None, seed=0):
        self.asked.append((context, grasped, target, grasped_up, target_up))
        pair = self.test.objects.draw(self.test.relation, TEST, self.test._rng(seed, 0))
        query, _, X_WB = self.test.query(seed, pair)
        motion = np.eye(4)
        motion[:3, 3] = X_WB[:3, 2] * self.dz
        return PoseEstimate((motion @ np.linalg.inv(query.start))[None], [0.0], [1.0])


@pytest.mark.parametrize("name", [relation.name for relation in PLACING_RELATIONS])
def test_what_is_put_where_it_belongs_stays(name: str) -> None:
    row = RelationTest(placing_relation(name)).trial(None, 3)
    assert row.success and row.aligner == "oracle" and row.translation == 0


@pytest.mark.parametrize("poses", ["upright", "arbitrary"])
def test_trials_ask_what_they_say_and_judge_the_answer(poses: str, tmp_path: Path) -> None:
    test = RelationTest(placing_relation("bottle_in_container"), poses=poses, demonstrations=1)
    right = _Answers(test)
    store = ResultsStore(tmp_path / "results.jsonl")
    (row,) = run_relation_trials(test, right, [4], store=store)
    assert row.success and row.translation == pytest.approx(0, abs=1e-6)
    ((context, grasped, target, grasped_up, target_up),) = right.asked
    assert len(context) == 1 and grasped.shape == target.shape == (512, 3)
    if poses == "upright":
        np.testing.assert_allclose([grasped_up, target_up], [[0, 0, 1]] * 2, atol=1e-9)
        assert all(shown.target_up is not None for shown in context)
        # A bottle is taller than wide.
        assert np.ptp(grasped, axis=0).argmax() == 2
    else:
        assert grasped_up is None and target_up is None and context[0].target_up is None
    (again,) = run_relation_trials(test, right, [4], store=ResultsStore(store.path))
    assert again == replace(row, reused=True) and len(right.asked) == 1
    wrong = _Answers(test, dz=0.3)
    wrong.name = "wrong"
    (row,) = run_relation_trials(test, wrong, [4])
    assert row.translation == pytest.approx(0.3, abs=1e-6)
    summary = summarise_relation(test, [row, again])
    assert summary["objects"] == "families" and summary["trials"] == 2
    assert summary["published_rndf"] == (0.8 if poses == "upright" else 0.75)


def test_a_user_s_meshes_are_told_apart(tmp_path: Path) -> None:
    (tmp_path / "bottle").mkdir()
    for n in range(4):
        trimesh.creation.cylinder(0.03, 0.15 + 0.01 * n).export(tmp_path / f"bottle/b{n}.stl")
    relation = placing_relation("bottle_in_container")
    test = RelationTest(relation, demonstrations=1, meshes=str(tmp_path))
    assert test.source == "meshes, container of families"
    heights = {
        split: {
            round(float(np.ptp(RelationObjects(str(tmp_path)).draw(
                relation, split, np.random.default_rng(k)).grasped.vertices[:, 2])), 3)
            for k in range(2)
        }
        for split in ("demonstration", "test")
    }  # fmt: skip
    assert heights["demonstration"] and not heights["demonstration"] & heights["test"]
    with pytest.raises(RelationObjectError, match=r"0 meshes of the category 'mug'.*bottle \(4\)"):
        RelationTest(placing_relation("mug_on_rack"), meshes=str(tmp_path))


def test_bad_arguments_are_refused() -> None:
    with pytest.raises(IgaDrakeError, match="one of: mug_on_rack, bottle_in_container"):
        placing_relation("hat_on_hook")
    relation = PLACING_RELATIONS[0]
    for arguments, message in (
        ({"poses": "lying"}, "one of upright, arbitrary"),
        ({"demonstrations": 0}, "at least 1"),
        ({"lift": -0.1}, "0 or more"),
    ):
        with pytest.raises(IgaDrakeError, match=message):
            RelationTest(relation, **arguments)
