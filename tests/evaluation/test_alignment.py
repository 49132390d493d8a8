"""Pose errors against hand-made poses, and the evaluation with aligners that know the answer."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from iga_drake import cli
from iga_drake.aligners.protocol import PoseEstimate
from iga_drake.checkpoint import load_checkpoint
from iga_drake.dataset.alignment_error import (
    CONFIG,
    SurfaceTolerance,
    equivalents,
    nearest_error,
    pose_errors,
    random_pose,
)
from iga_drake.dataset.samples import make_sample
from iga_drake.errors import IgaDrakeError
from iga_drake.evaluation.alignment import (
    Errors,
    by_category,
    evaluate_alignment,
    model_card,
    own_objects,
)
from iga_drake.evaluation.results import ResultsStore
from iga_drake.paths import landed_weights
from iga_drake.shapes.families import FAMILIES


def test_pose_errors_of_a_known_offset() -> None:
    cloud = np.random.default_rng(0).normal(size=(50, 3))
    truth = random_pose(3)
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_rotvec([0, 0, 0.25]).as_matrix()
    centre = truth @ np.append(cloud.mean(0), 1)
    about = np.eye(4)
    about[:3, 3] = centre[:3]
    shift = np.eye(4)
    shift[:3, 3] = (0.03, 0, 0.04)
    estimate = shift @ about @ turn @ np.linalg.inv(about) @ truth
    assert pose_errors(estimate, truth, cloud) == pytest.approx((0.05, 0.25), abs=1e-9)


def _about(point: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """(4, 4) turn by a rotation vector about a line through a point."""
    X = np.eye(4)
    X[:3, :3] = Rotation.from_rotvec(vector).as_matrix()
    X[:3, 3] = point - X[:3, :3] @ point
    return X


class _Fixed:
    """Answers with the inverse of the start pose after a motion in the test pair's frame."""

    name = "fixed"

    def __init__(self, motion: np.ndarray):
        self.motion = motion
        self.calls = 0

    def align(self, context, grasped, target, *, grasped_up=None, target_up=None, seed=0):
        self.calls += 1
        return PoseEstimate((self.motion @ np.linalg.inv(random_pose(seed)))[None], [0.0], [1.0])


def test_the_truth_has_no_error_and_an_offset_shows() -> None:
    row, _ = evaluate_alignment(_Fixed(np.eye(4)), "validation", 3)
    assert row.plain.translation_mean == pytest.approx(0, abs=1e-6)
    assert row.plain.success == row.modulo.success == (1.0, 1.0, 1.0)
    offset = np.eye(4)
    offset[0, 3] = 0.015
    row, rows = evaluate_alignment(_Fixed(offset), "unseen_categories", 3)
    assert row.plain.translation_mean == pytest.approx(1.5)
    assert row.plain.success == (0.0, 1.0, 1.0) and "1.50" in row.rows()
    assert [r.translation for r in rows] == pytest.approx([0.015] * 3)


def test_answers_off_by_over_45_degrees_are_flips() -> None:
    errors = Errors.of(np.zeros(4), np.radians([0.0, 44.0, 46.0, 180.0]))
    assert errors.flips == 0.5 and errors.columns().endswith("50.0")
    turn = _about(np.zeros(3), np.array([0.0, 0.0, 2.0]))
    row, rows = evaluate_alignment(_Fixed(turn), "validation", 2)
    assert row.plain.flips == 1.0 and "flips" in by_category(rows)


def test_any_of_the_modes_is_right() -> None:
    sample = make_sample("multi_modal", 0, CONFIG)
    for motion in sample.modes:
        error = nearest_error(motion, equivalents(sample, symmetry=False), sample.points[0, -1])
        assert error == pytest.approx((0, 0), abs=1e-6)


def test_errors_modulo_symmetry_forgive_what_turns_a_surface_into_itself() -> None:
    """Of a composite whose surface is a cuboid: half-turns about its axes, no quarter-turns."""
    sample = make_sample("unseen_instances", 0, replace(CONFIG, test_surface=False))
    assert [len(found) for found in sample.found_symmetries] == [1, 1]
    box = trimesh.creation.box((0.08, 0.12, 0.2))
    points, faces = trimesh.sample.sample_surface(box, 2000, seed=0)
    centre = np.array([0.3, -0.2, 0.1])
    surface = np.stack((points + centre, box.face_normals[faces]), 1).astype(np.float32)
    there = replace(
        sample, category=("composite", "composite"), surface=np.stack((surface, surface))
    )
    valid, cloud = equivalents(there, symmetry=True), there.points[0, -1]
    assert len(valid) == 16
    for axis in np.eye(3):
        error = nearest_error(_about(centre, np.pi * axis), valid, cloud)
        assert error[0] < 0.002 and np.degrees(error[1]) < 1.5
        assert nearest_error(_about(centre, np.pi / 2 * axis), valid, cloud)[1] > 1


def test_errors_modulo_symmetry_forgive_the_family_s_own_turns_and_no_others() -> None:
    sample = make_sample("validation", 0, CONFIG)
    vase = replace(sample, category=("composite", "composite"))
    axis_A, axis_B = sample.axes
    cloud = sample.points[0, -1]
    symmetric = {name: f.symmetry for name, f in FAMILIES.items() if not f.symmetry.is_trivial}
    assert any(s.order == 0 for s in symmetric.values())
    for name, group in symmetric.items():
        angle = group.angles()[len(group.angles()) // 2]
        for role, axis in enumerate((axis_A, axis_B)):
            turn = _about(axis[0], angle * axis[1])
            names = ["composite", "composite"]
            names[role] = name
            there = replace(sample, category=tuple(names))
            assert nearest_error(turn, equivalents(there, symmetry=True), cloud) == pytest.approx(
                (0, 0), abs=1e-6
            )
            plain = nearest_error(turn, equivalents(there, symmetry=False), cloud)
            assert plain[1] == pytest.approx(min(angle, 2 * np.pi - angle), abs=1e-6)
            assert nearest_error(turn, equivalents(vase, symmetry=True), cloud) == plain


def test_results_are_gone_on_from_and_belong_to_weights_and_options(tmp_path: Path) -> None:
    file = tmp_path / "results.jsonl"
    aligner = _Fixed(np.eye(4))
    evaluate_alignment(aligner, "validation", 2, store=ResultsStore(file))
    store = ResultsStore(file)
    row, rows = evaluate_alignment(aligner, "validation", 3, store=store)
    assert aligner.calls == 3 and row.count == 3 and row.reused == 2
    assert [r.reused for r in rows] == [True, True, False] and "2 reused" in row.rows()
    again, _ = evaluate_alignment(aligner, "validation", 3, store=ResultsStore(file))
    assert aligner.calls == 3 and replace(again, reused=2) == row
    for changes in ({"options": {"nodes": 32}}, {"weights_digest": "b"}):
        other = _Fixed(np.eye(4))
        other.__dict__.update(changes)
        options = changes.get("options")
        row, _ = evaluate_alignment(other, "validation", 1, options=options, store=store)
        assert other.calls == 1 and row.reused == 0


def test_the_oracle_answers_without_an_aligner() -> None:
    row, rows = evaluate_alignment(None, "easy", 3)
    assert row.aligner == "oracle" and 0 < row.plain.translation_median < 1.0
    assert "easy" in row.rows() and rows[0].grasped in by_category(rows)


class _Asked(_Fixed):
    """The right answer, and the ways up and sizes of clouds that were asked about."""

    def __init__(self) -> None:
        super().__init__(np.eye(4))
        self.ups: list = []
        self.sizes: list = []

    def align(self, context, grasped, target, *, grasped_up=None, target_up=None, seed=0):
        shown = [(a.grasped_up, a.target_up) for a in context]
        self.ups.append((grasped_up, target_up, shown))
        self.sizes.append((len(grasped), len(target)))
        return super().align(context, grasped, target, seed=seed)


def test_ways_up_are_given_in_sets_of_relations_or_on_demand() -> None:
    aligner = _Asked()
    row, _ = evaluate_alignment(aligner, "cross_instance", 4)
    assert row.up and row.plain.translation_mean == pytest.approx(0, abs=1e-6)
    for index, (grasped_up, target_up, shown) in enumerate(aligner.ups):
        sample = make_sample("cross_instance", index, CONFIG)
        np.testing.assert_allclose(target_up, sample.up[1, -1], atol=1e-6)
        np.testing.assert_allclose([B for _, B in shown], sample.up[1, :-1], atol=1e-6)
        if sample.up[0].any():
            expected = random_pose(index)[:3, :3] @ sample.up[0, -1]
            np.testing.assert_allclose(grasped_up, expected, atol=1e-6)
        else:
            assert grasped_up is None and all(A is None for A, _ in shown)
    assert any(up is None for up, *_ in aligner.ups) != all(up is None for up, *_ in aligner.ups)
    for split, up, given in (
        ("cross_instance", False, False),
        ("validation", None, False),
        ("validation", True, True),
    ):
        row, _ = evaluate_alignment(aligner, split, 1, up=up)
        assert row.up == given == (aligner.ups[-1][1] is not None)
        assert (" up" in row.rows()) == given


def test_field_versions_are_kept_apart_from_clean_results(tmp_path: Path) -> None:
    aligner, store = _Asked(), ResultsStore(tmp_path / "results.jsonl")
    clean, _ = evaluate_alignment(aligner, "cross_instance", 1, store=store)
    row, _ = evaluate_alignment(aligner, "cross_instance", 1, field="stray", store=store)
    assert row.reused == 0 and row.field == "stray" and "cross_instance stray" in row.rows()
    assert row.ratio(clean) == 1.0 and row.modulo.success == (1.0, 1.0, 1.0)
    assert all(a > b for a, b in zip(aligner.sizes[1], (485, 100), strict=True))
    again, _ = evaluate_alignment(aligner, "cross_instance", 1, field="stray", store=store)
    assert again.reused == 1 and len(aligner.sizes) == 2
    with pytest.raises(IgaDrakeError, match="field 'fog'"):
        evaluate_alignment(aligner, "cross_instance", 1, field="fog")


def test_bad_arguments_are_refused() -> None:
    with pytest.raises(IgaDrakeError, match=r"one of: train, .*validation"):
        evaluate_alignment(_Fixed(np.eye(4)), "seen", 1)
    with pytest.raises(IgaDrakeError, match="count 0"):
        evaluate_alignment(_Fixed(np.eye(4)), "validation", 0)


def test_the_model_card_tells_what_the_file_says() -> None:
    row, _ = evaluate_alignment(_Fixed(np.eye(4)), "validation", 1)
    _, card = load_checkpoint(landed_weights("descriptor"), kind="descriptor")
    text = model_card(landed_weights("descriptor"), [row])
    assert f"{card['samples_seen']:,} samples" in text
    assert row.rows() in text and "learning_rate" in text


def test_errors_on_own_objects_are_taken_at_tolerances_and_kept_by_content(tmp_path: Path) -> None:
    """A bar of 60 by 66 mm: a quarter turn is right where 5 mm don't count."""
    meshes = tmp_path / "meshes"
    meshes.mkdir()
    block = trimesh.creation.box((0.06, 0.066, 0.14))
    block.export(meshes / "block.stl")
    split, config = own_objects(meshes=str(meshes))
    tolerances = [SurfaceTolerance.of(text) for text in ("1mm", "5mm")]
    store = ResultsStore(tmp_path / "results.jsonl")
    arguments = {"config": config, "tolerances": tolerances, "store": store}
    row, _ = evaluate_alignment(_Fixed(np.eye(4)), split, 2, **arguments)
    assert list(row.at) == ["1mm", "5mm"] and "5mm" in row.rows()
    assert all(at.translation_mean < 1e-4 for at in row.at.values())
    sample = make_sample(split, 0, config)
    turns = sample.symmetries_within(0.005, 0.005)[0]
    angles = Rotation.from_matrix(turns[:, :3, :3]).magnitude()
    turn = turns[np.abs(angles - np.pi / 2).argmin()]
    aligner = _Fixed(turn)
    aligner.name = "turned"
    row, _ = evaluate_alignment(aligner, split, 1, **arguments)
    assert row.at["5mm"].rotation_mean < 1 and row.at["1mm"].rotation_mean > 70
    again, _ = evaluate_alignment(aligner, split, 1, **arguments)
    assert again.reused == 1 and again.at == row.at and aligner.calls == 1
    block.apply_translation((0, 0, 1)).export(meshes / "block.stl")  # another file, same name
    row, _ = evaluate_alignment(aligner, split, 1, **arguments)
    assert row.reused == 0


def test_own_objects_and_our_sets_do_not_go_together(tmp_path: Path, capsys) -> None:
    trimesh.creation.box((0.1, 0.1, 0.2)).export(tmp_path / "box.stl")
    for arguments, message in (
        (("--meshes", tmp_path, "--sets", "easy"), "leave out --meshes"),
        (("--relations", tmp_path / "r.yaml", "--unit", "0.001"), "the file of --relations states"),
        (("--meshes", tmp_path, "--unit", "-1"), "must be positive"),
        (("--meshes", tmp_path, "--tolerances", "2"), "such as 2mm or 1%"),
        (("--meshes", tmp_path / "none"), "no such folder"),
        (("--relations", tmp_path / "none.yaml"), "No such file"),
    ):
        command = ["evaluate", "alignment", "--aligner", "oracle,icp", *map(str, arguments)]
        assert cli.main(command) == cli.BAD_INPUT
        assert message in capsys.readouterr().err


def test_the_model_card_of_a_peer_is_of_its_own_weights(tmp_path: Path, capsys) -> None:
    path = tmp_path / "card.md"
    options = ["--sets", "validation", "--count", "1", "--card", str(path)]
    assert cli.main(["evaluate", "alignment", "--aligner", "reldist", *options]) == cli.SUCCESS
    _, card = load_checkpoint(landed_weights("reldist"), kind="reldist")
    text = path.read_text("utf-8")
    assert text.startswith("# reldist.safetensors")
    assert (
        f"{card['samples_seen']:,} samples seen (every sample {card['training']['uses']} " in text
    )
    assert capsys.readouterr().out.splitlines()[1] in text
