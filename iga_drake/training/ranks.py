"""The processes that torchrun started to train together; a process of its own is rank 0 of 1."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import timedelta

import torch
import torch.distributed as dist
from torch import Tensor

# The others wait while rank 0 validates.
TIMEOUT = timedelta(hours=1)


def launched() -> int:
    """Number of processes that torchrun has started for this training; 1 without it."""
    return int(os.environ.get("WORLD_SIZE", "1")) if "RANK" in os.environ else 1


@contextmanager
def process_group(device: str) -> Iterator[str]:
    """Joins the other processes (NCCL on GPUs, else gloo) and yields this one's device."""
    if launched() == 1:
        yield device
        return
    if torch.device(device).type == "cuda":
        device = f"cuda:{os.environ['LOCAL_RANK']}"
        torch.cuda.set_device(device)
    dist.init_process_group("nccl" if device.startswith("cuda") else "gloo", timeout=TIMEOUT)
    try:
        yield device
    finally:
        dist.destroy_process_group()


class Ranks:
    """Communication among the processes of a training."""

    def __init__(self, device: torch.device | str):
        self._device = device
        self.world = dist.get_world_size() if dist.is_initialized() else 1
        self.rank = dist.get_rank() if dist.is_initialized() else 0

    @property
    def first(self) -> bool:
        """Whether this process writes the files."""
        return self.rank == 0

    def sum_(self, values: Tensor) -> None:
        """Adds up `values` over the processes, in place."""
        if self.world > 1:
            dist.all_reduce(values)

    def firsts(self, answer: bool) -> bool:
        """The answer of rank 0, for what depends on a clock."""
        if self.world == 1:
            return answer
        shared = torch.tensor([answer], dtype=torch.int32, device=self._device)
        dist.broadcast(shared, 0)
        return bool(shared)

    def agree(self, value: int) -> bool:
        """Whether all processes gave the same value."""
        if self.world == 1:
            return True
        both = torch.tensor([value, -value], dtype=torch.int64, device=self._device)
        dist.all_reduce(both, dist.ReduceOp.MAX)
        return int(both.sum()) == 0
