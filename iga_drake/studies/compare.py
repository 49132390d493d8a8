"""`iga evaluate compare`: learned aligners on the same problems: error against samples seen,
training operations and inference time."""

import argparse
import dataclasses
import json
import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils.flop_counter import flop_registry

from iga_drake.aligners.iga.weights import DESCRIPTOR, load_descriptor
from iga_drake.aligners.iga_paper.aligner import (
    IgaPaperAligner,
    IgaPaperConfig,
    found_model,
    found_path,
)
from iga_drake.aligners.iga_paper.langevin import LangevinConfig
from iga_drake.aligners.iga_paper.model import PaperModel, kind_of
from iga_drake.aligners.iga_paper.variants import DfmAligner, DfmConfig, DirRegAligner, descent
from iga_drake.aligners.protocol import Aligner
from iga_drake.aligners.query import Query
from iga_drake.aligners.registry import make_aligner
from iga_drake.checkpoint import load_checkpoint
from iga_drake.dataset.alignment_error import CONFIG, equivalents, nearest_error, random_pose
from iga_drake.dataset.loader import collate
from iga_drake.dataset.samples import Sample, SampleConfig, make_sample
from iga_drake.dataset.splits import sample_sets
from iga_drake.errors import IgaDrakeError, kept_on_interrupt
from iga_drake.evaluation.alignment import COLUMNS, Errors
from iga_drake.evaluation.results import (
    ResultsStore,
    aligner_key,
    code_key,
    config_digest,
    results_file,
    results_kept,
)
from iga_drake.files import output_file, write_text
from iga_drake.paths import landed_weights
from iga_drake.progress import progress
from iga_drake.training.correspondence import LOSS_FIELDS, DescriptorTraining, descriptor_loss
from iga_drake.training.paper import (
    ENERGIES,
    FRAMES,
    PaperTraining,
    common_turns,
    info_nce_loss,
    nodes_of,
    taken,
    variant_loss,
)
from iga_drake.training.settings import replaced
from iga_drake.viewing.figures import figure_file, new_figure, write_figure

PARTS = {"iga-paper": ("rotation", "translation"), "dirreg": ("dirreg",), "dfm": ("dfm",)}
DESCRIPTORS = ("iga", "iga-energy")  # of their training, that of the descriptors is counted
COMPARED = ("iga", *PARTS)


@dataclass(frozen=True)
class Trained:
    """A trained aligner with the cost of its training."""

    name: str
    weights: str  # where they were read
    aligner: Aligner
    samples_seen: int  # by each of its networks
    # Floating point operations of the whole training: matrix products, forward and backward. Legs
    # before the last are counted at the last one's operations per sample.
    flops: float
    seconds: float  # of the whole training, on whatever machine it ran
    options: Mapping[str, Any] = field(default_factory=dict)  # search settings, for result keys


@dataclass(frozen=True)
class Compared:
    """Errors of one aligner on one set, modulo symmetry."""

    name: str
    weights: str
    split: str
    count: int
    samples_seen: int
    flops: float
    training_seconds: float
    inference_seconds: float  # median
    errors: Errors
    reused: int  # how many of the errors were found in a results file

    def row(self) -> str:
        """One line of the table."""
        return (
            f"{self.name:<10} {self.split:<18} {self.count:>5} {self.samples_seen:>9,} "
            f"{self.flops:9.1e} {self.training_seconds / 60:8.0f} {self.inference_seconds:8.2f}  "
            f"{self.errors.columns()}"
        ) + (f"  {self.reused} reused" if self.reused else "")


HEADER = (
    f"{'aligner':<10} {'set':<18} {'count':>5} {'samples':>9} {'FLOP':>9} {'minutes':>8} {'s':>8}  "
    f"{COLUMNS}"
)


class _Operations(TorchDispatchMode):
    """Counts floating point operations of matrix products and convolutions, backward included.

    PyTorch's own `FlopCounterMode` doesn't allow derivatives of derivatives.
    """

    def __init__(self) -> None:
        super().__init__()
        self.total = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        result = func(*args, **(kwargs or {}))
        if func.overloadpacket in flop_registry:
            self.total += flop_registry[func.overloadpacket](
                *args, **(kwargs or {}), out_val=result
            )
        return result


def counted(step: Callable[[], Any]) -> float:
    """Floating point operations of the matrix products in what is called."""
    with _Operations() as operations:
        step()
    return float(operations.total)


def paper_flops(model: PaperModel, card: dict) -> float:
    """Floating point operations of training a network of the paper on one sample.

    Includes the encoder; the mean over all steps, of which some are wide and some run Langevin
    dynamics.
    """
    config = replaced(PaperTraining(), _known(card["training"]), "card")
    config = dataclasses.replace(config, batch=1, bf16=False)
    samples = replaced(SampleConfig(), card["samples"], "card")
    batch = collate([make_sample("train", 0, samples)])
    loss = info_nce_loss if model.part in ENERGIES else variant_loss
    twin = PaperModel.described(model.description()).train()

    def step(number: int) -> None:
        nodes, _ = nodes_of(batch, twin, config.frames, "cpu")
        loss(twin, nodes, config, number, torch.Generator().manual_seed(0)).total.backward()

    wide, every = counted(lambda: step(0)), config.langevin_every
    later = max(0, card["step"] - config.wide_steps) / max(1, card["step"])
    if model.part not in ENERGIES or not every or not later:
        return wide
    langevin = counted(lambda: step(every * -(-config.wide_steps // every)))
    return wide + (langevin - wide) * later / every


def _known(training: dict) -> dict:
    fields = {field.name for field in dataclasses.fields(PaperTraining)}
    return {name: value for name, value in training.items() if name in fields}


def descriptor_flops(weights: Path) -> float:
    """Floating point operations of training the default aligner's descriptors on one sample."""
    net, card = load_descriptor(weights)
    net.train().requires_grad_(True)
    known = {field.name for field in dataclasses.fields(DescriptorTraining)}
    values = {name: value for name, value in card["training"].items() if name in known}
    config = replaced(DescriptorTraining(), values, f"{weights}: training")
    config = dataclasses.replace(config, batch=1, bf16=False)
    samples = replaced(SampleConfig(), card.get("samples", {}), f"{weights}: samples")
    batch = collate([make_sample("train", 0, samples)])

    def step() -> None:
        some = {name: batch[name] for name in LOSS_FIELDS}
        descriptor_loss(net, some, config).total.backward()

    return counted(step)


def trained(name: str, weights: Path | None, *, particles: int, steps: int) -> Trained:
    """An aligner from a checkpoint (of iga-paper: the folder of two; default: the landed ones).

    particles and steps are those of the paper's samplers. Of an aligner whose training isn't known
    here its samples, operations and seconds are 0. Raises `IgaDrakeError`.
    """
    if name not in PARTS and name not in DESCRIPTORS:
        options = {"weights": weights} if weights else {}
        return Trained(name, str(weights or ""), make_aligner(name, **options), 0, 0.0, 0.0)
    if name in DESCRIPTORS:
        path = weights or landed_weights(DESCRIPTOR)
        aligner = make_aligner(name, weights=path)
        _, card = load_checkpoint(path, kind=DESCRIPTOR)
        flops = descriptor_flops(path) * card["samples_seen"]
        return Trained(
            name, str(path), aligner, card["samples_seen"], flops, float(card["seconds"])
        )
    models = [found_model(part, weights, name)[0] for part in PARTS[name]]
    cards = [_card(part, weights, name) for part in PARTS[name]]
    search = LangevinConfig(particles=particles, steps=steps)
    made: Aligner
    if name == "iga-paper":
        made = IgaPaperAligner(models, config=IgaPaperConfig(rotation=search, translation=search))
    elif name == "dirreg":
        made = DirRegAligner(models[0])
    else:
        chosen = dataclasses.replace(descent(), particles=particles, steps=steps)
        made = DfmAligner(models[0], config=DfmConfig(langevin=chosen))
    per_sample = [paper_flops(m, c) for m, c in zip(models, cards, strict=True)]
    told = [taken(card) for card in cards]
    seen = [each["samples_seen"] for each in told]
    return Trained(
        name,
        str(weights or "landed"),
        made,
        max(seen),
        float(np.dot(per_sample, seen)),
        float(sum(each["seconds"] for each in told)),
        {"particles": particles, "steps": steps},
    )


def _card(part: str, weights: Path | None, name: str) -> dict:
    return load_checkpoint(found_path(part, weights, name), kind=kind_of(part))[1]


def in_common_frames(sample: Sample) -> Sample:
    """The demonstrations of a sample turned so that their targets stand as the test's does: what
    the paper's data have, and what no aligner can know."""
    points, canonical = torch.from_numpy(sample.points), torch.from_numpy(sample.canonical)
    turns = common_turns(points[None], canonical[None])[0]  # (N, 3, 3)
    turned = points.clone()
    turned[:, :-1] = points[:, :-1] @ turns[:-1].mT
    return dataclasses.replace(sample, points=turned.numpy())


def compare(
    entry: Trained,
    split: str,
    count: int,
    *,
    frames: str = "own",
    cloud_points: int = CONFIG.cloud_points,
    store: ResultsStore | None = None,
) -> Compared:
    """Errors of an aligner on the first `count` samples of a set; those that the store holds are
    taken from there."""
    if split not in sample_sets():
        raise IgaDrakeError(f"set '{split}' is not known; one of: {', '.join(sample_sets())}")
    if count < 1:
        raise IgaDrakeError(f"count {count}: at least 1 sample is needed")
    if cloud_points < 16:
        raise IgaDrakeError(f"--cloud-points {cloud_points}: at least 16 are needed")
    config = dataclasses.replace(CONFIG, cloud_points=cloud_points)
    common = {
        "kind": "compare",
        "set": split,
        "config": config_digest(config),
        "frames": frames,
        **aligner_key(entry.aligner, entry.name, entry.options),
        "code": code_key(entry.aligner),
    }
    rows, seconds, reused = [], [], 0
    for index in progress(range(count), f"{entry.name}, {split}"):
        key = {**common, "index": index}
        known = store.get(key) if store else None
        if known is not None:
            rows.append((known["translation"], known["rotation"]))
            seconds.append(known["seconds"])
            reused += 1
            continue
        sample = make_sample(split, index, config)
        if frames == "common":
            sample = in_common_frames(sample)
        query = Query.of(sample.points, random_pose(index))
        began = time.perf_counter()
        motion = query.motion(query.ask(entry.aligner, index))
        seconds.append(time.perf_counter() - began)
        valid = equivalents(sample, symmetry=True)
        rows.append(nearest_error(motion, valid, sample.points[0, -1]))
        if store:
            measured = zip(("translation", "rotation"), rows[-1], strict=True)
            store.add(key, {**dict(measured), "seconds": seconds[-1]})
    translation, rotation = np.array(rows).T
    return Compared(
        name=entry.name,
        weights=entry.weights,
        split=split,
        count=count,
        samples_seen=entry.samples_seen,
        flops=entry.flops,
        training_seconds=entry.seconds,
        inference_seconds=float(np.median(seconds)),
        errors=Errors.of(translation, rotation),
        reused=reused,
    )


def comparison_card(rows: Sequence[Compared], cards: dict[str, dict], frames: str) -> str:
    """Markdown: how networks were trained (from their own cards) and what they are off by."""
    lines = ["# " + ", ".join(cards), ""]
    for title, card in cards.items():
        seed, commit = card["training"].get("seed", 0), card.get("commit") or "unknown"
        told = taken(card)
        lines += [
            f"`{title}`: {card.get('parameters', 0):,} parameters with the encoder, "
            f"{told['step']:,} steps, {told['samples_seen']:,} samples seen in "
            f"{told['seconds'] / 60:.0f} minutes, seed {seed}, commit {commit}; settings below are "
            f"those of the last {card['step']:,} steps.",
            "",
        ]
    turned = "each in a frame of its own" if frames == "own" else "all targets turned alike"
    lines += [
        f"Errors modulo symmetry: four demonstrations, {turned}; the test pair's grasped cloud at "
        "a Haar-random pose; mean ± standard deviation (median).",
        "",
        "```",
        HEADER,
        *(row.row() for row in rows),
        "```",
        "",
    ]
    for title, card in cards.items():
        for name in ("model", "encoder", "training", "samples"):
            values = ", ".join(f"{k} {v}" for k, v in card.get(name, {}).items())
            lines += [f"`{title}`, `{name}`: {values}", ""]
    return "\n".join(lines)


def compare_figure(rows: Sequence[Compared], path: Path) -> None:
    """Median errors against samples, operations and time; a colour for each aligner, the mean over
    the sets where there are several."""
    figure, panels = new_figure(2, 3, inches=3.6)
    axes = (
        ("samples_seen", "training samples seen"),
        ("flops", "training operations (FLOP)"),
        ("inference_seconds", "inference (s)"),
    )
    names = list(dict.fromkeys(row.name for row in rows))
    for i, (kind, unit) in enumerate((("translation", "cm"), ("rotation", "deg"))):
        for j, (key, label) in enumerate(axes):
            panel = panels[3 * i + j]
            for color, name in enumerate(names):
                points = []
                for weights in dict.fromkeys(r.weights for r in rows if r.name == name):
                    some = [r for r in rows if r.name == name and r.weights == weights]
                    y = np.mean([getattr(r.errors, f"{kind}_median") for r in some])
                    points.append((float(np.mean([getattr(r, key) for r in some])), float(y)))
                points.sort()
                panel.plot(*zip(*points, strict=True), "o-", color=f"C{color}", ms=5, label=name)
            values = [float(getattr(row, key)) for row in rows]
            if min(values) > 0:  # whole decades, which have labels that don't run into each other
                panel.set_xscale("log")
                decades = math.floor(math.log10(min(values))), math.ceil(math.log10(max(values)))
                panel.set_xlim(10.0 ** decades[0], 10.0 ** max(decades[1], decades[0] + 1))
            panel.set_ylim(bottom=0)
            panel.set_xlabel(label)
            panel.set_ylabel(f"median {kind} error ({unit})")
            panel.grid(alpha=0.3)
    panels[0].legend(fontsize=8)
    write_figure(figure, path)


def _weights(text: str) -> tuple[str, Path]:
    name, separator, path = text.partition("=")
    if not separator or not path:
        raise argparse.ArgumentTypeError(f"'{text}' found, NAME=PATH expected")
    return name, Path(path)


def add_compare(parser: argparse.ArgumentParser) -> None:
    """Options of `iga evaluate compare`."""
    parser.description = "Aligners on the same problems, and what their training took."
    parser.add_argument("--aligners", default=",".join(COMPARED), help="names, comma-separated")
    parser.add_argument(
        "--weights", type=_weights, action="append", default=[], metavar="NAME=PATH",
        help="of an aligner (of iga-paper a folder), also several; default: the landed ones",
    )  # fmt: skip
    parser.add_argument("--sets", default="unseen_instances", help="names, comma-separated")
    parser.add_argument("--count", type=int, default=20, help="samples of each set")
    parser.add_argument(
        "--frames", choices=FRAMES, default="own",
        help="common: demonstrations turned as the test pair's target stands, as in the paper's "
        "data",
    )  # fmt: skip
    parser.add_argument(
        "--cloud-points", type=int, default=CONFIG.cloud_points,
        help="of a cloud; as many as in training, with the set train: the very training samples",
    )  # fmt: skip
    parser.add_argument("--particles", type=int, default=LangevinConfig.particles)
    parser.add_argument("--steps", type=int, default=LangevinConfig.steps, help="of the samplers")
    parser.add_argument(
        "--results", type=results_file, help="results file to append to and go on from"
    )
    parser.add_argument("--threads", type=int, default=1, help="threads of PyTorch")
    parser.add_argument("--png", type=figure_file, metavar="OUT", help="figure")
    card = partial(output_file, begins=(b"#",))
    parser.add_argument("--card", type=card, metavar="OUT", help="model card of one aligner")
    parser.add_argument("--json", action="store_true", help="print as JSON")


def evaluate_compare(arguments: argparse.Namespace) -> None:
    """Prints a row for each aligner, its weights and each set; draws the figure."""
    names = [name.strip() for name in arguments.aligners.split(",") if name.strip()]
    unused = [name for name, _ in arguments.weights if name not in names]
    if unused:
        raise IgaDrakeError(f"--weights {unused[0]}=...: not among --aligners {','.join(names)}")
    torch.set_num_threads(arguments.threads)
    if arguments.card and (len(names) != 1 or names[0] not in PARTS):
        raise IgaDrakeError(f"--card: of one of {', '.join(PARTS)}, not of {', '.join(names)}")
    store = ResultsStore(arguments.results) if arguments.results else None
    rows = []
    if not arguments.json:
        print(HEADER)
    with kept_on_interrupt(lambda: results_kept(arguments.results)):
        for name in names:
            chosen = [path for other, path in arguments.weights if other == name] or [None]
            for path in chosen:
                entry = trained(name, path, particles=arguments.particles, steps=arguments.steps)
                for split in arguments.sets.split(","):
                    found = compare(
                        entry,
                        split.strip(),
                        arguments.count,
                        frames=arguments.frames,
                        cloud_points=arguments.cloud_points,
                        store=store,
                    )
                    rows.append(found)
                    if not arguments.json:
                        print(found.row(), flush=True)
    if arguments.json:
        print(json.dumps([asdict(found) for found in rows], indent=2))
    if arguments.png:
        compare_figure(rows, arguments.png)
    if arguments.card:
        weights = arguments.weights[-1][1] if arguments.weights else None
        cards = {kind_of(part): _card(part, weights, names[0]) for part in PARTS[names[0]]}
        some = [row for row in rows if row.weights == rows[-1].weights]
        write_text(arguments.card, comparison_card(some, cards, arguments.frames))
