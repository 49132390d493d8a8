"""The cross-instance set: frames that meet, different products, ways up."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from iga_drake.dataset.alignment_error import CONFIG
from iga_drake.dataset.foreign import foreign_sample
from iga_drake.dataset.relations import RELATIONS, SPREAD, related_pairs
from iga_drake.dataset.samples import SIZE, canonical_mesh, category_names, make_sample
from iga_drake.dataset.splits import held_out_families, sample_set
from iga_drake.shapes.families import FAMILIES

SET = sample_set("cross_instance")


def test_relations_name_frames_that_their_families_have() -> None:
    assert len({relation.name for relation in RELATIONS}) == len(RELATIONS) >= 10
    for relation in RELATIONS:
        np.testing.assert_allclose(np.linalg.det(np.array(relation.turn)), 1.0)
        for families in (relation.grasped, relation.target):
            for name, frame in families.items():
                family = FAMILIES[name]
                draft = family.draft(family.sample_parameters(np.random.default_rng(0)))
                assert frame in draft.frames
                assert families is relation.target or relation.axes in {"", *draft.frames}


def test_frames_meet_up_to_one_offset_in_all_pairs() -> None:
    """The named frames, drawn anew from the streams, against the poses."""
    seen = set()
    for k in range(40):
        pairs = related_pairs(SET, k, SIZE)
        relation = pairs.relation
        seen.add(relation.name)
        offsets = []
        for n in range(SET.pairs + 1):
            X_OF = []
            for role, families in enumerate((relation.grasped, relation.target)):
                family = FAMILIES[pairs.category[role]]
                product = family.sample_parameters(SET.rng("instances", k, role))
                rng = SET.rng("instances", k, role, n)
                draft = family.draft(family.vary_parameters(product, rng, SPREAD))
                own, made = draft.surface().vertices, pairs.vertices[role][n]
                factor = np.ptp(made) / np.ptp(own)
                np.testing.assert_allclose(made, factor * own, atol=1e-9)
                X = draft.frames[families[pairs.category[role]]].copy()
                X[:3, 3] *= factor
                X_OF.append(X)
            X_AF, X_BF = X_OF
            place = (pairs.X_BA[n] @ X_AF)[:3, 3] - X_BF[:3, 3]
            axes = X_BF[:3, :3] if relation.frame_axes[1] else np.eye(3)
            offsets.append((axes.T @ place)[: 2 if relation.on_table else 3])
        np.testing.assert_allclose(offsets, offsets[:1] * len(offsets), atol=1e-9)
        for value, limits in zip(offsets[0], relation.offset, strict=False):
            assert limits[0] - 1e-9 <= value <= limits[1] + 1e-9
    assert len(seen) > 8


def test_all_pairs_show_different_products_of_different_sizes() -> None:
    for k in range(6):
        pairs = related_pairs(SET, k, SIZE)
        for vertices in pairs.vertices:
            extent = np.ptp(vertices, axis=1).max(1)
            assert (extent >= SIZE[0] - 1e-9).all() and (extent <= SIZE[1] + 1e-9).all()
            shapes = vertices / extent[:, None, None]
            for n in range(1, len(shapes)):
                assert np.abs(shapes[n] - shapes[0]).max() > 0.01
    ratios = [np.ptp(related_pairs(SET, k, SIZE).vertices[0], axis=1).max(1) for k in range(6)]
    assert np.mean([r.max() / r.min() for r in ratios]) > 1.3


def test_seen_and_held_out_families_take_part() -> None:
    names = {name for k in range(200) for name in category_names(SET, k)}
    assert names & held_out_families() and names - held_out_families()
    families = {n for r in RELATIONS for n in (*r.grasped, *r.target)}
    assert names == families


@pytest.mark.parametrize("index", [0, 3, 5])
def test_b_stands_upright_under_the_cameras(index: int) -> None:
    """Along `up` the lowest points of B are at its foot, and its cloud agrees with its mesh."""
    sample = make_sample("cross_instance", index, replace(CONFIG, test_surface=True))
    N = SET.pairs
    assert sample.up.shape == (2, N, 3)
    np.testing.assert_allclose(np.linalg.norm(sample.up[1], axis=1), 1.0, atol=1e-6)
    lengths = np.linalg.norm(sample.up[0], axis=1)
    assert (np.abs(lengths - lengths.round()) < 1e-6).all()
    pairs = related_pairs(SET, index, SIZE)
    for role in range(2):
        surface = sample.surface[role, :, 0]
        near = cKDTree(surface).query(sample.points[role, -1])[0]
        assert np.quantile(near, 0.9) < 0.012
        up = sample.up[role, -1]
        if up.any():
            height = surface @ up
            expected = np.ptp(pairs.vertices[role][-1][:, 2])
            assert np.ptp(height) == pytest.approx(expected, abs=0.01)
    # Frames of pairs are unrelated.
    assert np.linalg.norm(sample.up[1].mean(0)) < 0.95


def test_no_relation_is_foreign_to_itself() -> None:
    other = foreign_sample("cross_instance", 0)
    assert not set(other.category) & set(category_names(SET, 0))
    vertices, faces = canonical_mesh("cross_instance", 0, 1)
    assert faces.max() < len(vertices)
