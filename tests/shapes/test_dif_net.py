"""The fields of the DIF-Net, and the deformer that applies their displacement to any shape."""

from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial.transform import Rotation
from torch.func import jacrev, vmap

from iga_drake.checkpoint import CheckpointError, save_checkpoint
from iga_drake.paths import landed_weights
from iga_drake.shapes.deformers.dif_net import DifNetDeformer
from iga_drake.shapes.deformers.protocol import DeformableShape, PointDeformer
from iga_drake.shapes.dif_net import (
    KIND,
    DifNet,
    DifNetConfig,
    Normalisation,
    load_dif_net,
    siren,
    siren_jacobian,
)
from iga_drake.shapes.errors import ShapeError
from iga_drake.shapes.surfaces import ellipsoid, rounded_box

SMALL = DifNetConfig(latent=8, width=16, hidden=2, template_width=16, template_hidden=2)


def _net(shapes: int = 6, displacement: float = 1.0) -> DifNet:
    """An untrained net; `displacement` multiplies what it moves."""
    torch.manual_seed(0)
    net = DifNet(SMALL, shapes)
    with torch.no_grad():
        net.hyper[-1][2].weight *= 20 * displacement
        net.hyper[-1][2].bias *= 20 * displacement
    return net


def test_the_jacobian_is_that_of_automatic_differentiation() -> None:
    net = _net().double()
    points = torch.rand(2, 7, 3, dtype=torch.float64) * 2 - 1
    for layers in (net.deformation_layers(net.latents[:2]), net.template_layers()):
        value, jacobian = siren_jacobian(layers, points, 30.0)
        torch.testing.assert_close(value, siren(layers, points, 30.0))
        for b in range(2):
            own = [(w, c) if w.ndim == 2 else (w[b], c[b]) for w, c in layers]
            true = vmap(jacrev(lambda p, own=own: siren(own, p, 30.0)))(points[b])  # (P, out, 3)
            torch.testing.assert_close(jacobian[b].permute(1, 2, 0), true)


def test_layers_are_sine_networks_of_the_stated_sizes() -> None:
    net = DifNet(DifNetConfig(), 3)
    shapes = [tuple(w.shape) for w, _ in net.deformation_layers(net.latents)]
    assert shapes == [(3, 128, 3), (3, 128, 128), (3, 128, 128), (3, 4, 128)]
    (first, c), *_, (last, d) = [
        (w.detach().numpy(), b.detach().numpy()) for w, b in _net().template_layers()
    ]
    (middle, e) = [(w.detach().numpy(), b.detach().numpy()) for w, b in _net().template_layers()][1]
    p = np.random.default_rng(0).uniform(-1, 1, (5, 3)).astype(np.float32)
    hidden = np.sin(30 * (np.sin(30 * (p @ first.T + c)) @ middle.T + e))
    value = _net().template_value(torch.from_numpy(p)).detach().numpy()
    np.testing.assert_allclose(value, (hidden @ last.T + d)[:, 0], atol=1e-5)


def test_the_field_is_the_template_at_the_deformed_point_plus_the_correction() -> None:
    net = _net()
    points, latent = torch.rand(2, 9, 3), net.latents[:2]
    displacement, correction = net.deformation(points, net.deformation_layers(latent))
    expected = torch.stack(
        [net.template_value(points[b] + displacement[b]) + correction[b] for b in range(2)]
    )
    torch.testing.assert_close(net.sdf(points, latent), expected)
    torch.testing.assert_close(net.to_template(points, latent), points + displacement)
    # One field a latent: shapes differ, and each latent gives the same in any batch.
    assert (displacement[0] - displacement[1]).abs().max() > 1e-4
    torch.testing.assert_close(net.sdf(points[1:], latent[1:]), expected[1:])


def test_the_normalised_frame_holds_the_shape_in_the_unit_ball() -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        vertices = rng.normal(size=(50, 3)) * rng.uniform(0.01, 1, 3) + rng.normal(size=3)
        frame = Normalisation.of(vertices)
        unit = frame.apply(vertices)
        assert np.linalg.norm(unit, axis=1).max() == pytest.approx(1.0)
        np.testing.assert_allclose(unit.min(0), -unit.max(0), atol=1e-12)
        np.testing.assert_allclose(frame.invert(unit), vertices, atol=1e-12)


def _box() -> DeformableShape:
    surface = rounded_box((0.1, 0.06, 0.2), radius=0.01, flat=8)
    return DeformableShape(surface.vertices + [0.3, -0.1, 0.1], surface.faces)


@pytest.mark.parametrize("interpolate", [False, True])
def test_a_seed_names_an_instance(interpolate: bool) -> None:
    shape = _box()
    deformer = DifNetDeformer(_net(), interpolate=interpolate)
    assert isinstance(deformer, PointDeformer)
    moved = [deformer.deform(shape, seed) for seed in range(4)]
    np.testing.assert_array_equal(deformer.deform(shape, 2), moved[2])
    for a in range(4):
        assert np.abs(moved[a] - shape.vertices).max() > 1e-4
        for b in range(a):
            assert np.abs(moved[a] - moved[b]).max() > 1e-4
    some = deformer.deform_points(shape.vertices[3:30], 2, reference=shape.vertices)
    np.testing.assert_allclose(some, moved[2][3:30], atol=1e-7)


def test_the_displacement_is_the_fields_at_the_drawn_latent() -> None:
    """In the normalised frame, times `scale`; place and size of the shape go with it."""
    shape, net = _box(), _net(displacement=0.1)
    frame = Normalisation.of(shape.vertices)
    for seed in range(3):
        deformer = DifNetDeformer(net, scale=0.5, least_volume=0.0)
        latent = deformer.draw_latent(np.random.default_rng(seed))[None]
        points = torch.from_numpy(frame.apply(shape.vertices).astype(np.float32))[None]
        v = net.deformation(points, net.deformation_layers(latent))[0][0].detach().numpy()
        expected = frame.invert(frame.apply(shape.vertices) + 0.5 * v)
        np.testing.assert_allclose(deformer.deform(shape, seed), expected, atol=1e-6)
        larger = DeformableShape(3 * shape.vertices + 1.0, shape.faces)
        np.testing.assert_allclose(deformer.deform(larger, seed), 3 * expected + 1.0, atol=1e-5)


def test_drawn_latents_have_the_trained_ones_mean_and_covariance() -> None:
    net = _net(shapes=12)
    deformer = DifNetDeformer(net, latent_scale=2.0)
    rng = np.random.default_rng(0)
    drawn = np.stack([deformer.draw_latent(rng).numpy() for _ in range(20000)])
    trained = net.latents.detach().numpy()
    spread = np.cov(trained.T)
    np.testing.assert_allclose(drawn.mean(0), trained.mean(0), atol=0.01)
    np.testing.assert_allclose(np.cov(drawn.T), 4 * spread, atol=0.15 * 4 * spread.max())


def test_interpolated_latents_lie_between_two_trained_ones() -> None:
    net = _net()
    deformer = DifNetDeformer(net, interpolate=True)
    trained = net.latents.detach().numpy()
    rng = np.random.default_rng(3)
    for _ in range(20):
        latent = deformer.draw_latent(rng).numpy()
        rests = [
            np.linalg.norm(latent - a) + np.linalg.norm(latent - b) - np.linalg.norm(a - b)
            for i, a in enumerate(trained)
            for b in trained[:i]
        ]
        assert min(rests) < 1e-5


def test_a_folding_draw_is_reduced_until_it_folds_no_more() -> None:
    shape, net = _box(), _net(displacement=8.0)
    wild = DifNetDeformer(net, checked_points=0)
    tame = DifNetDeformer(net, checked_points=10_000)
    folded = 0
    for seed in range(20):
        folded += wild.jacobian_determinants(shape.vertices, seed).min() < 0
        assert tame.jacobian_determinants(shape.vertices, seed).min() >= 0.2 - 1e-4
        assert np.abs(tame.deform(shape, seed) - shape.vertices).max() > 1e-4
    assert folded > 10


def test_determinants_are_the_volume_ratios_of_small_balls() -> None:
    deformer = DifNetDeformer(_net(displacement=2.0), checked_points=0)
    ball = ellipsoid((1e-3, 1e-3, 1e-3), rings=7, segments=12)
    corners = _box().vertices
    reference = corners - corners.mean(0)
    for place in reference[::80]:
        points = ball.vertices + place
        moved = deformer.deform_points(points, 5, reference=reference)
        volumes = [
            trimesh.Trimesh(p - p.mean(0), ball.faces, process=False).volume
            for p in (points, moved)
        ]
        index = int(np.argmin(np.linalg.norm(reference - place, axis=1)))
        determinant = deformer.jacobian_determinants(reference, 5)[index]
        assert volumes[1] / volumes[0] == pytest.approx(determinant, rel=0.05, abs=0.02)


def test_stretch_scales_the_axes_and_nothing_else() -> None:
    shape = _box()
    still = DifNetDeformer(_net(), scale=0.0, stretch=0.3)
    centred = Normalisation.of(shape.vertices)
    for seed in range(3):
        moved = still.deform(shape, seed) - centred.centre
        ratio = moved / np.where(
            np.abs(shape.vertices - centred.centre) < 1e-6, np.nan, shape.vertices - centred.centre
        )
        assert np.nanmax(np.nanstd(ratio, axis=0)) < 1e-6
        assert np.std(np.log(np.nanmean(ratio, axis=0))) > 0.01


def test_one_latent_is_too_few() -> None:
    with pytest.raises(ShapeError, match="1 trained latents"):
        DifNetDeformer(_net(shapes=1))


def test_weights_are_read_back_and_wrong_ones_refused(tmp_path: Path) -> None:
    net = _net()
    card = {"model": vars(SMALL)}
    save_checkpoint(tmp_path / "a.safetensors", net.state_dict(), kind=KIND, card=card)
    loaded, _ = load_dif_net(tmp_path / "a.safetensors")
    points = torch.rand(1, 5, 3)
    expected = net.sdf(points, net.latents[:1])
    torch.testing.assert_close(loaded.sdf(points, loaded.latents[:1]), expected)
    card["model"] = vars(SMALL) | {"width": 17}
    save_checkpoint(tmp_path / "b.safetensors", net.state_dict(), kind=KIND, card=card)
    with pytest.raises(CheckpointError, match=r"(?s)b\.safetensors.*iga train dif-net"):
        load_dif_net(tmp_path / "b.safetensors")


def test_the_packages_weights_deform_a_ball_smoothly_and_each_seed_otherwise() -> None:
    """Of shapes that are no chairs: volumes stay positive, nothing folds, instances differ."""
    assert landed_weights("dif_net").is_file()
    surface = ellipsoid((0.05, 0.05, 0.1))
    turned = surface.vertices @ Rotation.from_euler("y", 0.4).as_matrix().T
    shape = DeformableShape(turned, surface.faces)
    deformer = DifNetDeformer()
    size = np.ptp(turned, axis=0).max()
    moves = []
    for seed in range(10):
        assert deformer.jacobian_determinants(turned, seed).min() > 0
        moved = deformer.deform(shape, seed)
        moves.append((moved - moved.mean(0)) - (turned - turned.mean(0)))
    assert np.linalg.norm(moves, axis=2).mean() > 0.005 * size
    assert np.std(moves, axis=0).max() > 0.01 * size
