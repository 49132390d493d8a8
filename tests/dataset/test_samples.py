"""Samples: pure, consistently aligned, honest about correspondence, modes and symmetry."""

import dataclasses
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from iga_drake.dataset.oracle import oracle_pose
from iga_drake.dataset.samples import (
    Sample,
    SampleConfig,
    category_names,
    make_sample,
    stream_index,
)
from iga_drake.dataset.splits import sample_set, sample_sets
from iga_drake.shapes.families import FAMILIES


def _arrays(sample: Sample) -> dict[str, np.ndarray]:
    values = {f.name: getattr(sample, f.name) for f in dataclasses.fields(sample)}
    return {name: value for name, value in values.items() if isinstance(value, np.ndarray)}


@pytest.mark.parametrize("name", list(sample_sets()))
def test_a_sample_is_a_pure_function_of_set_and_index(name: str) -> None:
    a, b, other = make_sample(name, 5), make_sample(name, 5), make_sample(name, 6)
    for field, value in _arrays(a).items():
        np.testing.assert_array_equal(value, getattr(b, field), err_msg=field)
    assert not np.array_equal(a.points, other.points)


def test_an_evaluation_set_is_the_same_on_another_machine(tmp_path: Path) -> None:
    """As far as one machine can show it: without the vector instructions that PyTorch uses here."""
    script = (
        "import sys, numpy as np, torch\n"
        "from iga_drake.dataset.samples import make_sample\n"
        "torch.set_num_threads(1)\n"
        "samples = [make_sample('seen_alignments', k) for k in range(8)]\n"
        "np.save(sys.argv[1], np.stack([s.points for s in samples]))\n"
        "print(torch.backends.cpu.get_cpu_capability())\n"
    )
    file = tmp_path / "there.npy"
    done = subprocess.run(
        [sys.executable, "-c", script, str(file)],
        env=os.environ | {"ATEN_CPU_CAPABILITY": "default"},
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.strip() == "DEFAULT"
    here = np.stack([make_sample("seen_alignments", k).points for k in range(8)])
    np.testing.assert_allclose(np.load(file), here, atol=1e-5)


@pytest.mark.parametrize("name", ["train", "multi_modal", "diversity_high"])
def test_shapes_sizes_and_units(name: str) -> None:
    config = SampleConfig(cloud_points=200)
    sample = make_sample(name, 3, config)
    N, M = sample_set(name).pairs, sample_set(name).modes
    assert sample.points.shape == sample.canonical.shape == (2, N, 200, 3)
    assert sample.points.dtype == sample.canonical.dtype == np.float32
    assert sample.aligned.shape == (2, N, 200) and sample.mode.shape == (N,)
    assert sample.modes.shape == (M, 4, 4) and sample.axes.shape == (2, 2, 3)
    assert np.isfinite(sample.points).all()
    assert (sample.size >= 0.0799).all() and (sample.size <= 0.3501).all()
    # Canonical places are in units of the canonical size.
    assert np.ptp(sample.canonical.reshape(2, -1, 3), axis=1).max() <= 1.0 + 1e-5
    # Every cloud is seen at its size: none is larger than its object (and its noise).
    extent = np.linalg.norm(np.ptp(sample.points, axis=2), axis=-1)
    assert (extent < sample.size * np.sqrt(3) + 0.05).all()


def test_sets_without_symmetry_leave_out_exactly_symmetric_families() -> None:
    exact = {n for n, f in FAMILIES.items() if f.symmetry.exact and not f.symmetry.is_trivial}
    assert exact
    for name in ("seen_alignments", "unseen_categories", "diversity_low"):
        chosen, config = sample_set(name), SampleConfig()
        streams = [stream_index(chosen, k, config) for k in range(60)]
        drawn = {c for k in streams for c in category_names(chosen, k)}
        assert not drawn & exact, name
        assert make_sample(name, 1).category == category_names(chosen, streams[1])
    training = {c for k in range(200) for c in category_names(sample_set("train"), k)}
    assert exact & training


def _tree_match(sample: Sample, role: int, a: int, b: int) -> tuple[np.ndarray, np.ndarray]:
    """Points of pairs a and b whose canonical places are within 1 % of the size."""
    distance, nearest = cKDTree(sample.canonical[role, b]).query(sample.canonical[role, a])
    good = distance < 0.01
    return sample.points[role, a][good], sample.points[role, b][nearest[good]]


def test_seen_objects_are_the_training_objects_under_new_views() -> None:
    """The k-th of the seen sets' objects are those of a training sample: rigidly moved, seen
    anew."""
    config = SampleConfig(cloud_points=1000, surface_points=4000)
    seen, unseen = (make_sample(n, 2, config) for n in ("seen_alignments", "unseen_alignments"))
    assert seen.category == unseen.category
    np.testing.assert_allclose(seen.size, unseen.size, rtol=1e-6)
    for role in range(2):
        # One canonical frame: matched places of the same instance differ by a rigid motion.
        distance, nearest = cKDTree(seen.canonical[role, 1]).query(unseen.canonical[role, 1])
        good = distance < 1e-4
        assert good.sum() > 30
        a, b = unseen.points[role, 1][good], seen.points[role, 1][nearest[good]]
        _, rssd = Rotation.align_vectors(b - b.mean(0), a - a.mean(0))
        assert rssd / np.sqrt(len(a)) < 0.008  # noise of both views


def test_the_oracle_finds_the_truth_without_noise_and_deformation() -> None:
    """Rigid instances: the neighbourhoods' fits leave nothing but the sampling."""
    angles = []
    for index in range(8):
        sample = make_sample("easy", index)
        motion = oracle_pose(sample)
        assert motion is not None
        angle = Rotation.from_matrix(motion[:3, :3]).magnitude()
        centre = sample.points[0, -1].mean(0)
        angles.append(
            (np.degrees(angle), np.linalg.norm(motion[:3, :3] @ centre + motion[:3, 3] - centre))
        )
    degrees, metres = np.median(angles, axis=0)
    assert degrees < 2.0 and metres < 0.004


def test_modes_are_other_valid_alignments_of_the_test_pair() -> None:
    """The test pair's A, moved by a mode's motion, stands to B as in that mode's
    demonstrations."""
    found = 0
    for index in range(6):
        sample = make_sample("multi_modal", index)
        assert set(sample.mode[:-1]) == {0, 1}
        np.testing.assert_array_equal(sample.modes[0], np.eye(4))
        other = sample.modes[1]
        moved = dataclasses.replace(
            sample,
            points=np.concatenate(
                (
                    sample.points[:, :-1],
                    np.stack(
                        (
                            sample.points[0, -1] @ other[:3, :3].T + other[:3, 3],
                            sample.points[1, -1],
                        )
                    )[:, None],
                ),
                1,
            ).astype(np.float32),
            mode=np.append(sample.mode[:-1], 1 - sample.mode[-1]),
        )
        # `aligned` marks the shown mode's neighbourhood; let every point take part instead.
        everywhere = dataclasses.replace(moved, aligned=np.ones_like(moved.aligned))
        motion = oracle_pose(everywhere)
        wrong = oracle_pose(dataclasses.replace(everywhere, points=sample.points))
        assert motion is not None and wrong is not None
        angle, wrong_angle = (Rotation.from_matrix(m[:3, :3]).magnitude() for m in (motion, wrong))
        found += angle < 0.5 < wrong_angle
    assert found >= 4


def test_a_symmetry_axis_lies_where_the_object_is_symmetric() -> None:
    """Turned about its axis, the cloud of a nearly undeformed, exactly symmetric object stays on
    itself."""
    checked = 0
    for index in range(400):
        name = sample_set("validation")
        if checked == 3:
            break
        categories = category_names(name, index)
        for role in range(2):
            if categories[role] == "composite":
                continue
            symmetry = FAMILIES[categories[role]].symmetry
            if symmetry.order != 0 or not symmetry.exact:
                continue
            undeformed = SampleConfig(deformations=(1.0, 0.0, 0.0, 0.0))
            sample = make_sample("validation", index, undeformed)
            cloud = sample.points[role, -1].astype(float)
            point, direction = sample.axes[role]
            arm = cloud - point
            along = arm @ direction
            radius = np.linalg.norm(arm - along[:, None] * direction, axis=1)
            # (radius, height) of a surface of revolution lie on a curve: nearest neighbours from
            # other sides are near.
            outline = np.column_stack((radius, along))
            distance, _ = cKDTree(outline).query(outline, k=2)
            spread = np.median(distance[:, 1]) / sample.size[role, -1]
            assert spread < 0.02
            off = np.median(np.linalg.norm(cloud - cloud.mean(0), axis=1))
            assert np.linalg.norm(arm.mean(0) - along.mean() * direction) < 0.5 * off
            checked += 1
    assert checked == 3
