"""Trains the dense descriptors by contrastive correspondence between the instances of a sample.

Loss: for every ordered pair of instances of one object, cross-entropy between the match logits of
each node and a soft target, a Gaussian in the canonical space (InfoNCE with soft positives).
"""

import dataclasses
import json
import subprocess
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from iga_drake.aligners.iga.descriptor import DescriptorConfig, DescriptorNet
from iga_drake.aligners.iga.weights import DESCRIPTOR as KIND
from iga_drake.aligners.iga.weights import descriptor_config
from iga_drake.checkpoint import CheckpointError, load_checkpoint, save_checkpoint
from iga_drake.dataset.loader import sample_loader
from iga_drake.dataset.samples import SampleConfig
from iga_drake.geometry.clouds import furthest_point_sampling

FEWER_PAIRS = 0.5  # of the steps use fewer than all pairs of a sample


@dataclass(frozen=True)
class DescriptorTraining:
    """One training run; saved with the weights."""

    batch: int = 6  # samples of 2 objects x N instances
    steps: int = 6000
    learning_rate: float = 1.5e-3
    warmup: int = 150
    decay_share: float = 0.35  # of the steps, at the end: linear to zero
    weight_decay: float = 0.02
    clip: float = 1.0
    ema: float = 0.998
    nodes: int = 64
    target_sigma: float = 0.05  # of the canonical size
    visible_within: float = 0.12  # a node counts where a true match is this near
    bf16: bool = True  # autocast of the matrix products
    seed: int = 0


def correspondence_loss(
    net: DescriptorNet, batch: dict[str, Tensor], config: DescriptorTraining
) -> tuple[Tensor, dict[str, float]]:
    """Loss and statistics: top-1 rate and the match error as a share of the canonical size."""
    points = batch["points"].flatten(0, 2)
    canonical = batch["canonical"].flatten(0, 2)
    S, _, N = batch["points"].shape[:3]
    start = torch.randint(points.shape[1], (len(points),), device=points.device)
    nodes = furthest_point_sampling(points, config.nodes, start)
    place = torch.gather(canonical, 1, nodes[..., None].expand(-1, -1, 3))
    M = config.nodes
    with torch.autocast(points.device.type, torch.bfloat16, enabled=config.bf16):
        descriptors = net(points, nodes, group=N)
    descriptors = descriptors.float().reshape(2 * S, N * M, -1)
    place = place.reshape(2 * S, N * M, 3)
    logits = net.similarity(descriptors, descriptors).reshape(2 * S, N, M, N, M)
    distance = torch.cdist(place, place).reshape(2 * S, N, M, N, M)
    target = (-(distance**2) / (2 * config.target_sigma**2)).softmax(-1)
    cross_entropy = -(target * logits.log_softmax(-1)).sum(-1)  # (2S, N, M, N)
    other = ~torch.eye(N, dtype=torch.bool, device=points.device)[None, :, None, :]
    valid = (distance.amin(-1) < config.visible_within) & other
    loss = cross_entropy[valid].mean()
    with torch.no_grad():
        best = logits.argmax(-1, keepdim=True)
        error = torch.gather(distance, -1, best)[..., 0][valid]
        hit = (best[..., 0] == distance.argmin(-1))[valid]
    return loss, {
        "loss": float(loss.detach()),
        "top1": float(hit.float().mean()),
        "error_mean": float(error.mean()),
        "error_median": float(error.median()),
    }


def _learning_rate(step: int, config: DescriptorTraining) -> float:
    decay = max(1, int(config.decay_share * config.steps))
    return config.learning_rate * min(
        1.0, (step + 1) / config.warmup, max(0.02, (config.steps - step) / decay)
    )


def _some_pairs(batch: dict[str, Tensor]) -> dict[str, Tensor]:
    """The first pairs of a batch, two or more: any number of demonstrations will be asked for."""
    N = batch["points"].shape[2]
    group = int(torch.randint(2, N + 1, ())) if torch.rand(()) < FEWER_PAIRS else N
    return {name: values[:, :, :group] for name, values in batch.items()}


def validate(
    net: DescriptorNet, config: DescriptorTraining, samples: SampleConfig, *, split: str, count: int
) -> dict[str, float]:
    """Mean statistics over the first `count` samples of a split."""
    device = next(net.parameters()).device
    rows = []
    torch_state = torch.get_rng_state()
    torch.manual_seed(0)
    net.eval()
    with torch.no_grad():
        for batch in sample_loader(split, config=samples, batch=8, count=count):
            batch = {k: batch[k].to(device) for k in ("points", "canonical")}
            rows.append(correspondence_loss(net, batch, config)[1])
    torch.set_rng_state(torch_state)
    net.train()
    return {key: float(np.mean([row[key] for row in rows])) for key in rows[0]}


def _commit() -> str:
    """The commit of the checkout that this package runs from; empty outside of one."""
    command = ["git", "-C", str(Path(__file__).parent), "rev-parse", "--short", "HEAD"]
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return ""


def _take_over(net: DescriptorNet, tensors: dict[str, Tensor], path: Path) -> None:
    """Loads weights; layers that the checkpoint lacks keep their start."""
    own = net.state_dict()
    wrong = sorted(n for n, t in tensors.items() if n not in own or own[n].shape != t.shape)
    if wrong:
        raise CheckpointError(
            f"{path}: {wrong[0]} does not fit this network: start from weights of its sizes"
        )
    net.load_state_dict(tensors, strict=False)


def train_descriptor(
    output: Path,
    *,
    model: DescriptorConfig | None = None,
    config: DescriptorTraining | None = None,
    samples: SampleConfig | None = None,
    device: str = "cpu",
    minutes: float = float("inf"),
    resume: bool = True,
    initial: Path | None = None,
    checkpoint_every: int = 200,
    stop_at: int | None = None,
    validation_count: int = 64,
    workers: int = 0,
) -> dict:
    """Trains until `config.steps`, `stop_at` or `minutes`; resumes from `output` where it can.

    Writes `output`/descriptor.safetensors (EMA weights), `output`/state.safetensors (all that
    resuming needs) and `output`/log.jsonl. Returns the model card, which ends with the statistics
    of the EMA weights over `validation_count` samples of the validation split.
    """
    config, samples = config or DescriptorTraining(), samples or SampleConfig()
    state_path = output / "state.safetensors"
    torch.manual_seed(config.seed)
    step, seconds = 0, 0.0
    tensors: dict[str, Tensor] = {}
    if resume and state_path.is_file():
        tensors, card = load_checkpoint(state_path, kind=KIND + "-state")
        model = descriptor_config(card)
        step, seconds = card["step"], card["seconds"]
    net = DescriptorNet(model or DescriptorConfig()).to(device)
    names = [name for name, _ in net.named_parameters()]
    optimizer = torch.optim.AdamW(
        net.parameters(),
        lr=config.learning_rate,
        weight_decay=config.weight_decay,
        betas=(0.9, 0.98),
    )
    if tensors:
        net.load_state_dict({n: tensors[f"net.{n}"] for n in names})
        for name, parameter in net.named_parameters():
            optimizer.state[parameter] = {
                "step": torch.tensor(float(step)),
                "exp_avg": tensors[f"m.{name}"].to(device),
                "exp_avg_sq": tensors[f"v.{name}"].to(device),
            }
        ema = {n: tensors[f"ema.{n}"].to(device) for n in names}
        torch.set_rng_state(tensors["rng"])
    else:
        if initial is not None:
            loaded, _ = load_checkpoint(initial, kind=KIND)
            _take_over(net, loaded, initial)
        ema = {n: p.detach().clone() for n, p in net.named_parameters()}
    output.mkdir(parents=True, exist_ok=True)
    log = (output / "log.jsonl").open("a")
    began = time.monotonic()
    recent: list[dict] = []

    def write() -> dict:
        card = {
            "model": dataclasses.asdict(net.config),
            "training": dataclasses.asdict(config),
            "samples": dataclasses.asdict(samples),
            "step": step,
            "samples_seen": step * config.batch,
            "seconds": seconds + time.monotonic() - began,
            "parameters": sum(p.numel() for p in net.parameters()),
            "commit": _commit(),
        }
        save_checkpoint(output / "descriptor.safetensors", ema, kind=KIND, card=card)
        state: dict[str, Tensor] = {f"net.{n}": p for n, p in net.named_parameters()}
        state |= {f"ema.{n}": t for n, t in ema.items()}
        for n, p in net.named_parameters():
            # The last layer's vectors feed nothing: they have no gradient and no moments.
            moments = optimizer.state.get(p, {})
            state[f"m.{n}"] = moments.get("exp_avg", torch.zeros_like(p))
            state[f"v.{n}"] = moments.get("exp_avg_sq", torch.zeros_like(p))
        state["rng"] = torch.get_rng_state()
        save_checkpoint(state_path, state, kind=KIND + "-state", card=card)
        return card

    batches = iter(
        sample_loader(
            "train",
            config=samples,
            batch=config.batch,
            first=config.seed * 10_000_000 + step * config.batch,
            workers=workers,
        )
    )
    last = config.steps if stop_at is None else min(stop_at, config.steps)
    while step < last and time.monotonic() - began < 60 * minutes:
        whole = next(batches)
        batch = _some_pairs({k: whole[k].to(device) for k in ("points", "canonical")})
        for group in optimizer.param_groups:
            group["lr"] = _learning_rate(step, config)
        loss, row = correspondence_loss(net, batch, config)
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(net.parameters(), config.clip)
        optimizer.step()
        step += 1
        rate = min(config.ema, (1 + step) / (10 + step))
        with torch.no_grad():
            for name, parameter in net.named_parameters():
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
                    f"step {step}: loss {mean['loss']:.3f} top-1 {mean['top1']:.3f} match error "
                    f"{100 * mean['error_median']:.1f} % of the size (median), "
                    f"{step * config.batch / mean['seconds']:.1f} samples/s",
                    flush=True,
                )
        if step % checkpoint_every == 0:
            write()
    card = write()
    final = DescriptorNet(net.config).to(device)
    final.load_state_dict(ema)
    card["validation"] = validate(
        final, config, samples, split="validation", count=validation_count
    )
    save_checkpoint(output / "descriptor.safetensors", ema, kind=KIND, card=card)
    return card
