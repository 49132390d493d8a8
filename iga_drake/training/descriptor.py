"""Trains the dense descriptors by contrastive correspondence between the instances of a sample.

Loss: for every ordered pair of instances of one object, cross-entropy between the match logits of
each node and a soft target, a Gaussian in the canonical space (InfoNCE with soft positives).
"""

import copy
import dataclasses
import functools
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from iga_drake.aligners.iga.aligner import IgaAligner
from iga_drake.aligners.iga.descriptor import DescriptorConfig, DescriptorNet
from iga_drake.aligners.iga.weights import DESCRIPTOR as KIND
from iga_drake.aligners.iga.weights import descriptor_config
from iga_drake.checkpoint import CheckpointError, load_checkpoint
from iga_drake.dataset.loader import sample_loader
from iga_drake.dataset.samples import SampleConfig
from iga_drake.geometry.clouds import furthest_point_sampling
from iga_drake.precision import mixed_precision
from iga_drake.training.run import RunConfig, RunOptions, SavedState, Term, TrainingRun
from iga_drake.training.settings import TrainingError, replaced
from iga_drake.training.validation import alignment_errors

FEWER_PAIRS = 0.5  # of the steps use fewer than all pairs of a sample
SEED_STRIDE = 10_000_000  # samples between the streams of two seeds
WRONG = 3.0  # target sigmas from the true place, from where on a match counts as wrong


@dataclass(frozen=True)
class DescriptorTraining(RunConfig):
    """One training run; saved with the weights. A sample has 2 objects of N instances."""

    optimizer: str = "muon"
    nodes: int = 64
    target_sigma: float = 0.05  # of the canonical size
    visible_within: float = 0.12  # a node counts where a true match is this near
    scored_samples: int = 64  # of the validation set, that the finished weights are scored on


@dataclass(frozen=True)
class DescriptorSettings:
    """All settings of a training; they and the first weights determine its result."""

    model: DescriptorConfig
    training: DescriptorTraining
    samples: SampleConfig

    @staticmethod
    def of(folder: Path) -> "DescriptorSettings":
        """The settings of the run in this folder, else the defaults. Raises `IgaDrakeError`."""
        saved = SavedState.read(folder, KIND)
        if saved is None:
            return DescriptorSettings(DescriptorConfig(), DescriptorTraining(), SampleConfig())
        return _saved_settings(saved, folder)


def _saved_settings(saved: SavedState, folder: Path) -> DescriptorSettings:
    where = f"{folder / 'state.safetensors'}"
    return DescriptorSettings(
        descriptor_config(saved.card),
        replaced(DescriptorTraining(), saved.card["training"], f"{where}: training"),
        replaced(SampleConfig(), saved.card["samples"], f"{where}: samples"),
    )


def correspondence_loss(
    net: DescriptorNet,
    batch: dict[str, Tensor],
    config: DescriptorTraining,
    start: Tensor | None = None,
) -> Term:
    """The cross-entropy of every node that has a true match, summed; mean logits of right and best
    wrong matches, top-1 rate, and the match error as a share of the canonical size.

    Nodes are sampled from the points `start` (clouds,) of the clouds on; default: at random.
    """
    points = batch["points"].flatten(0, 2)
    canonical = batch["canonical"].flatten(0, 2)
    S, _, N = batch["points"].shape[:3]
    if start is None:
        start = torch.randint(points.shape[1], (len(points),))
    nodes = furthest_point_sampling(points, config.nodes, start.to(points.device))
    place = torch.gather(canonical, 1, nodes[..., None].expand(-1, -1, 3))
    M = config.nodes
    with mixed_precision(points.device, config.bf16):
        descriptors = net(points, nodes, group=N)
    descriptors = descriptors.float().reshape(2 * S, N * M, -1)
    place = place.reshape(2 * S, N * M, 3)
    logits = net.similarity(descriptors, descriptors).reshape(2 * S, N, M, N, M)
    distance = torch.cdist(place, place).reshape(2 * S, N, M, N, M)
    target = (-(distance**2) / (2 * config.target_sigma**2)).softmax(-1)
    cross_entropy = -(target * logits.log_softmax(-1)).sum(-1)  # (2S, N, M, N)
    other = ~torch.eye(N, dtype=torch.bool, device=points.device)[None, :, None, :]
    valid = (distance.amin(-1) < config.visible_within) & other
    with torch.no_grad():
        best = logits.argmax(-1, keepdim=True)
        error = torch.gather(distance, -1, best)[..., 0][valid]
        hit = (best[..., 0] == distance.argmin(-1))[valid]
        wrong = distance > WRONG * config.target_sigma
        statistics = {
            "top1": hit.float().mean(),
            "error_mean": error.mean(),
            "error_median": error.median(),
            "positive_logit": (target * logits).sum(-1)[valid].mean(),
            # Only of nodes that have a wrong match to choose.
            "negative_logit": logits.masked_fill(~wrong, -torch.inf)
            .amax(-1)[valid & wrong.any(-1)]
            .mean(),
        }
    return Term(cross_entropy[valid].sum(), valid.sum(), statistics)


def _draw(shape: torch.Size, config: DescriptorTraining, world: int) -> tuple[int, Tensor]:
    """Random choices of a step, the same in all processes: how many pairs (two or more: any number
    of demonstrations will be asked for), and the first nodes (accumulate, world, clouds) of all."""
    _, _, N, P = shape[:4]
    group = int(torch.randint(2, N + 1, ())) if torch.rand(()) < FEWER_PAIRS else N
    return group, torch.randint(P, (config.accumulate, world, config.batch * 2 * group))


def validate(
    net: DescriptorNet, config: DescriptorTraining, samples: SampleConfig, *, split: str, count: int
) -> dict[str, float]:
    """Mean loss and statistics over the first `count` samples of a split."""
    device = next(net.parameters()).device
    rows = []
    net.eval()
    with torch.random.fork_rng(devices=[]), torch.no_grad():
        torch.manual_seed(0)
        for batch in sample_loader(split, config=samples, batch=8, count=count):
            batch = {k: batch[k].to(device) for k in ("points", "canonical")}
            term = correspondence_loss(net, batch, config)
            values = {"loss": term.total / term.count} | term.statistics
            rows.append({name: float(value) for name, value in values.items()})
    net.train()
    return {key: float(np.mean([row[key] for row in rows])) for key in rows[0]}


def _take_over(net: DescriptorNet, tensors: dict[str, Tensor], path: Path) -> None:
    """Loads weights; layers that the checkpoint lacks keep their start."""
    own = net.state_dict()
    wrong = sorted(n for n, t in tensors.items() if n not in own or own[n].shape != t.shape)
    if wrong:
        raise CheckpointError(
            f"{path}: {wrong[0]} does not fit this network: start from weights of its sizes"
        )
    net.load_state_dict(tensors, strict=False)


def _alignment_errors(
    weights: dict[str, Tensor], *, model: DescriptorConfig, count: int
) -> dict[str, float]:
    net = DescriptorNet(model)
    net.load_state_dict(weights)
    return alignment_errors(IgaAligner(net), count=count)


def train_descriptor(
    output: Path,
    *,
    model: DescriptorConfig | None = None,
    config: DescriptorTraining | None = None,
    samples: SampleConfig | None = None,
    device: str = "cpu",
    resume: bool = True,
    initial: Path | None = None,
    workers: int = 0,
    options: RunOptions | None = None,
) -> dict:
    """Trains until `config.steps`, or as `options` say; resumes from `output` where it can.

    Writes the files of `TrainingRun` to `output`. A resumed run keeps the settings of its state,
    those that are given aside. Returns the model card, which ends with the statistics of the EMA
    weights over `config.scored_samples` samples of the validation set. Raises `IgaDrakeError`.
    """
    saved = SavedState.read(output, KIND) if resume else None
    if saved is not None:
        before = _saved_settings(saved, output)
        if model not in (None, before.model):
            raise TrainingError(
                f"{output / 'state.safetensors'}: has another model than the one asked for "
                f"({before.model}): train in another folder"
            )
        model, config, samples = before.model, config or before.training, samples or before.samples
    model, config = model or DescriptorConfig(), config or DescriptorTraining()
    samples = samples or SampleConfig()
    torch.manual_seed(config.seed)
    net = DescriptorNet(model).to(device)
    if initial is not None and saved is None:
        loaded, _ = load_checkpoint(initial, kind=KIND)
        _take_over(net, loaded, initial)
    run = TrainingRun(
        output,
        KIND,
        net,
        config,
        saved=saved,
        card={"model": dataclasses.asdict(model), "samples": dataclasses.asdict(samples)},
        options=options,
        validate=functools.partial(_alignment_errors, model=model, count=config.validation_samples),
    )
    if options is not None and options.compile:
        net.compile_layers()
    batches = iter(
        sample_loader(
            "train",
            config=samples,
            batch=config.batch,
            first=config.seed * SEED_STRIDE + run.samples_seen,
            rank=run.ranks.rank,
            world=run.ranks.world,
            workers=workers,
        )
    )
    while run.goes_on():
        # Networks that samples are made with may be built here, once a process, at random.
        with torch.random.fork_rng(devices=[]):
            parts = [next(batches) for _ in range(config.accumulate)]
        group, start = _draw(parts[0]["points"].shape, config, run.ranks.world)
        row = run.advance(
            correspondence_loss(
                net,
                {k: part[k][:, :, :group].to(device) for k in ("points", "canonical")},
                config,
                first[run.ranks.rank],
            )
            for part, first in zip(parts, start, strict=True)
        )
        if row and run.ranks.first and run.step % (4 * config.log_every) == 0:
            print(
                f"step {run.step}: loss {row['loss']:.3f} top-1 {row['top1']:.3f} match error "
                f"{100 * row['error_median']:.1f} % of the size (median), "
                f"{row['samples_per_second']:.1f} samples/s",
                flush=True,
            )
    card = run.save()
    if run.ranks.first:
        final = copy.deepcopy(net)
        final.load_state_dict(run.ema)
        count = config.scored_samples
        scores = validate(final, config, samples, split="validation", count=count)
        card = run.save(validation=scores)
    run.close()
    return card
