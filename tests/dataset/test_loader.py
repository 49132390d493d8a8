"""The loader: one stream, whoever makes it."""

import itertools
import multiprocessing
import os
from dataclasses import dataclass

import numpy as np
import psutil
import pytest
import torch
from torch.utils.data import _utils

from iga_drake.dataset.loader import LoaderError, collate, sample_loader
from iga_drake.dataset.samples import SampleConfig, make_sample

SMALL = SampleConfig(
    surface_points=400, cloud_points=64, least_seen=8, deformations=(1.0, 0.0, 0.0, 0.0)
)


@dataclass(frozen=True)
class Cheap:
    values: np.ndarray
    name: str


def cheap(split: str, index: int, config: SampleConfig | None) -> Cheap:
    rng = np.random.default_rng(index)
    return Cheap(rng.normal(size=(2, 5, 200, 3)), f"{split}{index}")


def failing(split: str, index: int, config: SampleConfig | None) -> Cheap:
    if index == 5:
        raise ZeroDivisionError("a bad sample")
    return cheap(split, index, config)


def dying(split: str, index: int, config: SampleConfig | None) -> Cheap:
    if index == 5:
        os._exit(3)
    return cheap(split, index, config)


def uneven(split: str, index: int, config: SampleConfig | None) -> Cheap:
    return Cheap(np.zeros(index), "")


def equal(a: dict, b: dict) -> bool:
    return a.keys() == b.keys() and all(
        torch.equal(a[k], b[k]) if torch.is_tensor(a[k]) else a[k] == b[k] for k in a
    )


def test_the_number_of_workers_changes_nothing() -> None:
    streams = [
        list(sample_loader("train", batch=2, workers=workers, config=SMALL, count=6))
        for workers in (0, 1, 2)
    ]
    assert [len(stream) for stream in streams] == [3, 3, 3]
    for alone, one, two in zip(*streams, strict=True):
        assert equal(alone, one) and equal(alone, two)
    sample = make_sample("train", 3, SMALL)
    batch = streams[2][1]
    assert batch["index"].tolist() == [2, 3]
    np.testing.assert_array_equal(batch["points"][1].numpy(), sample.points)
    np.testing.assert_array_equal(batch["aligned"][1].numpy(), sample.aligned)
    assert batch["category"][1] == sample.category
    assert batch["points"].dtype == torch.float32 and batch["points"].shape == (2, 2, 5, 64, 3)


@pytest.mark.parametrize("workers", [0, 2])
def test_a_stream_resumes_anywhere(workers: int) -> None:
    whole = list(itertools.islice(sample_loader("s", batch=3, make=cheap), 6))
    resumed = sample_loader("s", batch=3, first=4 * 3, workers=workers, make=cheap)
    for expected, batch in zip(whole[4:], resumed, strict=False):
        assert equal(expected, batch)


@pytest.mark.parametrize("count", [24, 23, 7])
def test_ranks_share_the_stream_without_overlap(count: int) -> None:
    world, batch = 2, 4
    ranks = [
        list(sample_loader("s", batch=batch, rank=r, world=world, count=count, make=cheap))
        for r in range(world)
    ]
    seen = [i for batches in ranks for b in batches for i in b["index"].tolist()]
    assert sorted(seen) == list(range(count))
    together = itertools.chain.from_iterable(itertools.zip_longest(*ranks))
    in_order = [i for b in together if b for i in b["index"].tolist()]
    assert in_order == list(range(count))


@pytest.mark.parametrize("workers", [0, 1])
def test_a_failed_sample_is_named(workers: int) -> None:
    loader = sample_loader("s", batch=2, workers=workers, make=failing)
    with pytest.raises(LoaderError, match=r"sample 5 of 's': ZeroDivisionError: a bad sample"):
        list(itertools.islice(loader, 4))


def test_a_dead_worker_is_an_error_not_a_hang(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_utils, "MP_STATUS_CHECK_INTERVAL", 0.2)  # s
    loader = sample_loader("s", batch=2, workers=2, make=dying)
    with pytest.raises(LoaderError, match="worker process that makes samples of 's' died"):
        list(itertools.islice(loader, 8))


def test_workers_have_one_thread_and_are_gone_afterwards() -> None:
    before = set(multiprocessing.active_children())
    loader = iter(sample_loader("s", batch=1, workers=1, make=threads))
    assert next(loader)["values"].item() == 1
    (worker,) = set(multiprocessing.active_children()) - before
    assert psutil.pid_exists(worker.pid)
    del loader
    assert not psutil.pid_exists(worker.pid)


def threads(split: str, index: int, config: SampleConfig | None) -> Cheap:
    return Cheap(np.array([torch.get_num_threads()]), "")


def test_memory_stays_constant() -> None:
    """Of the loading process and its worker, over samples of 48 kB (144 MB in all)."""
    process = psutil.Process()

    def used() -> int:
        every = [process, *process.children(recursive=True)]
        return sum(p.memory_info().rss for p in every)

    sizes = []
    loader = sample_loader("s", batch=10, workers=1, count=3000, make=cheap)
    for step, _ in enumerate(loader):
        if step % 50 == 49:
            sizes.append(used())
    assert len(sizes) == 6
    assert sizes[-1] - sizes[1] < 20e6


def test_bad_numbers_and_shapes_are_refused() -> None:
    for arguments, message in [
        ({"batch": 0}, "batch = 0, must be at least 1"),
        ({"batch": 1, "workers": -1}, "workers = -1, must be at least 0"),
        ({"batch": 1, "first": -4}, "first = -4"),
        ({"batch": 1, "rank": 2, "world": 2}, "rank 2 of 2"),
        ({"batch": 1, "count": 0}, "count = 0"),
    ]:
        with pytest.raises(LoaderError, match=message):
            sample_loader("s", **arguments)
    with pytest.raises(LoaderError, match="values: samples of one batch differ in shape"):
        collate([uneven("s", 1, None), uneven("s", 2, None)])
