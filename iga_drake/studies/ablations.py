"""`iga evaluate ablations`: what the parts of the `iga` aligner are worth, at equal budgets.

Three groups of variants, each unlike the default in one thing:

- inference: the landed weights, used in other ways;
- energies: energies trained on the same problems;
- descriptors: descriptors trained from random weights on the same samples.

All trainings of a group see equally many samples, from one seed, by one schedule. Every variant has
a folder of its own, and what was measured is kept: a run that was stopped goes on where it was.
"""

import argparse
import contextlib
import dataclasses
import json
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch

from iga_drake.aligners.iga.aligner import IgaAligner, IgaConfig
from iga_drake.aligners.iga.descriptor import DescriptorConfig, DescriptorNet
from iga_drake.aligners.iga.energy import EnergyConfig, PairEnergyNet, minimise, pair_proposals
from iga_drake.aligners.iga.local_encoder import load_encoder
from iga_drake.aligners.iga.voting import VotingConfig
from iga_drake.aligners.iga.weights import DESCRIPTOR, ENERGY, load_descriptor, load_energy
from iga_drake.aligners.protocol import Aligner, PoseEstimate
from iga_drake.checkpoint import file_digest, save_checkpoint
from iga_drake.dataset.samples import SampleConfig
from iga_drake.demonstrations.alignment import Alignment
from iga_drake.errors import IgaDrakeError, kept_on_interrupt
from iga_drake.evaluation.results import ResultsStore, code_key, results_kept
from iga_drake.files import output_folder, write_text
from iga_drake.geometry.se3 import rigid
from iga_drake.paths import landed_weights
from iga_drake.training.correspondence import DescriptorTraining
from iga_drake.training.descriptor import train_descriptor, validate
from iga_drake.training.energy import VALIDATION as ENERGY_SET
from iga_drake.training.energy import EnergyTraining, train_energy
from iga_drake.training.run import RunConfig, SavedState
from iga_drake.training.validation import alignment_errors

INFERENCE, ENERGIES, DESCRIPTORS = GROUPS = ("inference", "energies", "descriptors")
DESCRIPTOR_SET = "validation"
PROBE = 12  # steps by which the speed of a training is measured
MATCHES = ("top1", "error_mean", "error_median")


class AblationError(IgaDrakeError):
    """The ablations can't run as asked, or their folder holds others."""


@dataclass(frozen=True)
class Setup:
    """Settings of training and inference that variants may change."""

    # Source of the poses: the "vote" alone, "both" (the energy ranks and refines what it and the
    # vote propose), or the "energy" alone.
    search: str = "vote"
    aligner: IgaConfig = field(default_factory=IgaConfig)
    voting: VotingConfig = field(default_factory=VotingConfig)
    energy: EnergyConfig = field(default_factory=EnergyConfig)
    energy_training: EnergyTraining = field(
        default_factory=lambda: EnergyTraining(problems=450, modes_problems=150)
    )
    # Initial weights of the descriptors: "random", or the "occupancy" encoder's; "untrained" ones
    # are random and stay so.
    start: str = "random"
    descriptor: DescriptorConfig = field(default_factory=DescriptorConfig)
    descriptor_training: DescriptorTraining = field(
        default_factory=lambda: DescriptorTraining(optimizer="muon")
    )
    samples: SampleConfig = field(default_factory=SampleConfig)

    def changed(self, changes: Mapping[str, Any]) -> "Setup":
        """A copy with fields replaced; a dict as value replaces fields of that field."""
        new = {
            name: dataclasses.replace(getattr(self, name), **value)
            if isinstance(value, dict)
            else value
            for name, value in changes.items()
        }
        return dataclasses.replace(self, **new)


@dataclass(frozen=True)
class Variant:
    """The default setup with one change."""

    name: str
    group: str
    change: str  # in words
    changes: Mapping[str, Any] = field(default_factory=dict)  # see `Setup.changed`


VARIANTS = (
    Variant("vote-alone", INFERENCE, "default: vote of 32 test nodes, 96 dense nodes"),
    Variant("both", INFERENCE, "energy ranks and refines, the vote among it", {"search": "both"}),
    Variant("energy-alone", INFERENCE, "energy's own proposals alone", {"search": "energy"}),
    *(
        Variant(f"nodes-{n}", INFERENCE, f"{n} dense nodes", {"aligner": {"nodes": n}})
        for n in (32, 64, 128)
    ),
    *(
        Variant(
            f"vote-parts-{n}",
            INFERENCE,
            f"{n} test nodes vote",
            {"voting": {"parts": n}},
        )
        for n in (8, 16)
    ),
    Variant("energy-default", ENERGIES, "default: placing, 32 test nodes"),
    Variant("energy-no-spread", ENERGIES, "without spread", {"energy": {"spread": False}}),
    *(
        Variant(
            f"energy-ranking-{n}",
            ENERGIES,
            f"ranking alone, {n} negatives",
            {"energy_training": {"placing": 0.0, "ranking": 1.0, "negatives": n}},
        )
        for n in (64, 256, 1024)
    ),
    Variant(
        "energy-no-hard-negatives",
        ENERGIES,
        "ranking alone, 256 negatives, none of them hard",
        {
            "energy_training": {
                "placing": 0.0,
                "ranking": 1.0,
                "negatives": 256,
                "minima": False,
            }
        },
    ),
    *(
        Variant(f"energy-parts-{n}", ENERGIES, f"{n} test nodes", {"energy": {"parts": n}})
        for n in (8, 16)
    ),
    Variant("descriptor-default", DESCRIPTORS, "default: local moments"),
    Variant(
        "descriptor-encoder",
        DESCRIPTORS,
        "local encoder, random start",
        {"descriptor": {"local": "encoder"}},
    ),
    Variant(
        "descriptor-encoder-occupancy",
        DESCRIPTORS,
        "local encoder, occupancy pre-training",
        {"descriptor": {"local": "encoder"}, "start": "occupancy"},
    ),
    Variant(
        "descriptor-coordinates",
        DESCRIPTORS,
        "coordinates at random rotations",
        {"descriptor": {"local": "coordinates"}},
    ),
    Variant(
        "descriptor-untrained",
        DESCRIPTORS,
        "no correspondence supervision",
        {"start": "untrained"},
    ),
)


@dataclass(frozen=True)
class Row:
    """Measurements of one variant: a row of the table."""

    name: str
    group: str
    change: str
    conditions: dict[str, Any]  # equal in all rows of one table
    samples_seen: int
    seconds: float  # of training
    parameters: int  # trained
    errors: dict[str, float]  # see `alignment_errors`; also query_s, median
    matches: dict[str, float]  # top-1 rate, errors as shares of the size
    reused: bool = field(default=False, compare=False)  # found in the folder's results

    def text(self) -> str:
        """One line of the table under `HEADER`."""
        columns = [
            f"{self.errors[name]:6.2f} ({self.errors[f'{name}_median']:6.2f})"
            for name in ("displacement_cm", "translation_cm", "rotation_deg")
        ]
        query = f"{self.errors['query_s']:.2f}" if "query_s" in self.errors else ""
        matches = ""
        if self.matches:
            top1, mean, median = (100 * self.matches[name] for name in MATCHES)
            matches = f"{top1:7.1f}  {mean:5.1f} ({median:4.1f})"
        return (
            f"{self.name:<29} {self.change:<38} {self.parameters:>10,} {self.samples_seen:>8,} "
            f"{self.seconds:>7.0f}  {'  '.join(columns)}  {query:>7}  {matches}"
        ).rstrip() + ("  reused" if self.reused else "")


HEADER = (
    f"{'variant':<29} {'change':<38} {'parameters':>10} {'samples':>8} {'s':>7}  "
    f"{'points cm (med.)':>15}  {'cm (median)':>15}  {'deg (median)':>15}  {'s/query':>7}  "
    "top-1 %  match % of size"
)


class EnergyAlone:
    """`Aligner` by the energy's minima from its own proposals: the vote's modes are no starts."""

    name = "energy"

    def __init__(self, aligner: IgaAligner, energy: PairEnergyNet):
        """`aligner` gives the matches; the poses are minima of `energy`."""
        self._aligner = aligner
        self._energy = energy.double()

    @torch.no_grad()
    def align(
        self,
        context: tuple[Alignment, ...],
        grasped: np.ndarray,
        target: np.ndarray,
        *,
        grasped_up: np.ndarray | None = None,
        target_up: np.ndarray | None = None,
        seed: int = 0,
    ) -> PoseEstimate:
        """See `Aligner.align`. Ways up are not used."""
        seen = self._aligner.explain(context, grasped, target, seed=seed)
        nodes = seen.nodes[:, -1] - seen.centres[:, None]
        voting = self._aligner.voting
        proposals = pair_proposals(*seen.matches, nodes[0], nodes[1], self._energy.config, voting)
        X, energies = minimise(self._energy(proposals), config=self._aligner.search)
        centre_A, centre_B = seen.centres
        R = X[:, :3, :3]
        poses = rigid(R, X[:, :3, 3] + centre_B - R @ centre_A)
        probability = (-energies).softmax(0)
        return PoseEstimate(poses.numpy(), energies.numpy(), probability.numpy())


class _Timed:
    """An aligner that keeps the seconds of every query."""

    def __init__(self, aligner: Aligner):
        self._aligner, self.name = aligner, aligner.name
        self.seconds: list[float] = []

    def align(self, *arguments: Any, **options: Any) -> PoseEstimate:
        began = time.perf_counter()
        estimate = self._aligner.align(*arguments, **options)
        self.seconds.append(time.perf_counter() - began)
        return estimate


def _errors(aligner: Aligner, split: str, count: int) -> dict[str, float]:
    timed = _Timed(aligner)
    errors = alignment_errors(timed, split=split, count=count)
    return errors | {"query_s": float(np.median(timed.seconds))}


@dataclass(frozen=True)
class Ablations:
    """Trains and measures variants in a folder."""

    folder: Path
    setup: Setup = field(default_factory=Setup)
    steps: int | None = None  # of each training; None: as many as fit in `minutes_each`
    # Time for the training of a group's default, which sets the steps of the whole group (min).
    minutes_each: float = 10.0
    count: int = 100  # samples (or problems) that errors are measured on
    weights: Path = field(default_factory=lambda: landed_weights(DESCRIPTOR))
    energy: Path = field(default_factory=lambda: landed_weights(ENERGY))
    encoder: Path = field(default_factory=lambda: landed_weights("encoder"))
    problems: Path | None = None  # folder; default: one in `folder`
    workers: int = 0
    device: str = "cpu"

    @property
    def results(self) -> Path:
        """The file of the rows that are finished."""
        return self.folder / "results.jsonl"

    def run(self, variants: Sequence[Variant]) -> Iterator[Row]:
        """The row of every variant, as they are finished. Raises `IgaDrakeError`."""
        self._check(variants)
        store = ResultsStore(self.results)
        for variant in variants:
            conditions = self._conditions(variant)
            key = {"kind": "ablations", "variant": variant.name, "conditions": conditions}
            for other, _ in store.rows():
                if other["variant"] == variant.name and other["conditions"] != conditions:
                    raise AblationError(
                        f"{store.path}: '{variant.name}' was measured with {other['conditions']}, "
                        f"now asked for with {conditions}: ask for the same or name another folder"
                    )
            key["code"] = code_key()
            known = store.get(key)
            if known is not None:
                yield Row(**known, reused=True)
                continue
            row = self._measure(variant, conditions)
            store.add(key, {n: v for n, v in asdict(row).items() if n != "reused"})
            yield row

    def measured(self, group: str) -> str:
        """A caption for the rows of a group: weights, error set and number of samples."""
        return {
            INFERENCE: f"landed weights; errors over {self.count} samples of {ENERGY_SET}",
            ENERGIES: f"errors over {self.count} problems of {ENERGY_SET}",
            DESCRIPTORS: f"vote alone; errors over {self.count} samples of {DESCRIPTOR_SET}",
        }[group]

    def _check(self, variants: Sequence[Variant]) -> None:
        """Raises `AblationError` for bad options or missing files, before any long computation."""
        if self.count < 1:
            raise AblationError(f"--count {self.count}: at least 1 sample is needed")
        if self.steps is not None and self.steps < 1:
            raise AblationError(f"--steps {self.steps}: at least 1 is needed")
        if not self.minutes_each > 0:
            raise AblationError(f"--minutes-each {self.minutes_each}: more than 0 are needed")
        for variant in variants:
            for option, path in self._files(variant).items():
                if not path.is_file():
                    raise AblationError(
                        f"{path}: no such checkpoint, which '{variant.name}' needs: name another "
                        f"with --{option}, or other variants with --only"
                    )

    def _files(self, variant: Variant) -> dict[str, Path]:
        """The checkpoints that a variant starts from, by option."""
        setup = self.setup.changed(variant.changes)
        if variant.group == DESCRIPTORS:
            return {"encoder": self.encoder} if setup.start == "occupancy" else {}
        files = {"weights": self.weights}
        if variant.group == INFERENCE and setup.search != "vote":
            files["energy"] = self.energy
        return files

    def _conditions(self, variant: Variant) -> dict[str, Any]:
        files = {name: file_digest(path) for name, path in self._files(variant).items()}
        if variant.group == INFERENCE:
            return {"count": self.count} | files
        conditions: dict[str, Any] = {"count": self.count, "steps": self._steps(variant.group)}
        if variant.group == ENERGIES:
            training = self.setup.energy_training
            conditions["problems"] = training.problems + training.modes_problems
        return conditions | files

    def _measure(self, variant: Variant, conditions: dict[str, Any]) -> Row:
        setup = self.setup.changed(variant.changes)
        measure: Callable[[Setup, Path, int], dict[str, Any]] = {
            INFERENCE: self._inference,
            ENERGIES: self._energy,
            DESCRIPTORS: self._descriptor,
        }[variant.group]
        with contextlib.redirect_stdout(sys.stderr):  # the trainings tell how they go
            print(f"{variant.name}: {variant.change}", flush=True)
            found = measure(setup, self.folder / variant.name, conditions.get("steps", 0))
        return Row(variant.name, variant.group, variant.change, conditions, **found)

    def _inference(self, setup: Setup, folder: Path, steps: int) -> dict[str, Any]:
        net, _ = load_descriptor(self.weights)
        energy, config = None, setup.aligner
        if setup.search == "both":
            energy, config = self.energy, dataclasses.replace(config, ranking="energy")
        aligner: Aligner
        aligner = iga = IgaAligner(net, energy=energy, config=config, voting=setup.voting)
        if setup.search == "energy":
            aligner = EnergyAlone(iga, load_energy(self.energy)[0])
        errors = _errors(aligner, ENERGY_SET, self.count)
        return _untrained() | {"errors": errors}

    def _train_energy(self, setup: Setup, folder: Path, config: EnergyTraining) -> dict:
        return train_energy(
            folder,
            model=setup.energy,
            config=dataclasses.replace(config, validation_samples=self.count),
            descriptor=self.weights,
            problems=self.problems or self.folder / "problems",
            device=self.device,
            workers=self.workers,
        )

    def _energy(self, setup: Setup, folder: Path, steps: int) -> dict[str, Any]:
        config = _planned(setup.energy_training, steps, folder, ENERGY)
        card = self._train_energy(setup, folder, config)
        return _trained(card) | {"errors": card["validation"]}

    def _train_descriptor(
        self, setup: Setup, folder: Path, config: DescriptorTraining, initial: Path | None = None
    ) -> dict:
        return train_descriptor(
            folder,
            model=setup.descriptor,
            config=dataclasses.replace(config, scored_samples=self.count),
            samples=setup.samples,
            device=self.device,
            initial=initial,
            workers=self.workers,
        )

    def _descriptor(self, setup: Setup, folder: Path, steps: int) -> dict[str, Any]:
        config = _planned(setup.descriptor_training, steps, folder, DESCRIPTOR)
        if setup.start == "untrained":
            torch.manual_seed(config.seed)
            net = DescriptorNet(setup.descriptor)
            scores = validate(net, config, setup.samples, split=DESCRIPTOR_SET, count=self.count)
            found = _untrained()
        else:
            initial = self._encoder_start(folder) if setup.start == "occupancy" else None
            card = self._train_descriptor(setup, folder, config, initial)
            net, _ = load_descriptor(folder / f"{DESCRIPTOR}.safetensors")
            scores, found = card["validation"], _trained(card)
        voter = IgaAligner(net, energy=None, config=setup.aligner, voting=setup.voting)
        return found | {
            "errors": _errors(voter, DESCRIPTOR_SET, self.count),
            "matches": {name: scores[name] for name in MATCHES},
        }

    def _encoder_start(self, folder: Path) -> Path:
        """Weights of the descriptors' local stage from the trained local encoder."""
        occupancy, _ = load_encoder(self.encoder)
        weights = occupancy.encoder.state_dict(prefix="local.encoder.")
        path = folder / "start.safetensors"
        save_checkpoint(path, weights, kind=DESCRIPTOR, card={"encoder": file_digest(self.encoder)})
        return path

    def _steps(self, group: str) -> int:
        """Number of steps of each training of a group.

        Unless it is given, the number that fits in `minutes_each` is measured once and kept in the
        folder's steps.json.
        """
        if self.steps is not None:
            return self.steps
        path = self.folder / "steps.json"
        known = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
        key = f"{group}, {self.minutes_each:g} minutes"
        if key not in known:
            folder = self.folder / f"{group}-speed"
            probe: dict[str, Any] = {"steps": PROBE, "log_every": PROBE // 2}
            config: RunConfig
            with contextlib.redirect_stdout(sys.stderr):
                print(f"{group}: measures the speed of training", flush=True)
                if group == ENERGIES:
                    config = dataclasses.replace(self.setup.energy_training, **probe)
                    self._train_energy(self.setup, folder, config)
                else:
                    config = dataclasses.replace(self.setup.descriptor_training, **probe)
                    self._train_descriptor(self.setup, folder, config)
            last = (folder / "log.jsonl").read_text(encoding="utf-8").splitlines()[-1]
            rate = json.loads(last)["samples_per_second"] / (config.batch * config.accumulate)
            known[key] = max(1, round(60 * self.minutes_each * rate))
            write_text(path, json.dumps(known, indent=2) + "\n")
        return int(known[key])


def _planned(config: Any, steps: int, folder: Path, kind: str) -> Any:
    """A training's settings (a `RunConfig`) for so many steps; refuses to go on with a run of
    others in `folder`."""
    saved = SavedState.read(folder, kind)
    if saved is not None and saved.card["training"]["steps"] != steps:
        raise AblationError(
            f"{folder / 'state.safetensors'}: of a training of "
            f"{saved.card['training']['steps']} steps, not {steps}: ask for the same or name "
            "another folder"
        )
    return dataclasses.replace(config, steps=steps, warmup=min(config.warmup, steps // 10))


def _trained(card: dict) -> dict[str, Any]:
    names = ("samples_seen", "seconds", "parameters")
    return {name: card[name] for name in names} | {"matches": {}}


def _untrained() -> dict[str, Any]:
    return {"samples_seen": 0, "seconds": 0.0, "parameters": 0, "matches": {}}


def chosen(names: Sequence[str] | None) -> list[Variant]:
    """Variants by their names or their groups'; all of them by default. Raises `AblationError`."""
    known = (*GROUPS, *(v.name for v in VARIANTS))
    for name in names or ():
        if name not in known:
            raise AblationError(
                f"--only {name}: unknown; a group ({', '.join(GROUPS)}) or one of: "
                f"{', '.join(v.name for v in VARIANTS)}"
            )
    return [v for v in VARIANTS if not names or v.name in names or v.group in names]


def add_ablations(parser: argparse.ArgumentParser) -> None:
    """Options of `iga evaluate ablations`."""
    parser.description = "What the parts of the iga aligner are worth, at equal budgets."
    parser.add_argument(
        "--out",
        type=output_folder,
        required=True,
        metavar="DIR",
        help="trainings, problems, results.jsonl",
    )
    budget = parser.add_mutually_exclusive_group()
    budget.add_argument(
        "--minutes-each", type=float, default=Ablations.minutes_each, metavar="M",
        help="steps of each training: those that the default makes in so many (default 10)",
    )  # fmt: skip
    budget.add_argument("--steps", type=int, metavar="N", help="steps of each training")
    parser.add_argument(
        "--only", type=lambda text: text.split(","), metavar="NAMES",
        help=f"variants, or groups of them: {', '.join(GROUPS)} (default: all)",
    )  # fmt: skip
    parser.add_argument(
        "--count", type=int, default=Ablations.count,
        help="samples, or problems, that errors are measured on (default 100)",
    )  # fmt: skip
    parser.add_argument(
        "--problem-count", type=int, default=600, metavar="N",
        help="problems that energies are trained on, a quarter with two alignments (default 600)",
    )  # fmt: skip
    parser.add_argument(
        "--problems", type=output_folder, help="folder of problems (default: in DIR)"
    )
    parser.add_argument("--weights", type=Path, help="descriptors (default: the landed ones)")
    parser.add_argument("--energy", type=Path, help="energy (default: the landed one)")
    parser.add_argument("--encoder", type=Path, help="local encoder (default: the landed one)")
    parser.add_argument("--workers", type=int, default=0, help="processes that make samples")
    parser.add_argument("--device", default="cpu", help="of the trainings (default cpu)")
    parser.add_argument("--json", action="store_true", help="print the table as JSON")


def evaluate_ablations(arguments: argparse.Namespace) -> int:
    """Runs `iga evaluate ablations`; returns the exit status."""
    variants = chosen(arguments.only)
    if arguments.problem_count < 1:
        raise AblationError(f"--problem-count {arguments.problem_count}: at least 1 is needed")
    modes = arguments.problem_count // 4
    problems = {"problems": arguments.problem_count - modes, "modes_problems": modes}
    files = {
        name: getattr(arguments, name)
        for name in ("weights", "energy", "encoder", "problems")
        if getattr(arguments, name)
    }
    ablations = Ablations(
        arguments.out,
        Setup().changed({"energy_training": problems}),
        steps=arguments.steps,
        minutes_each=arguments.minutes_each,
        count=arguments.count,
        workers=arguments.workers,
        device=arguments.device,
        **files,
    )
    rows: list[Row] = []
    with kept_on_interrupt(lambda: results_kept(ablations.results)):
        for row in ablations.run(variants):
            if not arguments.json:
                if not rows:
                    print(HEADER)
                if not rows or row.group != rows[-1].group:
                    print(f"{row.group}: {ablations.measured(row.group)}")
                print(row.text(), flush=True)
            rows.append(row)
    if arguments.json:
        print(json.dumps([asdict(row) for row in rows], indent=2))
    return 0
