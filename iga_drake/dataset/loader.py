"""Batches of samples from worker processes, in an order that depends on the index alone.

Step t of rank r holds the `batch` samples from index first + (t world + r) batch on: no two workers
or ranks ever make the same sample, their number changes nothing, and a run resumes by its index.
"""

import contextlib
import dataclasses
import itertools
import multiprocessing
import signal
import threading
from collections.abc import Callable, Iterator
from types import FrameType
from typing import Any

import numpy as np
import torch
from torch.utils.data import DataLoader, Dataset

from iga_drake.dataset.samples import Sample, SampleConfig, make_sample
from iga_drake.errors import IgaDrakeError

Batch = dict[str, Any]  # tensors (batch, ...), and lists of what isn't an array


class LoaderError(IgaDrakeError):
    """Samples can't be loaded: bad arguments, a sample that failed, or a worker that died."""


def collate(samples: list[Sample]) -> Batch:
    """Fields of samples, arrays stacked to tensors (batch, ...), others as lists.

    `samples` may be of any dataclass. Raises `LoaderError` where arrays differ in shape.
    """
    batch: Batch = {}
    for field in dataclasses.fields(samples[0]):
        values = [getattr(sample, field.name) for sample in samples]
        if not isinstance(values[0], np.ndarray):
            batch[field.name] = values
            continue
        if len({value.shape for value in values}) > 1:
            shapes = sorted({value.shape for value in values})
            raise LoaderError(f"{field.name}: samples of one batch differ in shape: {shapes}")
        batch[field.name] = torch.from_numpy(np.ascontiguousarray(np.stack(values)))
    return batch


class SampleDataset(Dataset):
    """The samples of a set by index (map style); the same whichever process asks."""

    def __init__(
        self,
        split: str,
        config: SampleConfig | None = None,
        make: Callable[[str, int, SampleConfig | None], Any] = make_sample,
    ):
        self.split, self.config, self._make = split, config, make

    def __getitem__(self, index: int) -> tuple[int, Any]:
        try:
            return index, self._make(self.split, index, self.config)
        except IgaDrakeError:
            raise
        except Exception as error:
            message = f"sample {index} of '{self.split}': {type(error).__name__}: {error}"
            raise LoaderError(message) from error


class IndexStream:
    """Lists of sample indices, one a batch, of one rank (a batch sampler)."""

    def __init__(self, batch: int, first: int, rank: int, world: int, count: int | None):
        self._batch, self._first, self._rank, self._world = batch, first, rank, world
        self._end = None if count is None else first + count

    def __iter__(self) -> Iterator[list[int]]:
        for step in itertools.count():
            start = self._first + (step * self._world + self._rank) * self._batch
            stop = start + self._batch
            if self._end is not None:
                stop = min(stop, self._end)
            if start >= stop:
                return
            yield list(range(start, stop))


def _collate_with_index(items: list[tuple[int, Any]]) -> Batch:
    batch = collate([sample for _, sample in items])
    batch["index"] = torch.tensor([index for index, _ in items])
    return batch


def _processes() -> Any:
    """How workers are started: as copies of a fresh process, since copies of this one would crash
    where it runs threads of others (Ray's, say)."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([__name__])
    return context


def _start_worker(_: int) -> None:
    """One thread a worker: the workers share the cores. Ctrl-C is the first process's matter, which
    ends them."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    torch.set_num_threads(1)


@contextlib.contextmanager
def _interrupt_waits() -> Iterator[None]:
    """Has Ctrl-C wait for the end of the block: a worker complains where nobody takes the batch
    that it hands over. A second one doesn't wait."""
    before = signal.getsignal(signal.SIGINT)
    if threading.current_thread() is not threading.main_thread() or not callable(before):
        yield
        return
    asked: list[FrameType | None] = []

    def ask(_: int, frame: FrameType | None) -> None:
        asked.append(frame)
        signal.signal(signal.SIGINT, before)

    signal.signal(signal.SIGINT, ask)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
    if asked:
        before(signal.SIGINT, asked[0])


class SampleLoader:
    """Iterates over batches; every iteration starts again at the first."""

    def __init__(self, loader: DataLoader, split: str):
        self._loader, self._split = loader, split

    def __iter__(self) -> Iterator[Batch]:
        batches = iter(self._loader)
        try:
            while True:
                with _interrupt_waits():
                    batch = next(batches, None)
                if batch is None:
                    return
                yield batch
        except IgaDrakeError:
            raise
        except RuntimeError as error:
            if "DataLoader worker" not in str(error):
                raise
            raise LoaderError(
                f"a worker process that makes samples of '{self._split}' died ({error}); it may "
                "have run out of memory: use fewer workers, or none to see the error itself"
            ) from error


def sample_loader(
    split: str,
    *,
    batch: int,
    workers: int = 0,
    config: SampleConfig | None = None,
    first: int = 0,
    rank: int = 0,
    world: int = 1,
    count: int | None = None,
    prefetch: int = 2,
    make: Callable[[str, int, SampleConfig | None], Any] = make_sample,
) -> SampleLoader:
    """Batches of the set `split`: stacked fields of `Sample` and "index" (batch,).

    Args:
      batch: samples a batch, of this rank.
      workers: processes that make samples; 0 makes them in this one.
      first: index of the first sample of all ranks; to resume after t steps add t world batch.
      rank: this process's number among all that train together, from 0.
      world: number of processes that train together.
      count: samples of all ranks together; None goes on for ever. The last batch may be short, and
        the last ranks may get one batch fewer.
      prefetch: batches that every worker makes ahead.
      make: what makes a sample (a function that processes can import).

    Raises `LoaderError` for bad numbers, and while iterating for samples that fail.
    """
    lowest = {"batch": 1, "workers": 0, "first": 0, "rank": 0, "world": 1, "prefetch": 1}
    given = {
        "batch": batch, "workers": workers, "first": first, "rank": rank, "world": world,
        "prefetch": prefetch,
    }  # fmt: skip
    for name, least in lowest.items():
        if given[name] < least:
            raise LoaderError(f"sample_loader: {name} = {given[name]}, must be at least {least}")
    if rank >= world:
        raise LoaderError(f"sample_loader: rank {rank} of {world}; ranks count from 0")
    if count is not None and count < 1:
        raise LoaderError(f"sample_loader: count = {count}, must be at least 1 (or None)")
    loader: DataLoader = DataLoader(
        SampleDataset(split, config, make),
        batch_sampler=IndexStream(batch, first, rank, world, count),  # type: ignore[arg-type]
        num_workers=workers,
        collate_fn=_collate_with_index,
        worker_init_fn=_start_worker,
        prefetch_factor=prefetch if workers else None,
        multiprocessing_context=_processes() if workers else None,
        generator=torch.Generator(),  # leaves the caller's random numbers alone
    )
    return SampleLoader(loader, split)
