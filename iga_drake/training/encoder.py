"""Trains the local encoder by occupancy (paper, section "Local Encoder Network").

Loss: binary cross-entropy of the decoder's logits at labelled queries. Every query is asked of the
embedding of the centre nearest to it; the number of centres and where furthest point sampling
begins change from step to step; a batch serves for a few steps, each with its share of the queries.
"""

import argparse
import dataclasses
import json
import math
import subprocess
import time
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
from iga_drake.checkpoint import load_checkpoint, save_checkpoint
from iga_drake.dataset.loader import Batch, sample_loader
from iga_drake.dataset.occupancy import OccupancyConfig, make_occupancy_sample
from iga_drake.geometry.clouds import furthest_point_sampling
from iga_drake.precision import mixed_precision

# Logits (B, Q) at queries (B, Q, 3) from clouds (B, P, 3) with centres (B, K), by index.
Predictor = Callable[[Tensor, Tensor, Tensor], Tensor]


@dataclass(frozen=True)
class EncoderTraining:
    """One training run; saved with the weights."""

    batch: int = 8  # clouds
    uses: int = 4  # steps in a row with one batch, each with other centres and queries
    steps: int = 12000
    learning_rate: float = 1e-3
    warmup: int = 50
    weight_decay: float = 0.01
    clip: float = 1.0
    ema: float = 0.998
    centres: tuple[int, int] = (8, 32)  # log-uniform
    bf16: bool = True  # autocast of the matrix products
    seed: int = 0


def _batches(
    split: str, samples: OccupancyConfig, batch: int, first: int, count: int | None, workers: int
) -> Iterator[Batch]:
    loader = sample_loader(
        split,
        batch=batch,
        first=first,
        count=count,
        workers=workers,
        config=samples,  # type: ignore[arg-type]
        make=make_occupancy_sample,  # type: ignore[arg-type]
    )
    return iter(loader)


def occupancy_scores(
    predictors: dict[str, Predictor],
    *,
    split: str,
    count: int,
    centres: int = 8,
    samples: OccupancyConfig | None = None,
    first: int = 0,
) -> dict[str, dict[str, float]]:
    """Of each predictor over all queries of `count` samples of a set.

    accuracy: share of the queries told rightly; iou: intersection over union of what is and what
    is said to be occupied; iou_uniform: the same over the uniform queries alone, the volumes'.
    """
    samples = samples or OccupancyConfig()
    sums = {name: np.zeros(6) for name in predictors}
    for batch in _batches(split, samples, 16, first, count, 0):
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
    net: OccupancyNet, batch: dict[str, Tensor], config: EncoderTraining, shell: float
) -> tuple[Tensor, dict[str, float]]:
    """Binary cross-entropy and statistics of one step, with random centres."""
    points = batch["points"]
    low, high = config.centres
    count = round(low * (high / low) ** float(torch.rand(())))
    start = torch.randint(points.shape[1], (len(points),)).to(points.device)
    index = furthest_point_sampling(points, count, start)
    target = (batch["distance"] < shell).float()
    with mixed_precision(points.device, config.bf16):
        logits = net(points, batch["queries"], index)
    logits = logits.float()
    loss = torch.nn.functional.binary_cross_entropy_with_logits(logits, target)
    right = ((logits > 0) == (target > 0)).float().mean()
    return loss, {"loss": float(loss.detach()), "accuracy": float(right)}


def _learning_rate(step: int, config: EncoderTraining) -> float:
    """Warm-up, then a cosine to 1 %."""
    progress = min(1.0, step / max(1, config.steps))
    cosine = 0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * progress))
    return config.learning_rate * min((step + 1) / config.warmup, cosine)


def _commit() -> str:
    """The commit of the checkout that this package runs from; empty outside of one."""
    command = ["git", "-C", str(Path(__file__).parent), "rev-parse", "--short", "HEAD"]
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return ""


def train_encoder(
    output: Path,
    *,
    encoder: EncoderConfig | None = None,
    decoder: DecoderConfig | None = None,
    config: EncoderTraining | None = None,
    samples: OccupancyConfig | None = None,
    device: str = "cpu",
    minutes: float = float("inf"),
    checkpoint_every: int = 200,
    stop_at: int | None = None,
    validation_count: int = 64,
    workers: int = 0,
) -> dict:
    """Trains until `config.steps`, `stop_at` or `minutes`; resumes from `output` where it can.

    Writes `output`/encoder.safetensors (EMA weights of encoder and decoder),
    `output`/state.safetensors (all that resuming needs) and `output`/log.jsonl. A resumed run
    keeps the sizes and the settings of its state, but for `steps`. Returns the card, which ends
    with scores on the validation set. Raises `CheckpointError` for a damaged state.
    """
    encoder, decoder = encoder or EncoderConfig(), decoder or DecoderConfig()
    config, samples = config or EncoderTraining(), samples or OccupancyConfig()
    state_path = output / "state.safetensors"
    torch.manual_seed(config.seed)
    step, seconds = 0, 0.0
    tensors: dict[str, Tensor] = {}
    if state_path.is_file():
        tensors, card = load_checkpoint(state_path, kind=ENCODER + "-state")
        encoder, decoder = EncoderConfig(**card["encoder"]), DecoderConfig(**card["decoder"])
        saved = card["training"] | {"centres": tuple(card["training"]["centres"])}
        config = EncoderTraining(**saved | {"steps": config.steps})
        near = tuple((share, sigma) for share, sigma in card["samples"]["near"])
        samples = OccupancyConfig(**card["samples"] | {"near": near})
        step, seconds = card["step"], card["seconds"]
    net = OccupancyNet(encoder, decoder).to(device)
    named = dict(net.named_parameters())
    optimizer = torch.optim.AdamW(
        named.values(), lr=config.learning_rate, weight_decay=config.weight_decay
    )
    ema = {n: p.detach().clone() for n, p in named.items()}
    if tensors:
        net.load_state_dict({n: tensors[f"net.{n}"] for n in named})
        for name, parameter in named.items():
            ema[name] = tensors[f"ema.{name}"].to(device)
            if f"m.{name}" in tensors:
                optimizer.state[parameter] = {
                    "step": torch.tensor(float(step)),
                    "exp_avg": tensors[f"m.{name}"].to(device),
                    "exp_avg_sq": tensors[f"v.{name}"].to(device),
                }
        torch.set_rng_state(tensors["rng"])
    output.mkdir(parents=True, exist_ok=True)
    began = time.monotonic()
    recent: list[dict] = []
    whole: Batch = {}

    def write() -> dict:
        card = {
            "encoder": dataclasses.asdict(encoder),
            "decoder": dataclasses.asdict(decoder),
            "training": dataclasses.asdict(config),
            "samples": dataclasses.asdict(samples),
            "step": step,
            "samples_seen": math.ceil(step / config.uses) * config.batch,
            "seconds": seconds + time.monotonic() - began,
            "parameters": sum(p.numel() for p in net.encoder.parameters()),
            "decoder_parameters": sum(p.numel() for p in net.decoder.parameters()),
            "commit": _commit(),
        }
        save_checkpoint(output / "encoder.safetensors", ema, kind=ENCODER, card=card)
        state: dict[str, Tensor] = {f"net.{n}": p for n, p in named.items()}
        state |= {f"ema.{n}": t for n, t in ema.items()}
        for n, p in named.items():
            if moments := optimizer.state.get(p):
                state |= {f"m.{n}": moments["exp_avg"], f"v.{n}": moments["exp_avg_sq"]}
        state["rng"] = torch.get_rng_state()
        save_checkpoint(state_path, state, kind=ENCODER + "-state", card=card)
        return card

    first = config.seed * 10_000_000 + step // config.uses * config.batch
    batches = _batches("train", samples, config.batch, first, None, workers)
    last = config.steps if stop_at is None else min(stop_at, config.steps)
    with (output / "log.jsonl").open("a", encoding="utf-8") as log:
        while step < last and time.monotonic() - began < 60 * minutes:
            use = step % config.uses
            if use == 0 or not whole:
                whole = next(batches)
            some = slice(use, None, config.uses)  # queries are in random order
            batch = {
                "points": whole["points"].to(device),
                "queries": whole["queries"][:, some].to(device),
                "distance": whole["distance"][:, some].to(device),
            }
            for group in optimizer.param_groups:
                group["lr"] = _learning_rate(step, config)
            loss, row = occupancy_loss(net, batch, config, samples.shell)
            optimizer.zero_grad(set_to_none=True)
            loss.backward()
            row["gradient"] = float(torch.nn.utils.clip_grad_norm_(net.parameters(), config.clip))
            optimizer.step()
            step += 1
            rate = min(config.ema, (1 + step) / (10 + step))
            with torch.no_grad():
                for name, parameter in named.items():
                    ema[name].lerp_(parameter, 1 - rate)
            recent.append(row)
            if step % 25 == 0:
                mean = {key: float(np.mean([r[key] for r in recent])) for key in recent[0]}
                mean |= {"step": step, "seconds": seconds + time.monotonic() - began}
                log.write(json.dumps(mean) + "\n")
                log.flush()
                recent = []
                if step % 100 == 0:
                    print(
                        f"step {step}: loss {mean['loss']:.3f}, accuracy {mean['accuracy']:.3f}, "
                        f"{step * config.batch / mean['seconds']:.1f} clouds/s",
                        flush=True,
                    )
            if step % checkpoint_every == 0:
                write()
    card = write()
    final = OccupancyNet(encoder, decoder).to(device).eval()
    final.load_state_dict(ema)
    card["validation"] = occupancy_scores(
        {"encoder": network_predictor(final)},
        split="validation",
        count=validation_count,
        samples=samples,
    )["encoder"]
    save_checkpoint(output / "encoder.safetensors", ema, kind=ENCODER, card=card)
    return card


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `iga train encoder`."""
    parser.add_argument("--out", type=Path, required=True, help="folder of weights, state and log")
    parser.add_argument(
        "--size", choices=("paper", "light"), default="paper",
        help="1.7 M parameters as in the paper, or 0.4 M",
    )  # fmt: skip
    parser.add_argument(
        "--query", choices=("position", "projections"), default=DecoderConfig.query,
        help="what the decoder sees of a query: its position, as in the paper, or invariants",
    )  # fmt: skip
    parser.add_argument("--steps", type=int, default=EncoderTraining.steps)
    parser.add_argument("--batch", type=int, default=EncoderTraining.batch, help="clouds a step")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--minutes", type=float, default=float("inf"), help="stop after this long")
    parser.add_argument("--workers", type=int, default=0, help="processes that make samples")
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--threads", type=int, default=1, help="threads of PyTorch on the CPU")
    parser.add_argument("--float32", action="store_true", help="no bfloat16 autocast")


def main(arguments: argparse.Namespace) -> int:
    """Runs the training; a run that was stopped (or killed) goes on from its last checkpoint."""
    torch.set_num_threads(arguments.threads)
    light = arguments.size == "light"
    card = train_encoder(
        arguments.out,
        encoder=EncoderConfig.light() if light else EncoderConfig(),
        decoder=DecoderConfig(query=arguments.query, width=128 if light else 256),
        config=EncoderTraining(
            steps=arguments.steps,
            batch=arguments.batch,
            seed=arguments.seed,
            bf16=not arguments.float32,
        ),
        device=arguments.device,
        minutes=arguments.minutes,
        workers=arguments.workers,
    )
    scores = card["validation"]
    print(
        f"step {card['step']}, {card['samples_seen']} clouds seen, {card['seconds']:.0f} s; "
        f"validation: accuracy {scores['accuracy']:.3f}, IoU {scores['iou']:.3f}, of the volume "
        f"{scores['iou_uniform']:.3f}"
    )
    return 0
