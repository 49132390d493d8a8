"""`iga evaluate stabilisers`: what each of the paper's stabilisers does to the energy's landscape.

A landscape is good for gradient descent where an object that starts a little way from its place
comes home: from 30 degrees away for a rotation network, from 5 cm for a translation network.
"""

import argparse
import dataclasses
import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import torch

from iga_drake.aligners.iga_paper.graph import SIZES, GraphConfig
from iga_drake.aligners.iga_paper.langevin import LangevinConfig, langevin, tangent_gradient
from iga_drake.aligners.iga_paper.model import PaperModel, kind_of, load_model
from iga_drake.aligners.iga_paper.nodes import problem
from iga_drake.aligners.iga_paper.search import energy_of
from iga_drake.dataset.loader import collate
from iga_drake.dataset.samples import SampleConfig, make_sample
from iga_drake.errors import IgaDrakeError
from iga_drake.files import output_folder
from iga_drake.geometry.se3 import geodesic_angle, so3_exp
from iga_drake.progress import progress
from iga_drake.training.paper import (
    ENERGIES,
    PaperTraining,
    nodes_of,
    right_place,
    train_paper,
)
from iga_drake.training.run import RunOptions

# Distance (rad, m) from the right pose at which descents start, and within which one is home.
AWAY = {"rotation": math.radians(30), "translation": 0.05}
HOME = {"rotation": math.radians(10), "translation": 0.02}
ABLATIONS = ("all", "no-spectral", "no-energy-penalty", "no-gradient-penalty", "no-langevin")


@dataclass(frozen=True)
class Convergence:
    """How descents of one network's energy end, over several starts for each sample.

    The first three are shares of the starts, in [0, 1].
    """

    home: float  # share that ends within HOME of the right pose
    nearer: float  # share that ends nearer to it than it began
    uphill: float  # share that begins where descent leads away from it
    final_median: float  # median distance at the end, deg (rotation) or cm (translation)
    starts: int  # number of starts


def measure_convergence(
    model: PaperModel,
    config: PaperTraining,
    *,
    split: str = "train",
    count: int = 20,
    starts: int = 32,
    steps: int = 60,
    samples: SampleConfig | None = None,
) -> Convergence:
    """Descends without noise from `starts` places about the right pose of each of `count` samples.

    The rotation network's object rests at the demonstrations' mean offset, as in its training.
    """
    part = model.part
    if part not in ENERGIES:
        raise IgaDrakeError(f"part '{part}' has no energy; one of: {', '.join(ENERGIES)}")
    device = next(model.parameters()).device
    search = LangevinConfig(steps=steps, noise=0.0)
    if part == "rotation":
        search = dataclasses.replace(search, translation_rate=0.0)
    else:
        search = dataclasses.replace(search, rotation_rate=0.0)
    before, after, uphill = [], [], []
    for index in progress(range(count), part):
        batch = collate([make_sample(split, index, samples)])
        asked = problem(nodes_of(batch, model, config.frames, device)[0])
        generator = torch.Generator(device).manual_seed(index)
        away = torch.randn(1, starts, 3, generator=generator, device=device)
        away = AWAY[part] * away / away.norm(dim=-1, keepdim=True)
        R = torch.eye(3, device=device).expand(1, starts, 3, 3)
        t = right_place(asked)[:, None].expand(1, starts, 3)
        if part == "rotation":
            t = asked.offset()[:, None].expand(1, starts, 3)
            R = so3_exp(away)
        else:
            t = t + away
        with torch.no_grad():
            energy = energy_of(model.graph, asked.context(model.graph))
        _, by_w, by_t = tangent_gradient(energy, R, t)
        slope = by_w if part == "rotation" else by_t
        uphill.append((slope * away).sum(-1) <= 0)
        found_R, found_t, _ = langevin(energy, R, t, search)

        if part == "rotation":
            none = torch.eye(3, device=device).expand_as(R)
            before.append(geodesic_angle(none, R))
            after.append(geodesic_angle(none, found_R))
        else:
            place = right_place(asked)[:, None]
            before.append((t - place).norm(dim=-1))
            after.append((found_t - place).norm(dim=-1))
    start, end = torch.cat(before), torch.cat(after)
    unit = math.degrees(1) if part == "rotation" else 100.0
    return Convergence(
        home=float((end < HOME[part]).float().mean()),
        nearer=float((end < start).float().mean()),
        uphill=float(torch.cat(uphill).float().mean()),
        final_median=float(unit * end.median()),
        starts=end.numel(),
    )


def ablated(
    name: str, model: GraphConfig, config: PaperTraining
) -> tuple[GraphConfig, PaperTraining]:
    """The settings without one of the stabilisers. Raises `IgaDrakeError` for an unknown name."""
    changes: dict[str, dict] = {
        "all": {},
        "no-spectral": {},
        "no-energy-penalty": {"energy_penalty": 0.0},
        "no-gradient-penalty": {"gradient_penalty": 0.0},
        "no-langevin": {"langevin_every": 0},
    }
    if name not in changes:
        raise IgaDrakeError(f"'{name}' is not known; one of: {', '.join(changes)}")
    model = dataclasses.replace(model, spectral=name != "no-spectral")
    return model, dataclasses.replace(config, **changes[name])


HEADER = f"{'run':<24} {'home':>6} {'nearer':>7} {'uphill':>7}  ends (median)  {'loss':>6}"


def row(name: str, part: str, found: Convergence, loss: float | None) -> str:
    """One line of the table under `HEADER`."""
    unit = "deg" if part == "rotation" else "cm"
    text = "" if loss is None else f"{loss:6.3f}"
    return (
        f"{name:<24} {100 * found.home:5.1f}% {100 * found.nearer:6.1f}% "
        f"{100 * found.uphill:6.1f}%  {found.final_median:8.2f} {unit:<4} {text}"
    )


def add_stabilisers(parser: argparse.ArgumentParser) -> None:
    """Options of `iga evaluate stabilisers`."""
    parser.description = "How often gradient descent comes home, with and without stabilisers."
    parser.add_argument("--part", choices=ENERGIES, default="translation")
    parser.add_argument(
        "--weights", type=Path, nargs="*", default=[], help="of trained networks to look at"
    )
    parser.add_argument(
        "--out", type=output_folder, help="train the ablation in folders of this one"
    )
    parser.add_argument("--size", choices=SIZES, default="small")
    parser.add_argument("--steps", type=int, default=400, help="of each training")
    parser.add_argument("--subset", type=int, default=50, help="samples trained on, over and over")
    parser.add_argument("--candidates", type=int, default=64)
    parser.add_argument("--batch", type=int, default=2, help="samples of a step")
    parser.add_argument("--frames", choices=("own", "common"), default="common")
    parser.add_argument("--ablations", default=",".join(ABLATIONS), help="which, comma-separated")
    parser.add_argument("--minutes", type=float, default=math.inf, help="of each training")
    parser.add_argument("--count", type=int, default=20, help="training samples looked at")
    parser.add_argument("--json", action="store_true", help="print as JSON")


def evaluate_stabilisers(arguments: argparse.Namespace) -> None:
    """Trains what is asked for, then prints a row for each network."""
    part = arguments.part
    if not arguments.weights and not arguments.out:
        raise IgaDrakeError("stabilisers: name trained networks (--weights) or a folder (--out)")
    networks: dict[str, Path] = {str(path): path for path in arguments.weights}
    results = {}
    for name in arguments.ablations.split(",") if arguments.out else ():
        model, config = ablated(name, GraphConfig.of_size(arguments.size), _training(arguments))
        folder = arguments.out / name
        options = RunOptions(minutes=arguments.minutes)
        train_paper(folder, part, model=model, config=config, options=options)
        networks[name] = folder / f"{kind_of(part)}.safetensors"
    if not arguments.json:
        print(HEADER)
    for name, path in networks.items():
        net, card = load_model(path, part)
        config = PaperTraining(
            **{k: v for k, v in card["training"].items() if k in ("frames", "subset")}
        )
        found = measure_convergence(net, config, count=arguments.count)
        loss = _last_loss(path.parent)
        results[name] = asdict(found) | {"loss": loss}
        if not arguments.json:
            print(row(path.parent.name, part, found, loss), flush=True)
    if arguments.json:
        print(json.dumps(results, indent=2))


def _training(arguments: argparse.Namespace) -> PaperTraining:
    return PaperTraining(
        steps=arguments.steps,
        subset=arguments.subset,
        candidates=arguments.candidates,
        batch=arguments.batch,
        accumulate=1,
        frames=arguments.frames,
        any_test=False,
        optimizer="muon",
        learning_rate=2e-3,
        warmup=20,
        ema=0.99,
        wide_steps=arguments.steps // 4,
    )


def _last_loss(folder: Path) -> float | None:
    from iga_drake.studies.training_log import LogError, read_log

    try:
        training: Sequence[dict] = read_log(folder)[0]
    except LogError:
        return None
    return float(training[-1]["loss"])
