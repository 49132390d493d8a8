"""Loads objects that others describe: SDF, URDF and Drake's model directives, with their meshes.

Drake draws and collides .obj (with normals), .gltf and .vtk meshes. Others are converted, and what
it would take silently for something else (a missing inertia is 1 kg and 1 kg m^2, an impossible one
is replaced) is refused with the reason and a remedy.
"""

import hashlib
import re
import shutil
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from urllib.parse import unquote, urlparse
from xml.sax.saxutils import escape

import numpy as np
import trimesh
from pydrake.geometry import (
    Box,
    Capsule,
    Convex,
    Cylinder,
    Ellipsoid,
    GeometryId,
    HalfSpace,
    Mesh,
    Role,
    SceneGraphInspector,
    Sphere,
)
from pydrake.math import RigidTransform
from pydrake.multibody.parsing import PackageMap, Parser
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, MultibodyPlant
from pydrake.multibody.tree import ModelInstanceIndex, RigidBody
from pydrake.systems.framework import Context, DiagramBuilder

from iga_drake.errors import error_text
from iga_drake.files import write_text
from iga_drake.paths import cache_dir
from iga_drake.shapes.convex_pieces import hull_of, joined
from iga_drake.shapes.instance import MassProperties, ShapeInstance
from iga_drake.shapes.mesh_cleaning import UP_AXES
from iga_drake.shapes.mesh_object import LARGEST
from iga_drake.shapes.sdf import visual_obj
from iga_drake.station.contract import StationError
from iga_drake.station.simulated.scene import SceneObject

# Kinds of model files, by the ends of their names.
MODEL_FILES = {".sdf": "sdf", ".urdf": "urdf", ".dmd.yaml": "dmd.yaml"}
_DRAWN = (".obj", ".gltf", ".vtk")
_CONVERTED = (".stl", ".ply", ".glb", ".dae", ".off")
_FIXED_LARGEST = 20.0  # m, of what is fixed to the world
# What is hollow has at most half the diagonal of its bounds for a radius of gyration.
_GYRATION = 2.0


@dataclass(frozen=True, kw_only=True)
class AddedObject:
    """An object in a plant."""

    base: RigidBody  # whose pose is the object's
    bodies: tuple[RigidBody, ...]
    fixed: bool  # to the world


def model_kind(path: Path | str) -> str | None:
    """ "sdf", "urdf" or "dmd.yaml" for the name of such a file, None for others."""
    name = str(path).lower()
    return next((kind for end, kind in MODEL_FILES.items() if name.endswith(end)), None)


def read_model(path: Path, packages: Mapping[str, Path] | None = None) -> str:
    """The text of a model file for `SceneObject.model`: its URIs absolute, its meshes usable.

    Args:
      packages: folders of the packages that URIs name, by name; besides, packages are a folder of
        that name above the file, those in ROS_PACKAGE_PATH, Drake's, and installed Python packages.

    Raises `StationError` that names the file, the reason and a remedy.
    """
    kind = model_kind(path)
    if kind is None:
        raise StationError(f"{path}: no model file; use one of {', '.join(MODEL_FILES)}")
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise StationError(f"{path}: can't be read ({error}): name the model's file") from error
    if kind == "dmd.yaml":
        return _directives(path, text, packages or {})
    return _usable(text, str(path), path.parent, packages or {})


def resolve_uri(uri: str, folder: Path | None, packages: Mapping[str, Path]) -> Path:
    """The file that a URI means: file://, package://, model://, a path (relative to `folder`).

    Raises `StationError` with the reason and a remedy.
    """
    parsed = urlparse(uri)
    if parsed.scheme in ("package", "model"):
        path = _package(parsed.netloc, folder, packages) / unquote(parsed.path).lstrip("/")
    elif parsed.scheme in ("file", ""):
        plain = uri.removeprefix("file://")
        path = Path(plain)
        if not path.exists() and Path(unquote(plain)).exists():
            path = Path(unquote(plain))
        if not path.is_absolute():
            if folder is None:
                raise StationError(
                    f"'{uri}' is relative and the model has no file: state file:///its/whole/path"
                )
            path = folder / path
    else:
        raise StationError(
            f"'{uri}': '{parsed.scheme}' is no kind of URI that is known; use file://, package:// "
            "or a path relative to the model's file"
        )
    if not path.exists():
        raise StationError(f"'{uri}' means {path}, which doesn't exist: mend the path")
    return path.resolve()


def _package(name: str, folder: Path | None, packages: Mapping[str, Path]) -> Path:
    if name in packages:
        return Path(packages[name])
    for above in (folder.resolve(), *folder.resolve().parents) if folder else ():
        if above.name == name:
            return above
    known = PackageMap()
    known.PopulateFromRosPackagePath()
    if known.Contains(name):
        try:
            return Path(known.GetPath(name))
        except RuntimeError as error:  # Drake downloads some
            raise StationError(f"package '{name}' can't be had: {error_text(error)}") from error
    try:
        spec = find_spec(name.replace("-", "_")) if name.replace("-", "_").isidentifier() else None
    except (ImportError, ValueError):
        spec = None
    if spec is not None and spec.submodule_search_locations:
        return Path(next(iter(spec.submodule_search_locations)))
    raise StationError(
        f"package '{name}' is unknown: state its folder (`packages: {{{name}: ...}}` in the task, "
        "or the environment variable ROS_PACKAGE_PATH), or install it"
    )


# The text of a model


def _directives(path: Path, text: str, packages: Mapping[str, Path]) -> str:
    """Directives whose files are usable copies, kept in the cache."""
    if "directives" not in text:
        raise StationError(
            f"{path}: no `directives:` in it: name a file of Drake's model directives"
        )

    def usable(match: re.Match) -> str:
        try:
            file = resolve_uri(match["uri"], path.parent, packages)
        except StationError as error:
            raise StationError(f"{path}: {error}") from error
        if model_kind(file) is None:
            return f"{match['key']}'file://{file}'"
        copy = _kept(read_model(file, packages), f"{file.stem.removesuffix('.dmd')}", file)
        return f"{match['key']}'file://{copy}'"

    return _DIRECTIVE_FILE.sub(usable, text)


_DIRECTIVE_FILE = re.compile(
    r"""(?P<key>\bfile:\s*)(?P<q>['"]?)(?P<uri>[^'",}\n]+?)(?P=q)(?=\s*[,}\n]|\s*$)"""
)


def _kept(text: str, name: str, file: Path | str) -> Path:
    """A file in the cache that holds `text`, of the same kind as `file`."""
    digest = hashlib.sha256(text.encode()).hexdigest()[:24]
    end = next(end for end in MODEL_FILES if str(file).lower().endswith(end))
    path = cache_dir() / "object_models" / digest / f"{name}{end}"
    if not path.is_file():
        write_text(path, text)
    return path


def _usable(text: str, where: str, folder: Path | None, packages: Mapping[str, Path]) -> str:
    """SDF or URDF text with absolute URIs and meshes that Drake takes; the rest as it was."""
    try:
        # Only looked at: prefixes that files use without declaring them are no matter.
        root = ElementTree.fromstring(re.sub(r"(</?\w+):(\w)", r"\1_\2", text.strip()))
    except ElementTree.ParseError as error:
        raise StationError(
            f"{where}: not XML ({error}): an SDF or URDF model, or a .dmd.yaml file, is expected"
        ) from error
    if root.tag not in ("sdf", "robot"):
        raise StationError(
            f"{where}: its root is <{root.tag}>: <sdf> or <robot> (URDF) is expected; export the "
            "model as one of these"
        )
    if root.find(".//link") is None and root.find(".//include") is None:
        raise StationError(f"{where}: it has no <link>: nothing to simulate; name another model")
    drawn: dict[str, bool] = {}
    for uri, look in _mesh_uris(root):
        drawn[uri] = drawn.get(uri, False) or look
    try:
        for uri, look in drawn.items():
            file = _usable_mesh(resolve_uri(uri, folder, packages), look)
            text = _with_uri(text, uri, file)
        for include in root.iter("include"):
            uri = (include.findtext("uri") or "").strip()
            text = _with_uri(text, uri, _included(resolve_uri(uri, folder, packages), packages))
        if re.search(r"<static>\s*(true|1)", text) is None:
            for link in root.iter("link"):
                _check_inertial(link, root.tag)
    except StationError as error:
        raise StationError(f"{where}: {error}") from error
    return text


def _with_uri(text: str, uri: str, file: Path) -> str:
    """XML text in which `uri` is that of a file, as an element's text or a mesh's file name."""
    quoted = re.escape(escape(uri))
    new = escape(f"file://{file}")
    text = re.sub(rf"(<uri>\s*){quoted}(\s*</uri>)", lambda m: m[1] + new + m[2], text)
    return re.sub(rf"""(filename\s*=\s*["']){quoted}(["'])""", lambda m: m[1] + new + m[2], text)


def _included(path: Path, packages: Mapping[str, Path]) -> Path:
    """A usable copy of a model that another includes: a file, or a folder with model.sdf."""
    file = path / "model.sdf" if path.is_dir() else path
    return _kept(read_model(file, packages), file.stem, file)


def _mesh_uris(root: ElementTree.Element) -> Iterator[tuple[str, bool]]:
    """The URI of each mesh, and whether it is drawn there."""
    for owner in root.iter():
        if owner.tag not in ("visual", "collision"):
            continue
        for mesh in owner.iter("mesh"):
            uris = [mesh.get("filename"), *(uri.text for uri in mesh.iter("uri"))]
            for uri in uris:
                if uri is not None:
                    yield uri.strip(), owner.tag == "visual"


def _check_inertial(link: ElementTree.Element, tag: str) -> None:
    """Raises `StationError` for an inertia that Drake would replace by another."""
    name = link.get("name", "")
    inertial = link.find("inertial")
    if inertial is None:
        return  # fine for what is fixed; `add_object` looks at the others
    inertia = inertial.find("inertia")
    mass = inertial.find("mass")
    keys = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
    try:
        if tag == "robot":
            kilograms = None if mass is None else float(mass.get("value", "nan"))
            values = None if inertia is None else [float(inertia.get(key, "0")) for key in keys]
        else:
            kilograms = None if mass is None else float(mass.text or "nan")
            values = None
            if inertia is not None:
                values = [float(inertia.findtext(key, "0") or "0") for key in keys]
    except ValueError as error:
        raise StationError(f"link '{name}': <inertial> holds no number ({error})") from error
    if kilograms is not None and not (np.isfinite(kilograms) and kilograms > 0):
        if tag == "robot" and kilograms == 0 and not any(values or ()):
            return  # URDF's way to say that a link is a mere frame
        raise StationError(f"link '{name}': a mass of {kilograms:g} kg; it has to be > 0")
    if values is None:
        return
    xx, yy, zz, xy, xz, yz = values
    moments = np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    if not (moments[0] > 0 and moments[0] + moments[1] >= moments[2] * (1 - 1e-6)):
        raise StationError(
            f"link '{name}': no body has the principal moments of inertia "
            f"{', '.join(f'{value:.3g}' for value in moments)} kg m^2 (each has to be > 0 and at "
            "most the sum of the others): compute them anew"
        )


def _usable_mesh(path: Path, drawn: bool) -> Path:
    """The mesh's own file, or one that Drake takes, made once from it. Raises `StationError`."""
    suffix = path.suffix.lower()
    if suffix == ".obj":
        return path if not drawn or _has_normals(path) else _with_normals(path)
    if suffix in _DRAWN:
        return path
    if suffix not in _CONVERTED:
        raise StationError(
            f"mesh {path}: '{suffix}' can't be read; use one of {', '.join(_DRAWN + _CONVERTED)}"
        )
    target = cache_dir() / "object_meshes" / f"{_digest(path)}.obj"
    if target.is_file():
        return target
    try:
        scene = trimesh.load_scene(path)
        mesh = scene.to_mesh()
    except Exception as error:  # parsers of broken files raise anything
        hint = ": pip install 'iga-drake[visuals]'" if "collada" in str(error) else ""
        raise StationError(f"mesh {path}: not readable: {error_text(error)[:200]}{hint}") from error
    if not len(mesh.faces):
        raise StationError(f"mesh {path}: it has no faces: export it with them")
    if suffix == ".glb":  # as Drake does with .gltf
        mesh.vertices = mesh.vertices @ UP_AXES["y"].T
    mesh.merge_vertices(merge_norm=True, merge_tex=True)
    mesh.update_faces(mesh.nondegenerate_faces())
    write_text(target, visual_obj(trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)))
    return target


def _digest(path: Path) -> str:
    return hashlib.sha256(b"1" + path.suffix.encode() + path.read_bytes()).hexdigest()[:24]


def _has_normals(path: Path) -> bool:
    with path.open(encoding="utf-8", errors="replace") as file:
        return any(line.startswith("vn ") for line in file)


def _with_normals(path: Path) -> Path:
    """A copy of an .obj with the normal of each face, beside copies of its materials."""
    digest = hashlib.sha256(b"1" + str(path.parent).encode() + path.read_bytes()).hexdigest()[:24]
    folder = cache_dir() / "object_meshes" / digest
    target = folder / path.name
    if target.is_file():
        return target
    vertices: list[list[float]] = []
    lines: list[str] = []
    normals = 0
    try:
        for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
            words = line.split()
            if words[:1] == ["v"]:
                vertices.append([float(word) for word in words[1:4]])
            elif words[:1] == ["mtllib"]:
                _copy_materials(path.parent / line.split(maxsplit=1)[1].strip(), folder)
            elif words[:1] == ["f"]:
                corners = [_corner(word, len(vertices)) for word in words[1:]]
                p = np.array([vertices[index] for index, _ in corners])
                normal = np.cross(p, np.roll(p, -1, axis=0)).sum(axis=0)  # Newell's
                size = np.linalg.norm(normal)
                if not size > 0:
                    continue
                normals += 1
                lines.append("vn {:.6f} {:.6f} {:.6f}".format(*normal / size))
                texture = [text for _, text in corners]
                line = "f " + " ".join(
                    f"{index + 1}/{text}/{normals}"
                    for (index, _), text in zip(corners, texture, strict=True)
                )
            lines.append(line)
    except (OSError, ValueError, IndexError) as error:
        raise StationError(
            f"mesh {path}: it has no normals, and they can't be made: {error_text(error)}: export "
            "it with normals"
        ) from error
    write_text(target, "\n".join(lines) + "\n")
    return target


def _corner(word: str, count: int) -> tuple[int, str]:
    """Index from 0 of a corner's vertex, of `count` so far, and its texture's index as text."""
    vertex, _, rest = word.partition("/")
    number = int(vertex)
    index = number - 1 if number > 0 else count + number
    if not 0 <= index < count:
        raise ValueError(f"a face names vertex {number} of {count}")
    return index, rest.partition("/")[0]


def _copy_materials(path: Path, folder: Path) -> None:
    """Copies an .mtl file and the pictures that it names; what is missing is left out."""
    if not path.is_file():
        return
    folder.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(path, folder / path.name)
    for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
        words = line.split()
        if words and words[0].startswith("map_") and (path.parent / words[-1]).is_file():
            (folder / words[-1]).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(path.parent / words[-1], folder / words[-1])


# The object in a plant


def names_the_world(item: SceneObject) -> bool:
    """Whether an object's model may fix something to the world: it has to be added to a plant that
    has no constraints yet, so before the robot."""
    return re.search(r"<static>\s*(true|1)|\bworld\b|^directives:", item.model) is not None


def add_object(plant: MultibodyPlant, item: SceneObject) -> AddedObject:
    """Adds an object's bodies; their model instances are called by its name, or NAME::....

    What the model fixes to the world is fixed so that the base body is at `item.X_WO`; the pose of
    a free base body is its default one.

    Raises `StationError` that names the object, its file, the reason and a remedy.
    """
    where = f"object '{item.name}'" + (f" ({item.source})" if item.source else "")
    directives = item.model.lstrip().startswith("directives:")
    text = item.model
    if not directives:
        text = _usable(text, where, None, {})
    parser = Parser(plant)
    parser.SetAutoRenaming(True)
    first = plant.num_model_instances()
    if plant.HasModelInstanceNamed(item.name):
        raise StationError(f"{where}: there is something of this name already: rename it")
    try:
        if directives:
            plant.AddModelInstance(item.name)
            file = _kept(text, item.name, ".dmd.yaml")
            text = (
                f"directives:\n- add_directives: {{file: 'file://{file}', "
                f"model_namespace: '{item.name}'}}\n"
            )
            parser.AddModelsFromString(text, "dmd.yaml")
        else:
            kind = "urdf" if "<robot" in text[:2000] else "sdf"
            added = parser.AddModelsFromString(text, kind)
            names = {plant.GetModelInstanceName(instance): instance for instance in added}
            tops = [n for n in names if not any(n.startswith(f"{other}::") for other in names)]
            if len(tops) != 1:
                raise StationError(
                    f"{where}: it holds {len(tops)} models, 1 is expected: make each an object"
                )
            _rename(plant, item.name, names[tops[0]], first)
    except (RuntimeError, ValueError) as error:
        raise StationError(f"{where}: {_reason(error)}; mend it") from error
    instances = [ModelInstanceIndex(index) for index in range(first, plant.num_model_instances())]
    bodies = [
        plant.get_body(index) for instance in instances for index in plant.GetBodyIndices(instance)
    ]
    if not bodies:
        raise StationError(f"{where}: it has no body: nothing to simulate; name another model")
    return _placed(plant, item, bodies, where)


def _rename(plant: MultibodyPlant, name: str, top: ModelInstanceIndex, first: int) -> None:
    """Calls a model `name`, and those within it NAME::...."""
    old = plant.GetModelInstanceName(top)
    for index in range(first, plant.num_model_instances()):
        instance = ModelInstanceIndex(index)
        now = plant.GetModelInstanceName(instance)
        inner = now.removeprefix(f"{old}::") if now != old else ""
        plant.RenameModelInstance(instance, f"{name}::{inner}" if inner else name)


def _reason(error: Exception) -> str:
    """Drake's words without the names that it gives texts without a file."""
    text = error_text(error).removeprefix("RuntimeError: ")
    for name in ("<literal-string>.sdf:", "<literal-string>.urdf:", "<literal-string>:"):
        text = text.replace(name, "line ")
    return text


def _placed(
    plant: MultibodyPlant, item: SceneObject, bodies: Sequence[RigidBody], where: str
) -> AddedObject:
    """Finds the base body, moves welds to the world, and checks what can be told so far."""
    members = {int(body.index()) for body in bodies}
    parents: dict[int, int] = {}
    welds = []
    for index in plant.GetJointIndices():
        joint = plant.get_joint(index)
        child, parent = int(joint.child_body().index()), int(joint.parent_body().index())
        if child in members:
            parents[child] = parent
            if parent == 0 and joint.type_name() == "weld":
                welds.append(joint)
    roots = [body for body in bodies if int(body.index()) not in parents]
    fixed = not roots
    if len(roots) > 1 or (roots and welds):
        loose = ", ".join(f"'{body.name()}'" for body in roots)
        raise StationError(
            f"{where}: its links {loose} are not joined to {'the rest' if welds else 'one another'}"
            ": join them, or make each an object of its own"
        )
    if fixed:
        if not welds:
            raise StationError(
                f"{where}: it is joined to the world by a joint that moves, so it can't be placed: "
                "weld its base to the world, or leave the joint out"
            )
        welded = {int(weld.child_body().index()) for weld in welds}
        base = next(body for body in bodies if int(body.index()) in welded)
        try:
            _move_welds(plant, welds, base, item.X_WO)
        except RuntimeError as error:  # of constraints in the plant
            raise StationError(
                f"{where}: it can't be fixed where it is to stand: {_reason(error)}; leave out "
                "what constrains it (a mimic joint, say), or the joint to the world"
            ) from error
    else:
        base = roots[0]
    if not fixed and not sum(body.default_mass() for body in bodies) > 0:
        raise StationError(f"{where}: link '{base.name()}' has no mass: state <inertial>")
    if not fixed and not any(plant.GetCollisionGeometriesForBody(body) for body in bodies):
        raise StationError(
            f"{where}: it has no <collision>, so it would fall through the table: add one, or make "
            "the model static"
        )
    return AddedObject(base=base, bodies=tuple(bodies), fixed=fixed)


def _move_welds(
    plant: MultibodyPlant, welds: Sequence, base: RigidBody, X_WO: RigidTransform
) -> None:
    """Welds to the world what is, so that the base body is at `X_WO`."""
    poses = {}
    for weld in welds:
        # X_WB of the welded body, from the frames that the weld joins.
        X_PF = weld.frame_on_parent().GetFixedPoseInBodyFrame()
        X_BM = weld.frame_on_child().GetFixedPoseInBodyFrame()
        poses[int(weld.child_body().index())] = X_PF @ weld.X_FM() @ X_BM.inverse()
    X_move = X_WO @ poses[int(base.index())].inverse()
    for weld in welds:
        child = weld.child_body()
        plant.RemoveJoint(weld)
        plant.WeldFrames(
            plant.world_frame(), child.body_frame(), X_move @ poses[int(child.index())]
        )


# What an object looks like


def model_shape(model: str, name: str, source: str) -> tuple[ShapeInstance, bool]:
    """The shape of an object that is described by `model`, and whether it is fixed to the world.

    Its mesh and pieces are the hulls of its collision geometries (of its visual ones where it has
    none) with its joints at their defaults, its parts their names, its mass the links' together;
    its frames are those of the model. All in the frame of the base body.

    Raises `StationError` that names the file, the reason and a remedy.
    """
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, time_step=0.01)
    added = add_object(plant, SceneObject(name, "other", model, RigidTransform(), source))
    try:
        plant.Finalize()
        diagram = builder.Build()
    except RuntimeError as error:
        raise StationError(f"{source}: {_reason(error)}; mend it") from error
    context = plant.GetMyContextFromRoot(diagram.CreateDefaultContext())
    mass = check_object(plant, scene_graph.model_inspector(), context, added, source)
    hulls = [
        (label, hull_of(points))
        for label, points in _geometries(
            plant, scene_graph.model_inspector(), context, added, source
        )
    ]
    names = list(dict.fromkeys(label for label, _ in hulls))
    surface = joined([hull for _, hull in hulls])
    labels = np.concatenate([np.full(len(hull.faces), names.index(n)) for n, hull in hulls])
    X_BW = added.base.EvalPoseInWorld(context).inverse()
    frames = {}
    for instance in {body.model_instance() for body in added.bodies}:
        for index in plant.GetFrameIndices(instance):
            frame = plant.get_frame(index)
            if not frame.name().startswith("__"):
                frames[frame.name()] = (X_BW @ frame.CalcPoseInWorld(context)).GetAsMatrix4()
    shape = ShapeInstance(
        family=name,
        parameters={},
        vertices=surface.vertices,
        faces=surface.faces,
        part_labels=labels,
        part_names=tuple(names),
        frames=frames,
        convex_pieces=tuple(np.asarray(hull.vertices) for _, hull in hulls),
        stated_mass=mass,
    )
    return shape, added.fixed


def check_object(
    plant: MultibodyPlant,
    inspector: SceneGraphInspector,
    context: Context,
    added: AddedObject,
    source: str,
) -> MassProperties:
    """The mass and inertia of an object's links together, in the base body's frame.

    Args:
      inspector: of the finished plant.
      context: of the plant itself in the finished diagram.
      source: names the object in messages.

    Raises `StationError` where the object is larger than one on a table can be, or a free one
    states no inertia.
    """
    points = np.concatenate(
        [points for _, points in _geometries(plant, inspector, context, added, source)]
    )
    size = np.ptp(points, axis=0)
    most = _FIXED_LARGEST if added.fixed else LARGEST
    if size.max() > most:
        edges = " x ".join(f"{edge:.3g}" for edge in size)
        raise StationError(
            f"{source}: it is {edges} m large, an object is at most {most:g} m: if its meshes are "
            "in millimetres, state <scale>0.001 0.001 0.001</scale> for each"
        )
    inertia = plant.CalcSpatialInertia(
        context, added.base.body_frame(), [body.index() for body in added.bodies]
    )
    kilograms = float(inertia.get_mass())
    if not kilograms > 0:  # fixed: it doesn't matter
        return MassProperties(1.0, np.zeros(3), np.eye(3))
    central = inertia.Shift(inertia.get_com()).CalcRotationalInertia().CopyToFullMatrix3()
    gyration = np.sqrt(np.linalg.eigvalsh(central)[-1] / kilograms)
    unstated = [body.name() for body in added.bodies if _has_default_inertia(body)]
    if unstated and not added.fixed and gyration > _GYRATION * np.linalg.norm(size) / 2:
        raise StationError(
            f"{source}: link '{unstated[0]}' states no inertia, and 1 kg m^2, which Drake would "
            f"take, can't be that of something {np.linalg.norm(size):.3g} m large: state "
            "<inertial>, or name its mesh file as the object, with a density or mass"
        )
    return MassProperties(kilograms, np.asarray(inertia.get_com()), np.asarray(central))


def _has_default_inertia(body: RigidBody) -> bool:
    """Whether it has the inertia of an SDF link that states none."""
    if not body.default_mass() > 0:
        return False
    moments = body.default_spatial_inertia().CalcRotationalInertia().get_moments()
    return bool(np.allclose(moments, 1.0))


def _geometries(
    plant: MultibodyPlant,
    inspector: SceneGraphInspector,
    context: Context,
    added: AddedObject,
    source: str,
) -> list[tuple[str, np.ndarray]]:
    """Name and points (n, 3) (m, in the base body's frame) of each collision geometry, or of each
    visual one where there is no other."""
    X_BW = added.base.EvalPoseInWorld(context).inverse()
    for role in (Role.kProximity, Role.kPerception, Role.kIllustration):
        found = []
        for body in added.bodies:
            for geometry in inspector.GetGeometries(
                plant.GetBodyFrameIdOrThrow(body.index()), role
            ):
                corners = _corners(inspector, geometry, source)
                X = X_BW @ body.EvalPoseInWorld(context) @ inspector.GetPoseInFrame(geometry)
                label = inspector.GetName(geometry).split("::")[-1]
                found.append((label, X.multiply(corners.T).T))
        if found:
            return found
    raise StationError(f"{source}: it has no geometry: add <collision> and <visual>")


def _corners(inspector: SceneGraphInspector, geometry: GeometryId, source: str) -> np.ndarray:
    """(n, 3) points of a geometry in its own frame (m) whose hull is about its hull."""
    shape = inspector.GetShape(geometry)
    if isinstance(shape, Box):
        return trimesh.creation.box(shape.size()).vertices
    if isinstance(shape, Sphere):
        return trimesh.creation.icosphere(2, radius=shape.radius()).vertices
    if isinstance(shape, Ellipsoid):
        return trimesh.creation.icosphere(2).vertices * [shape.a(), shape.b(), shape.c()]
    if isinstance(shape, Cylinder):
        return trimesh.creation.cylinder(shape.radius(), shape.length()).vertices
    if isinstance(shape, Capsule):
        ends = np.array([[0, 0, shape.length() / 2], [0, 0, -shape.length() / 2]])
        ball = trimesh.creation.icosphere(2, radius=shape.radius()).vertices
        return np.concatenate([ball + end for end in ends])
    if isinstance(shape, Convex | Mesh):
        hull = shape.GetConvexHull()
        return np.array([hull.vertex(index) for index in range(hull.num_vertices())])
    if isinstance(shape, HalfSpace):  # endless: what of it may be under things
        return trimesh.creation.box((1.0, 1.0, 1e-3)).vertices
    kind = type(shape).__name__
    raise StationError(f"{source}: geometry of the kind {kind} can't be used: make it a mesh")
