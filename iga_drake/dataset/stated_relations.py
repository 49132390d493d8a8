"""Relations between a user's own meshes, stated by named frames in a YAML file.

    meshes: .            # a folder beside this file (default: its own), or a package of scans
    unit: 0.001          # metres per unit of the mesh files (default 1)
    up: z                # their axis that points up (default: y for glTF, else z)
    objects:
      mugs:              # a category: the folder of that name, or the meshes named below
        tests: [blue, tall]           # instances that the test pairs alone show
        demonstrations: [red, green]  # the others (default: all others of the folder)
        upright: true                 # whether they stand when they are seen (default)
        frames:                       # of every instance, beside base, centre and top
          rim: {frame: top, xyz: [0, 0, -0.005]}
        instances:                    # frames of single ones
          red: {frames: {handle: {xyz: [0.05, 0, 0.04], rpy_deg: [90, 0, 0]}}}
      plates: {tests: [oval]}
    relations:
      - grasped: mugs.base            # this frame of A ...
        target: plates.base           # ... goes to this one of B, turned and moved by:
        xyz: [0, 0, 0.01]
        rpy_deg: [0, 0, 0]
        vary_xyz: [0.02, 0.02, 0]     # at most so much more or less, alike in all pairs of a sample
        vary_rpy_deg: [0, 0, 180]

Meshes stand on z = 0 with the middle of their bounds on the z axis; there are their frames `base`,
`centre` and `top`. Lengths are in m in every case, angles in degrees.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from iga_drake.dataset.collections import list_keys, own_mesh
from iga_drake.dataset.splits import SampleSet
from iga_drake.errors import IgaDrakeError, shortened
from iga_drake.shapes.errors import ShapeError
from iga_drake.shapes.mesh_object import bounds_frames
from iga_drake.shapes.readers import PACKAGES, MeshShape

Frames = Mapping[str, np.ndarray]  # X_OF (4, 4) by name


class RelationError(IgaDrakeError):
    """A file of relations can't be used."""


@dataclass(frozen=True)
class StatedObject:
    """A category of meshes."""

    demonstrations: tuple[str, ...]  # keys of the instances that demonstrations show
    tests: tuple[str, ...]  # and test pairs
    upright: bool
    frames: Mapping[str, Frames]  # by the instance's key


@dataclass(frozen=True)
class StatedRelation:
    """Where an object of one category belongs on one of another."""

    grasped: tuple[str, str]  # A's category and frame
    target: tuple[str, str]
    xyz: np.ndarray  # (3,) m, of A's frame in B's
    rpy: np.ndarray  # (3,) rad
    vary_xyz: np.ndarray  # (3,) m
    vary_rpy: np.ndarray  # (3,) rad


@dataclass(frozen=True)
class RelationFile:
    """The content of a file of relations between instances of one's own categories."""

    source: str  # the collection of its meshes
    unit: float
    up: str
    objects: Mapping[str, StatedObject]
    relations: tuple[StatedRelation, ...]


@dataclass(frozen=True)
class StatedPairs:
    """N pairs of meshes in one relation, the test pair last."""

    meshes: tuple[tuple[MeshShape, ...], tuple[MeshShape, ...]]  # of A and B
    upright: tuple[bool, bool]
    X_BA: np.ndarray  # (N, 4, 4)


def stated_pairs(chosen: SampleSet, k: int, file: str) -> StatedPairs:
    """The pairs at index k of a set: demonstrations of some instances, the test pair of others.

    Raises `RelationError` and `ShapeError`, as `read_relations`.
    """
    stated = read_relations(file)
    relation = stated.relations[int(chosen.rng("categories", k).integers(len(stated.relations)))]
    shared = chosen.rng("alignments", k)
    X_FF = _pose(
        relation.xyz + shared.uniform(-1, 1, 3) * relation.vary_xyz,
        relation.rpy + shared.uniform(-1, 1, 3) * relation.vary_rpy,
    )
    keys: list[list[str]] = []
    for role, (name, _) in enumerate((relation.grasped, relation.target)):
        rng, item = chosen.rng("instances", k, role), stated.objects[name]
        others = keys[0] if keys else [""] * chosen.pairs
        order = rng.permutation(len(item.demonstrations))
        shown = [item.demonstrations[order[n % len(order)]] for n in range(chosen.pairs - 1)]
        drawn = [*shown, item.tests[int(rng.integers(len(item.tests)))]]
        for n, (key, other) in enumerate(zip(drawn, others, strict=True)):
            pool = item.tests if n == chosen.pairs - 1 else item.demonstrations
            free = [each for each in pool if each != other]
            if key == other and free:  # an object doesn't meet itself
                drawn[n] = free[int(rng.integers(len(free)))]
        keys.append(drawn)
    poses = []
    for a, b in zip(*keys, strict=True):
        X_AF = stated.objects[relation.grasped[0]].frames[a][relation.grasped[1]]
        X_BF = stated.objects[relation.target[0]].frames[b][relation.target[1]]
        poses.append(X_BF @ X_FF @ np.linalg.inv(X_AF))
    A, B = (
        tuple(own_mesh(stated.source, key, stated.unit, stated.up) for key in own) for own in keys
    )
    upright = tuple(stated.objects[name].upright for name, _ in (relation.grasped, relation.target))
    return StatedPairs(meshes=(A, B), upright=(upright[0], upright[1]), X_BA=np.stack(poses))


@lru_cache(maxsize=8)
def read_relations(file: str) -> RelationFile:
    """Reads and checks a file of relations and all of its meshes.

    Raises `RelationError` that names the file and the key; `ShapeError` where there are no meshes.
    """
    path = Path(file)
    try:
        document = yaml.safe_load(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise RelationError(f"{path}: {error.strerror}: name a file of relations") from error
    except (UnicodeDecodeError, yaml.YAMLError) as error:
        raise RelationError(f"{path}: not a readable YAML file ({error})") from error
    try:
        return _relations(path, document)
    except RelationError as error:
        raise RelationError(f"{path}: {error}") from error


def _relations(path: Path, document: Any) -> RelationFile:
    top = _mapping("", document, {"meshes", "unit", "up", "objects", "relations"})
    source = _text("meshes", top.get("meshes", "."))
    if source not in PACKAGES:
        source = str(path.parent / source)
    unit = _numbers("unit", [top.get("unit", 1.0)], 1)[0]
    up = _text("up", top.get("up", ""))
    by_category: dict[str, list[str]] = {}
    for key in list_keys(source):
        by_category.setdefault(key.rpartition("/")[0], []).append(key)
    read = lru_cache(maxsize=None)(lambda key: own_mesh(source, key, float(unit), up))
    objects = {}
    for name, entry in _mapping("objects", top.get("objects")).items():
        objects[name] = _object(f"objects.{name}", name, entry, by_category, read)
    stated = top.get("relations")
    if not isinstance(stated, list) or not stated or not objects:
        raise RelationError("objects and relations: at least one of each is needed")
    relations = tuple(
        _relation(f"relations[{n}]", entry, objects) for n, entry in enumerate(stated)
    )
    return RelationFile(source, float(unit), up, objects, relations)


def _object(
    where: str, name: str, entry: Any, by_category: Mapping[str, Sequence[str]], read: Any
) -> StatedObject:
    keys = {"tests", "demonstrations", "upright", "frames", "instances"}
    entry = _mapping(where, entry, keys)
    own = by_category.get(name, [])
    named = {key: key for group in by_category.values() for key in group}
    named |= {key.rpartition("/")[2]: key for group in by_category.values() for key in group}
    named |= {key.rpartition("/")[2]: key for key in own}  # the category's own go first

    def instances(key: str, default: list[str]) -> tuple[str, ...]:
        if key not in entry:
            return tuple(default)
        if not isinstance(entry[key], list) or not entry[key]:
            raise RelationError(f"{where}.{key}: a list of instances expected")
        return tuple(instance(f"{where}.{key}", str(each)) for each in entry[key])

    def instance(where: str, given: str) -> str:
        if given not in named:
            there = own or list(named)
            raise RelationError(f"{where}: no instance '{given}'; there are: {', '.join(there)}")
        return named[given]

    if not own and not entry.get("demonstrations"):
        raise RelationError(
            f"{where}: no meshes in a folder '{name}', there are folders "
            f"{', '.join(by_category)}: name one of these, or list `demonstrations` and `tests`"
        )
    tests = instances("tests", [])
    if not tests:
        raise RelationError(f"{where}.tests: name the instances that demonstrations don't show")
    demonstrations = instances("demonstrations", [key for key in own if key not in tests])
    both = set(tests) & set(demonstrations)
    if both or not demonstrations:
        raise RelationError(
            f"{where}: {', '.join(sorted(both)) or 'no instance'} is left for demonstrations and "
            "tests both: each instance is for one of the two"
        )
    single = {
        instance(f"{where}.instances", str(given)): _mapping(
            f"{where}.instances.{given}", value, {"frames"}
        ).get("frames", {})
        for given, value in _mapping(f"{where}.instances", entry.get("instances", {})).items()
    }
    frames, reasons = {}, []
    for key in (*demonstrations, *tests):
        try:
            mesh = read(key)
        except ShapeError as error:
            reasons.append(str(error))
            continue
        known = dict(bounds_frames(mesh.vertices))
        for place, given in (
            (f"{where}.frames", entry.get("frames", {})),
            (f"{where}.instances.{key}.frames", single.get(key, {})),
        ):
            for label, value in _mapping(place, given).items():
                known[label] = _frame(f"{place}.{label}", value, known)
        frames[key] = known
    if reasons:
        raise RelationError(f"{where}: mend or leave out: {'; '.join(reasons)}")
    upright = entry.get("upright", True)
    if not isinstance(upright, bool):
        raise RelationError(f"{where}.upright: true or false expected, {shortened(upright)} found")
    return StatedObject(demonstrations, tests, upright, frames)


def _frame(where: str, entry: Any, known: Frames) -> np.ndarray:
    """X_OF (4, 4)."""
    entry = _mapping(where, entry, {"frame", "xyz", "rpy_deg"})
    base = _text(f"{where}.frame", entry.get("frame", ""))
    if base and base not in known:
        raise RelationError(f"{where}.frame: '{base}' is none of {', '.join(known)}")
    return (known[base] if base else np.eye(4)) @ _pose(*_place(where, entry))


def _relation(where: str, entry: Any, objects: Mapping[str, StatedObject]) -> StatedRelation:
    keys = {"grasped", "target", "xyz", "rpy_deg", "vary_xyz", "vary_rpy_deg"}
    entry = _mapping(where, entry, keys)
    ends = []
    for role in ("grasped", "target"):
        given = _text(f"{where}.{role}", entry.get(role, ""))
        name, _, frame = given.rpartition(".")
        if name not in objects:
            raise RelationError(
                f"{where}.{role}: '{given}' found, an object and its frame such as "
                f"{next(iter(objects))}.base expected; objects: {', '.join(objects)}"
            )
        for key, frames in objects[name].frames.items():
            if frame not in frames:
                raise RelationError(
                    f"{where}.{role}: instance '{key}' has no frame '{frame}', only "
                    f"{', '.join(frames)}: state it in objects.{name}.frames, or in "
                    f"objects.{name}.instances.{key.rpartition('/')[2]}.frames"
                )
        ends.append((name, frame))
    return StatedRelation(ends[0], ends[1], *_place(where, entry), *_place(where, entry, "vary_"))


def _place(where: str, entry: Mapping[str, Any], prefix: str = "") -> tuple[np.ndarray, np.ndarray]:
    """The values (3,) of `xyz` (m) and of `rpy_deg` (in rad), 0 where they aren't stated."""
    xyz, rpy = (
        _numbers(f"{where}.{key}", entry.get(key, [0, 0, 0]), 3)
        for key in (f"{prefix}xyz", f"{prefix}rpy_deg")
    )
    return xyz, np.radians(rpy)


def _pose(xyz: np.ndarray, rpy: np.ndarray) -> np.ndarray:
    """The pose (4, 4) by its origin (m) and its turns about fixed axes x, y, z (rad), in order."""
    X = np.eye(4)
    X[:3, :3], X[:3, 3] = Rotation.from_euler("xyz", rpy).as_matrix(), xyz
    return X


def _mapping(where: str, value: Any, keys: set[str] | None = None) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise RelationError(
            f"{where or 'file'}: keys with values expected, {shortened(value)} found"
        )
    unknown = [str(key) for key in value if keys is not None and key not in keys]
    if unknown:
        dot = f"{where}." if where else ""
        raise RelationError(f"{dot}{unknown[0]}: unknown; one of: {', '.join(sorted(keys or ()))}")
    return {str(key): each for key, each in value.items()}


def _text(where: str, value: Any) -> str:
    if not isinstance(value, str):
        raise RelationError(f"{where}: a text expected, {shortened(value)} found")
    return value


def _numbers(where: str, value: Any, count: int) -> np.ndarray:
    try:
        array = np.array(value, np.float64)
    except (TypeError, ValueError):
        array = np.empty(0)
    if array.shape != (count,) or not np.isfinite(array).all():
        what = "a number" if count == 1 else f"{count} numbers"
        found = value[0] if count == 1 else value
        raise RelationError(f"{where}: {what} expected, {shortened(found)} found")
    return array
