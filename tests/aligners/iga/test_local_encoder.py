"""The local encoder and its decoder: symmetries over random inputs, groups, sizes."""

import dataclasses

import pytest
import torch
from scipy.spatial.transform import Rotation

from iga_drake.aligners.iga.local_encoder import (
    ENCODER,
    DecoderConfig,
    EncoderConfig,
    LocalEncoder,
    OccupancyNet,
    load_encoder,
    nearest_centre,
    positional_encoding,
)
from iga_drake.checkpoint import CheckpointError, save_checkpoint

SIZES = [
    EncoderConfig(channels=16, scalars=12, layers=8, point_layers=8),
    EncoderConfig(channels=16, scalars=12, layers=5, point_layers=2),
]


@pytest.fixture(autouse=True)
def float64():
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(torch.float32)


def rotation(seed: int) -> torch.Tensor:
    return torch.from_numpy(Rotation.random(random_state=seed).as_matrix())


def cloud(seed: int, points: int = 150, batch: int = 3) -> torch.Tensor:
    torch.manual_seed(seed)
    return 0.06 * torch.randn(batch, points, 3) * torch.tensor([1.0, 0.6, 0.3])


@pytest.mark.parametrize("config", SIZES)
@pytest.mark.parametrize("seed", range(4))
def test_features_turn_with_the_cloud(config: EncoderConfig, seed: int) -> None:
    x, R, shift = cloud(seed), rotation(seed), torch.randn(3)
    net = LocalEncoder(config)
    before, after = net(x, 8), net(x @ R.T + shift, 8)
    assert before.vectors.square().mean() > 1e-4
    torch.testing.assert_close(after.centres, before.centres @ R.T + shift, atol=1e-9, rtol=0)
    turned = torch.einsum("ij,bkjc->bkic", R, before.vectors)
    torch.testing.assert_close(after.vectors, turned, atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(after.scalars, before.scalars, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("seed", range(4))
def test_a_turn_of_one_axis_alone_is_noticed(seed: int) -> None:
    """The features aren't constant: a mirrored cloud is another cloud."""
    x = cloud(seed)
    net = LocalEncoder(SIZES[1])
    mirrored = net(x * torch.tensor([-1.0, 1.0, 1.0]), 8)
    assert (mirrored.scalars - net(x, 8).scalars).abs().max() > 1e-4


@pytest.mark.parametrize("config", SIZES)
@pytest.mark.parametrize("seed", range(4))
def test_the_order_of_points_does_not_matter(config: EncoderConfig, seed: int) -> None:
    x = cloud(seed)
    order = torch.randperm(x.shape[1])
    net = LocalEncoder(config)
    before, after = net(x, 8), net(x[:, order], 8)
    assert torch.equal(order[after.chosen], before.chosen)
    for one, other in zip(before[1:], after[1:], strict=True):
        torch.testing.assert_close(one, other, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("seed", range(4))
def test_padding_changes_nothing(seed: int) -> None:
    x = cloud(seed)
    padded = torch.cat((torch.randn(3, 40, 3), x, torch.randn(3, 30, 3)), 1)
    mask = torch.zeros(padded.shape[:2], dtype=torch.bool)
    mask[:, 40:190] = True
    net = LocalEncoder(SIZES[0])
    before, after = net(x, 8), net(padded, 8, mask=mask)
    assert torch.equal(after.chosen - 40, before.chosen)
    for one, other in zip(before[1:], after[1:], strict=True):
        torch.testing.assert_close(one, other, atol=1e-9, rtol=1e-9)


def test_parts_are_described_by_their_own_points_alone() -> None:
    """Each group by itself, in a loop, gives what the batch of groups gives."""
    x = cloud(5, batch=1)
    net = LocalEncoder(SIZES[0])
    features = net(x, 6)
    owner = nearest_centre(x, features.centres)[0]
    for k in range(6):
        members = x[:, owner == k]
        own = (members == features.centres[:, k, None]).all(-1).nonzero()[:1, 1]
        alone = net(members, index=own[None])
        torch.testing.assert_close(alone.vectors[0, 0], features.vectors[0, k])
        torch.testing.assert_close(alone.scalars[0, 0], features.scalars[0, k])


@pytest.mark.parametrize("seed", range(3))
def test_predictions_from_projections_turn_with_the_cloud(seed: int) -> None:
    x, R, shift = cloud(seed), rotation(seed), torch.randn(3)
    q = x + 0.01 * torch.randn_like(x)
    net = OccupancyNet(SIZES[1], DecoderConfig(query="projections", width=32, blocks=2))
    index = torch.arange(7).expand(3, 7)
    before = net(x, q, index)
    torch.testing.assert_close(
        net(x @ R.T + shift, q @ R.T + shift, index), before, atol=1e-5, rtol=0
    )
    assert before.std() > 1e-3
    plain = OccupancyNet(SIZES[1], DecoderConfig(query="position", width=32, blocks=2))
    difference = plain(x @ R.T, q @ R.T, index) - plain(x, q, index)
    assert difference.abs().max() > 1e-3  # the paper's decoder has to learn rotations


def test_the_encoding_of_a_query_is_the_paper_s() -> None:
    p = torch.tensor([0.013, -0.2, 0.07])
    expected = {
        float(f(2.0**l * torch.pi * x))
        for l in range(10)
        for x in p
        for f in (torch.sin, torch.cos)
    }
    found = positional_encoding(p, 10)
    assert found.shape == (60,)
    torch.testing.assert_close(found.sort()[0], torch.tensor(sorted(expected)))


@pytest.mark.parametrize(
    ("config", "low", "high"),
    [(EncoderConfig(), 1.6e6, 1.8e6), (EncoderConfig.light(), 0.2e6, 0.4e6)],
)
def test_sizes_are_as_said(config: EncoderConfig, low: float, high: float) -> None:
    assert low < sum(p.numel() for p in LocalEncoder(config).parameters()) < high
    assert config.layers == 8


def test_gradients_are_those_of_finite_differences() -> None:
    config = EncoderConfig(channels=4, scalars=3, layers=2, point_layers=1, shells=2)
    net = OccupancyNet(config, DecoderConfig(query="projections", width=6, blocks=1, frequencies=2))
    x, index = cloud(2, points=12, batch=1), torch.tensor([[0, 5]])
    q = (x + 0.004).requires_grad_()
    parameters = list(net.parameters())
    torch.manual_seed(0)
    directions = [torch.randn_like(p) for p in parameters]
    loss = net(x, q.detach(), index).square().sum()
    slope = sum(
        (g * d).sum()
        for g, d in zip(torch.autograd.grad(loss, parameters), directions, strict=True)
    )
    values = []
    for sign in (1, -1):
        with torch.no_grad():
            for p, d in zip(parameters, directions, strict=True):
                p.add_(sign * 1e-6 * d)
            values.append(net(x, q, index).square().sum())
            for p, d in zip(parameters, directions, strict=True):
                p.sub_(sign * 1e-6 * d)
    torch.testing.assert_close((values[0] - values[1]) / 2e-6, slope, rtol=1e-4, atol=1e-8)


def test_centres_are_counted_or_named() -> None:
    net = LocalEncoder(SIZES[1])
    with pytest.raises(ValueError, match="either"):
        net(cloud(0))
    with pytest.raises(ValueError, match="either"):
        net(cloud(0), 4, index=torch.zeros(3, 2, dtype=torch.long))


def test_a_saved_encoder_comes_back_and_a_foreign_one_is_refused(tmp_path) -> None:
    torch.set_default_dtype(torch.float32)
    decoder = DecoderConfig(width=16, blocks=1)
    net = OccupancyNet(SIZES[1], decoder)
    card = {"encoder": dataclasses.asdict(SIZES[1]), "decoder": dataclasses.asdict(decoder)}
    path = tmp_path / "encoder.safetensors"
    save_checkpoint(path, net.state_dict(), kind=ENCODER, card=card)
    loaded, _ = load_encoder(path)
    assert not loaded.training
    x = cloud(1).float()
    torch.testing.assert_close(loaded.encoder(x, 4).vectors, net.encoder(x, 4).vectors)
    card["encoder"]["channels"] = 8
    save_checkpoint(path, net.state_dict(), kind=ENCODER, card=card)
    with pytest.raises(CheckpointError, match=r"encoder\.safetensors: card and tensors"):
        load_encoder(path)
