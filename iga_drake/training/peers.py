"""Trains the peers, aligners of others, on our own samples: one loop, and what each has its own.

A batch of samples serves `uses` steps in a row, each with another test pair and other
demonstrations among the sample's pairs. `samples_seen` counts every use.
"""

import dataclasses
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from iga_drake.aligners.peers.aligner import PeerAligner
from iga_drake.dataset.loader import Batch, sample_loader
from iga_drake.dataset.samples import SampleConfig, make_sample
from iga_drake.training.run import RunConfig, RunOptions, SavedState, Term, TrainingRun
from iga_drake.training.settings import TrainingError, check_same_model, replaced
from iga_drake.training.validation import alignment_errors

SEED_STRIDE = 10_000_000  # samples between the streams of two seeds


@dataclass(frozen=True)
class PeerTraining(RunConfig):
    """What the trainings of all peers have in common."""

    batch: int = 4
    optimizer: str = "muon"
    learning_rate: float = 1e-3
    warmup: int = 50
    bf16: bool = False
    log_every: int = 20
    split: str = "train"  # the set of samples
    uses: int = 2  # steps in a row with one batch

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.uses < 1:
            raise TrainingError(f"uses = {self.uses}, must be at least 1")


@dataclass(frozen=True)
class Peer:
    """One of the peers, for training."""

    aligner: type[PeerAligner]
    help: str
    training: PeerTraining  # settings by default
    # Loss of a batch under settings, with draws of the generator.
    loss: Callable[[nn.Module, Batch, Any, torch.Generator], Term]
    samples: Any = field(default_factory=SampleConfig)  # settings by default
    make: Callable[[str, int, Any], Any] = make_sample  # sample by set, index and `samples`
    rate_factors: Mapping[str, float] = field(default_factory=dict)  # as of `TrainingRun`

    @property
    def name(self) -> str:
        """Of the aligner, the command and the checkpoints."""
        return self.aligner.name

    @property
    def model(self) -> Any:
        """Sizes by default."""
        return self.aligner.sizes()


@dataclass(frozen=True)
class PeerSettings:
    """All settings of a training; they determine its result."""

    model: Any
    training: Any
    samples: Any

    @staticmethod
    def of(folder: Path, peer: Peer) -> "PeerSettings":
        """The settings of the run in this folder, else the defaults. Raises `IgaDrakeError`."""
        saved = SavedState.read(folder, peer.name)
        card = {} if saved is None else saved.card
        where = folder / "state.safetensors"
        return PeerSettings(
            *(
                replaced(getattr(peer, part), card.get(part, {}), f"{where}: {part}")
                for part in ("model", "training", "samples")
            )
        )


def drawn_pairs(batch: Batch, generator: torch.Generator) -> Batch:
    """The fields of S samples with their pairs in random order, the last one the test, and any
    number of demonstrations before it, the more the likelier. Fields (S, 2, N, ...) become
    (S, 2, D + 1, ...)."""
    N = batch["points"].shape[2]
    order = torch.randperm(N, generator=generator)
    several = torch.arange(1.0, N)
    shown = 1 + int(torch.multinomial(several, 1, generator=generator))
    chosen = order[: shown + 1]
    return {name: batch[name][:, :, chosen] for name in ("points", "canonical", "present")}


def _batches(
    peer: Peer, config: PeerTraining, samples: Any, run: TrainingRun, workers: int
) -> Iterator[Batch]:
    """This process's batches from where the run stands."""
    a_step = config.batch * config.accumulate * run.ranks.world
    used = run.samples_seen // (a_step * config.uses) * a_step
    loader = sample_loader(
        config.split,
        batch=config.batch,
        first=config.seed * SEED_STRIDE + used,
        rank=run.ranks.rank,
        world=run.ranks.world,
        workers=workers,
        config=samples,
        make=peer.make,
    )
    return iter(loader)


def train_peer(
    output: Path,
    peer: Peer,
    *,
    settings: PeerSettings | None = None,
    device: str = "cpu",
    workers: int = 0,
    options: RunOptions | None = None,
) -> dict:
    """Trains until `steps`, or as `options` say; resumes from `output` where it can.

    Writes the files of `TrainingRun` to `output`. Returns the card, which ends with errors over the
    first `validation_samples` samples of the validation set where the training is over. Raises
    `IgaDrakeError`.
    """
    saved = SavedState.read(output, peer.name)
    before = PeerSettings.of(output, peer)
    settings = settings or before
    model, config, samples = settings.model, settings.training, settings.samples
    if saved is not None:
        check_same_model(output, model, before.model)
    torch.manual_seed(config.seed)
    net = peer.aligner.network(model).to(device)

    def validate(weights: dict[str, Tensor]) -> dict[str, float]:
        measured = peer.aligner.network(model)
        measured.load_state_dict(weights, strict=False)
        return alignment_errors(peer.aligner(measured.eval()), count=config.validation_samples)

    run = TrainingRun(
        output,
        peer.name,
        net,
        config,
        saved=saved,
        card={"model": dataclasses.asdict(model), "samples": dataclasses.asdict(samples)},
        options=options,
        validate=validate,
        rate_factors=peer.rate_factors,
    )
    batches = _batches(peer, config, samples, run, workers)
    ranks = run.ranks
    whole: list[Batch] = []
    while run.goes_on():
        if run.step % config.uses == 0 or not whole:
            # Networks that samples are made with may be built here, once a process, at random.
            with torch.random.fork_rng(devices=[]):
                whole = [next(batches) for _ in range(config.accumulate)]
        first = run.step * config.accumulate
        numbers = [(first + k) * ranks.world + ranks.rank for k in range(config.accumulate)]
        row = run.advance(
            peer.loss(
                net,
                {k: v.to(device) for k, v in batch.items() if isinstance(v, Tensor)},
                config,
                torch.Generator().manual_seed((config.seed * 2**32 + number) % 2**62),
            )
            for batch, number in zip(whole, numbers, strict=True)
        )
        if row and ranks.first and run.step % (5 * config.log_every) == 0:
            hidden = ("learning_rate", "memory_mib", "workers_mib", "gradient_norm")
            shown = ", ".join(f"{k} {v:.3g}" for k, v in row.items() if k not in hidden)
            print(f"step {run.step}: {shown}", flush=True)
    card = run.save()
    if ranks.first and run.done:
        with torch.random.fork_rng(devices=[]):
            card = run.save(validation=validate(run.ema))
    run.close()
    return card
