"""The losses of the descriptors against sums in loops, and their idea of symmetry."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from iga_drake.aligners.iga.descriptor import DescriptorConfig, DescriptorNet
from iga_drake.geometry.clouds import furthest_point_sampling
from iga_drake.training.correspondence import (
    DescriptorTraining,
    Draw,
    descriptor_loss,
    half_turns,
)

MODEL = DescriptorConfig(scalars=24, vectors=8, heads=2, layers=2, descriptor=16)
INSTANCES, POINTS, NODES, SHOWN = 3, 20, 6, 2


def _config(**changes) -> DescriptorTraining:
    alone = {"presence_weight": 0.0, "motion_weight": 0.0, "up_error": 0.0}
    return DescriptorTraining(nodes=NODES, visible_within=0.3, bf16=False, **(alone | changes))


@pytest.fixture(scope="module")
def net() -> DescriptorNet:
    torch.manual_seed(3)
    return DescriptorNet(MODEL)


@pytest.fixture(scope="module")
def batch() -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(5)
    shape = (2, 2, INSTANCES, POINTS)
    up = torch.randn(*shape[:3], 3, generator=generator)
    return {
        "points": torch.randn(*shape, 3, generator=generator),
        "canonical": torch.rand(*shape, 3, generator=generator) ** 4,  # no turn leaves it as it is
        "present": torch.rand(*shape, generator=generator) < 0.8,
        "up": torch.nn.functional.normalize(up, dim=-1),
    }


@pytest.fixture(scope="module")
def draw() -> Draw:
    return Draw(
        demonstrations=SHOWN,
        start=torch.arange(12).reshape(2, 2, INSTANCES) % POINTS,
        known=torch.tensor([[True, False], [False, True]]),
        tilt=torch.zeros(2, 2, INSTANCES, 3),
        turns=torch.from_numpy(
            Rotation.random(4, rng=np.random.default_rng(0)).as_matrix()
        ).float(),
    )


class _Described:
    """Nodes, places and descriptors of the batch, one object after another."""

    def __init__(self, net: DescriptorNet, batch: dict[str, torch.Tensor], draw: Draw):
        self.objects = []
        for k in range(4):
            points, canonical, present, up = (
                batch[name].flatten(0, 1)[k] for name in ("points", "canonical", "present", "up")
            )
            nodes = furthest_point_sampling(points, NODES, draw.start.flatten(0, 1)[k])
            up = up * draw.known.flatten()[k]
            shown = net(points[:SHOWN], nodes[:SHOWN], group=SHOWN, up=up[:SHOWN])
            test = net(points[SHOWN:], nodes[SHOWN:], up=up[SHOWN:], memory=shown.memory)
            self.objects.append(
                {
                    "descriptors": torch.cat((shown.descriptors, test.descriptors)),
                    "presence": torch.cat((shown.presence, test.presence)).double().numpy(),
                    "place": np.take_along_axis(canonical.numpy(), nodes.numpy()[..., None], 1),
                    "seen": np.take_along_axis(present.numpy(), nodes.numpy(), 1),
                }
            )


@torch.no_grad()
def test_matches_are_cross_entropies_of_nodes_that_are_there_twice(net, batch, draw) -> None:
    term = descriptor_loss(net, batch, _config(), draw)
    total, weights = 0.0, 0.0
    for each in _Described(net, batch, draw).objects:
        for i in range(INSTANCES):
            for j in range(INSTANCES):
                if i == j:
                    continue
                weight = 0.5 if max(i, j) < SHOWN else 1.0
                logits = net.similarity(each["descriptors"][i], each["descriptors"][j])
                logits = logits.double().numpy()
                for node in range(NODES):
                    d = np.linalg.norm(each["place"][i, node] - each["place"][j], axis=1)
                    d = np.where(each["seen"][j], d, np.inf)
                    if not each["seen"][i, node] or d.min() >= 0.3:
                        continue
                    target = np.exp((d.min() ** 2 - d**2) / (2 * 0.05**2))
                    target /= target.sum()
                    log_p = logits[node] - np.log(np.exp(logits[node]).sum())
                    total -= weight * target @ log_p
                    weights += weight
    assert float(term.count) == pytest.approx(weights) and weights > 30
    assert float(term.total) == pytest.approx(total, rel=1e-4)


@torch.no_grad()
def test_clutter_is_a_binary_cross_entropy(net, batch, draw) -> None:
    bare = descriptor_loss(net, batch, _config(), draw)
    term = descriptor_loss(net, batch, _config(presence_weight=2.0), draw)
    expected = 0.0
    for each in _Described(net, batch, draw).objects:
        p = 1 / (1 + np.exp(-each["presence"]))
        expected -= np.log(np.where(each["seen"], p, 1 - p)).sum()
    assert float(term.total - bare.total) == pytest.approx(2 * expected, rel=1e-3)


def _box(count: int, size: tuple[float, float, float], seed: int) -> np.ndarray:
    """Points on the surface of a box about the origin."""
    rng = np.random.default_rng(seed)
    a, b, c = size
    area = np.array([b * c, a * c, a * b])
    axis = rng.choice(3, count, p=area / area.sum())
    points = rng.uniform(-0.5, 0.5, (count, 3))
    points[np.arange(count), axis] = rng.choice([-0.5, 0.5], count)
    return points * size


@pytest.mark.parametrize("turned", [False, True])
def test_half_turns_that_leave_a_shape_as_it_is(turned: bool) -> None:
    """A box has all three, a box with a stick on one end those about the stick alone."""
    rng = np.random.default_rng(1)
    plain = _box(1200, (1.0, 0.6, 0.35), 2)
    stick = np.concatenate((_box(900, (0.6, 0.5, 0.3), 3), _box(300, (0.5, 0.1, 0.1), 4)))
    stick[900:, 0] += 0.55
    skew = plain.copy()
    skew[:300] = _box(300, (0.3, 0.1, 0.1), 6) + [0.4, 0.3, 0.2]
    R = Rotation.random(rng=rng).as_matrix() if turned else np.eye(3)
    shapes = [shape @ R.T + 0.3 for shape in (plain, stick, skew)]
    canonical = torch.from_numpy(np.stack(shapes)).float()
    present = torch.ones(canonical.shape[:2], dtype=torch.bool)
    X, same = half_turns(canonical, present)
    np.testing.assert_array_equal(same.sum(1).numpy(), [4, 2, 1])
    assert same[:, 0].all()
    # The one of the stick leaves the stick's axis as it is.
    k = int(same[1, 1:].nonzero()[0, 0]) + 1
    axis = torch.from_numpy(R[:, 0]).float()
    torch.testing.assert_close((X[1, k, :3, :3] @ axis).abs(), axis.abs(), atol=0.06, rtol=0)


def test_clutter_does_not_count_for_symmetry() -> None:
    box = _box(1200, (1.0, 0.6, 0.35), 2)
    with_clutter = np.concatenate((box, np.random.default_rng(0).normal(size=(300, 3)) + 2))
    present = torch.arange(1500)[None] < 1200
    X, same = half_turns(torch.from_numpy(with_clutter)[None].float(), present)
    assert same.all()
    torch.testing.assert_close(X[0, :, :3, 3], torch.zeros(4, 3), atol=0.05, rtol=0)


@torch.no_grad()
@pytest.mark.parametrize("upside_down", [False, True])
def test_the_motion_loss_tells_a_whole_turn(upside_down: bool) -> None:
    """With the true places as descriptors no motion is wrong; with places that are turned by half
    a turn, all are."""
    shape = _box(400, (1.0, 0.6, 0.35), 2)
    shape = np.concatenate((shape, _box(100, (0.2, 0.2, 0.2), 3) + [0.5, 0.3, 0.2]))
    rng = np.random.default_rng(0)

    class Telling(DescriptorNet):
        """Descriptors that are nearer the nearer the places."""

        def forward(self, points, nodes, *, memory=None, **_):  # type: ignore[no-untyped-def]
            x = torch.gather(points, 1, nodes[..., None].expand(-1, -1, 3))
            x = x - points.mean(1, keepdim=True)
            if memory is not None and upside_down:
                x = x * torch.tensor([-1.0, -1.0, 1.0])
            features = torch.cat((x, 0.7 * torch.ones_like(x[..., :1])), -1)
            return type(self).Answer(
                torch.nn.functional.normalize(features, dim=-1),
                torch.zeros_like(nodes).float(),
                (),
            )

        from iga_drake.aligners.iga.descriptor import Description as Answer

    points = np.stack([shape[rng.permutation(500)[:256]] for _ in range(4)])
    points = torch.from_numpy(points).float().reshape(1, 2, 2, 256, 3)
    batch = {
        "points": points,
        "canonical": points,
        "present": torch.ones(points.shape[:-1], dtype=torch.bool),
        "up": torch.zeros_like(points[..., 0, :]) + torch.tensor([0, 0, 1.0]),
    }
    config = DescriptorTraining(nodes=48, bf16=False)
    telling = Telling(MODEL)
    telling.log_temperature.fill_(4.0)
    torch.manual_seed(0)
    term = descriptor_loss(telling, batch, config)
    assert float(term.statistics["wrong_motion"]) == (1.0 if upside_down else 0.0)
    assert (float(term.statistics["motion_loss"]) > 1.0) == upside_down
