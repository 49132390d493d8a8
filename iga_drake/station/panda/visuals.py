"""The Panda's published meshes, converted once so that Drake can draw them.

They are looked at, and nothing else: no mass, contact or cloud depends on them.
"""

import importlib.util
import math
import sys
from functools import cache
from pathlib import Path

from iga_drake.files import write_bytes
from iga_drake.paths import cache_dir

# Link -> mesh of the package. The right finger is the left one turned, which the loader does.
_MESHES = {
    **{f"panda_link{i}": f"link{i}" for i in range(8)},
    "panda_hand": "hand",
    "panda_leftfinger": "finger",
    "panda_rightfinger": "finger",
}
_VERSION = "4"  # of the conversion
# Share of the triangles of a part that are dropped if it has more than few, where the package
# fast-simplification is there; angle (rad) from which on an edge is seen as one.
_SHARE_DROPPED, _FEW_FACES, _CREASE = 0.75, 1500, math.radians(35.0)


def _source_dir() -> Path | None:
    """The folder of the .dae files, None where the package example-robot-data is missing."""
    relative = "share/example-robot-data/robots/panda_description/meshes/visual"
    for entry in sys.path:
        folder = Path(entry) / "cmeel.prefix" / relative
        if folder.is_dir():
            return folder
    return None


@cache
def mesh_visuals() -> dict[str, Path]:
    """Link name -> mesh file that Drake can draw; empty where the packages are missing."""
    source = _source_dir()
    if source is None or importlib.util.find_spec("collada") is None:
        return {}
    target = cache_dir() / f"panda_visuals_v{_VERSION}"
    target.mkdir(parents=True, exist_ok=True)
    for name in set(_MESHES.values()):
        if not (target / f"{name}.gltf").exists():
            _convert(source / f"{name}.dae", target / f"{name}.gltf")
    return {link: target / f"{name}.gltf" for link, name in _MESHES.items()}


def _convert(source: Path, target: Path) -> None:
    """Writes one .dae file as a glTF with everything embedded, y up as glTF wants it."""
    import trimesh

    scene = trimesh.load_scene(source)
    for name, geometry in scene.geometry.items():
        material = geometry.visual.material
        material.metallicFactor, material.roughnessFactor = 0.0, 0.6
        # The file has each triangle's corners for themselves: tenfold the points.
        mesh = trimesh.Trimesh(geometry.vertices, geometry.faces)
        if len(mesh.faces) > _FEW_FACES and importlib.util.find_spec("fast_simplification"):
            mesh = mesh.simplify_quadric_decimation(percent=_SHARE_DROPPED)
        mesh = trimesh.graph.smooth_shade(mesh, angle=_CREASE)
        mesh.visual = trimesh.visual.TextureVisuals(material=material)
        scene.geometry[name] = mesh
    scene.apply_transform(trimesh.transformations.rotation_matrix(-math.pi / 2, [1, 0, 0]))
    files = trimesh.exchange.gltf.export_gltf(scene, embed_buffers=True)
    write_bytes(target, files["model.gltf"])
