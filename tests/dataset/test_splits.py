"""The file of splits: disjoint where it must be, equal where it says so."""

import pytest

from iga_drake.dataset.samples import category_names
from iga_drake.dataset.splits import (
    STREAMS,
    SplitError,
    family_names,
    held_out_families,
    later_families,
    sample_set,
    sample_sets,
)
from iga_drake.shapes.families import FAMILIES


def test_training_and_held_out_families_share_nothing_and_are_all() -> None:
    training, held_out = set(family_names("training")), set(family_names("held_out"))
    assert not training & held_out and held_out == held_out_families()
    assert training | held_out == set(family_names("both"))
    assert not later_families() & (training | held_out)
    assert training | later_families() == set(family_names("products"))
    assert later_families() | training | held_out == set(FAMILIES)


def test_only_the_sets_that_say_so_share_streams_with_training() -> None:
    shared = {
        name: {stream for stream in STREAMS if entry.streams[stream] == "train"}
        for name, entry in sample_sets().items()
    }
    assert shared.pop("train") == set(STREAMS)
    assert shared.pop("seen_alignments") == {"categories", "instances", "alignments"}
    assert shared.pop("unseen_alignments") == {"categories", "instances"}
    assert shared.pop("unseen_instances") == {"categories"}
    assert not any(shared.values())


@pytest.mark.parametrize("name", ["unseen_categories", "multi_modal"])
def test_unseen_categories_are_held_out(name: str) -> None:
    drawn = {family for k in range(60) for family in category_names(sample_set(name), k)}
    assert drawn == held_out_families()
    training = {family for k in range(300) for family in category_names(sample_set("train"), k)}
    assert not training & held_out_families()
    assert training - {"composite"} == set(family_names("training"))


def test_streams_are_independent_of_each_other_and_of_the_index() -> None:
    chosen = sample_set("validation")
    draws = {
        tuple(chosen.rng(stream, k).integers(1 << 60, size=2))
        for stream in STREAMS[:1]
        for k in range(50)
    }
    assert len(draws) == 50
    for name in ("seen_alignments", "unseen_alignments"):
        a, b = sample_set("train"), sample_set(name)
        assert a.rng("instances", 3, 1).random() == b.rng("instances", 3, 1).random()
        assert a.rng("views", 3).random() != b.rng("views", 3).random()


def test_an_unknown_set_is_named_with_those_that_exist() -> None:
    with pytest.raises(SplitError, match=r"'seen' is not known; one of: train, .*multi_modal"):
        sample_set("seen")
