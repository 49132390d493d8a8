import numpy as np
import pytest

from iga_drake.dataset.foreign import FOREIGN_KINDS, foreign_pair, foreign_sample
from iga_drake.dataset.samples import COMPOSITE, SampleConfig, category_names, make_sample
from iga_drake.dataset.splits import sample_set
from iga_drake.errors import IgaDrakeError

SMALL = SampleConfig(surface_points=400, cloud_points=64, least_seen=8)


@pytest.mark.parametrize("split", ["unseen_categories", "validation"])
def test_the_other_objects_are_of_other_families(split: str) -> None:
    from iga_drake.dataset.samples import stream_index

    chosen = sample_set(split)
    for index in range(6):
        own = set(category_names(chosen, stream_index(chosen, index, SMALL), SMALL))
        other = set(foreign_sample(split, index, SMALL).category)
        assert not (own & other) - {COMPOSITE}


def test_every_kind_changes_the_objects_that_it_says() -> None:
    split, index = "validation", 3
    sample = make_sample(split, index, SMALL)
    own = sample.points[0, -1], sample.points[1, -1]
    for kind, foreign in FOREIGN_KINDS.items():
        pair = foreign_pair(sample, kind, split, index, SMALL)
        again = foreign_pair(sample, kind, split, index, SMALL)
        for role, other in enumerate(foreign):
            np.testing.assert_array_equal(pair[role], again[role])
            assert np.array_equal(pair[role], own[role]) != other
            if kind.endswith("solid") and other:
                at, there = pair[role].mean(0), own[role].mean(0)
                np.testing.assert_allclose(at, there, atol=0.002)
                ratio = pair[role].std(0).sum() / own[role].std(0).sum()
                assert 0.5 < ratio < 2
    np.testing.assert_array_equal(foreign_pair(sample, "swapped", split, index, SMALL)[0], own[1])
    with pytest.raises(IgaDrakeError, match="foreign 'odd' is not known; one of: both"):
        foreign_pair(sample, "odd", split, index, SMALL)
