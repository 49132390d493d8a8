"""How often gradient descent comes home, on landscapes that are known."""

import dataclasses
import json
from pathlib import Path

import pytest
import torch
from paper_networks import SMALL, model, untrained

from iga_drake import cli
from iga_drake.aligners.iga_paper.graph import GraphConfig
from iga_drake.dataset.samples import SampleConfig
from iga_drake.errors import IgaDrakeError
from iga_drake.studies import stabilisers
from iga_drake.studies.stabilisers import ABLATIONS, ablated, measure_convergence
from iga_drake.training.paper import PaperTraining, right_place

SAMPLES = SampleConfig(cloud_points=64, surface_points=400, least_seen=8)


@pytest.mark.parametrize("part", ["rotation", "translation"])
@pytest.mark.parametrize("sign", [1, -1])
def test_a_well_brings_home_and_a_hill_does_not(part: str, sign: int, monkeypatch) -> None:
    places = []

    def remember(asked):
        places.append(right_place(asked))
        return places[-1]

    def energy(network, context):
        def well(R, t):
            turn = (R - torch.eye(3)).square().sum((-2, -1))
            shift = (t - (places[-1][:, None] if places else 0)).square().sum(-1)
            return sign * (20 * turn + 2000 * shift)

        return well

    monkeypatch.setattr(stabilisers, "right_place", remember)
    monkeypatch.setattr(stabilisers, "energy_of", energy)
    found = measure_convergence(model(part), PaperTraining(), count=2, starts=5, samples=SAMPLES)
    assert found.starts == 10
    assert (found.home, found.nearer, found.uphill) == ((1, 1, 0) if sign == 1 else (0, 0, 1))
    assert found.final_median < 1 if sign == 1 else found.final_median > 5


def test_each_ablation_leaves_one_thing_out() -> None:
    whole = GraphConfig(), PaperTraining()
    assert ablated("all", *whole) == whole
    found = [ablated(name, *whole) for name in ABLATIONS]
    for net, training in found[1:]:
        both = [(net, whole[0]), (training, whole[1])]
        changed = [
            field.name
            for ours, theirs in both
            for field in dataclasses.fields(ours)
            if getattr(ours, field.name) != getattr(theirs, field.name)
        ]
        assert len(changed) == 1 and not getattr(both[changed[0] != "spectral"][0], changed[0])
    with pytest.raises(IgaDrakeError, match="no-spectral"):
        ablated("no-luck", *whole)


def test_of_weights(tmp_path: Path, capsys) -> None:
    path = untrained(tmp_path) / "paper-translation.safetensors"
    options = ("--weights", str(path), "--count", "1")
    assert cli.main(["evaluate", "stabilisers", *options, "--json"]) == cli.SUCCESS
    found = json.loads(capsys.readouterr().out)[str(path)]
    assert 0 <= found["home"] <= found["nearer"] <= 1 and found["loss"] is None
    assert cli.main(["evaluate", "stabilisers"]) == cli.BAD_INPUT
    assert "--weights" in capsys.readouterr().err and SMALL.spectral
