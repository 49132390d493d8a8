"""Trains the paper's networks (appendix "Energy Based Model", section "Training").

Parts: the rotation and the translation network, by InfoNCE against counter-examples, copies of the
test alignment whose grasped object was moved; and the variants: DirReg by the error of the
transform that it regresses, DFM by that of the distances that it tells.

The paper leaves open where the grasped object stands while the rotation network is trained; here
about where its search will start, at the demonstrations' mean offset.
"""

import dataclasses
import functools
import math
from collections.abc import Iterator
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from iga_drake.aligners.iga.local_encoder import EncoderConfig, LocalEncoder, load_encoder
from iga_drake.aligners.iga_paper.graph import GraphConfig, Nodes, moved
from iga_drake.aligners.iga_paper.langevin import LangevinConfig, haar_rotations, langevin
from iga_drake.aligners.iga_paper.model import OUTPUTS, PaperModel, kind_of
from iga_drake.aligners.iga_paper.nodes import PaperProblem, encode, problem
from iga_drake.aligners.iga_paper.search import (
    DISTANCE_UNIT,
    best,
    correction_of,
    distances_of,
    energy_of,
    search_distance,
    search_rotation,
    search_translation,
    uniform,
)
from iga_drake.aligners.iga_paper.variants import descent
from iga_drake.checkpoint import CheckpointError, check_finite, load_checkpoint
from iga_drake.dataset.alignment_error import displacement, equivalents, nearest_error
from iga_drake.dataset.loader import Batch, collate, sample_loader
from iga_drake.dataset.samples import SampleConfig, make_sample
from iga_drake.dataset.splits import sample_sets
from iga_drake.geometry.se3 import geodesic_angle, kabsch, rigid, so3_exp
from iga_drake.paths import landed_weights
from iga_drake.precision import mixed_precision
from iga_drake.training.run import RunConfig, RunOptions, SavedState, Term, TrainingRun
from iga_drake.training.settings import TrainingError, check_same_model, replaced

SEED_STRIDE = 10_000_000  # samples between the streams of two seeds
FRAMES = ("own", "common")
ENERGIES = ("rotation", "translation")
NOTHING = {"step": 0, "samples_seen": 0, "seconds": 0.0}  # taken before a training
SPREAD = 0.3  # m, half the width of the cube where translations start in validation


@dataclass(frozen=True)
class PaperTraining(RunConfig):
    """One training; saved with the weights."""

    batch: int = 1
    accumulate: int = 8
    steps: int = 50_000
    learning_rate: float = 1e-3
    warmup: int = 200
    decay: str = "cosine"
    decay_share: float = 1.0
    weight_decay: float = 0.01
    ema: float = 0.999
    bf16: bool = True
    validation_samples: int = 8
    # Counter-examples of a sample; of the variants, the poses that a sample is trained on.
    candidates: int = 256
    # Wide counter-examples for so many steps: cube of translations (m), angle (rad; pi is uniform).
    wide_steps: int = 10_000
    wide_translation: float = 0.8
    wide_rotation: float = math.pi
    # Then local ones, and at every so many steps this share by Langevin dynamics (0: never).
    local_translation: float = 0.1
    local_rotation: float = math.pi / 4
    langevin_every: int = 5
    langevin_steps: int = 5
    langevin_share: float = 0.5
    # Share of the local ones that stays wide (the paper: none).
    wide_share: float = 0.0
    # So many of the energies' poses (0: all), drawn as likely as exp(-E), carry the gradient. Its
    # mean is that of all; the energy penalty is then on those.
    drawn: int = 0
    # Stabilisers; 0 leaves one out. Spectral normalisation is a field of the model.
    energy_penalty: float = 1e-3  # on the mean square of the energies
    gradient_penalty: float = 1e-2  # on the mean square of the gradient by A-B edges
    penalty_poses: int = 32  # of a sample, that the gradient is penalised at
    # How far (m) from the demonstrations' mean offset the grasped object stands in training for
    # rotations.
    rotation_offset: float = 0.05
    # Only the first so many samples, over and over (0: all): the paper's pre-training.
    subset: int = 0
    # "own": every alignment in a frame of its own, as the evaluation sets have them. "common": as
    # in the paper's data, target objects turned alike in all alignments of a sample.
    frames: str = "own"
    # The alignment of a sample that is the test: any, drawn at every use; or always the last, as
    # in the evaluation, which makes a fifth of the problems of a subset.
    any_test: bool = True
    turned: bool = False  # each sample as a whole, at random at every use: more data than there is
    validation_split: str = "validation"  # set; "train" while it learns a subset of that
    validation_particles: int = 32
    validation_steps: int = 40

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("candidates", "penalty_poses", "validation_particles"):
            if getattr(self, name) < 1:
                raise TrainingError(f"{name} = {getattr(self, name)}, must be at least 1")
        for name in ("langevin_share", "wide_share"):
            if not 0 <= getattr(self, name) <= 1:
                raise TrainingError(f"{name} = {getattr(self, name)}, must be from 0 to 1")
        for name in ("subset", "drawn", "langevin_every", "energy_penalty", "gradient_penalty"):
            if getattr(self, name) < 0:
                raise TrainingError(f"{name} = {getattr(self, name)}, must not be below 0")
        if self.validation_split not in sample_sets():
            raise TrainingError(
                f"validation_split = '{self.validation_split}', must be one of: "
                f"{', '.join(sample_sets())}"
            )
        if self.frames not in FRAMES:
            raise TrainingError(f"frames = '{self.frames}', must be one of: {', '.join(FRAMES)}")


@dataclass(frozen=True)
class PaperSettings:
    """All settings of a training; with the encoder's weights they determine its result."""

    model: GraphConfig
    training: PaperTraining
    samples: SampleConfig

    @staticmethod
    def of(folder: Path, part: str, size: str = "full") -> "PaperSettings":
        """The settings of the run in this folder, else the defaults of a part and size."""
        saved = SavedState.read(folder, kind_of(part))
        if saved is not None:
            return _saved_settings(saved, folder, part)
        return PaperSettings(default_model(part, size), PaperTraining(), SampleConfig())


def default_model(part: str, size: str = "full") -> GraphConfig:
    """A size for a part: spectral normalisation stabilises energies, regression needs none."""
    return dataclasses.replace(GraphConfig.of_size(size), spectral=part in ENERGIES)


def _saved_settings(saved: SavedState, folder: Path, part: str) -> PaperSettings:
    where = f"{folder / 'state.safetensors'}"
    return PaperSettings(
        replaced(GraphConfig(), saved.card["model"], f"{where}: model"),
        replaced(PaperTraining(), saved.card["training"], f"{where}: training"),
        replaced(SampleConfig(), saved.card["samples"], f"{where}: samples"),
    )


# The samples as nodes


def common_turns(points: Tensor, canonical: Tensor) -> Tensor:
    """Rotations (S, N, 3, 3) after which the target objects of a sample stand as the last one does,
    from what is known (S, 2, N, P, 3) of every observed point."""
    R = kabsch(canonical[:, 1], points[:, 1])[..., :3, :3]
    return R[:, -1:] @ R.mT


def _turned(nodes: Nodes, turns: Tensor) -> Nodes:
    """Nodes (S, 2, N, K), each alignment as a whole turned (S, N, 3, 3)."""
    return moved(nodes, rigid(turns, torch.zeros_like(turns[..., 0]))[:, None])


def nodes_of(
    batch: Batch, model: PaperModel, frames: str, device: torch.device | str
) -> tuple[Nodes, Tensor]:
    """Nodes (S, 2, N, K) of samples, and the rotations (S, N, 3, 3) of their alignments from W:
    none, or for common frames those of `common_turns`."""
    points = batch["points"].to(device)
    nodes = encode(model.encoder, points, model.graph.config.nodes)
    if frames == "own":
        S, _, N = points.shape[:3]
        return nodes, torch.eye(3, device=points.device).expand(S, N, 3, 3)
    turns = common_turns(points, batch["canonical"].to(device))
    return _turned(nodes, turns), turns


class NodeStream:
    """Nodes (batch, 2, N, K) of the training samples, without end.

    The samples of a subset are made and encoded once and kept: 60 to 250 kB each.
    """

    def __init__(
        self,
        model: PaperModel,
        config: PaperTraining,
        samples: SampleConfig,
        *,
        first: int,
        rank: int,
        world: int,
        workers: int,
        device: torch.device | str,
    ):
        self._model, self._config, self._samples, self._device = model, config, samples, device
        self._next, self._stride = first + rank * config.batch, world * config.batch
        self._kept: dict[int, Nodes] = {}
        self._batches: Iterator[Batch] = iter(())
        if not config.subset:
            loader = sample_loader(
                "train", config=samples, batch=config.batch, first=first,
                rank=rank, world=world, workers=workers,
            )  # fmt: skip
            self._batches = iter(loader)

    def __next__(self) -> Nodes:
        config = self._config
        if not config.subset:
            return nodes_of(next(self._batches), self._model, config.frames, self._device)[0]
        some = [self._of_subset((self._next + k) % config.subset) for k in range(config.batch)]
        self._next += self._stride
        return Nodes(*(torch.stack(parts) for parts in zip(*some, strict=True)))

    def _of_subset(self, index: int) -> Nodes:
        if index not in self._kept:
            batch = collate([make_sample("train", index, self._samples)])
            nodes, _ = nodes_of(batch, self._model, self._config.frames, self._device)
            self._kept[index] = Nodes(*(part[0] for part in nodes))
        return self._kept[index]


def drawn_problem(nodes: Nodes, config: PaperTraining, generator: torch.Generator) -> PaperProblem:
    """One of the alignments as the test, the others as demonstrations, as `any_test` and `turned`
    of the training say."""
    S, _, N = nodes.positions.shape[:3]
    device = nodes.positions.device
    if config.any_test:
        order = torch.randperm(N, generator=generator, device=device)
        nodes = Nodes(*(part[:, :, order] for part in nodes))
    if config.turned:
        R = haar_rotations(S, generator=generator, device=device)
        nodes = _turned(nodes, R[:, None].expand(S, N, 3, 3))
    return problem(nodes)


# Losses


def moves(
    S: int, M: int, rotation: float, translation: float, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Rotations (S, M, 3, 3) and shifts (S, M, 3) m, uniform: rotation vectors in a cube of half
    the width `rotation` (Haar-uniform rotations from pi on), shifts in one of `translation`."""
    device = generator.device
    if rotation >= math.pi:
        R = haar_rotations(S, M, generator=generator, device=device)
    else:
        R = so3_exp(rotation * uniform(S, M, 3, generator=generator, device=device))
    return R, translation * uniform(S, M, 3, generator=generator, device=device)


def right_place(asked: PaperProblem) -> Tensor:
    """(S, 3) where A's centre belongs from B's; the right rotation is none."""
    return asked.centres[0] - asked.centres[1]


def candidates(
    model: PaperModel,
    asked: PaperProblem,
    config: PaperTraining,
    step: int,
    generator: torch.Generator,
) -> tuple[Tensor, Tensor]:
    """The right pose, first, and its counter-examples: (S, 1 + M, 3, 3) and (S, 1 + M, 3)."""
    turns = model.part == "rotation"
    place = right_place(asked)
    S, M = len(place), config.candidates
    if turns:
        shift = uniform(S, 3, generator=generator, device=generator.device)
        place = asked.offset() + config.rotation_offset * shift

    def around(count: int, wide: bool) -> tuple[Tensor, Tensor]:
        angle = config.wide_rotation if wide else config.local_rotation
        length = config.wide_translation if wide else config.local_translation
        R, t = moves(S, count, angle if turns else 0.0, 0.0 if turns else length, generator)
        return R, place[:, None] + t

    wide = step < config.wide_steps
    far = M if wide else round(config.wide_share * M)
    R, t = (
        torch.cat(both, 1) for both in zip(around(M - far, False), around(far, True), strict=True)
    )
    every = config.langevin_every
    if not wide and every and step % every == 0:
        moving = round(config.langevin_share * M)
        start = around(moving, True)
        rates = {"translation_rate": 0.0} if turns else {"rotation_rate": 0.0}
        chosen = LangevinConfig(steps=config.langevin_steps, **rates)  # type: ignore[arg-type]
        with torch.no_grad():
            energy = energy_of(model.graph, asked.context(model.graph), bf16=config.bf16)
            found = langevin(energy, *start, chosen, generator)
        R = torch.cat((found[0], R[:, moving:]), 1)
        t = torch.cat((found[1], t[:, moving:]), 1)
    none = torch.eye(3, device=R.device).expand(S, 1, 3, 3)
    return torch.cat((none, R), 1), torch.cat((place[:, None], t), 1)


def info_nce_loss(
    model: PaperModel, nodes: Nodes, config: PaperTraining, step: int, generator: torch.Generator
) -> Term:
    """InfoNCE (paper, eq. "aprox_distribution"), summed over samples, with its penalties.

    Statistics: the lowest and the highest energy, the right pose's, how often it is the lowest.
    """
    asked = drawn_problem(nodes, config, generator)
    R, t = candidates(model, asked, config, step, generator)
    with mixed_precision(R.device, config.bf16):
        context = asked.context(model.graph)
        with torch.no_grad() if config.drawn else nullcontext():
            E = model.graph(context, R, t)[..., 0].float()  # (S, 1 + M)
        carrying = E
        if config.drawn:
            drawn = (-E).softmax(1).multinomial(config.drawn, replacement=True, generator=generator)
            drawn = torch.cat((torch.zeros_like(drawn[:, :1]), drawn), 1)
            rows = torch.arange(len(E), device=E.device)[:, None]
            carrying = model.graph(context, R[rows, drawn], t[rows, drawn])[..., 0].float()
        if config.gradient_penalty:
            some = torch.randperm(R.shape[1], generator=generator, device=R.device)
            some = some[: config.penalty_poses]
            edges = model.graph.edges_between(context, R[:, some], t[:, some]).requires_grad_()
            of_some = model.graph(context, R[:, some], t[:, some], edges).float().sum()
    nce = E[:, 0] + (-E).logsumexp(1)
    if config.drawn:
        # The gradient is that of the right pose's energy less the mean over all poses with the
        # probabilities that the energies give them.
        slope = carrying[:, 0] - carrying[:, 1:].mean(1)
        nce = nce + slope - slope.detach()
    total = nce.sum() + config.energy_penalty * carrying.square().mean(1).sum()
    statistics = {
        "nce": nce.detach().mean(),
        "energy_min": E.detach().amin(1).mean(),
        "energy_max": E.detach().amax(1).mean(),
        "energy_true": E.detach()[:, 0].mean(),
        "top1": (E.argmin(1) == 0).float().mean(),
    }
    if config.gradient_penalty:
        (gradient,) = torch.autograd.grad(of_some, edges, create_graph=True)
        penalty = gradient.float().square().sum((-3, -2, -1)).mean(1).sum()
        total = total + config.gradient_penalty * penalty
        statistics["edge_gradient"] = penalty.detach() / len(E)
    return Term(total, torch.tensor(float(len(E)), device=R.device), statistics)


def variant_loss(
    model: PaperModel, nodes: Nodes, config: PaperTraining, step: int, generator: torch.Generator
) -> Term:
    """The loss of DirReg or DFM, summed over samples: half of the poses wide, half local."""
    asked = drawn_problem(nodes, config, generator)
    place = right_place(asked)
    S, M = len(place), config.candidates
    far = moves(S, M - M // 2, config.wide_rotation, config.wide_translation, generator)
    near = moves(S, M // 2, config.local_rotation, config.local_translation, generator)
    R, t = (torch.cat(parts, 1) for parts in zip(far, near, strict=True))
    if model.part == "dirreg":  # from where it will be asked: about the demonstrations' offset
        R = haar_rotations(S, M, generator=generator, device=R.device)
        t = asked.offset()[:, None] + config.local_translation * uniform(
            S, M, 3, generator=generator, device=R.device
        )
    else:
        t = place[:, None] + t
    identity = torch.eye(3, device=R.device).expand_as(R)
    with mixed_precision(R.device, config.bf16):
        context = asked.context(model.graph)
        if model.part == "dirreg":
            found_R, found_t = correction_of(model.graph, context, R, t)
        else:
            said = distances_of(model.graph, context, R, t)
    if model.part == "dirreg":
        off = (found_t - place[:, None]).norm(dim=-1)
        chord = (found_R - identity).square().sum((-2, -1))  # 4 - 4 cos of the angle
        total = (chord + off / DISTANCE_UNIT).mean(1).sum()
        with torch.no_grad():
            turn = geodesic_angle(found_R, identity)
    else:
        turn = geodesic_angle(R, identity)
        true = torch.stack((turn, (t - place[:, None]).norm(dim=-1) / DISTANCE_UNIT), -1)
        total = torch.nn.functional.smooth_l1_loss(said, true, reduction="none").mean((1, 2)).sum()
        wrong = (said.detach() - true).abs()
        turn, off = wrong[..., 0], wrong[..., 1] * DISTANCE_UNIT
    statistics = {
        "rotation_deg": torch.rad2deg(turn).mean(),
        "translation_cm": 100 * off.detach().mean(),
    }
    return Term(total, torch.tensor(float(S), device=R.device), statistics)


# Validation


@torch.no_grad()
def part_errors(
    model: PaperModel,
    config: PaperTraining,
    *,
    split: str = "validation",
    count: int = 8,
    samples: SampleConfig | None = None,
) -> dict[str, float]:
    """Errors of a part after its search, modulo symmetry, over samples of a set.

    Rotations are searched at the demonstrations' mean offset, translations at the right rotation:
    means and medians of degrees or centimetres; of the variants both, and first the mean
    displacement of the grasped cloud's points. Raises `IgaDrakeError` for an unknown set.
    """
    device = next(model.parameters()).device
    search = LangevinConfig(particles=config.validation_particles, steps=config.validation_steps)
    rows = []
    for index in range(count):
        sample = make_sample(split, index, samples)
        nodes, turns = nodes_of(collate([sample]), model, config.frames, device)
        asked, turn = problem(nodes), turns[0, -1].double().cpu().numpy()
        generator = torch.Generator(device).manual_seed(index)
        context, start = asked.context(model.graph), asked.offset()
        R, t = torch.eye(3, device=device)[None], right_place(asked)
        if model.part == "rotation":
            R = best(*search_rotation(model.graph, context, start, search, generator))
        elif model.part == "translation":
            found = search_translation(
                model.graph, context, R, start, search, generator, spread=SPREAD
            )
            t = best(*found)
        elif model.part == "dirreg":
            from_R = haar_rotations(1, 1, generator=generator, device=device)
            R, t = (x[:, 0] for x in correction_of(model.graph, context, from_R, start[:, None]))
        else:
            chosen = dataclasses.replace(descent(), particles=search.particles, steps=search.steps)
            R, t, distance = search_distance(
                model.graph, context, start, chosen, generator, spread=SPREAD
            )
            R, t = best(R, distance), best(t, distance)
        motion = _motion(asked, R[0], t[0], turn)
        cloud = sample.points[0, -1]
        valid = equivalents(sample, symmetry=True)
        translation, rotation = nearest_error(motion, valid, cloud)
        off = displacement(motion, valid, cloud)
        rows.append((np.degrees(rotation), 100 * translation, 100 * off))
    degrees, centimetres, displacements = np.array(rows).T
    result: dict[str, float] = {}
    if model.part not in ENERGIES:
        result["displacement_cm"] = float(displacements.mean())
    if model.part != "translation":
        result |= {"rotation_deg": float(degrees.mean())}
        result |= {"rotation_deg_median": float(np.median(degrees))}
    if model.part != "rotation":
        result |= {"translation_cm": float(centimetres.mean())}
        result |= {"translation_cm_median": float(np.median(centimetres))}
    return result


def _motion(asked: PaperProblem, R: Tensor, t: Tensor, turn: np.ndarray) -> np.ndarray:
    """(4, 4) in W by which a pose moves A away from its place there; `turn` (3, 3) from W."""
    c_A, c_B = (c[0].double().cpu().numpy() for c in asked.centres)
    rotation = R.double().cpu().numpy()
    X = np.eye(4)
    X[:3, :3] = turn.T @ rotation @ turn
    X[:3, 3] = turn.T @ (t.double().cpu().numpy() + c_B - rotation @ c_A)
    return X


def _validation_errors(
    weights: dict[str, Tensor], *, card: dict, config: PaperTraining, samples: SampleConfig
) -> dict[str, float]:
    model = PaperModel.described(card).with_weights(weights)
    return part_errors(
        model,
        config,
        split=config.validation_split,
        count=config.validation_samples,
        samples=samples,
    )


# Training


def _generator(config: PaperTraining, number: int, device: torch.device | str) -> torch.Generator:
    """Random generator of one forward pass, the same whatever process makes it."""
    seed = (config.seed * 2**32 + number) % 2**62
    return torch.Generator(device).manual_seed(seed)


def _new_model(part: str, config: GraphConfig, encoder: Path | None) -> PaperModel:
    trained: LocalEncoder = load_encoder(encoder or landed_weights("encoder"))[0].encoder
    model = PaperModel(part, config, trained.config)
    model.encoder.load_state_dict(trained.state_dict())
    return model


def train_paper(
    output: Path,
    part: str,
    *,
    model: GraphConfig | None = None,
    config: PaperTraining | None = None,
    samples: SampleConfig | None = None,
    encoder: Path | None = None,
    initial: Path | None = None,
    device: str = "cpu",
    workers: int = 0,
    options: RunOptions | None = None,
) -> dict:
    """Trains a part until `config.steps`, or as `options` say; resumes from `output` where it can.

    Writes the files of `TrainingRun` to `output`. A resumed run keeps the settings of its state,
    those that are given aside; a new one takes its local encoder from the checkpoint `encoder`
    (default: the landed one) and, where `initial` is given, its first weights from there. Returns
    the card. Raises `IgaDrakeError`.
    """
    if part not in OUTPUTS:
        raise TrainingError(f"part '{part}' is not known; one of: {', '.join(OUTPUTS)}")
    saved = SavedState.read(output, kind_of(part))
    if saved is not None:
        before = _saved_settings(saved, output, part)
        check_same_model(output, model, before.model)
        model, config, samples = before.model, config or before.training, samples or before.samples
    model = model or default_model(part)
    config, samples = config or PaperTraining(), samples or SampleConfig()
    torch.manual_seed(config.seed)
    if saved is not None:
        net = PaperModel(part, model, EncoderConfig(**saved.card["encoder"])).to(device)
    else:
        net = _new_model(part, model, encoder).to(device)
    taken_before = saved.card.get("before", NOTHING) if saved is not None else NOTHING
    if saved is None and initial is not None:
        taken_before = _take_over(net, initial, part)
    description = net.description() | {"before": taken_before}
    run = TrainingRun(
        output,
        kind_of(part),
        net,
        config,
        saved=saved,
        card=description | {"samples": dataclasses.asdict(samples)},
        options=options,
        validate=functools.partial(
            _validation_errors, card=description, config=config, samples=samples
        ),
    )
    ranks = run.ranks
    # Neither the samples that the first weights have seen come again, nor the draws made on them.
    seen = int(taken_before["samples_seen"])
    stream = NodeStream(
        net, config, samples,
        first=config.seed * SEED_STRIDE + seen + run.samples_seen,
        rank=ranks.rank, world=ranks.world, workers=workers, device=device,
    )  # fmt: skip
    loss = info_nce_loss if part in ENERGIES else variant_loss
    while run.goes_on():
        net.graph.power_iteration()
        first = run.step * config.accumulate
        numbers = [seen + (first + k) * ranks.world + ranks.rank for k in range(config.accumulate)]
        row = run.advance(
            loss(net, next(stream), config, run.step, _generator(config, number, device))
            for number in numbers
        )
        if row and ranks.first:
            print(f"step {run.step}: {_summary(row)}", flush=True)
    card = run.save()
    run.close()
    return card


def taken(card: dict) -> dict:
    """Steps, samples and seconds of a training, with those of the weights that it began with."""
    before = card.get("before", NOTHING)
    return {name: card[name] + before[name] for name in NOTHING}


def _take_over(net: PaperModel, path: Path, part: str) -> dict:
    """Weights from a checkpoint of the same part; returns what they have `taken`. Raises
    `CheckpointError`."""
    tensors, card = load_checkpoint(path, kind=kind_of(part))
    check_finite(path, tensors)
    try:
        net.load_state_dict({name: tensor.float() for name, tensor in tensors.items()})
    except RuntimeError as error:
        raise CheckpointError(
            f"{path}: does not fit this network ({error}): start from weights of its sizes"
        ) from error
    return taken(card)


def _summary(row: dict[str, float]) -> str:
    names = ("nce", "top1", "energy_min", "energy_true", "energy_max", "rotation_deg")
    parts = [f"loss {row['loss']:.3f}"]
    parts += [f"{name} {row[name]:.3f}" for name in (*names, "translation_cm") if name in row]
    return ", ".join([*parts, f"{row['samples_per_second']:.2f} samples/s"])
