"""Training of the DIF-Net: signed distances, losses, learning, and going on after a stop."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from descriptor_runs import assert_same

from iga_drake import cli
from iga_drake.checkpoint import CheckpointError, load_checkpoint
from iga_drake.shapes.dif_net import DifNet, DifNetConfig, Normalisation, load_dif_net
from iga_drake.shapes.errors import ShapeError
from iga_drake.shapes.surfaces import ellipsoid
from iga_drake.training import dif_net
from iga_drake.training.dif_net import (
    DifNetSettings,
    DifNetTraining,
    dif_net_loss,
    sample_sdf,
    train_dif_net,
    training_shapes,
)
from iga_drake.training.run import RunOptions

MODEL = DifNetConfig(
    latent=8, width=32, hidden=2, template_width=32, template_hidden=2, hyper_width=16
)


def _config(steps: int, **changes) -> DifNetTraining:
    options = {"shapes": 3, "stored_points": 400, "batch": 2, "points": 64, "warmup": 5}
    return DifNetTraining(steps=steps, **(options | changes))


def test_distances_of_an_ellipsoids_ball_are_the_balls() -> None:
    ball = ellipsoid((0.05, 0.05, 0.05), rings=63, segments=128)
    surface, normals, points, distance = sample_sdf(ball.vertices + 0.3, ball.faces, 2000, seed=0)
    np.testing.assert_allclose(np.linalg.norm(surface, axis=1), 1.0, atol=2e-3)
    np.testing.assert_allclose(np.sum(surface * normals, axis=1), 1.0, atol=2e-3)
    np.testing.assert_allclose(distance, np.linalg.norm(points, axis=1) - 1, atol=2e-3)
    assert np.abs(distance[:1000]).mean() < 0.1 < np.abs(distance[1000:]).mean()
    assert points[1000:].min() >= -1 and points[1000:].max() <= 1


def test_what_lies_inside_another_part_is_no_surface() -> None:
    """Two boxes that overlap: distances are to their union, which is a box again."""
    box = trimesh.creation.box((0.1, 0.04, 0.06))
    moved = box.copy().apply_translation((0.05, 0, 0))
    both = trimesh.util.concatenate([box, moved])
    frame = Normalisation.of(both.vertices)
    surface, _, points, distance = sample_sdf(both.vertices, both.faces, 3000, seed=1)
    half = np.array([0.15, 0.04, 0.06]) / 2 / frame.scale
    outside = np.abs(points) - half
    expected = np.linalg.norm(np.maximum(outside, 0), axis=1) + np.minimum(outside.max(1), 0)
    np.testing.assert_allclose(distance, expected, atol=1e-6)
    np.testing.assert_allclose((np.abs(surface) - half).max(1), 0, atol=1e-6)


def test_a_part_that_is_not_closed_is_refused() -> None:
    ball = ellipsoid((0.05, 0.05, 0.05))
    with pytest.raises(ShapeError, match="1 parts"):
        sample_sdf(ball.vertices, ball.faces[10:], 100, seed=0)


def test_the_losses_are_those_of_their_definitions() -> None:
    """Derivatives by automatic differentiation of the fields themselves."""
    torch.manual_seed(1)
    net = DifNet(MODEL, 4).double()
    with torch.no_grad():
        net.hyper[-1][2].weight *= 100
        net.hyper[-1][2].bias *= 30
    config = _config(1)
    index = torch.tensor([2, 0])
    surface, points = torch.rand(2, 2, 10, 3, dtype=torch.float64) * 2 - 1
    normals = torch.nn.functional.normalize(torch.randn(2, 10, 3, dtype=torch.float64), dim=-1)
    distance = torch.rand(2, 10, dtype=torch.float64) - 0.5
    term = dif_net_loss(net, index, surface, normals, points, distance, config)
    terms = {name: float(value.detach()) for name, value in term.statistics.items()}

    def gradient(values: torch.Tensor, at: torch.Tensor) -> torch.Tensor:
        return torch.autograd.grad(values.sum(), at, retain_graph=True)[0]

    p = torch.cat((surface, points), 1).requires_grad_()
    latent = net.latents[index]
    s = net.sdf(p, latent)
    v, dc = net.deformation(p, net.deformation_layers(latent))
    q = (p + v).detach().requires_grad_()
    grad_s, grad_T = gradient(s, p), gradient(net.template_value(q), q)
    rows = torch.stack([gradient(v[..., k], p) for k in range(3)], -2)  # grad v_k
    d = torch.cat((torch.zeros_like(distance), distance), 1)
    clipped = (s.clamp(-0.5, 0.5) - d.clamp(-0.5, 0.5)).abs()
    cos = torch.nn.functional.cosine_similarity
    expected = {
        "sdf": clipped.mean(),
        "off_surface": torch.exp(-100 * s[:, 10:].abs()).mean(),
        "normal": (1 - cos(grad_s[:, :10], normals, dim=-1)).mean(),
        "eikonal": (grad_s.norm(dim=-1) - 1).abs().mean(),
        "template_normal": (1 - cos(grad_T[:, :10], normals, dim=-1)).mean(),
        "smooth": rows.norm(dim=-1).sum(-1).mean(),
        "correction": dc.abs().mean(),
        "latent": latent.square().mean(),
    }
    for name, value in expected.items():
        assert terms[name] == pytest.approx(float(value.detach()), rel=1e-6), name
    total = sum(getattr(config, name) * float(value.detach()) for name, value in expected.items())
    assert float(term.total.detach()) == pytest.approx(total, rel=1e-6)
    assert int(term.count) == 1


def test_a_stopped_run_goes_on_to_the_same_weights(tmp_path: Path) -> None:
    train_dif_net(tmp_path / "whole", model=MODEL, config=_config(6))
    train_dif_net(
        tmp_path / "parts", model=MODEL, config=_config(6), options=RunOptions(minutes=0.0)
    )
    train_dif_net(tmp_path / "parts", options=RunOptions(stop_at=3))
    card = train_dif_net(tmp_path / "parts")
    assert card["step"] == 6 and card["samples_seen"] == 6 * 2
    whole, _ = load_checkpoint(tmp_path / "whole" / "state.safetensors", kind="dif-net-state")
    parts, _ = load_checkpoint(tmp_path / "parts" / "state.safetensors", kind="dif-net-state")
    assert_same(whole, parts)
    assert_same(
        {name: whole[f"net.{name}"] for name in dict(DifNet(MODEL, 3).named_parameters())},
        load_checkpoint(tmp_path / "parts" / "dif-net.safetensors", kind="dif-net")[0],
    )


def test_latents_move_at_a_rate_of_their_own(tmp_path: Path) -> None:
    """A first step of Adam moves every parameter that has a gradient by its learning rate."""
    moved = {}
    for steps in (0, 1):
        train_dif_net(
            tmp_path / str(steps),
            model=MODEL,
            config=_config(1, warmup=0, decay_share=0.0, batch=3, latent_rate=7.0),
            options=RunOptions(stop_at=steps),
        )
        net, _ = load_dif_net(tmp_path / str(steps) / "dif-net.safetensors")
        moved[steps] = dict(net.named_parameters())
    off = {name: (moved[1][name] - moved[0][name]).abs().median() for name in moved[0]}
    assert off["latents"] == pytest.approx(7e-4, rel=0.01)
    assert off["template.1.weight"] == pytest.approx(1e-4, rel=0.01)


def test_a_run_starts_from_given_weights_of_as_many_shapes(tmp_path: Path) -> None:
    train_dif_net(tmp_path / "first", model=MODEL, config=_config(3))
    given = tmp_path / "first" / "dif-net.safetensors"
    still = _config(1, learning_rate=0.0, seed=5)
    train_dif_net(tmp_path / "second", model=MODEL, config=still, initial=given)
    first, second = (
        load_dif_net(tmp_path / name / "dif-net.safetensors")[0] for name in ("first", "second")
    )
    for a, b in zip(first.parameters(), second.parameters(), strict=True):
        torch.testing.assert_close(a, b, atol=0, rtol=0)
    with pytest.raises(CheckpointError, match=r"dif-net\.safetensors: 3 shapes.*expected 2 shapes"):
        train_dif_net(tmp_path / "third", model=MODEL, config=_config(1, shapes=2), initial=given)


def test_a_run_does_not_go_on_with_other_shapes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    train_dif_net(tmp_path, model=MODEL, config=_config(1))
    changed = [(1.01 * vertices, faces) for vertices, faces in training_shapes(_config(1))]
    monkeypatch.setattr(dif_net, "training_shapes", lambda config: changed)
    with pytest.raises(ShapeError, match=r"state\.safetensors: family 'chair'.*train anew"):
        train_dif_net(tmp_path, config=_config(2))


def test_training_learns_the_shapes(tmp_path: Path) -> None:
    config = _config(300, learning_rate=1e-3, batch=3, points=128, seed=3)
    train_dif_net(tmp_path, model=MODEL, config=config)
    log = [json.loads(line) for line in (tmp_path / "log.jsonl").read_text().splitlines()]
    assert [row["step"] for row in log] == [50, 100, 150, 200, 250, 300]
    assert log[-1]["sdf"] < 0.75 * log[0]["sdf"]
    assert log[-1]["normal"] < log[0]["normal"] - 0.1
    net, _ = load_dif_net(tmp_path / "dif-net.safetensors")
    settings = DifNetSettings.of(tmp_path)
    assert settings.training == config and settings.model == net.config
    # New points, and each shape by its own latent rather than by another's.
    errors = np.zeros((3, 3))
    for k, (vertices, faces) in enumerate(training_shapes(config)):
        _, _, points, distance = sample_sdf(vertices, faces, 1000, seed=77)
        p = torch.from_numpy(points.astype(np.float32))[None]
        for other in range(3):
            s = net.sdf(p, net.latents[other][None])[0].numpy()
            errors[k, other] = np.abs(s - distance).mean()
    own = np.eye(3, dtype=bool)
    assert errors[own].mean() < 0.9 * errors[~own].mean()


def test_an_unknown_family_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ShapeError, match="'sofa': unknown; one of"):
        train_dif_net(tmp_path, config=_config(1, family="sofa"))


def test_the_command_trains(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    options = "--steps 2 --shapes 4 --batch 2 --points 16 --device cpu".split()
    assert cli.main(["train", "dif-net", "--out", str(tmp_path), *options]) == 0
    assert capsys.readouterr().out.startswith("step 2, 4 shapes seen")
    net, card = load_dif_net(tmp_path / "dif-net.safetensors")
    assert len(net.latents) == 4 and card["training"]["family"] == "chair"
