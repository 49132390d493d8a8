"""Trains the dense descriptors by correspondence between the instances of a sample.

The losses are in `training/correspondence.py`.
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
from iga_drake.checkpoint import CheckpointError, check_finite, load_checkpoint
from iga_drake.dataset.loader import sample_loader
from iga_drake.dataset.samples import SampleConfig
from iga_drake.training.correspondence import (
    LOSS_FIELDS,
    DescriptorTraining,
    Draw,
    descriptor_loss,
)
from iga_drake.training.run import RunOptions, SavedState, TrainingRun
from iga_drake.training.settings import check_same_model, replaced
from iga_drake.training.validation import alignment_errors

TRAINING_SAMPLES = SampleConfig(field=0.6)
SEED_STRIDE = 10_000_000  # samples between the streams of two seeds


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
            return DescriptorSettings(DescriptorConfig(), DescriptorTraining(), TRAINING_SAMPLES)
        return _saved_settings(saved, folder)


def _saved_settings(saved: SavedState, folder: Path) -> DescriptorSettings:
    where = f"{folder / 'state.safetensors'}"
    return DescriptorSettings(
        descriptor_config(saved.card),
        replaced(DescriptorTraining(), saved.card["training"], f"{where}: training"),
        replaced(SampleConfig(), saved.card["samples"], f"{where}: samples"),
    )


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
            term = descriptor_loss(net, {k: batch[k].to(device) for k in LOSS_FIELDS}, config)
            values = {"loss": term.total / term.count} | term.statistics
            rows.append({name: float(value) for name, value in values.items()})
    net.train()
    return {key: float(np.mean([row[key] for row in rows])) for key in rows[0]}


def _draws(shape: torch.Size, config: DescriptorTraining, world: int) -> list[list[Draw]]:
    """Random choices of a step, the same in all processes: of each forward pass and process."""
    _, _, N, P = shape[:4]
    draw = Draw.at_random(config.accumulate * world * config.batch, N, P, config)
    parts = draw.split(config.batch)
    return [parts[k * world : (k + 1) * world] for k in range(config.accumulate)]


def _take_over(net: DescriptorNet, tensors: dict[str, Tensor], path: Path) -> None:
    """Loads weights; layers that the checkpoint lacks keep their start, and inputs that it lacks
    begin without effect."""
    own = net.state_dict()
    for name, tensor in tensors.items():
        wide = own.get(name)
        if wide is not None and wide.ndim == tensor.ndim == 2 and wide.shape[1] > tensor.shape[1]:
            missing = wide.shape[1] - tensor.shape[1]
            tensors[name] = torch.nn.functional.pad(tensor, (0, missing))
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
        check_same_model(output, model, before.model)
        model, config, samples = before.model, config or before.training, samples or before.samples
    model, config = model or DescriptorConfig(), config or DescriptorTraining()
    samples = samples or TRAINING_SAMPLES
    torch.manual_seed(config.seed)
    net = DescriptorNet(model).to(device)
    if initial is not None and saved is None:
        loaded, _ = load_checkpoint(initial, kind=KIND)
        check_finite(initial, loaded)
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
    batches = iter(
        sample_loader(
            config.split,
            config=samples,
            batch=config.batch,
            first=config.seed * SEED_STRIDE + run.samples_seen,
            rank=run.ranks.rank,
            world=run.ranks.world,
            workers=workers,
        )
    )
    rank = run.ranks.rank
    while run.goes_on():
        # Networks that samples are made with may be built here, once a process, at random.
        with torch.random.fork_rng(devices=[]):
            parts = [next(batches) for _ in range(config.accumulate)]
        draws = _draws(parts[0]["points"].shape, config, run.ranks.world)
        row = run.advance(
            descriptor_loss(net, {k: part[k].to(device) for k in LOSS_FIELDS}, config, of_all[rank])
            for part, of_all in zip(parts, draws, strict=True)
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
