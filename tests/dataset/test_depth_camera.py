"""The training camera against analytic visibility, and its noise against its formulas."""

import dataclasses
import math

import numpy as np
import pytest
import torch

from iga_drake.dataset.depth_camera import CameraError, observe, random_voxel_indices, visible
from iga_drake.dataset.depth_noise import DepthNoise

NO_ERROR = DepthNoise(
    disparity=0, patch_disparity=0, quantum=1e-6, grazing_kept=-0.9, grazing_lost=-1.0, edge_lost=0,
    edge_flying=0,
)  # fmt: skip


def _generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def _sphere(count: int, radius: float, centre=(0.0, 0.0, 0.0)) -> tuple[torch.Tensor, torch.Tensor]:
    """Uniform samples (count, 3) of a sphere and their normals."""
    normals = torch.randn(count, 3, generator=_generator())
    normals = normals / normals.norm(dim=1, keepdim=True)
    return normals * radius + torch.tensor(centre), normals


def _ball_spacing(count: int, radius: float) -> float:
    return math.sqrt(4 * math.pi * radius**2 / count)


@pytest.mark.parametrize("radius", [0.04, 0.17])
@pytest.mark.parametrize("distance", [0.5, 1.1])
def test_a_sphere_shows_its_near_cap(radius: float, distance: float) -> None:
    points, normals = _sphere(2000, radius)
    direction = torch.nn.functional.normalize(torch.tensor([1.0, -2.0, 0.5]), dim=0)
    mask = visible(
        points[None, None],
        normals[None, None],
        (direction * distance)[None, None],
        spacing=_ball_spacing(2000, radius),
    )[0, 0, 0]
    # Seen from distance d, the cap of a sphere of radius r is height > r^2 / d.
    height, horizon = points @ direction, radius**2 / distance
    assert not mask[height < horizon].any()
    assert mask[height > horizon].float().mean() > 0.95


def test_the_front_ball_hides_the_shadow_behind_it() -> None:
    """Two balls in line: of the far one only what lies outside the near one's cone is seen."""
    near, normals_near = _sphere(2000, 0.05, (0.0, 0.0, 0.15))
    far, normals_far = _sphere(2000, 0.1, (0.0, 0.0, -0.15))
    camera = torch.tensor([0.0, 0.0, 0.85])
    spacing = torch.tensor([[_ball_spacing(2000, 0.05), _ball_spacing(2000, 0.1)]])
    mask = visible(
        torch.stack((near, far))[None],
        torch.stack((normals_near, normals_far))[None],
        camera[None, None],
        spacing=spacing,
    )[0, 0]
    rays = far - camera
    facing = (rays * normals_far).sum(1) < 0
    sine = 0.05 / 0.7  # half the angle of the near ball's cone
    across = rays[:, :2].norm(dim=1) / rays.norm(dim=1)
    assert mask[1][facing & (across < 0.9 * sine)].float().mean() < 0.02
    assert mask[1][facing & (across > 1.1 * sine)].float().mean() > 0.95
    facing = ((near - camera) * normals_near).sum(1) < 0
    assert mask[0][facing].float().mean() > 0.97


def test_a_slanted_plate_does_not_hide_itself() -> None:
    """A thin closed plate seen at 75 degrees from its normal: all of its top."""
    u = torch.rand(4000, 2, generator=_generator()) * 0.2 - 0.1
    top = torch.tensor([0.0, 0.0, 1.0]).expand(2000, 3)
    points = torch.cat((u, torch.full((4000, 1), 0.002)), 1)
    points[2000:, 2] = -0.002
    normals = torch.cat((top, -top))
    tilt = math.radians(75)
    camera = 0.8 * torch.tensor([math.sin(tilt), 0.0, math.cos(tilt)])
    spacing = math.sqrt(2 * 0.04 / 4000)
    mask = visible(points[None, None], normals[None, None], camera[None, None], spacing=spacing)
    assert mask[0, 0, 0, :2000].float().mean() > 0.97
    assert not mask[0, 0, 0, 2000:].any()


def test_scenes_cameras_and_objects_do_not_mix() -> None:
    """A batch gives what its scenes give one by one."""
    points, normals = _sphere(4 * 2 * 300, 1.0)
    normals = normals.reshape(4, 2, 300, 3)
    centres = torch.randn(4, 2, 1, 3, generator=_generator(1)) * 0.08
    points = normals * 0.06 + centres
    cameras = torch.randn(4, 3, 3, generator=_generator(2))
    cameras = 0.8 * cameras / cameras.norm(dim=-1, keepdim=True)
    whole = visible(points, normals, cameras, spacing=0.01)
    for s in range(4):
        for k in range(3):
            one = visible(
                points[s : s + 1], normals[s : s + 1], cameras[s : s + 1, k : k + 1], spacing=0.01
            )
            torch.testing.assert_close(one[0, 0], whole[s, k])
    # The order of the objects changes nothing.
    swapped = visible(points.flip(1), normals.flip(1), cameras, spacing=0.01)
    torch.testing.assert_close(swapped.flip(2), whole)


def test_exact_observation_is_a_choice_of_visible_samples() -> None:
    points, normals = _sphere(2000, 0.08)
    cameras = torch.tensor([[[0.0, 0.0, 0.8], [0.7, 0.0, 0.0]]])
    arguments = (points[None, None], normals[None, None], cameras)
    spacing = _ball_spacing(2000, 0.08)
    seen = visible(*arguments, spacing=spacing)[0, :, 0].any(0)
    for noise, tolerance in ((None, 1e-7), (NO_ERROR, 1e-5)):
        clouds = observe(
            *arguments, spacing=spacing, voxel=0.005, count=256, noise=noise, calibration=0.0,
            generator=_generator(),
        )  # fmt: skip
        index = clouds.index[0, 0]
        assert seen[index].all()
        assert (clouds.points[0, 0] - points[index]).abs().max() <= tolerance
        cells = np.floor(points[seen].numpy() / 0.005).astype(int)
        assert abs(int(clouds.distinct) - len(np.unique(cells, axis=0))) <= 1
        assert len(set(index.tolist())) == 256


def test_few_points_repeat_evenly_and_nothing_seen_is_zero() -> None:
    points, normals = _sphere(40, 0.05)
    cameras = torch.tensor([[[0.0, 0.0, 0.8]]])
    scene = (points.expand(1, 1, 40, 3), normals.expand(1, 1, 40, 3), cameras)
    clouds = observe(
        *scene, spacing=0.03, voxel=0.005, count=100, noise=None, generator=_generator()
    )
    counts = np.unique(clouds.index.numpy(), return_counts=True)[1]
    assert len(counts) == int(clouds.distinct) < 40
    assert counts.max() - counts.min() <= 1
    inside_out = (scene[0], -scene[1], cameras)
    far_side_only = torch.cat((scene[0], scene[0])), torch.cat((scene[1], -scene[1].abs()))
    for case in (inside_out, (*far_side_only, cameras.expand(2, 1, 3))):
        clouds = observe(
            *case, spacing=0.03, voxel=0.005, count=10, noise=None, generator=_generator()
        )
        empty = clouds.distinct == 0
        assert torch.isfinite(clouds.points).all()
        assert not clouds.points[empty].any() and not clouds.index[empty].any()


def _plate_depths(noise: DepthNoise, z: float, calibration: float = 0.0) -> np.ndarray:
    """Measured depths of a plate across the optical axis at z, by many cameras."""
    u = torch.rand(1500, 2, generator=_generator(3)) * 0.2 - 0.1
    points = torch.cat((u, torch.zeros(1500, 1)), 1)[None, None]
    normals = torch.tensor([0.0, 0.0, 1.0]).expand(1, 1, 1500, 3)
    depths = []
    for seed in range(20):
        clouds = observe(
            points, normals, torch.tensor([[[0.0, 0.0, z]]]),
            spacing=0.005, voxel=1e-4, count=1000, noise=noise, calibration=calibration,
            generator=_generator(seed),
        )  # fmt: skip
        depths.append(z - clouds.points[0, 0, :, 2].numpy())
    return np.stack(depths)


@pytest.mark.parametrize("z", [0.5, 1.0])
def test_depth_error_is_that_of_the_disparity(z: float) -> None:
    noise = DepthNoise(
        disparity=0.05, patch_disparity=0.05, quantum=1e-6, edge_lost=0, edge_flying=0
    )  # fmt: skip
    error = _plate_depths(noise, z) - z
    assert error.std() == pytest.approx(z * z * math.hypot(0.05, 0.05) / 33.8, rel=0.05)
    assert abs(error.mean()) < 0.1 * error.std()


def test_disparity_is_quantised() -> None:
    noise = DepthNoise(patch_disparity=0, edge_lost=0, edge_flying=0)
    steps = 33.8 / _plate_depths(noise, 0.8) * 32
    assert np.abs(steps - np.round(steps)).max() < 0.02
    assert len(np.unique(np.round(steps))) > 5


def test_a_camera_is_misplaced_as_a_whole() -> None:
    depth = _plate_depths(NO_ERROR, 0.8, calibration=0.002)
    assert depth.std(1).max() < 1e-5
    assert 0.001 < depth.mean(1).std() < 0.003


def test_grazing_surfaces_and_edges_are_lost_and_some_edge_points_fly() -> None:
    points, normals = _sphere(2000, 0.1)
    scene = (points[None, None], normals[None, None], torch.tensor([[[0.0, 0.0, 0.8]]]))

    def look(noise: DepthNoise) -> tuple[torch.Tensor, torch.Tensor]:
        clouds = observe(
            *scene, spacing=_ball_spacing(2000, 0.1), voxel=1e-4, count=2000, noise=noise,
            calibration=0.0, generator=_generator(),
        )  # fmt: skip
        index, first = np.unique(clouds.index.numpy(), return_index=True)
        return torch.from_numpy(index), clouds.points[0, 0][torch.from_numpy(first)]

    rays = points - torch.tensor([0.0, 0.0, 0.8])
    cosine = -(rays * normals).sum(1) / rays.norm(dim=1)
    everything, _ = look(NO_ERROR)
    assert (cosine[everything] < 0.1).any()
    kept, _ = look(dataclasses.replace(NO_ERROR, grazing_kept=0.5, grazing_lost=0.2))
    assert cosine[kept].min() >= 0.2
    assert set(everything[cosine[everything] > 0.5].tolist()) <= set(kept.tolist())
    kept, _ = look(dataclasses.replace(NO_ERROR, edge_lost=1.0))
    lost = sorted(set(everything.tolist()) - set(kept.tolist()))
    assert len(lost) > 20 and cosine[lost].max() < 0.7  # the silhouette
    index, place = look(dataclasses.replace(NO_ERROR, edge_flying=1.0, flying=0.03))
    behind = (place - points[index]).norm(dim=1)
    assert 0.02 < behind.max() <= 0.03 * 1.03
    assert behind[cosine[index] > 0.7].max() < 1e-4


def test_the_generator_decides_everything() -> None:
    points, normals = _sphere(500, 0.08)
    scene = (points[None, None], normals[None, None], torch.tensor([[[0.0, 0.0, 0.8]]]))

    def look(seed: int) -> torch.Tensor:
        return observe(
            *scene, spacing=0.01, voxel=0.005, count=64, noise=DepthNoise(),
            generator=_generator(seed),
        ).points  # fmt: skip

    assert torch.equal(look(1), look(1))
    assert not torch.equal(look(1), look(2))


def test_one_point_of_every_voxel_of_every_cloud() -> None:
    points = torch.randn(5000, 3, generator=_generator()) * 0.03
    cloud = torch.randint(4, (5000,), generator=_generator(1))
    index = random_voxel_indices(points, cloud, 0.01, _generator(2))
    key = torch.cat((cloud[:, None], torch.floor(points / 0.01).long()), 1).numpy()
    assert len(np.unique(key[index], axis=0)) == len(index) == len(np.unique(key, axis=0))
    assert (cloud[index].diff() >= 0).all()
    # Each point of a voxel is as likely as another.
    two = torch.tensor([[0.001, 0, 0], [0.002, 0, 0]])
    one = torch.zeros(2, dtype=torch.int64)
    drawn = [int(random_voxel_indices(two, one, 0.01, _generator(k))[0]) for k in range(200)]
    assert 70 < sum(drawn) < 130


def test_wrong_shapes_are_refused() -> None:
    points = torch.zeros(2, 1, 5, 3)
    with pytest.raises(CameraError, match=r"points and normals: expected .* got \(2, 5, 3\)"):
        visible(points[:, 0], points[:, 0], torch.zeros(2, 3, 3), spacing=0.01)
    with pytest.raises(CameraError, match=r"cameras: expected \(2, cameras, 3\), got \(1, 3, 3\)"):
        visible(points, points, torch.zeros(1, 3, 3), spacing=0.01)
    with pytest.raises(CameraError, match=r"spacing: expected \(2, 1\)"):
        visible(points, points, torch.ones(2, 3, 3), spacing=torch.ones(2))
