"""Trains the deformed implicit field (iga_drake/shapes/dif_net.py) on signed distances of shapes.

The losses are those of Deng, Yang & Tong (CVPR 2021), equations in `dif_net_loss`.
"""

import argparse
import dataclasses
import hashlib
import json
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import trimesh
from torch import Tensor

from iga_drake.checkpoint import CheckpointError, load_checkpoint, save_checkpoint
from iga_drake.shapes.dif_net import (
    KIND,
    DifNet,
    DifNetConfig,
    Normalisation,
    siren_jacobian,
)
from iga_drake.shapes.errors import ShapeError
from iga_drake.shapes.families import FAMILIES


@dataclass(frozen=True)
class DifNetTraining:
    """One training run; saved with the weights."""

    family: str = "chair"
    shapes: int = 150
    stored_points: int = 6000  # of each shape on the surface, and as many off it
    batch: int = 4  # shapes a step
    points: int = 256  # of each shape a step: half on the surface, half off it
    steps: int = 10000
    learning_rate: float = 1e-4
    latent_rate: float = 10.0  # learning rate of the latents relative to that of the networks
    warmup: int = 100
    decay_share: float = 0.4  # of the steps, at the end: linear to zero
    clip: float = 1e3
    # Weights of the losses, names as in `dif_net_loss`.
    sdf: float = 3e3
    off_surface: float = 5e2
    normal: float = 1e2
    eikonal: float = 5e1
    template_normal: float = 1e2
    smooth: float = 5.0
    correction: float = 5e2
    latent: float = 1e3
    off_surface_rate: float = 1e2  # delta of exp(-delta |s|)
    seed: int = 0


@dataclass(frozen=True)
class SdfSamples:
    """Points of N shapes in the normalised frame; float32."""

    surface: Tensor  # (N, M, 3)
    normals: Tensor  # (N, M, 3) unit, outwards
    points: Tensor  # (N, M, 3) off the surface: first half near it, second half in the cube
    distance: Tensor  # (N, M) signed, of `points`, negative inside


def union(vertices: np.ndarray, faces: np.ndarray) -> trimesh.Trimesh:
    """The outer surface of overlapping closed parts. Raises `ShapeError`."""
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    parts = list(mesh.split(only_watertight=False))
    try:
        whole = trimesh.boolean.union(parts, engine="manifold")
    except (ImportError, ValueError) as error:
        raise ShapeError(
            f"union of {len(parts)} parts: {error}; pip install 'iga-drake[train]'"
        ) from error
    if not whole.is_watertight:
        raise ShapeError(f"union of {len(parts)} parts: not watertight")
    return whole


def sample_sdf(
    vertices: np.ndarray, faces: np.ndarray, count: int, seed: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Surface points, their normals (count, 3), points off the surface (count, 3), and the signed
    distance (count,) of those, all in the normalised frame of the shape.

    Half of the points off the surface are near it (normal, sigma 0.02 and 0.1), half are uniform in
    the cube [-1, 1]^3. The distance is to the union of the parts. Raises `ShapeError`.
    """
    try:
        import igl
    except ImportError as error:
        raise ShapeError("signed distances need libigl: pip install 'iga-drake[train]'") from error
    rng = np.random.default_rng(seed)
    whole = union(Normalisation.of(vertices).apply(vertices), faces)
    surface, face = trimesh.sample.sample_surface(whole, count, seed=rng)
    near = count // 2
    sigma = np.where(np.arange(near) % 2 == 0, 0.02, 0.1)[:, None]
    points = np.concatenate(
        (surface[:near] + sigma * rng.normal(size=(near, 3)), rng.uniform(-1, 1, (count - near, 3)))
    )
    distance = igl.signed_distance(
        points,
        np.ascontiguousarray(whole.vertices, dtype=np.float64),
        np.ascontiguousarray(whole.faces, dtype=np.int64),
        sign_type=igl.SignedDistanceType.SIGNED_DISTANCE_TYPE_PSEUDONORMAL,
    )[0]
    return np.asarray(surface), whole.face_normals[face], points, distance


def training_shapes(config: DifNetTraining) -> list[tuple[np.ndarray, np.ndarray]]:
    """Vertices (V, 3) m and faces of the training shapes, a pure function of the seed."""
    if config.family not in FAMILIES:
        raise ShapeError(f"family '{config.family}': unknown; one of {', '.join(FAMILIES)}")
    shapes = []
    for index in range(config.shapes):
        rng = np.random.default_rng((config.seed, index))
        family = FAMILIES[config.family]
        surface = family.surface(family.sample_parameters(rng))
        shapes.append((surface.vertices, surface.faces))
    return shapes


def shapes_digest(shapes: list[tuple[np.ndarray, np.ndarray]]) -> str:
    """SHA-256 of the vertices to 1e-9 m: tells whether a family has changed since a training."""
    digest = hashlib.sha256()
    for vertices, _ in shapes:
        digest.update(np.round(vertices * 1e9).astype("<i8").tobytes())
    return digest.hexdigest()


def training_samples(
    shapes: list[tuple[np.ndarray, np.ndarray]], config: DifNetTraining
) -> SdfSamples:
    """Signed distances of the training shapes."""
    rows = [
        sample_sdf(vertices, faces, config.stored_points, index)
        for index, (vertices, faces) in enumerate(shapes)
    ]
    arrays = [
        torch.from_numpy(np.stack(column).astype(np.float32)) for column in zip(*rows, strict=True)
    ]
    return SdfSamples(*arrays)


def dif_net_loss(
    net: DifNet,
    index: Tensor,
    surface: Tensor,
    normals: Tensor,
    points: Tensor,
    distance: Tensor,
    config: DifNetTraining,
) -> tuple[Tensor, dict[str, float]]:
    """Weighted sum of the losses, and each of them, for shapes `index` (B,) at their samples.

    With S the surface points, O those off it, both together Omega, n the normals, d the distance:

    sdf              mean over Omega of |s - d|
    normal           mean over S of 1 - cos(grad s, n)
    eikonal          mean over Omega of | |grad s| - 1 |
    off_surface      mean over O of exp(-delta |s|)
    template_normal  mean over S of 1 - cos(grad T at p + v(p), n)
    smooth           mean over Omega of the sum over x, y, z of |grad v_d|
    correction       mean over Omega of |dc|
    latent           mean of alpha^2
    """
    latent = net.latents[index]
    omega = net.config.omega
    everywhere = torch.cat((surface, points), 1)
    on = surface.shape[1]
    field, jacobian = siren_jacobian(net.deformation_layers(latent), everywhere, omega)
    displacement, correction = field[..., :3], field[..., 3]
    dv, dc = jacobian[..., :3], jacobian[..., 3]  # (B, 3, P, 3): d v_k / d p_j at [:, j, :, k]
    value, template_gradient = siren_jacobian(
        net.template_layers(), everywhere + displacement, omega
    )
    gradient_T = template_gradient[..., 0]  # (B, 3, P)
    s = value[..., 0] + correction
    gradient = gradient_T + torch.einsum("bjpk,bkp->bjp", dv, gradient_T) + dc
    normal = normals.mT  # (B, 3, P)
    target = torch.cat((torch.zeros_like(distance[:, :1]).expand(-1, on), distance), 1)
    # Far from the surface only the sign and the eikonal loss matter.
    error = (s.clamp(-0.5, 0.5) - target.clamp(-0.5, 0.5)).abs()
    terms = {
        "sdf": error.mean(),
        "off_surface": torch.exp(-config.off_surface_rate * s[:, on:].abs()).mean(),
        "normal": (1 - torch.cosine_similarity(gradient[..., :on], normal, dim=1)).mean(),
        "eikonal": (gradient.square().sum(1).add(1e-12).sqrt() - 1).abs().mean(),
        "template_normal": (
            1 - torch.cosine_similarity(gradient_T[..., :on], normal, dim=1)
        ).mean(),
        "smooth": dv.square().sum(1).add(1e-12).sqrt().sum(-1).mean(),
        "correction": correction.abs().mean(),
        "latent": latent.square().mean(),
    }
    loss = sum((getattr(config, name) * term for name, term in terms.items()), torch.zeros(()))
    return loss, {"loss": float(loss.detach())} | {k: float(t.detach()) for k, t in terms.items()}


def _learning_rate(step: int, config: DifNetTraining) -> float:
    decay = max(1, int(config.decay_share * config.steps))
    return config.learning_rate * min(
        1.0, (step + 1) / config.warmup, max(0.01, (config.steps - step) / decay)
    )


def train_dif_net(
    output: Path,
    *,
    model: DifNetConfig | None = None,
    config: DifNetTraining | None = None,
    device: str = "cpu",
    minutes: float = float("inf"),
    initial: Path | None = None,
    checkpoint_every: int = 500,
    stop_at: int | None = None,
) -> dict:
    """Trains until `config.steps`, `stop_at` or `minutes`; resumes from `output` where it can.

    Writes `output`/dif_net.safetensors (weights and latents), `output`/state.safetensors (these
    and the optimiser's moments: all that resuming needs) and `output`/log.jsonl. A resumed run
    keeps the model and the training configuration of its state, but for `steps`. `initial` names
    weights of as many shapes to start from instead of at random. Returns the card.
    Raises `CheckpointError` for a damaged state, `ShapeError` where the family has changed since.
    """
    config, model = config or DifNetTraining(), model or DifNetConfig()
    state_path = output / "state.safetensors"
    torch.manual_seed(config.seed)
    step, seconds = 0, 0.0
    tensors: dict[str, Tensor] = {}
    if state_path.is_file():
        tensors, card = load_checkpoint(state_path, kind=KIND + "-state")
        model = DifNetConfig(**card["model"])
        config = dataclasses.replace(DifNetTraining(**card["training"]), steps=config.steps)
        step, seconds = card["step"], card["seconds"]
    net = DifNet(model, config.shapes).to(device)
    networks = [p for p in net.parameters() if p is not net.latents]
    if initial is not None and not tensors:
        loaded, card = load_checkpoint(initial, kind=KIND)
        try:
            net.load_state_dict(loaded)
        except RuntimeError as error:
            raise CheckpointError(
                f"{initial}: {len(loaded['latents'])} shapes, model {card['model']}; expected "
                f"{config.shapes} shapes, model {dataclasses.asdict(model)}"
            ) from error
    optimizer = torch.optim.Adam([{"params": networks}, {"params": [net.latents]}], fused=True)
    if tensors:
        for name, parameter in net.named_parameters():
            parameter.data.copy_(tensors[f"net.{name}"])
            optimizer.state[parameter] = {
                "step": torch.tensor(float(step)),
                "exp_avg": tensors[f"m.{name}"].to(device),
                "exp_avg_sq": tensors[f"v.{name}"].to(device),
            }
        torch.set_rng_state(tensors["rng"])
    shapes = training_shapes(config)
    digest = shapes_digest(shapes)
    if tensors and card["shapes_digest"] != digest:
        raise ShapeError(
            f"{state_path}: family '{config.family}' makes other shapes now than when this "
            "training began: train anew in another folder"
        )
    samples = SdfSamples(
        *(t.to(device) for t in dataclasses.astuple(training_samples(shapes, config)))
    )
    output.mkdir(parents=True, exist_ok=True)
    began = time.monotonic()
    recent: list[dict] = []

    def write() -> dict:
        card = {
            "model": dataclasses.asdict(model),
            "training": dataclasses.asdict(config),
            "shapes_digest": digest,
            "step": step,
            "points_seen": step * config.batch * config.points,
            "seconds": seconds + time.monotonic() - began,
            "parameters": sum(p.numel() for p in net.parameters()),
        }
        save_checkpoint(output / "dif_net.safetensors", net.state_dict(), kind=KIND, card=card)
        state: dict[str, Tensor] = {f"net.{n}": p for n, p in net.named_parameters()}
        for n, p in net.named_parameters():
            moments = optimizer.state.get(p, {})
            state[f"m.{n}"] = moments.get("exp_avg", torch.zeros_like(p))
            state[f"v.{n}"] = moments.get("exp_avg_sq", torch.zeros_like(p))
        state["rng"] = torch.get_rng_state()
        save_checkpoint(state_path, state, kind=KIND + "-state", card=card)
        return card

    half = config.points // 2
    last = config.steps if stop_at is None else min(stop_at, config.steps)
    with (output / "log.jsonl").open("a", encoding="utf-8") as log:
        while step < last and time.monotonic() - began < 60 * minutes:
            index = torch.randperm(config.shapes)[: config.batch].to(device)
            on, off = torch.randint(config.stored_points, (2, len(index), half)).to(device)
            row = index[:, None]
            rate = _learning_rate(step, config)
            for group, factor in zip(optimizer.param_groups, (1, config.latent_rate), strict=True):
                group["lr"] = factor * rate
            loss, terms = dif_net_loss(
                net,
                index,
                samples.surface[row, on],
                samples.normals[row, on],
                samples.points[row, off],
                samples.distance[row, off],
                config,
            )
            optimizer.zero_grad(set_to_none=True)
            loss.backward()
            torch.nn.utils.clip_grad_norm_(net.parameters(), config.clip)
            optimizer.step()
            step += 1
            recent.append(terms)
            if step % 50 == 0:
                mean = {key: float(np.mean([r[key] for r in recent])) for key in recent[0]}
                mean |= {"step": step, "seconds": seconds + time.monotonic() - began}
                log.write(json.dumps(mean) + "\n")
                log.flush()
                recent = []
                if step % 200 == 0:
                    print(
                        f"step {step}: loss {mean['loss']:.1f} sdf {mean['sdf']:.4f} normals "
                        f"{mean['normal']:.3f} template normals {mean['template_normal']:.3f} "
                        f"smooth {mean['smooth']:.3f} correction {mean['correction']:.4f}, "
                        f"{mean['seconds']:.0f} s",
                        flush=True,
                    )
            if step % checkpoint_every == 0:
                write()
    return write()


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `iga train dif-net`."""
    parser.add_argument("--out", type=Path, required=True, help="folder of weights, state and log")
    parser.add_argument("--family", default=DifNetTraining.family, help="of the training shapes")
    parser.add_argument("--shapes", type=int, default=DifNetTraining.shapes)
    parser.add_argument("--steps", type=int, default=DifNetTraining.steps)
    parser.add_argument("--batch", type=int, default=DifNetTraining.batch, help="shapes a step")
    parser.add_argument(
        "--points", type=int, default=DifNetTraining.points, help="points of each shape a step"
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--minutes", type=float, default=float("inf"), help="stop after this long")
    parser.add_argument("--initial", type=Path, help="start from these weights of as many shapes")
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--threads", type=int, default=1, help="threads of PyTorch on the CPU")


def main(arguments: argparse.Namespace) -> int:
    """Runs the training; a run that was stopped (or killed) goes on from its last checkpoint."""
    torch.set_num_threads(arguments.threads)
    torch.set_flush_denormal(True)
    card = train_dif_net(
        arguments.out,
        config=DifNetTraining(
            family=arguments.family,
            shapes=arguments.shapes,
            steps=arguments.steps,
            batch=arguments.batch,
            points=arguments.points,
            seed=arguments.seed,
        ),
        device=arguments.device,
        minutes=arguments.minutes,
        initial=arguments.initial,
    )
    print(
        f"step {card['step']}, {card['points_seen']} points seen, {card['seconds']:.0f} s: "
        f"{arguments.out / 'dif_net.safetensors'}"
    )
    return 0
