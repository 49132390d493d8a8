"""Samples: pure, consistently aligned, honest about correspondence."""

import numpy as np
import pytest

from iga_drake.dataset.samples import HELD_OUT_FAMILIES, SampleConfig, make_sample

CLEAN = SampleConfig(noise=False, voxel=0.001, surface_points=5000, cloud_points=2000)


@pytest.mark.parametrize("split", ["train", "validation", "unseen_categories"])
def test_a_sample_is_a_pure_function_of_split_and_index(split: str) -> None:
    a, b = make_sample(split, 5), make_sample(split, 5)
    np.testing.assert_array_equal(a.points, b.points)
    np.testing.assert_array_equal(a.canonical, b.canonical)
    assert not np.array_equal(a.points, make_sample(split, 6).points)


def test_splits_differ_and_held_out_families_stay_out_of_training() -> None:
    assert not np.array_equal(make_sample("train", 0).points, make_sample("validation", 0).points)
    seen = {name for k in range(40) for name in make_sample("train", k).category}
    assert not seen & set(HELD_OUT_FAMILIES)
    unseen = {name for k in range(10) for name in make_sample("unseen_categories", k).category}
    assert unseen <= set(HELD_OUT_FAMILIES)


def _fit(source: np.ndarray, goal: np.ndarray) -> tuple[np.ndarray, float]:
    """Independent rigid fit (SciPy) of matched points and its root-mean-square residual."""
    from scipy.spatial.transform import Rotation

    rotation, rssd = Rotation.align_vectors(goal - goal.mean(0), source - source.mean(0))
    return rotation.as_matrix(), rssd / np.sqrt(len(source))


def _matched(sample, role: int, a: int, b: int) -> tuple[np.ndarray, np.ndarray]:
    """Points of alignments a and b with nearly the same canonical place, both in the
    neighbourhood."""
    pa, pb = sample.aligned[role, a], sample.aligned[role, b]
    ca, cb = sample.canonical[role, a][pa], sample.canonical[role, b][pb]
    distance = np.linalg.norm(ca[:, None] - cb[None], axis=-1)
    nearest = distance.argmin(1)
    good = distance.min(1) < 0.02
    return sample.points[role, a][pa][good], sample.points[role, b][pb][nearest[good]]


def test_the_aligned_neighbourhoods_keep_their_relative_pose() -> None:
    """Fitting A's and B's neighbourhoods from one alignment to another gives the same motion."""
    angles = []
    for index in range(14):
        sample = make_sample("validation", index, CLEAN)
        pairs = [_matched(sample, role, 0, 1) for role in range(2)]
        if min(len(p[0]) for p in pairs) < 30:
            continue
        (RA, errorA), (RB, errorB) = (_fit(*pair) for pair in pairs)
        if max(errorA, errorB) > 0.014:
            continue  # the neighbourhood itself is bent too much to define a rotation
        angles.append(np.degrees(np.arccos(np.clip((np.trace(RA.T @ RB) - 1) / 2, -1, 1))))
    assert len(angles) >= 8
    assert np.median(angles) < 12


def test_sizes_and_shapes() -> None:
    sample = make_sample("train", 3)
    assert sample.points.shape == (2, 5, SampleConfig().cloud_points, 3)
    assert np.isfinite(sample.points).all() and np.isfinite(sample.canonical).all()
    assert (sample.size >= 0.0799).all() and (sample.size <= 0.3501).all()
    # Canonical places are in units of the canonical size.
    assert np.ptp(sample.canonical.reshape(2, -1, 3), axis=1).max() <= 1.0 + 1e-5
