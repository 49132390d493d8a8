"""Contact sheets: many shapes side by side in one picture, drawn by Drake's renderer."""

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import trimesh
from pydrake.common import MemoryFile
from pydrake.geometry import (
    ClippingRange,
    ColorRenderCamera,
    GeometryInstance,
    InMemoryMesh,
    LightParameter,
    Mesh,
    PerceptionProperties,
    RenderCameraCore,
    RenderLabel,
    SceneGraph,
)
from pydrake.math import RigidTransform
from pydrake.systems.sensors import CameraInfo, ImageIo, ImageRgb8U

from iga_drake.shapes.errors import ShapeError
from iga_drake.shapes.families import FAMILIES
from iga_drake.shapes.instance import ShapeInstance
from iga_drake.viewing.rendering import headless_renderer

# One light tint a part label, in turn.
TINTS = (
    np.array(
        [
            [136, 180, 224],
            [246, 184, 120],
            [150, 208, 150],
            [226, 150, 160],
            [188, 168, 222],
            [214, 202, 118],
            [134, 208, 204],
            [218, 160, 206],
            [186, 186, 186],
            [190, 158, 130],
        ]
    )
    / 255.0
)
# A shape and how it is coloured: vertices (V, 3) m, faces (F, 3) and part labels (F,) int, or
# colours (V, 3) of the vertices or (F, 3) of the faces from 0 to 1, or None.
ColoredMesh = tuple[np.ndarray, np.ndarray, np.ndarray | None]
_DISTANCE = 30.0  # of the camera, in tiles: so far off that the view is nearly parallel
_SUPERSAMPLING = 2
# Directions of the light in the camera's frame: from above on the left, the right, from below.
_LIGHTS = ([0.5, 0.8, 1.0], [-0.9, 0.2, 0.6], [0.2, -0.8, 0.8])
_CREASE = np.cos(np.radians(40.0))  # faces that meet at a larger angle keep a sharp edge


def canonical_colors(canonical: np.ndarray) -> np.ndarray:
    """(V, 3) from 0 to 1: canonical positions (V, 3) as colours, the bounding box as the cube."""
    low, high = canonical.min(axis=0), canonical.max(axis=0)
    return (canonical - low) / np.maximum(high - low, 1e-9)


def contact_sheet(
    shapes: Sequence[ShapeInstance | ColoredMesh],
    *,
    columns: int = 6,
    tile_px: int = 200,
    azimuth: float = np.radians(-60.0),
    elevation: float = np.radians(28.0),
    same_scale: bool = False,
) -> np.ndarray:
    """(H, W, 3) uint8: the shapes in rows of `columns` tiles of `tile_px` x `tile_px` pixels.

    They are seen from `azimuth` about their z axis and `elevation` above their xy plane (rad), each
    filling its tile, or all at the `same_scale`, the largest filling its tile. Instances are
    coloured by part. Raises `ShapeError` where there is nothing to draw or colours don't fit.
    """
    if not shapes or columns < 1 or tile_px < 1:
        raise ShapeError(
            f"contact_sheet: {len(shapes)} shapes, {columns} columns, {tile_px} px a tile; "
            "each must be at least 1"
        )
    meshes = [_colored(shape, f"shapes[{index}]") for index, shape in enumerate(shapes)]
    rows = -(-len(meshes) // columns)
    R_CO = _view(azimuth, elevation)
    views = [vertices @ R_CO.T for vertices, _, _ in meshes]
    extents = [float(np.ptp(view[:, :2], axis=0).max()) for view in views]
    sizes = [max(extents)] * len(extents) if same_scale else extents
    corners, normals, colors = [], [], []
    for index, (view, (_, faces, color), size) in enumerate(zip(views, meshes, sizes, strict=True)):
        centre = (view.min(axis=0) + view.max(axis=0)) / 2
        tile = [index % columns - (columns - 1) / 2, index // columns - (rows - 1) / 2, 0.0]
        placed = (view - centre) * (0.88 / max(size, 1e-9)) + tile
        corners.append(placed[faces].reshape(-1, 3))
        normals.append(_corner_normals(placed, faces).reshape(-1, 3))
        colors.append(color.reshape(-1, 3))
    document = _gltf(np.concatenate(corners), np.concatenate(normals), np.concatenate(colors))
    return _render(document, columns=columns, rows=rows, tile_px=tile_px)


def shape_sheet(
    family_name: str, count: int = 24, seed: int = 0, *, columns: int = 6, tile_px: int = 200
) -> np.ndarray:
    """(H, W, 3) uint8: `count` draws of a family. Raises `ShapeError` for an unknown one."""
    if family_name not in FAMILIES:
        raise ShapeError(f"unknown family '{family_name}'; known: {', '.join(sorted(FAMILIES))}")
    family = FAMILIES[family_name]
    rng = np.random.default_rng(seed)
    shapes = [family.build(family.sample_parameters(rng)) for _ in range(count)]
    return contact_sheet(shapes, columns=columns, tile_px=tile_px)


def add_view_shapes(parser: argparse.ArgumentParser) -> None:
    """Options of `iga view shapes`."""
    parser.add_argument(
        "--family", action="append", metavar="NAME", help="repeatable (default: every family)"
    )
    parser.add_argument("--out", type=Path, required=True, metavar="DIR")
    parser.add_argument("--count", type=int, default=24, help="products a sheet (default 24)")
    parser.add_argument("--seed", type=int, default=0)


def view_shapes(arguments: argparse.Namespace) -> int:
    """Writes one contact sheet a family; returns the exit status."""
    if arguments.count < 1:
        raise ShapeError(f"--count {arguments.count}: at least 1 is needed")
    for name in arguments.family or FAMILIES:
        path = arguments.out / f"{name}.png"
        write_png(shape_sheet(name, arguments.count, arguments.seed), path)
        print(f"written: {path}", flush=True)
    return 0


def write_png(image: np.ndarray, path: Path | str) -> None:
    """Writes (H, W, 3) uint8 as a PNG file; missing folders are made."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    height, width, _ = image.shape
    out = ImageRgb8U(width, height)
    out.mutable_data[:] = image
    ImageIo().Save(out, path.with_suffix(".png"))


def _view(azimuth: float, elevation: float) -> np.ndarray:
    """R_CO (3, 3) of an optical frame (x right, y down, z forward) that looks at the origin."""
    s, c = np.sin(azimuth), np.cos(azimuth)
    forward = -np.array([c * np.cos(elevation), s * np.cos(elevation), np.sin(elevation)])
    right = np.array([-s, c, 0.0])
    return np.stack([right, np.cross(forward, right), forward])


def _colored(
    shape: ShapeInstance | ColoredMesh, name: str
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices (V, 3), faces (F, 3) and the colour of each face's corners (F, 3, 3)."""
    if isinstance(shape, ShapeInstance):
        shape = (shape.vertices, shape.faces, shape.part_labels)
    vertices, faces = np.asarray(shape[0], dtype=np.float64), np.asarray(shape[1])
    colors = np.zeros(len(faces), dtype=int) if shape[2] is None else np.asarray(shape[2])
    if colors.shape == (len(faces),) and np.issubdtype(colors.dtype, np.integer):
        return vertices, faces, np.repeat(TINTS[colors % len(TINTS)][:, None], 3, axis=1)
    if colors.shape == vertices.shape:
        return vertices, faces, colors[faces]
    if colors.shape == faces.shape:
        return vertices, faces, np.repeat(colors[:, None], 3, axis=1)
    raise ShapeError(
        f"contact_sheet: {name}: colours {colors.shape} of {colors.dtype} for {len(vertices)} "
        f"vertices and {len(faces)} faces; expected labels (F,) int or colours (V, 3) or (F, 3)"
    )


def _corner_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(F, 3, 3) smoothed normals of each face's corners, the face's own beside a sharp edge."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    areas = np.cross(b - a, c - a)
    smooth = np.zeros_like(vertices)
    for k in range(3):
        np.add.at(smooth, faces[:, k], areas)
    flat = areas / np.maximum(np.linalg.norm(areas, axis=1, keepdims=True), 1e-30)
    smooth /= np.maximum(np.linalg.norm(smooth, axis=1, keepdims=True), 1e-30)
    sharp = np.einsum("fkd,fd->fk", smooth[faces], flat) < _CREASE
    return np.where(sharp[..., None], flat[:, None], smooth[faces])


def _gltf(corners: np.ndarray, normals: np.ndarray, colors: np.ndarray) -> bytes:
    """A glTF document of loose triangles: corners (3F, 3), their normals and colours."""
    # glTF's y is up: Drake turns what it reads by 90 degrees about x.
    turn = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    linear = np.clip(colors, 0.0, 1.0) ** 2.2
    rgba = np.concatenate([linear, np.ones((len(colors), 1))], axis=1)
    mesh = trimesh.Trimesh(
        vertices=corners @ turn.T,
        faces=np.arange(len(corners)).reshape(-1, 3),
        vertex_normals=normals @ turn.T,
        vertex_colors=np.round(255 * rgba).astype(np.uint8),
        process=False,
    )

    def matt(tree: dict) -> None:
        tree["materials"] = [
            {"pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 0.8}}
        ]
        for primitive in tree["meshes"][0]["primitives"]:
            primitive["material"] = 0

    files = trimesh.exchange.gltf.export_gltf(
        trimesh.Scene([mesh]), include_normals=True, embed_buffers=True, tree_postprocessor=matt
    )
    return files["model.gltf"]


def _render(document: bytes, *, columns: int, rows: int, tile_px: int) -> np.ndarray:
    """(H, W, 3) uint8 of a scene laid out in the camera's xy plane, one unit a tile."""
    scene_graph = SceneGraph()
    lights = [
        LightParameter(type="directional", frame="camera", direction=direction, intensity=intensity)
        for direction, intensity in zip(_LIGHTS, (2.0, 1.0, 1.2), strict=True)
    ]
    scene_graph.AddRenderer("vtk", headless_renderer(default_clear_color=[1, 1, 1], lights=lights))
    geometry = GeometryInstance(
        RigidTransform(),
        Mesh(InMemoryMesh(mesh_file=MemoryFile(document, ".gltf", "sheet"))),
        "sheet",
    )
    properties = PerceptionProperties()
    properties.AddProperty("label", "id", RenderLabel.kDontCare)
    geometry.set_perception_properties(properties)
    scene_graph.RegisterAnchoredGeometry(scene_graph.RegisterSource("sheet"), geometry)
    scale = _SUPERSAMPLING * tile_px
    width, height = columns * scale, rows * scale
    info = CameraInfo(
        width, height, scale * _DISTANCE, scale * _DISTANCE, (width - 1) / 2, (height - 1) / 2
    )
    clipping = ClippingRange(_DISTANCE - 5.0, _DISTANCE + 5.0)
    camera = ColorRenderCamera(RenderCameraCore("vtk", info, clipping, RigidTransform()))
    query = scene_graph.get_query_output_port().Eval(scene_graph.CreateDefaultContext())
    image = query.RenderColorImage(
        camera, scene_graph.world_frame_id(), RigidTransform([0.0, 0.0, -_DISTANCE])
    ).data[..., :3]
    blocks = image.reshape(rows * tile_px, _SUPERSAMPLING, columns * tile_px, _SUPERSAMPLING, 3)
    return np.round(blocks.mean(axis=(1, 3))).astype(np.uint8)
