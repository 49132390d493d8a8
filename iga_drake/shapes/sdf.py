"""Writes a shape as SDF text that Drake loads: one model, one link, meshes beside it.

The visual mesh carries normals with creases kept sharp. The collision geometry is the instance's
convex pieces, rigid hydroelastic: a compliant finger pad gets a hydroelastic contact surface with
them, anything else rigid falls back to point contact. Pieces may be soft instead.
"""

import hashlib
import os
import re
import shutil
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from iga_drake.files import write_text
from iga_drake.shapes.errors import ShapeError
from iga_drake.shapes.instance import ShapeInstance

_CREASE = np.radians(40.0)


@dataclass(frozen=True, kw_only=True)
class Softness:
    """How a collision piece gives way, in place of a rigid one."""

    # Pressure (Pa) at the piece's middle in contact surfaces, which it has with what is
    # hydroelastic too; from 0 at its surface.
    modulus: float
    # Force (N) per penetration (m) at contact points, which it has with everything else.
    stiffness: float
    # Coulomb coefficient, in place of the object's.
    friction: float


def write_sdf(
    instance: ShapeInstance,
    folder: Path | str,
    *,
    name: str,
    color: tuple[float, float, float] = (0.8, 0.8, 0.8),
    friction: float = 0.8,
    soft: Mapping[int, Softness] | None = None,
) -> str:
    """Writes the meshes of `instance` below `folder` and returns SDF text that refers to them.

    Args:
      folder: holds a subfolder for each distinct shape, named after its content; a shape that is
        there already is used as it is, so many processes may share the folder.
      name: of the model and its link.
      color: diffuse, r, g, b in [0, 1].
      friction: Coulomb coefficient, static = dynamic. Drake combines two bodies' coefficients a, b
        into 2 a b / (a + b).
      soft: the convex pieces that are not rigid, by their index.
    """
    meshes = _write_meshes(instance, Path(folder))
    return _sdf(instance, f"file://{meshes}", name=name, color=color, friction=friction, soft=soft)


def write_sdf_file(
    instance: ShapeInstance,
    folder: Path | str,
    *,
    name: str,
    color: tuple[float, float, float] = (0.8, 0.8, 0.8),
    friction: float = 0.8,
) -> Path:
    """Writes `folder`/`name`.sdf and its meshes, and returns the file's path.

    The file refers to the meshes by relative paths, so that the folder can be moved, and holds the
    instance's named frames, which `write_sdf` leaves out.

    Raises `ShapeError` where `name` can't be a model's, a file's and a link's name.
    """
    if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_-]*", name) or name == "world":
        raise ShapeError(
            f"name {name!r}: expected letters, digits, _ and -, a letter first, and not 'world'"
        )
    if name in instance.frames:
        raise ShapeError(
            f"name '{name}': {instance.family} has a frame of this name; choose another one than "
            f"{', '.join(sorted(instance.frames))}"
        )
    folder = Path(folder)
    meshes = _write_meshes(instance, folder)
    text = _sdf(
        instance, meshes.name, name=name, color=color, friction=friction, frames=instance.frames
    )
    path = folder / f"{name}.sdf"
    write_text(path, text)
    return path


def _sdf(
    instance: ShapeInstance,
    meshes: str,
    *,
    name: str,
    color: tuple[float, float, float],
    friction: float,
    frames: Mapping[str, np.ndarray] | None = None,
    soft: Mapping[int, Softness] | None = None,
) -> str:
    """SDF text; `meshes` is the URI of the folder with visual.obj and piece_<i>.obj."""
    mass = instance.mass_properties
    inertia = mass.I_CcmO
    r, g, b = color
    pieces = "".join(
        f"""
      <collision name="piece_{index}">
        <geometry><mesh>
          <uri>{meshes}/piece_{index}.obj</uri><drake:declare_convex/>
        </mesh></geometry>
        <drake:proximity_properties>{_contact(friction, (soft or {}).get(index))}
        </drake:proximity_properties>
      </collision>"""
        for index in range(len(instance.convex_pieces))
    )
    named = "".join(
        f"""
    <frame name="{frame}" attached_to="{name}">
      <pose relative_to="{name}" rotation_format="quat_xyzw">{_pose(X_OF)}</pose>
    </frame>"""
        for frame, X_OF in (frames or {}).items()
    )
    x, y, z = mass.p_OCcm
    return f"""<?xml version="1.0"?>
<sdf version="1.10" xmlns:drake="http://drake.mit.edu">
  <model name="{name}">
    <link name="{name}">
      <inertial>
        <pose>{x:.9g} {y:.9g} {z:.9g} 0 0 0</pose>
        <mass>{mass.mass:.9g}</mass>
        <inertia>
          <ixx>{inertia[0, 0]:.9g}</ixx><iyy>{inertia[1, 1]:.9g}</iyy><izz>{inertia[2, 2]:.9g}</izz>
          <ixy>{inertia[0, 1]:.9g}</ixy><ixz>{inertia[0, 2]:.9g}</ixz><iyz>{inertia[1, 2]:.9g}</iyz>
        </inertia>
      </inertial>
      <visual name="surface">
        <geometry><mesh><uri>{meshes}/visual.obj</uri></mesh></geometry>
        <material><diffuse>{r:.4g} {g:.4g} {b:.4g} 1</diffuse></material>
      </visual>{pieces}
    </link>{named}
  </model>
</sdf>
"""


def _contact(friction: float, softness: Softness | None) -> str:
    """The proximity properties of one collision piece."""
    kind = "<drake:rigid_hydroelastic/>"
    if softness is not None:
        friction = softness.friction
        kind = f"""<drake:compliant_hydroelastic/>
          <drake:hydroelastic_modulus>{softness.modulus:.6g}</drake:hydroelastic_modulus>
          <drake:point_contact_stiffness>{softness.stiffness:.6g}</drake:point_contact_stiffness>"""
    return f"""
          {kind}
          <drake:mu_static>{friction:.4g}</drake:mu_static>
          <drake:mu_dynamic>{friction:.4g}</drake:mu_dynamic>"""


def _pose(X: np.ndarray) -> str:
    """x y z qx qy qz qw of a transform (4, 4)."""
    quaternion = Rotation.from_matrix(X[:3, :3]).as_quat()
    return " ".join(f"{value:.12g}" for value in (*X[:3, 3], *quaternion))


def _write_meshes(instance: ShapeInstance, folder: Path) -> Path:
    """The folder with visual.obj and piece_<i>.obj, made whole or not at all."""
    target = folder.resolve() / f"{instance.family}-{_digest(instance)}"
    if target.is_dir():
        return target
    folder.mkdir(parents=True, exist_ok=True)
    temporary = Path(tempfile.mkdtemp(prefix=f".{target.name}-", dir=folder))
    try:
        (temporary / "visual.obj").write_text(visual_obj(instance.mesh))
        for index, piece in enumerate(instance.convex_pieces):
            hull = trimesh.convex.convex_hull(piece)
            (temporary / f"piece_{index}.obj").write_text(_obj(hull.vertices, hull.faces))
        temporary.chmod(0o755)
        try:
            os.rename(temporary, target)
        except OSError:  # another process was quicker
            if not target.is_dir():
                raise
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
    return target


def _digest(instance: ShapeInstance) -> str:
    digest = hashlib.sha256(b"1")  # rises when what is written changes
    for array in (instance.vertices, instance.faces, *instance.convex_pieces):
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()[:16]


def visual_obj(mesh: trimesh.Trimesh) -> str:
    """An .obj whose normals are averaged over a vertex's faces that meet at less than a crease."""
    corner_normals = _corner_normals(mesh)
    keys, index = np.unique(np.round(corner_normals.reshape(-1, 3), 5), axis=0, return_inverse=True)
    return _obj(mesh.vertices, mesh.faces, keys, index.reshape(-1, 3))


def _corner_normals(mesh: trimesh.Trimesh) -> np.ndarray:
    """(F, 3, 3) unit normal of each corner of each face."""
    faces = mesh.vertex_faces[mesh.faces]  # (F, 3, n) faces around each corner's vertex, -1 padded
    normals = np.vstack([mesh.face_normals, np.zeros(3)])[faces]  # (F, 3, n, 3)
    area = np.append(mesh.area_faces, 0.0)[faces]
    cosine = np.einsum("fknd,fd->fkn", normals, mesh.face_normals)
    weight = np.where(cosine > np.cos(_CREASE), area, 0.0)
    total = np.einsum("fkn,fknd->fkd", weight, normals)
    return total / np.linalg.norm(total, axis=-1, keepdims=True)


def _obj(
    vertices: np.ndarray,
    faces: np.ndarray,
    normals: np.ndarray | None = None,
    normal_index: np.ndarray | None = None,
) -> str:
    lines = [f"v {x:.7f} {y:.7f} {z:.7f}" for x, y, z in vertices]
    if normals is None or normal_index is None:
        lines += [f"f {a} {b} {c}" for a, b, c in faces + 1]
    else:
        lines += [f"vn {x:.5f} {y:.5f} {z:.5f}" for x, y, z in normals]
        lines += [
            "f " + " ".join(f"{v}//{n}" for v, n in zip(face, corner, strict=True))
            for face, corner in zip(faces + 1, normal_index + 1, strict=True)
        ]
    return "\n".join(lines) + "\n"
