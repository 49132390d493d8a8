import numpy as np
import pytest

from iga_drake.dataset.foreign import FOREIGN_KINDS, foreign_points, foreign_sample
from iga_drake.dataset.samples import COMPOSITE, SampleConfig, category_names
from iga_drake.dataset.splits import sample_set

SMALL = SampleConfig(surface_points=400, cloud_points=64, least_seen=8)


@pytest.mark.parametrize("split", ["unseen_categories", "validation"])
def test_the_other_objects_are_of_other_families(split: str) -> None:
    from iga_drake.dataset.samples import stream_index

    chosen = sample_set(split)
    for index in range(6):
        own = set(category_names(chosen, stream_index(chosen, index, SMALL), SMALL))
        other = set(foreign_sample(split, index, SMALL).category)
        assert not (own & other) - {COMPOSITE}


def test_only_the_test_pair_is_changed() -> None:
    rng = np.random.default_rng(0)
    points, other = rng.normal(size=(2, 2, 5, 8, 3))
    for index, kind in enumerate(FOREIGN_KINDS):
        mixed = foreign_points(points, other, index)
        np.testing.assert_array_equal(mixed[:, :-1], points[:, :-1])
        for role, name in enumerate(("grasped", "target")):
            expected = other if kind in ("both", name) else points
            np.testing.assert_array_equal(mixed[role, -1], expected[role, -1])
