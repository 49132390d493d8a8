"""Trains the local encoder by occupancy (paper, section "Local Encoder Network").

Loss: binary cross-entropy of the decoder's logits at labelled queries. Every query is asked of the
embedding of the centre nearest to it; the number of centres and where furthest point sampling
begins change from step to step; a batch serves for a few steps, each with its share of the queries.
"""

import copy
import dataclasses
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from iga_drake.aligners.iga.local_encoder import (
    ENCODER,
    DecoderConfig,
    EncoderConfig,
    OccupancyNet,
)
from iga_drake.dataset.loader import Batch, sample_loader
from iga_drake.dataset.occupancy import OccupancyConfig, make_occupancy_sample
from iga_drake.geometry.clouds import furthest_point_sampling
from iga_drake.precision import mixed_precision
from iga_drake.training.run import RunConfig, RunOptions, SavedState, Term, TrainingRun
from iga_drake.training.settings import TrainingError, check_same_model, replaced

SEED_STRIDE = 10_000_000  # samples between the streams of two seeds

# Logits (B, Q) at queries (B, Q, 3) from clouds (B, P, 3) with centres (B, K), by index.
Predictor = Callable[[Tensor, Tensor, Tensor], Tensor]


@dataclass(frozen=True)
class EncoderTraining(RunConfig):
    """One training run; saved with the weights. A sample is a cloud with its queries."""

    batch: int = 8
    uses: int = 4  # steps in a row with one batch, each with other centres and queries
    steps: int = 12000
    learning_rate: float = 1e-3
    betas: tuple[float, float] = (0.9, 0.999)
    warmup: int = 50
    decay_share: float = 1.0
    decay: str = "cosine"
    weight_decay: float = 0.01
    centres: tuple[int, int] = (8, 32)  # log-uniform
    validation_samples: int = 64

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.uses < 1:
            raise TrainingError(f"uses = {self.uses}, must be at least 1")


@dataclass(frozen=True)
class EncoderSettings:
    """All settings of a training; they determine its result."""

    encoder: EncoderConfig
    decoder: DecoderConfig
    training: EncoderTraining
    samples: OccupancyConfig

    @staticmethod
    def of(folder: Path) -> "EncoderSettings":
        """The settings of the run in this folder, else the defaults. Raises `IgaDrakeError`."""
        saved = SavedState.read(folder, ENCODER)
        card = {} if saved is None else saved.card
        where = folder / "state.safetensors"
        return EncoderSettings(
            replaced(EncoderConfig(), card.get("encoder", {}), f"{where}: encoder"),
            replaced(DecoderConfig(), card.get("decoder", {}), f"{where}: decoder"),
            replaced(EncoderTraining(), card.get("training", {}), f"{where}: training"),
            replaced(OccupancyConfig(), card.get("samples", {}), f"{where}: samples"),
        )


def occupancy_scores(
    predictors: dict[str, Predictor],
    *,
    split: str,
    count: int,
    centres: int = 8,
    samples: OccupancyConfig | None = None,
    first: int = 0,
) -> dict[str, dict[str, float]]:
    """Scores of each predictor over all queries of `count` samples of a set.

    accuracy: share of the queries told rightly; iou: intersection over union of what is and what
    is said to be occupied; iou_uniform: the same over the uniform queries alone, the volumes'.
    """
    samples = samples or OccupancyConfig()
    sums = {name: np.zeros(6) for name in predictors}
    batches = sample_loader(
        split,
        batch=16,
        first=first,
        count=count,
        config=samples,  # type: ignore[arg-type]
        make=make_occupancy_sample,  # type: ignore[arg-type]
    )
    for batch in batches:
        points = batch["points"]
        index = furthest_point_sampling(points, centres)
        true, uniform = batch["distance"] < samples.shell, batch["uniform"]
        for name, predict in predictors.items():
            with torch.no_grad():
                said = predict(points, batch["queries"], index) > 0
            both, either = said & true, said | true
            counts = [said == true, both, either, both & uniform, either & uniform]
            sums[name] += [*(float(c.sum()) for c in counts), true.numel()]
    return {
        name: {"accuracy": s[0] / s[5], "iou": s[1] / s[2], "iou_uniform": s[3] / s[4]}
        for name, s in sums.items()
    }


def centre_baseline(radius: float) -> Predictor:
    """Occupied within `radius` (m) of the nearest centre: what is known without an embedding."""

    def predict(points: Tensor, queries: Tensor, index: Tensor) -> Tensor:
        centres = torch.gather(points, 1, index[..., None].expand(-1, -1, 3))
        return radius - torch.cdist(queries, centres).amin(-1)

    return predict


def point_baseline(radius: float) -> Predictor:
    """Occupied within `radius` (m) of a point of the cloud: nothing is learned or compressed."""

    def predict(points: Tensor, queries: Tensor, index: Tensor) -> Tensor:
        return radius - torch.cdist(queries, points).amin(-1)

    return predict


def always_occupied(points: Tensor, queries: Tensor, index: Tensor) -> Tensor:
    """Every query is occupied."""
    return torch.ones_like(queries[..., 0])


def network_predictor(net: OccupancyNet) -> Predictor:
    """A trained network's logits, in float32."""

    def predict(points: Tensor, queries: Tensor, index: Tensor) -> Tensor:
        device = next(net.parameters()).device
        return net(points.to(device), queries.to(device), index.to(device)).cpu()

    return predict


def occupancy_loss(
    net: OccupancyNet,
    batch: Batch,
    config: EncoderTraining,
    *,
    shell: float,
    count: int,
    start: Tensor,
) -> Term:
    """Binary cross-entropy summed over the queries of a batch, and the share told rightly.

    Args:
      batch: points (B, P, 3), queries (B, Q, 3) and distance (B, Q) to the surface, m.
      shell: m, distance below which a query is occupied.
      count: centres of a cloud.
      start: (B,) indices of the points that furthest point sampling starts from.
    """
    points = batch["points"]
    index = furthest_point_sampling(points, count, start)
    target = (batch["distance"] < shell).float()
    with mixed_precision(points.device, config.bf16):
        logits = net(points, batch["queries"], index)
    logits = logits.float()
    loss = torch.nn.functional.binary_cross_entropy_with_logits(logits, target, reduction="sum")
    right = ((logits > 0) == (target > 0)).float().mean()
    return Term(loss, torch.tensor(target.numel()), {"accuracy": right})


def _draw(points: int, config: EncoderTraining, world: int) -> tuple[int, Tensor]:
    """Random choices of a step, the same in all processes: the number of centres, and the points
    (accumulate, world, batch) that furthest point sampling starts from in clouds of `points`."""
    low, high = config.centres
    count = round(low * (high / low) ** float(torch.rand(())))
    return count, torch.randint(points, (config.accumulate, world, config.batch))


def _batches(
    config: EncoderTraining, samples: OccupancyConfig, run: TrainingRun, workers: int
) -> Iterator[Batch]:
    """This process's batches from where the run stands."""
    a_step = config.batch * config.accumulate * run.ranks.world
    used = run.samples_seen // (a_step * config.uses) * a_step
    loader = sample_loader(
        "train",
        batch=config.batch,
        first=config.seed * SEED_STRIDE + used,
        rank=run.ranks.rank,
        world=run.ranks.world,
        workers=workers,
        config=samples,  # type: ignore[arg-type]
        make=make_occupancy_sample,  # type: ignore[arg-type]
    )
    return iter(loader)


def train_encoder(
    output: Path,
    *,
    encoder: EncoderConfig | None = None,
    decoder: DecoderConfig | None = None,
    config: EncoderTraining | None = None,
    samples: OccupancyConfig | None = None,
    device: str = "cpu",
    workers: int = 0,
    options: RunOptions | None = None,
) -> dict:
    """Trains until `config.steps`, or as `options` say; resumes from `output` where it can.

    Writes the files of `TrainingRun` to `output`; encoder.safetensors holds encoder and decoder. A
    resumed run keeps the settings of its state, those that are given aside. Every use of a cloud
    counts in `samples_seen`. Returns the card, which ends with scores of the EMA weights over
    `config.validation_samples` samples of the validation set. Raises `IgaDrakeError`.
    """
    saved = SavedState.read(output, ENCODER)
    before = EncoderSettings.of(output)
    if saved is not None:
        check_same_model(output, encoder, before.encoder)
        check_same_model(output, decoder, before.decoder)
    encoder, decoder = encoder or before.encoder, decoder or before.decoder
    config, samples = config or before.training, samples or before.samples
    torch.manual_seed(config.seed)
    net = OccupancyNet(encoder, decoder).to(device)

    def scores(weights: dict[str, Tensor]) -> dict[str, float]:
        measured = copy.deepcopy(net).eval()
        measured.load_state_dict(weights)
        predictors = {ENCODER: network_predictor(measured)}
        count = config.validation_samples
        return occupancy_scores(predictors, split="validation", count=count, samples=samples)[
            ENCODER
        ]

    def validate(weights: dict[str, Tensor]) -> dict[str, float]:
        found = scores(weights)
        return {"wrong": 1 - found["accuracy"]} | found

    run = TrainingRun(
        output,
        ENCODER,
        net,
        config,
        saved=saved,
        card={
            "encoder": dataclasses.asdict(encoder),
            "decoder": dataclasses.asdict(decoder),
            "samples": dataclasses.asdict(samples),
        },
        options=options,
        validate=validate,
    )
    batches = _batches(config, samples, run, workers)
    whole: list[Batch] = []
    while run.goes_on():
        use = run.step % config.uses
        if use == 0 or not whole:
            # Networks that samples are made with may be built here, once a process, at random.
            with torch.random.fork_rng(devices=[]):
                whole = [next(batches) for _ in range(config.accumulate)]
        some = slice(use, None, config.uses)  # queries are in random order
        count, start = _draw(whole[0]["points"].shape[1], config, run.ranks.world)
        row = run.advance(
            occupancy_loss(
                net,
                {
                    "points": batch["points"].to(device),
                    "queries": batch["queries"][:, some].to(device),
                    "distance": batch["distance"][:, some].to(device),
                },
                config,
                shell=samples.shell,
                count=count,
                start=first[run.ranks.rank].to(device),
            )
            for batch, first in zip(whole, start, strict=True)
        )
        if row and run.ranks.first and run.step % (4 * config.log_every) == 0:
            print(
                f"step {run.step}: loss {row['loss']:.3f}, accuracy {row['accuracy']:.3f}, "
                f"{row['samples_per_second']:.1f} clouds/s",
                flush=True,
            )
    card = run.save()
    if run.ranks.first:
        with torch.random.fork_rng(devices=[]):
            card = run.save(validation=scores(run.ema))
    run.close()
    return card
