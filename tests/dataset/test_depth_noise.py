"""Depth noise on samples and on images: each against its formulas, and one against the other."""

import dataclasses
import math

import numpy as np
import pytest
import torch

from iga_drake.dataset.depth_camera import observe
from iga_drake.dataset.depth_noise import LOST, DepthNoise, noisy_depth, noisy_samples

FOCAL, HEIGHT, WIDTH = 615.0, 240, 320
EXACT = DepthNoise(
    disparity=0, patch_disparity=0, quantum=1e-9, grazing_kept=-0.9, grazing_lost=-1, edge_lost=0,
    edge_flying=0,
)  # fmt: skip
U = (np.arange(WIDTH) + 0.5 - WIDTH / 2) / FOCAL
V = ((np.arange(HEIGHT) + 0.5 - HEIGHT / 2) / FOCAL)[:, None]


def _only(**changes: float) -> DepthNoise:
    return dataclasses.replace(EXACT, **changes)


def _plane(z: float, cosine: float = 1.0) -> np.ndarray:
    """Depth (H, W) of a plane that the optical axis meets at z (m) and at an angle."""
    slope = math.sqrt(1 / cosine**2 - 1)
    return (z / (1 + slope * U) * np.ones((HEIGHT, 1))).astype(np.float32)


def _by_image(depth: np.ndarray, noise: DepthNoise, seed: int = 0) -> np.ndarray:
    return noisy_depth(depth, noise, np.random.default_rng(seed), focal=FOCAL)


def _by_samples(depth: np.ndarray, cosine: float, noise: DepthNoise, seed: int = 0) -> np.ndarray:
    """The same image, every pixel a surface sample."""
    u, v, w = (torch.from_numpy(a.astype(float)).flatten() for a in _rays(depth))
    stretch, kept = noisy_samples(
        u, v, w, torch.full_like(w, cosine), torch.zeros(len(w), dtype=torch.bool),
        torch.zeros(len(w), dtype=torch.int64), 1, noise, torch.Generator().manual_seed(seed),
    )  # fmt: skip
    return np.where(kept, stretch.numpy() / w.numpy(), LOST).reshape(depth.shape)


def _rays(depth: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return U * np.ones((HEIGHT, 1)), V * np.ones((1, WIDTH)), 1 / depth


def _block_deviation(error: np.ndarray, pixels: int) -> float:
    """Standard deviation of the means over squares of so many pixels."""
    rows, columns = (size // pixels for size in error.shape)
    blocks = error[: rows * pixels, : columns * pixels].reshape(rows, pixels, columns, pixels)
    return float(blocks.mean((1, 3)).std())


@pytest.mark.parametrize("z", [0.5, 0.8, 1.2])
def test_images_and_samples_have_the_same_depth_error(z: float) -> None:
    """Its size is that of the disparity's, and as much of it is common to a patch."""
    noise, depth = DepthNoise(), _plane(z)
    block = round(noise.patch * FOCAL / z)
    found = []
    for seed in range(3):
        both = _by_image(depth, noise, seed), _by_samples(depth, 1.0, noise, seed)
        found.append([(e.std(), _block_deviation(e, block)) for e in (m - z for m in both)])
    (image, image_block), (samples, samples_block) = np.mean(found, 0)
    step = noise.quantum / math.sqrt(12)
    sigma = z**2 / noise.focal_baseline * math.hypot(0.05, 0.05, step)
    assert image == pytest.approx(sigma, rel=0.05) and samples == pytest.approx(sigma, rel=0.05)
    assert image_block == pytest.approx(samples_block, rel=0.08)
    # Independent errors alone would nearly vanish in the mean over a patch.
    assert image_block > 3 * _block_deviation(_by_image(depth, _only(disparity=0.05)) - z, block)


@pytest.mark.parametrize("cosine", [0.15, 0.2, 0.25, 0.5])
def test_images_and_samples_lose_as_much_of_a_slanted_plane(cosine: float) -> None:
    noise = _only(grazing_kept=0.3, grazing_lost=0.1)
    # About the optical axis, where the cosine to the ray is that to the axis.
    middle = np.s_[:, WIDTH // 2 - 3 : WIDTH // 2 + 3]
    depth = _plane(0.8, cosine)
    image = (_by_image(depth, noise)[middle] == LOST).mean()
    samples = (_by_samples(depth, cosine, noise)[middle] == LOST).mean()
    expected = np.clip((0.3 - cosine) / 0.2, 0, 1)
    assert image == pytest.approx(expected, abs=0.06)
    assert samples == pytest.approx(expected, abs=0.06)


def _disc(radius: float, z: float, behind: float) -> tuple[np.ndarray, np.ndarray]:
    """Depth (H, W) of a disc across the axis before a wall, and which pixels show the disc."""
    on = np.hypot(U, V) * z < radius
    return np.where(on, z, behind).astype(np.float32), on


def test_images_lose_about_as_much_at_edges_as_training_cameras_do() -> None:
    radius, z, count = 0.08, 0.8, 2000
    noise = _only(edge_lost=1.0)
    depth, on = _disc(radius, z, math.inf)
    image = (_by_image(depth, noise)[on] == LOST).mean()
    seen = []
    for seed in range(4):
        generator = torch.Generator().manual_seed(seed)
        angle = torch.rand(count, generator=generator) * 2 * math.pi
        r = radius * torch.rand(count, generator=generator).sqrt()
        points = torch.stack((r * angle.cos(), r * angle.sin(), torch.zeros(count)), 1)
        normals = torch.tensor([0.0, 0.0, 1.0]).expand(1, 1, count, 3)
        clouds = observe(
            points[None, None], normals, torch.tensor([[[0.0, 0.0, z]]]), noise=noise,
            spacing=math.sqrt(math.pi * radius**2 / count), voxel=1e-5, count=count,
            calibration=0.0, generator=generator,
        )  # fmt: skip
        seen.append(int(clouds.distinct) / count)
    samples = 1 - np.mean(seen)
    assert 0.07 < samples < 0.13
    assert image == pytest.approx(samples, rel=0.25)


@pytest.mark.parametrize("behind", [1.0, math.inf, 0.0])
def test_the_near_side_of_edges_is_lost_or_flies(behind: float) -> None:
    depth, on = _disc(0.1, 0.8, behind)
    share = _by_image(depth, _only(edge_lost=0.25, edge_flying=0.1))
    everything = _by_image(depth, _only(edge_lost=1.0))
    edge = (everything == LOST) & on
    np.testing.assert_allclose(everything[~edge], depth[~edge], rtol=1e-6)
    from_rim = 0.1 - np.hypot(U, V) * 0.8
    assert edge[on & (from_rim < 0.003)].all() and not edge[from_rim > 0.007].any()
    assert (share[edge] == LOST).mean() == pytest.approx(0.25, abs=0.05)
    behind_it = share[edge] - depth[edge]
    flies = behind_it > 1e-5
    assert flies.mean() == pytest.approx(0.1, abs=0.04)
    assert 0.015 < behind_it[flies].max() <= 0.0201
    np.testing.assert_allclose(share[~edge], depth[~edge], rtol=1e-6)


def test_pixels_without_depth_stay_and_no_error_changes_nothing() -> None:
    depth = _plane(0.8)
    depth[:10], depth[20, 30], depth[40:50, :20] = np.inf, np.nan, 0.0
    np.testing.assert_allclose(_by_image(depth, EXACT), depth, rtol=1e-6)
    noisy = _by_image(depth, DepthNoise())
    invalid = ~(np.isfinite(depth) & (depth > 0))
    np.testing.assert_array_equal(noisy[invalid], depth[invalid])
    assert np.isfinite(noisy[~invalid]).all() and noisy.dtype == np.float32
    nothing = np.full((4, 5), np.inf, np.float32)
    np.testing.assert_array_equal(_by_image(nothing, DepthNoise()), nothing)


def test_disparity_comes_in_steps() -> None:
    noisy = _by_image(_plane(0.8), _only(disparity=0.05, quantum=1 / 32))
    steps = 33.8 / noisy * 32
    assert np.abs(steps - np.round(steps)).max() < 1e-3
    assert len(np.unique(np.round(steps))) > 5


def test_the_generator_decides_everything() -> None:
    depth, _ = _disc(0.1, 0.8, 1.0)
    first = _by_image(depth, DepthNoise(), seed=1)
    np.testing.assert_array_equal(first, _by_image(depth, DepthNoise(), seed=1))
    assert (first != _by_image(depth, DepthNoise(), seed=2)).mean() > 0.5
