"""The training camera against Drake's rendered depth of the same scenes.

Drake's VTK renderer gives exact depth images (848 x 480, no noise) of the meshes; the training
camera sees 2,000 surface samples of each.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from pydrake.geometry import (
    ClippingRange,
    DepthRange,
    DepthRenderCamera,
    GeometryInstance,
    Mesh,
    PerceptionProperties,
    RenderCameraCore,
    SceneGraph,
)
from pydrake.math import RigidTransform
from pydrake.systems.sensors import CameraInfo
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from iga_drake.dataset.depth_camera import visible
from iga_drake.shapes.families import FAMILIES
from iga_drake.station.cameras.rgbd import add_renderer, look_at

# Drake's renderer looks through the middle of a pixel: the first one's is (0.5, 0.5).
INFO = CameraInfo(848, 480, 615.0, 615.0, 424.0, 240.0)
SAMPLES = 2000
SAME = 0.0015  # m, by which a sample's depth may differ from that of the surface in its pixel
# Each scene's objects; the second stands beside, before or behind the first.
SCENES = [
    ("mug", "chair"), ("kettle", "hammer"), ("basket", "spoon"), ("bowl", "mug"), ("watering_can",),
    ("shoe", "plate"),
]  # fmt: skip


@dataclass(frozen=True)
class Scene:
    points: torch.Tensor  # (1, O, P, 3)
    normals: torch.Tensor
    spacing: torch.Tensor  # (1, O)
    cameras: np.ndarray  # (K, 3)
    drake_sees: np.ndarray  # (K, O, P) bool
    drake_clouds: list[np.ndarray]  # of each camera (n, 3) m
    scale: float  # m, largest extent of an object


def _meshes(names: tuple[str, ...], rng: np.random.Generator) -> list[trimesh.Trimesh]:
    meshes = []
    for place, name in enumerate(names):
        surface = FAMILIES[name].surface(FAMILIES[name].sample_parameters(rng))
        mesh = trimesh.Trimesh(surface.vertices, surface.faces, process=False)
        mesh.apply_scale(rng.uniform(0.12, 0.26) / mesh.extents.max())
        mesh.apply_translation(-mesh.bounds.mean(0))
        turn = np.eye(4)
        turn[:3, :3] = Rotation.random(rng=rng).as_matrix()
        turn[:3, 3] = place * Rotation.random(rng=rng).as_matrix()[0] * rng.uniform(0.1, 0.17)
        mesh.apply_transform(turn)
        meshes.append(mesh)
    return meshes


def _render(meshes: list[trimesh.Trimesh], cameras: np.ndarray, folder: Path) -> list:
    """Of each camera its pose X_WC and Drake's depth image (480, 848) m."""
    scene_graph = SceneGraph()
    add_renderer(scene_graph)
    source = scene_graph.RegisterSource("scene")
    for number, mesh in enumerate(meshes):
        path = folder / f"{number}.obj"
        mesh.export(path, include_normals=True)
        geometry = GeometryInstance(RigidTransform(), Mesh(str(path)), f"object{number}")
        geometry.set_perception_properties(PerceptionProperties())
        scene_graph.RegisterAnchoredGeometry(source, geometry)
    query = scene_graph.get_query_output_port().Eval(scene_graph.CreateDefaultContext())
    core = RenderCameraCore("vtk", INFO, ClippingRange(0.01, 10.0), RigidTransform())
    camera = DepthRenderCamera(core, DepthRange(0.1, 5.0))
    middle = np.mean([mesh.bounds for mesh in meshes], axis=(0, 1))
    images = []
    for position in cameras:
        X_WC = look_at(position, middle)
        image = query.RenderDepthImage(camera, scene_graph.world_frame_id(), X_WC)
        images.append((X_WC, image.data[:, :, 0].copy()))
    return images


def _shown(
    image: np.ndarray, X_WC: RigidTransform, points: np.ndarray, normals: np.ndarray
) -> np.ndarray:
    """Which points (n, 3) face the camera and lie on the surface that their pixel shows.

    A sample is up to 0.71 pixels off the pixel's centre: on a slanted surface its depth differs.
    """
    rays = X_WC.inverse().multiply(points.T)
    across = X_WC.rotation().inverse().multiply(normals.T)
    x, y, z = rays
    facing = -(rays * across).sum(0)
    cosine = facing / np.linalg.norm(rays, axis=0)
    slant = np.sqrt(1 - cosine**2) / np.maximum(cosine, 0.02)
    column = np.floor(INFO.focal_x() * x / z + INFO.center_x()).astype(int)
    row = np.floor(INFO.focal_y() * y / z + INFO.center_y()).astype(int)
    inside = (column >= 0) & (column < INFO.width()) & (row >= 0) & (row < INFO.height())
    inside &= facing > 0
    shown = np.zeros(len(points), bool)
    error = np.abs(z[inside] - image[row[inside], column[inside]])
    shown[inside] = error < SAME + (0.71 * z * slant)[inside] / INFO.focal_x()
    return shown


def _back_projected(image: np.ndarray, X_WC: RigidTransform) -> np.ndarray:
    row, column = np.nonzero(np.isfinite(image) & (image > 0))
    z = image[row, column]
    x = (column + 0.5 - INFO.center_x()) / INFO.focal_x() * z
    y = (row + 0.5 - INFO.center_y()) / INFO.focal_y() * z
    return X_WC.multiply(np.stack((x, y, z))).T


@pytest.fixture(scope="module")
def scenes(tmp_path_factory: pytest.TempPathFactory) -> list[Scene]:
    made = []
    for number, names in enumerate(SCENES):
        rng = np.random.default_rng([7, number])
        meshes = _meshes(names, rng)
        samples = [trimesh.sample.sample_surface(m, SAMPLES, seed=number) for m in meshes]
        points = np.stack([place for place, _ in samples])
        normals = np.stack(
            [m.face_normals[face] for m, (_, face) in zip(meshes, samples, strict=True)]
        )
        rays = rng.normal(size=(3, 3)) * (1, 1, 0.6)
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        cameras = points.mean((0, 1)) + rays * rng.uniform(0.75, 1.1, (3, 1))
        images = _render(meshes, cameras, tmp_path_factory.mktemp("meshes"))
        for _, image in images:  # nothing is cut off by the image's edge
            border = np.concatenate((image[0], image[-1], image[:, 0], image[:, -1]))
            assert not np.isfinite(border).any()
            assert np.isfinite(image).sum() > 2000
        flat = points.reshape(-1, 3), normals.reshape(-1, 3)
        sees = [_shown(image, X_WC, *flat) for X_WC, image in images]
        made.append(
            Scene(
                points=torch.from_numpy(points.astype(np.float32))[None],
                normals=torch.from_numpy(normals.astype(np.float32))[None],
                spacing=torch.tensor([[np.sqrt(m.area / SAMPLES) for m in meshes]]).float(),
                cameras=cameras,
                drake_sees=np.stack(sees).reshape(3, len(meshes), SAMPLES),
                drake_clouds=[_back_projected(image, X_WC) for X_WC, image in images],
                scale=max(m.extents.max() for m in meshes),
            )
        )
    return made


Camera = Callable[[Scene], np.ndarray]


def _training_camera(scene: Scene) -> np.ndarray:
    cameras = torch.from_numpy(scene.cameras.astype(np.float32))[None]
    return visible(scene.points, scene.normals, cameras, spacing=scene.spacing)[0].numpy()


def _culling_alone(scene: Scene) -> np.ndarray:
    rays = scene.points[0].numpy() - scene.cameras[:, None, None]
    return (rays * scene.normals[0].numpy()).sum(-1) < 0


def _everything(scene: Scene) -> np.ndarray:
    return np.ones_like(scene.drake_sees)


def _self_occlusion_alone(scene: Scene) -> np.ndarray:
    cameras = torch.from_numpy(scene.cameras.astype(np.float32))[None]
    cameras = cameras.expand(scene.points.shape[1], -1, -1)
    each = visible(
        scene.points.transpose(0, 1),
        scene.normals.transpose(0, 1),
        cameras,
        spacing=scene.spacing.T,
    )
    return each[:, :, 0].transpose(0, 1).numpy()


def _disagreement(scenes: list[Scene], camera: Camera) -> tuple[float, float]:
    """Samples that only the camera sees and that only Drake sees, as shares of Drake's."""
    only_camera = only_drake = total = 0
    for scene in scenes:
        mask = camera(scene)
        only_camera += int((mask & ~scene.drake_sees).sum())
        only_drake += int((~mask & scene.drake_sees).sum())
        total += int(scene.drake_sees.sum())
    return only_camera / total, only_drake / total


def _distances(scenes: list[Scene], camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Distances (m) of the camera's points to Drake's cloud, and of Drake's to the camera's in
    units of the samples' spacing."""
    forth, back = [], []
    for scene in scenes:
        mask = camera(scene)
        for k, cloud in enumerate(scene.drake_clouds):
            ours = scene.points[0].numpy()[mask[k]]
            forth.append(cKDTree(cloud).query(ours)[0])
            back.append(cKDTree(ours).query(cloud)[0] / float(scene.spacing.max()))
    return np.concatenate(forth), np.concatenate(back)


def test_the_same_samples_are_seen(scenes: list[Scene]) -> None:
    only_camera, only_drake = _disagreement(scenes, _training_camera)
    print(f"seen by the training camera alone {only_camera:.2%}, by Drake alone {only_drake:.2%}")
    assert only_camera < 0.09
    assert only_drake < 0.1


def test_both_clouds_lie_on_each_other(scenes: list[Scene]) -> None:
    forth, back = _distances(scenes, _training_camera)
    print(f"training -> Drake, m: mean {forth.mean():.5f}, 95 % {np.quantile(forth, 0.95):.5f}")
    print(
        f"Drake -> training, spacings: mean {back.mean():.2f}, 95 % {np.quantile(back, 0.95):.2f}"
    )
    assert forth.mean() < 0.002
    assert np.quantile(forth, 0.95) < 0.005
    assert back.mean() < 0.8
    assert np.quantile(back, 0.95) < 1.8


@pytest.mark.parametrize("broken", [_everything, _culling_alone, _self_occlusion_alone])
def test_a_camera_without_occlusion_is_found_out(scenes: list[Scene], broken: Camera) -> None:
    """The bounds above tell broken cameras from the real one."""
    only_camera, _ = _disagreement(scenes, broken)
    print(f"{broken.__name__}: {only_camera:.2%} seen that Drake doesn't see")
    assert only_camera > 0.12
