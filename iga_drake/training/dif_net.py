"""Trains the deformed implicit field (iga_drake/shapes/dif_net.py) on signed distances of shapes.

The losses are those of Deng, Yang & Tong (CVPR 2021), equations in `dif_net_loss`.
"""

import dataclasses
import hashlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import trimesh
from torch import Tensor

from iga_drake.checkpoint import CheckpointError, check_finite, load_checkpoint
from iga_drake.shapes.dif_net import (
    KIND,
    DifNet,
    DifNetConfig,
    Normalisation,
    siren_jacobian,
)
from iga_drake.shapes.errors import ShapeError
from iga_drake.shapes.families import FAMILIES
from iga_drake.training.run import RunConfig, RunOptions, SavedState, Term, TrainingRun
from iga_drake.training.settings import check_same_model, replaced


@dataclass(frozen=True)
class DifNetTraining(RunConfig):
    """One training run; saved with the weights. A sample is a shape with some of its points."""

    batch: int = 4
    steps: int = 10000
    learning_rate: float = 1e-4
    betas: tuple[float, float] = (0.9, 0.999)
    warmup: int = 100
    decay_share: float = 0.4
    weight_decay: float = 0.0
    clip: float = 1e3
    ema: float = 0.0
    bf16: bool = False
    log_every: int = 50
    family: str = "chair"
    shapes: int = 150
    stored_points: int = 6000  # of each shape on the surface, and as many off it
    points: int = 256  # of each shape a step: half on the surface, half off it
    latent_rate: float = 10.0  # learning rate of the latents relative to that of the networks
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


@dataclass(frozen=True)
class DifNetSettings:
    """All settings of a training; they and the first weights determine its result."""

    model: DifNetConfig
    training: DifNetTraining

    @staticmethod
    def of(folder: Path) -> "DifNetSettings":
        """The settings of the run in this folder, else the defaults. Raises `IgaDrakeError`."""
        saved = SavedState.read(folder, KIND)
        card = {} if saved is None else saved.card
        where = folder / "state.safetensors"
        return DifNetSettings(
            replaced(DifNetConfig(), card.get("model", {}), f"{where}: model"),
            replaced(DifNetTraining(), card.get("training", {}), f"{where}: training"),
        )


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
            f"union of {len(parts)} parts: {error}; pip install 'iga-drake[dif-net]'"
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
        raise ShapeError(
            "signed distances need libigl: pip install 'iga-drake[dif-net]'"
        ) from error
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
) -> Term:
    """Weighted sum of the losses, and each of them, for shapes `index` (B,) at their samples
    (B, P, 3) and distance (B, P) in the normalised frame.

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
    loss = sum(getattr(config, name) * term for name, term in terms.items())
    assert isinstance(loss, Tensor)
    return Term(loss, torch.ones(()), terms)


def _draw(config: DifNetTraining, world: int) -> tuple[Tensor, Tensor, Tensor]:
    """Random choices of a step, the same in all processes and one for every forward pass: shapes
    (accumulate, world, B), and which of their points on and off the surface (..., B, points / 2).
    """
    passes = (config.accumulate, world)
    index = torch.rand(*passes, config.shapes).argsort(-1)[..., : config.batch]
    on, off = torch.randint(config.stored_points, (2, *index.shape, config.points // 2))
    return index, on, off


def _take_over(net: DifNet, path: Path) -> None:
    """Loads weights of as many shapes; raises `CheckpointError`."""
    loaded, card = load_checkpoint(path, kind=KIND)
    check_finite(path, loaded)
    try:
        net.load_state_dict(loaded)
    except RuntimeError as error:
        raise CheckpointError(
            f"{path}: {len(loaded['latents'])} shapes, model {card['model']}; expected "
            f"{len(net.latents)} shapes, model {dataclasses.asdict(net.config)}"
        ) from error


def train_dif_net(
    output: Path,
    *,
    model: DifNetConfig | None = None,
    config: DifNetTraining | None = None,
    device: str = "cpu",
    initial: Path | None = None,
    options: RunOptions | None = None,
) -> dict:
    """Trains until `config.steps`, or as `options` say; resumes from `output` where it can.

    Writes the files of `TrainingRun` to `output`; dif-net.safetensors holds networks and latents.
    A resumed run keeps the settings of its state, those that are given aside. `initial` names
    weights of as many shapes to start from instead of at random. Returns the card. Raises
    `IgaDrakeError`, also where the family makes other shapes than when the run began.
    """
    saved = SavedState.read(output, KIND)
    before = DifNetSettings.of(output)
    if saved is not None:
        check_same_model(output, model, before.model)
    model, config = model or before.model, config or before.training
    shapes = training_shapes(config)
    digest = shapes_digest(shapes)
    if saved is not None and saved.card["shapes_digest"] != digest:
        raise ShapeError(
            f"{output / 'state.safetensors'}: family '{config.family}' makes other shapes now than "
            "when this training began: train anew in another folder"
        )
    torch.manual_seed(config.seed)
    net = DifNet(model, config.shapes).to(device)
    if initial is not None and saved is None:
        _take_over(net, initial)
    samples = SdfSamples(
        *(t.to(device) for t in dataclasses.astuple(training_samples(shapes, config)))
    )
    run = TrainingRun(
        output,
        KIND,
        net,
        config,
        saved=saved,
        card={"model": dataclasses.asdict(model), "shapes_digest": digest},
        options=options,
        rate_factors={"latents": config.latent_rate},
    )
    while run.goes_on():
        mine = (drawn[:, run.ranks.rank].to(device) for drawn in _draw(config, run.ranks.world))
        row = run.advance(
            dif_net_loss(
                net,
                index,
                samples.surface[index[:, None], on],
                samples.normals[index[:, None], on],
                samples.points[index[:, None], off],
                samples.distance[index[:, None], off],
                config,
            )
            for index, on, off in zip(*mine, strict=True)
        )
        if row and run.ranks.first and run.step % (4 * config.log_every) == 0:
            print(
                f"step {run.step}: loss {row['loss']:.1f} sdf {row['sdf']:.4f} normals "
                f"{row['normal']:.3f} template normals {row['template_normal']:.3f} smooth "
                f"{row['smooth']:.3f} correction {row['correction']:.4f}, "
                f"{row['samples_per_second']:.1f} shapes/s",
                flush=True,
            )
    card = run.save()
    run.close()
    return card
