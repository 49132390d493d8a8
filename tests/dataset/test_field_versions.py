"""Field versions: always the same, and disturbed as much as they say, where they say so."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from iga_drake.dataset.alignment_error import CONFIG
from iga_drake.dataset.field_versions import FIELD_KINDS, RING, SPARSE_POINTS, field_clouds
from iga_drake.dataset.samples import Sample, make_sample
from iga_drake.errors import IgaDrakeError

SETS = ("unseen_instances", "cross_instance")


@pytest.fixture(scope="module", params=SETS)
def made(request: pytest.FixtureRequest) -> tuple[str, Sample]:
    return request.param, make_sample(request.param, 2, CONFIG)


@pytest.mark.parametrize("kind", list(FIELD_KINDS))
def test_a_version_is_a_pure_function_and_has_a_truth(kind: str, made: tuple[str, Sample]) -> None:
    split, sample = made
    clouds, again = (field_clouds(sample, kind, split, 2) for _ in range(2))
    other = field_clouds(sample, kind, split, 3)
    for own, same, points in zip(clouds, again, sample.points, strict=True):
        assert len(own) == len(points)
        for cloud, twin, clean in zip(own, same, points, strict=True):
            np.testing.assert_array_equal(cloud, twin)
            assert len(cloud) >= 32 and np.isfinite(cloud).all()
            # A part of the clean cloud is always there, in its place.
            there = cKDTree(clean).query(cloud)[0] < 1e-6
            assert there.sum() >= 20
    assert any(
        a.shape != b.shape or (a != b).any()
        for own, o in zip(clouds, other, strict=True)
        for a, b in zip(own, o, strict=True)
    )
    if kind != "field":
        for own, points in zip(clouds, sample.points, strict=True):
            for cloud, clean in zip(own[:-1], points[:-1], strict=True):
                assert {*map(tuple, cloud)} == {*map(tuple, clean)}


def _shares(sample: Sample, split: str, kind: str) -> list[tuple[int, int]]:
    """Of the test pair's A and B: points that the clean cloud has, and others."""
    result = []
    for own, points in zip(field_clouds(sample, kind, split, 2), sample.points, strict=True):
        there = cKDTree(points[-1]).query(own[-1])[0] < 1e-6
        result.append((int(there.sum()), int((~there).sum())))
    return result


def test_versions_do_what_they_say(made: tuple[str, Sample]) -> None:
    split, sample = made
    distinct = [len(np.unique(points[-1], axis=0)) for points in sample.points]
    for (own, stray), whole in zip(_shares(sample, split, "stray"), distinct, strict=True):
        assert own == whole and stray / (own + stray) == pytest.approx(0.05, abs=0.005)
    for (own, more), whole in zip(_shares(sample, split, "sparse"), distinct, strict=True):
        assert (own, more) == (min(whole, SPARSE_POINTS), 0)
    (own_A, more_A), (own_B, more_B) = _shares(sample, split, "ring")
    assert (own_A, more_A, own_B) == (distinct[0], 0, distinct[1]) and more_B > 30
    half = _shares(sample, split, "half")
    kept = [own / whole for (own, _), whole in zip(half, distinct, strict=True)]
    assert sorted(kept) == pytest.approx([0.5, 1.0], abs=0.02)


def test_the_ring_is_the_table_that_b_stands_on() -> None:
    sample = make_sample("cross_instance", 2, CONFIG)
    up, clean = sample.up[1, -1], sample.points[1, -1]
    cloud = field_clouds(sample, "ring", "cross_instance", 2)[1][-1]
    added = cloud[cKDTree(clean).query(cloud)[0] > 1e-6]
    assert np.abs(added @ up - (clean @ up).min()).max() < 0.006
    flat = clean - np.outer(clean @ up, up)
    distance = cKDTree(flat).query(added - np.outer(added @ up, up))[0]
    assert 0.8 * RING < distance.max() < RING + 0.005


def test_another_kind_is_refused() -> None:
    with pytest.raises(IgaDrakeError, match="'fog' is not known; one of: stray, sparse"):
        field_clouds(make_sample("validation", 0), "fog", "validation", 0)
