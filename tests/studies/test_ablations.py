"""Tiny trainings: variants differ where they must, a finished one is kept, bad requests."""

import argparse
import dataclasses
import json
from pathlib import Path

import pytest
import torch

from iga_drake.aligners.iga.aligner import IgaConfig
from iga_drake.aligners.iga.descriptor import DescriptorConfig, DescriptorNet
from iga_drake.aligners.iga.energy import EnergyConfig, PairEnergyNet
from iga_drake.aligners.iga.voting import VotingConfig
from iga_drake.aligners.iga.weights import DESCRIPTOR, ENERGY
from iga_drake.checkpoint import load_checkpoint, save_checkpoint
from iga_drake.dataset.samples import SampleConfig
from iga_drake.evaluation.results import ResultsError
from iga_drake.studies import ablations
from iga_drake.studies.ablations import (
    VARIANTS,
    AblationError,
    Ablations,
    Row,
    Setup,
    Variant,
    add_ablations,
    chosen,
    evaluate_ablations,
)
from iga_drake.training import energy_problems
from iga_drake.training.correspondence import DescriptorTraining
from iga_drake.training.energy import EnergyTraining

SMALL = DescriptorConfig(scalars=16, vectors=4, heads=2, layers=2, descriptor=16)
ENERGY_SIZES = EnergyConfig(parts=6, pairs=12, combinations=3, hidden=8)
SETUP = Setup(
    aligner=IgaConfig(points=128, nodes=24),
    voting=VotingConfig(triplets=48, parts=8),
    energy=ENERGY_SIZES,
    energy_training=EnergyTraining(
        batch=2, problems=2, modes_problems=0, negatives=32, log_every=1
    ),
    descriptor=SMALL,
    descriptor_training=DescriptorTraining(
        optimizer="muon", batch=2, nodes=16, bf16=False, log_every=1
    ),
    samples=SampleConfig(cloud_points=64, surface_points=400, least_seen=8),
)


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Untrained networks as checkpoints; the energy has random weights everywhere."""
    folder = tmp_path_factory.mktemp("weights")
    torch.manual_seed(0)
    net, energy = DescriptorNet(SMALL), PairEnergyNet(ENERGY_SIZES)
    for parameter in energy.parameters():
        torch.nn.init.normal_(parameter, std=0.3)
    files = {"weights": folder / "d.safetensors", "energy": folder / "e.safetensors"}
    save_checkpoint(
        files["weights"], net.state_dict(), kind=DESCRIPTOR, card={"model": vars(SMALL)}
    )
    card = {"model": vars(ENERGY_SIZES)}
    save_checkpoint(files["energy"], energy.state_dict(), kind=ENERGY, card=card)
    return files


def run(there: Ablations, names: str) -> dict[str, Row]:
    return {row.name: row for row in there.run(chosen(names.split(",")))}


def forbid(monkeypatch: pytest.MonkeyPatch) -> None:
    """Anything that takes time."""

    def never(*_, **__):
        raise AssertionError("computed anew")

    for name in ("train_energy", "train_descriptor", "alignment_errors"):
        monkeypatch.setattr(ablations, name, never)


def test_inference_variants_differ_and_are_kept(
    tmp_path: Path, weights: dict[str, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    there = Ablations(tmp_path, SETUP, count=2, **weights)
    names = "both,vote-alone,energy-alone,nodes-32,vote-parts-16"
    rows = run(there, names)
    errors = [row.errors["displacement_cm"] for row in rows.values()]
    assert len(set(errors)) == len(errors) == 5
    assert all(row.samples_seen == 0 and row.errors["query_s"] > 0 for row in rows.values())
    forbid(monkeypatch)
    assert run(there, names) == rows
    with pytest.raises(AblationError, match=r"results\.jsonl: 'both' was measured with .*: 2.*: 3"):
        run(dataclasses.replace(there, count=3), "both")


def test_energies_train_for_equal_budgets_on_shared_problems(
    tmp_path: Path, weights: dict[str, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(energy_problems, "SHARD", 2)
    there = Ablations(tmp_path, SETUP, steps=3, count=2, **weights)
    rows = run(there, "energy-default,energy-no-spread,energy-parts-8")
    assert {row.samples_seen for row in rows.values()} == {6}
    default, plain, parts = rows.values()
    assert plain.parameters < default.parameters == parts.parameters
    assert "vote_rotation_deg" in default.errors and not default.matches
    # Two sets of problems with the default parts, which two variants share, and two with others.
    assert len(list((tmp_path / "problems").iterdir())) == 4
    forbid(monkeypatch)
    assert run(there, "energy-default")["energy-default"] == default


def test_descriptors_train_for_equal_budgets(tmp_path: Path, weights: dict[str, Path]) -> None:
    there = Ablations(tmp_path, SETUP, steps=2, count=1, **weights)
    rows = run(there, "descriptors")
    seen = {name.removeprefix("descriptor-"): row.samples_seen for name, row in rows.items()}
    trained = dict.fromkeys(("default", "encoder", "encoder-occupancy", "coordinates"), 4)
    assert seen == trained | {"untrained": 0}
    results = [tuple(row.matches.values()) for row in rows.values()]
    assert len(set(results)) == 5
    assert {row.parameters > 300_000 for n, row in rows.items() if "encoder" in n} == {True}
    given, start = (
        load_checkpoint(path, kind=kind)[0]
        for path, kind in (
            (there.encoder, "encoder"),
            (tmp_path / "descriptor-encoder-occupancy" / "start.safetensors", DESCRIPTOR),
        )
    )
    name = "encoder.point_layers.0.linear.weight"
    torch.testing.assert_close(start[f"local.{name}"], given[name])
    line = rows["descriptor-default"].text()
    assert "local moments" in line and line.count("(") == 4


def test_a_stopped_training_goes_on_and_an_unequal_one_is_refused(
    tmp_path: Path, weights: dict[str, Path]
) -> None:
    there = Ablations(tmp_path, SETUP, steps=2, count=1, **weights)
    run(there, "descriptor-default")
    log = (tmp_path / "descriptor-default" / "log.jsonl").read_text(encoding="utf-8")
    (tmp_path / "results.jsonl").unlink()  # as if stopped just before it was written
    run(there, "descriptor-default")
    assert (tmp_path / "descriptor-default" / "log.jsonl").read_text(encoding="utf-8") == log
    (tmp_path / "results.jsonl").unlink()
    with pytest.raises(AblationError, match=r"state\.safetensors: of a training of 2 steps, not 5"):
        run(dataclasses.replace(there, steps=5), "descriptor-default")


def test_minutes_become_steps_once(
    tmp_path: Path, weights: dict[str, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ablations, "PROBE", 2)
    there = Ablations(tmp_path, SETUP, minutes_each=1e-3, count=1, **weights)
    row = run(there, "descriptor-default")["descriptor-default"]
    steps = json.loads((tmp_path / "steps.json").read_text(encoding="utf-8"))
    assert steps == {"descriptors, 0.001 minutes": row.conditions["steps"]}
    assert row.samples_seen == 2 * row.conditions["steps"]
    forbid(monkeypatch)
    assert run(there, "descriptor-default")["descriptor-default"] == row


def test_every_variant_changes_one_setting_that_exists() -> None:
    assert len({v.name for v in VARIANTS}) == len(VARIANTS)
    setups = [(v.group, Setup().changed(v.changes)) for v in VARIANTS]
    assert all(setups.count(setup) == 1 for setup in setups)
    assert [v.name for v in chosen(["energies", "both"])][:2] == ["both", "energy-default"]


def test_bad_requests_are_refused(tmp_path: Path, weights: dict[str, Path]) -> None:
    with pytest.raises(AblationError, match=r"--only bth: unknown; a group .*vote-alone, both"):
        chosen(["both", "bth"])
    there = Ablations(tmp_path, SETUP, count=1, **weights)
    with pytest.raises(
        AblationError, match=r"none.*which 'both' needs: name another with --energy"
    ):
        run(dataclasses.replace(there, energy=tmp_path / "none"), "vote-alone,both")
    for changes, text in (({"count": 0}, "--count 0"), ({"steps": 0}, "--steps 0")):
        with pytest.raises(AblationError, match=text):
            run(dataclasses.replace(there, **changes), "both")
    (tmp_path / "results.jsonl").write_text('{"a": 1}\n', encoding="utf-8")
    with pytest.raises(ResultsError, match=r"results\.jsonl, line 1: not a result"):
        run(there, "both")


def test_the_command_prints_a_table(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    def measure(self: Ablations, variant: Variant, conditions: dict) -> Row:
        sizes = ("displacement_cm", "translation_cm", "rotation_deg")
        errors = {f"{n}{end}": 1.25 for n in sizes for end in ("", "_median")}
        return Row(variant.name, variant.group, variant.change, conditions, 8, 1.0, 9, errors, {})

    monkeypatch.setattr(Ablations, "_measure", measure)
    parser = argparse.ArgumentParser()
    add_ablations(parser)
    options = ["--out", str(tmp_path), "--steps", "7", "--only", "vote-alone,energies"]
    assert evaluate_ablations(parser.parse_args(options)) == 0
    out = capsys.readouterr().out
    assert out.count("1.25 (  1.25)") == 3 * 9 and "64 negatives" in out
    assert evaluate_ablations(parser.parse_args([*options, "--json"])) == 0
    rows = json.loads(capsys.readouterr().out)
    assert rows[-1]["name"] == "energy-parts-16"
    assert rows[-1]["conditions"]["problems"] == 600 and rows[-1]["conditions"]["steps"] == 7
