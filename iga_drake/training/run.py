"""The run that all trainings share: schedule, steps, averaged weights, checkpoints, log, resuming.

The gradient of a step is that of the mean over all items (matches, poses) of all samples of the
step. Forward passes therefore give sums over items with their counts; gradients and counts are
added up over the accumulated passes and over all processes, and divided once. Any way of dividing
the same samples among passes and processes gives the same step, up to rounding.
"""

import dataclasses
import json
import math
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from torch import Tensor, nn

from iga_drake.checkpoint import load_checkpoint, save_checkpoint
from iga_drake.files import PARTIAL
from iga_drake.progress import counter
from iga_drake.training.log import TrainingLog, resident_memory
from iga_drake.training.muon import Muon
from iga_drake.training.ranks import Ranks
from iga_drake.training.settings import TrainingError

DECAYS = ("linear", "cosine")
OPTIMIZERS = ("adamw", "muon")


@contextmanager
def flushed_denormals() -> Iterator[None]:
    """Numbers too small for full precision count as zero meanwhile, in this thread and those that
    it starts: processors are slow with them, and small gradients become such."""
    before = sys.float_info.min / 2 == 0.0
    torch.set_flush_denormal(True)
    try:
        yield
    finally:
        torch.set_flush_denormal(before)


@dataclass(frozen=True)
class RunConfig:
    """Batches, schedule and validation of a training; saved with the weights."""

    batch: int = 6  # samples of a forward pass of one process
    accumulate: int = 1  # forward passes of one process in a step
    steps: int = 6000
    # adamw (Loshchilov & Hutter 2019), or muon (Jordan et al. 2024): matrices by momentum made
    # orthogonal, at steps of AdamW's size, and all else by AdamW.
    optimizer: str = "adamw"
    learning_rate: float = 1.5e-3
    betas: tuple[float, float] = (0.9, 0.98)  # of AdamW's moments
    warmup: int = 150
    decay_share: float = 0.35  # of the steps, at the end
    decay: str = "linear"  # to zero; or cosine
    weight_decay: float = 0.02
    clip: float = 1.0  # norm of the gradient
    ema: float = 0.998  # decay of the averaged weights; 0: they are the weights themselves
    bf16: bool = True  # autocast of the matrix products
    seed: int = 0
    log_every: int = 25  # steps
    validate_every: int = 0  # steps between validations by alignment error; 0: never
    validation_samples: int = 24  # of each

    def __post_init__(self) -> None:
        for name in ("batch", "accumulate", "steps", "log_every", "validation_samples"):
            if getattr(self, name) < 1:
                raise TrainingError(f"{name} = {getattr(self, name)}, must be at least 1")
        for name, allowed in (("decay", DECAYS), ("optimizer", OPTIMIZERS)):
            if getattr(self, name) not in allowed:
                raise TrainingError(
                    f"{name} = '{getattr(self, name)}', must be one of: {', '.join(allowed)}"
                )


@dataclass(frozen=True)
class Term:
    """Part of a step's loss: a sum over items and how many they are."""

    total: Tensor  # ()
    count: Tensor  # ()
    statistics: dict[str, Tensor]  # () each, means over these items


@dataclass(frozen=True)
class SavedState:
    """Tensors and card from which a run resumes."""

    tensors: dict[str, Tensor]
    card: dict

    @staticmethod
    def read(folder: Path, kind: str) -> "SavedState | None":
        """The state in a run's folder, if there is one; raises `CheckpointError`."""
        path = folder / "state.safetensors"
        return SavedState(*load_checkpoint(path, kind=f"{kind}-state")) if path.is_file() else None


@dataclass(frozen=True)
class RunOptions:
    """Options of a run that don't change its result."""

    minutes: float = math.inf  # stop after this long
    stop_at: int | None = None  # or after this step
    checkpoint_every: int = 200  # steps
    checkpoint_minutes: float = 5.0  # or after this long, what comes first
    tensorboard: bool = False


def learning_rate(step: int, config: RunConfig) -> float:
    """The rate at a step counted from 0: linear warm-up, constant, decay to 2 % of the highest."""
    left = min(1.0, (config.steps - step) / max(1, int(config.decay_share * config.steps)))
    if config.decay == "cosine":
        left = (1 - math.cos(math.pi * left)) / 2
    return config.learning_rate * min(1.0, (step + 1) / max(1, config.warmup), max(0.02, left))


def make_optimizers(
    named: Mapping[str, nn.Parameter], config: RunConfig, rate_factors: Mapping[str, float]
) -> list[torch.optim.Optimizer]:
    """The optimizers that together make a step.

    `rate_factors` are learning rates of parameters by name, relative to all others'.
    """
    rate, decay = config.learning_rate, config.weight_decay

    def groups(chosen: Iterable[str]) -> list[dict[str, Any]]:
        of_factor: dict[float, list[nn.Parameter]] = {1.0: []}
        for name in chosen:
            of_factor.setdefault(rate_factors.get(name, 1.0), []).append(named[name])
        return [{"params": p, "factor": factor} for factor, p in of_factor.items() if p]

    def adamw(chosen: Iterable[str]) -> torch.optim.Optimizer:
        return torch.optim.AdamW(groups(chosen), lr=rate, weight_decay=decay, betas=config.betas)

    if config.optimizer == "adamw":
        return [adamw(named)]
    matrices = [name for name, p in named.items() if p.ndim == 2]
    others = [name for name, p in named.items() if p.ndim != 2]
    return [Muon(groups(matrices), lr=rate, weight_decay=decay), adamw(others)]


def training_kept(folder: Path) -> str:
    """What is kept of a training in a folder that was interrupted, in words."""
    try:
        with safe_open(folder / "state.safetensors", framework="pt") as file:
            step = json.loads(file.metadata()["card"])["step"]
    except (OSError, SafetensorError):
        return f"{folder} holds no step of it yet"
    return f"step {step} is kept in {folder}, the same command goes on from there"


class TrainingRun:
    """One training in a folder; goes on from `saved` where it is given.

    The first process writes `kind`.safetensors (EMA weights), best.safetensors (those of the lowest
    validation error), state.safetensors and log.jsonl. Whenever it is killed, the state resumes it
    to the same weights and the same log. Where batches or processes are others than before, the
    stream of samples goes on after `samples_seen` all the same.
    """

    def __init__(
        self,
        folder: Path,
        kind: str,
        net: nn.Module,
        config: RunConfig,
        *,
        saved: SavedState | None,
        card: dict,
        options: RunOptions | None = None,
        validate: Callable[[dict[str, Tensor]], dict[str, float]] | None = None,
        rate_factors: Mapping[str, float] | None = None,
    ):
        """Starts the run, or resumes it from `saved`. Raises `TrainingError`.

        Args:
          folder: where the files are written.
          kind: of the checkpoints, and the name of the weights' file.
          net: on the device that it trains on.
          config: saved in the card under "training".
          saved: the folder's state, if there is one.
          card: describes the run in its checkpoints.
          options: how it goes.
          validate: measures EMA weights (on the CPU): errors by name, the first of which chooses
            the best weights.
          rate_factors: learning rates of parameters by name, relative to all others'.
        """
        self.net, self.config = net, config
        self.step, self.samples_seen, self._seconds = 0, 0, 0.0
        self._folder, self._kind, self._card = folder, kind, card
        self._options, self._validate = options or RunOptions(), validate
        self._named = dict(net.named_parameters())
        self._device = next(net.parameters()).device
        self.ranks = Ranks(self._device)
        self._optimizers = make_optimizers(self._named, config, rate_factors or {})
        # Sums of the statistics since the last row of the log, and their number.
        self._sums: dict[str, Tensor] = {}
        self._summed = 0
        self._errors: dict[str, dict] = {}  # latest and best validation
        if saved is not None:
            self._restore(saved)
        else:
            self.ema = {n: p.detach().clone() for n, p in self._named.items()}
        if not self.ranks.agree(self.step):
            raise TrainingError(
                f"{folder}: processes resumed at different steps: they need to share this folder"
            )
        self._log: TrainingLog | None = None
        if self.ranks.first:
            folder.mkdir(parents=True, exist_ok=True)
            left_over = folder.glob(f".*.safetensors.*{PARTIAL}")  # by a process that was killed
            for path in left_over:
                path.unlink(missing_ok=True)
            self._log = TrainingLog(folder, self.step, tensorboard=self._options.tensorboard)
        shown = self.ranks.first and self.step < config.steps
        self._counter = counter(kind, config.steps, done=self.step) if shown else None
        self._commit = _commit()
        self._began = self._saved_at = time.monotonic()
        self._row_began = (self._began, self.samples_seen)

    def _restore(self, saved: SavedState) -> None:
        tensors, card = saved.tensors, saved.card
        self.step, self._seconds = card["step"], card["seconds"]
        self.samples_seen = card["samples_seen"]
        for name, parameter in self._named.items():
            parameter.data.copy_(tensors[f"net.{name}"])
            state = self._state_of(parameter)
            first, second = (tensors.get(f"{k}.{name}") for k in "mv")
            if first is None:
                continue
            if self._by_muon(parameter):
                state["momentum_buffer"] = first.to(self._device)
            elif second is not None:  # else it was made by the other optimizer: starts anew
                state["step"] = torch.tensor(float(self.step))
                state["exp_avg"] = first.to(self._device)
                state["exp_avg_sq"] = second.to(self._device)
        self.ema = {n: tensors[f"ema.{n}"].to(self._device) for n in self._named}
        torch.set_rng_state(tensors["rng"])
        since = card.get("since_row", {"count": 0, "sums": {}})
        self._summed = since["count"]
        self._sums = {
            k: torch.tensor(v, dtype=torch.float64, device=self._device)
            for k, v in since["sums"].items()
        }
        self._errors = card.get("errors", {})

    def _by_muon(self, parameter: nn.Parameter) -> bool:
        return self.config.optimizer == "muon" and parameter.ndim == 2

    def _state_of(self, parameter: nn.Parameter) -> dict:
        """The optimizer's state of a parameter, to read or fill."""
        return self._optimizers[
            0 if self.config.optimizer == "adamw" or self._by_muon(parameter) else 1
        ].state[parameter]

    @property
    def seconds(self) -> float:
        """Seconds since the training began, without pauses."""
        return self._seconds + time.monotonic() - self._began

    @property
    def done(self) -> bool:
        """Whether the planned steps are over."""
        return self.step >= self.config.steps

    def goes_on(self) -> bool:
        """Whether there is another step to make now; the same in all processes."""
        late = time.monotonic() - self._began >= 60 * self._options.minutes
        stop = self._options.stop_at
        return not (
            self.done or (stop is not None and self.step >= stop) or self.ranks.firsts(late)
        )

    def advance(self, terms: Iterable[Term]) -> dict[str, float] | None:
        """Makes one step from this process's `terms`, each of its own forward pass; then logs,
        validates and saves what is due. Returns the row of the log, if one was due."""
        rate = learning_rate(self.step, self.config)
        for optimizer in self._optimizers:
            for group in optimizer.param_groups:
                group["lr"] = group["factor"] * rate
            optimizer.zero_grad(set_to_none=True)
        sums: dict[str, Tensor] = {}
        for term in terms:
            term.total.backward()
            mine = {"count": term.count, "loss": term.total.detach(), "terms": torch.tensor(1.0)}
            for name, value in (mine | term.statistics).items():
                value = value.detach().to(self._device, torch.float32)
                sums[name] = sums[name] + value if name in sums else value
        statistics = self._average_gradients(sums)
        clipped = nn.utils.clip_grad_norm_(self.net.parameters(), self.config.clip)
        statistics["gradient_norm"] = clipped.detach()
        for optimizer in self._optimizers:
            optimizer.step()
        self.step += 1
        if self._counter is not None:
            self._counter.update()
        self.samples_seen += self.config.batch * self.config.accumulate * self.ranks.world
        rate = min(self.config.ema, (1 + self.step) / (10 + self.step))
        with torch.no_grad():
            for name, parameter in self._named.items():
                self.ema[name].lerp_(parameter, 1 - rate)
        for name, value in statistics.items():
            value = value.double()
            self._sums[name] = self._sums[name] + value if name in self._sums else value
        self._summed += 1
        row = self._write_row() if self.step % self.config.log_every == 0 else None
        every = self.config.validate_every
        due = self.step % self._options.checkpoint_every == 0
        if every and (self.step % every == 0 or self.done):
            self._measure()
            due = True
        late = time.monotonic() - self._saved_at >= 60 * self._options.checkpoint_minutes
        if due or late:
            self.save()
        return row

    def _average_gradients(self, sums: dict[str, Tensor]) -> dict[str, Tensor]:
        """Makes the gradients those of the mean over all items, of this process and the others;
        returns the mean loss and the means of the statistics over forward passes."""
        gradients = [p.grad for p in self._named.values() if p.grad is not None]
        flat = torch.cat([g.flatten() for g in gradients] + [torch.stack(list(sums.values()))])
        self.ranks.sum_(flat)
        parts = flat.split([g.numel() for g in gradients] + [len(sums)])
        means = dict(zip(sums, parts[-1].unbind(), strict=True))
        count, terms = means.pop("count").clamp(min=1), means.pop("terms")
        for gradient, part in zip(gradients, parts, strict=False):
            gradient.copy_((part / count).view_as(gradient))
        loss = means.pop("loss") / count
        return {"loss": loss} | {name: value / terms for name, value in means.items()}

    def _write_row(self) -> dict[str, float]:
        now, (began, seen) = time.monotonic(), self._row_began
        row = {name: float(value / self._summed) for name, value in self._sums.items()}
        row["learning_rate"] = learning_rate(self.step - 1, self.config)
        row["samples_per_second"] = (self.samples_seen - seen) / max(now - began, 1e-9)
        row |= resident_memory()
        self._sums, self._summed, self._row_began = {}, 0, (now, self.samples_seen)
        if self._log:
            self._log.write("training", self.step, self.seconds, row)
        return row

    def _measure(self) -> None:
        """Validates the EMA weights and keeps them where they are the best so far."""
        if not self._log or self._validate is None:
            return
        began = time.monotonic()
        with torch.random.fork_rng(devices=[]):
            errors = self._validate({n: t.detach().cpu().clone() for n, t in self.ema.items()})
        row_began, seen = self._row_began
        self._row_began = (row_began + time.monotonic() - began, seen)
        self._log.write("validation", self.step, self.seconds, errors)
        chosen = next(iter(errors))
        self._errors["latest"] = {"step": self.step} | errors
        if "best" not in self._errors or errors[chosen] < self._errors["best"][chosen]:
            self._errors["best"] = self._errors["latest"]
            path = self._folder / "best.safetensors"
            save_checkpoint(path, self.ema, kind=self._kind, card=self.card())

    def card(self) -> dict:
        """Describes the run and where it stands; `errors` are those of the validations."""
        return self._card | {
            "training": dataclasses.asdict(self.config),
            "step": self.step,
            "samples_seen": self.samples_seen,
            "seconds": self.seconds,
            "processes": self.ranks.world,
            "parameters": sum(p.numel() for p in self._named.values()),
            "commit": self._commit,
            "errors": self._errors,
        }

    def save(self, **more: object) -> dict:
        """Writes weights and state; returns the card of the weights, which `more` adds to."""
        card = self.card()
        if self.ranks.first:
            path = self._folder / f"{self._kind}.safetensors"
            save_checkpoint(path, self.ema, kind=self._kind, card=card | more)
            state: dict[str, Tensor] = {f"net.{n}": p for n, p in self._named.items()}
            state |= {f"ema.{n}": t for n, t in self.ema.items()}
            for n, p in self._named.items():
                # A parameter that feeds nothing has no gradient and no moments.
                moments = self._state_of(p)
                if self._by_muon(p):
                    state[f"m.{n}"] = moments.get("momentum_buffer", torch.zeros_like(p))
                    continue
                state[f"m.{n}"] = moments.get("exp_avg", torch.zeros_like(p))
                state[f"v.{n}"] = moments.get("exp_avg_sq", torch.zeros_like(p))
            state["rng"] = torch.get_rng_state()
            sums = {name: float(value) for name, value in self._sums.items()}
            since = {"since_row": {"count": self._summed, "sums": sums}}
            path = self._folder / "state.safetensors"
            save_checkpoint(path, state, kind=f"{self._kind}-state", card=card | since)
        self._saved_at = time.monotonic()
        return card | more

    def close(self) -> None:
        """Ends the log."""
        if self._counter is not None:
            self._counter.close()
        if self._log:
            self._log.close()


def _commit() -> str:
    """The commit of the checkout that this package runs from; empty outside of one."""
    command = ["git", "-C", os.path.dirname(__file__), "rev-parse", "--short", "HEAD"]
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return ""
