"""Demonstrations as data: what was seen, where the end effector went, and their folder on disk.

A folder holds `manifest.json` (format, version, task, frames, units, and for every arrays file its
sha256 and the shape and dtype of each array) beside one safetensors file for each demonstration.
The same format serves simulation, teaching and the real arm.

Frames: W is the robot's base, E the end-effector frame between the finger pads. All lengths in m.
"""

import hashlib
import json
import math
import os
import secrets
import shutil
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import safetensors
from safetensors.numpy import load as load_arrays
from safetensors.numpy import save as save_arrays

from iga_drake.demonstrations.alignment import Alignment
from iga_drake.errors import IgaDrakeError

FORMAT = "iga-drake demonstrations"
VERSION = 1
MANIFEST = "manifest.json"
FRAMES = {"grasped": "E", "target": "W", "X_WE": "W"}
UNITS = {"grasped": "m", "target": "m", "X_WE": "m", "openings": "m"}
ARRAYS = ("grasped", "target", "X_WE", "openings")


class DemonstrationError(IgaDrakeError):
    """A demonstration can't be made, read or written; says the file, found, expected, remedy."""


def _finite(name: str, value: np.ndarray, shape: tuple[int | None, ...]) -> np.ndarray:
    array = np.array(value, dtype=np.float64)
    if array.ndim != len(shape) or any(
        wanted not in (None, found) for wanted, found in zip(shape, array.shape, strict=True)
    ):
        wanted_text = tuple("any" if n is None else n for n in shape)
        raise DemonstrationError(f"{name}: shape {array.shape} found, {wanted_text} expected")
    if not np.isfinite(array).all():
        bad = int((~np.isfinite(array)).sum())
        raise DemonstrationError(
            f"{name}: {bad} of {array.size} numbers are NaN or infinite, all must be finite: "
            "record the demonstration again"
        )
    return array


@dataclass(frozen=True)
class Demonstration:
    """One demonstrated task: both clouds, and the poses and actions of its T waypoints."""

    # (P, 3) cloud of the grasped object (for a grasp: of the gripper) in the end-effector frame E.
    grasped: np.ndarray
    # (Q, 3) cloud of the target object in the world frame W.
    target: np.ndarray
    # (T, 4, 4) poses of the end effector in W, one for each waypoint.
    X_WE: np.ndarray
    # (T,) opening of the hand (m) commanded once the waypoint is reached.
    openings: np.ndarray
    # T names of the waypoints.
    names: tuple[str, ...]
    # Plain JSON values such as the instance and the seed.
    metadata: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        shapes: dict[str, tuple[int | None, ...]] = {
            "grasped": (None, 3),
            "target": (None, 3),
            "X_WE": (None, 4, 4),
            "openings": (None,),
        }
        for name, shape in shapes.items():
            array = _finite(f"Demonstration.{name}", getattr(self, name), shape)
            object.__setattr__(self, name, array)
        object.__setattr__(self, "names", tuple(self.names))
        count = len(self.X_WE)
        if count == 0 or len(self.openings) != count or len(self.names) != count:
            raise DemonstrationError(
                f"Demonstration: {count} poses, {len(self.openings)} openings and "
                f"{len(self.names)} names found, at least 1 of each and equally many expected"
            )
        for index, pose in enumerate(self.X_WE):
            R = pose[:3, :3]
            if (
                np.abs(R.T @ R - np.eye(3)).max() > 1e-6
                or np.linalg.det(R) < 0
                or not np.array_equal(pose[3], [0, 0, 0, 1])
            ):
                raise DemonstrationError(
                    f"Demonstration.X_WE[{index}]: not a rigid transform: expected a rotation "
                    "matrix (orthonormal, determinant 1) over the row (0, 0, 0, 1)"
                )

    def alignment(self, waypoint: int) -> Alignment:
        """Both clouds in W at a waypoint: the grasped cloud is carried there by its X_WE."""
        X = self.X_WE[waypoint]
        return Alignment(grasped=self.grasped @ X[:3, :3].T + X[:3, 3], target=self.target)


@dataclass(frozen=True)
class DemonstrationSet:
    """Demonstrations of one task, all with the same waypoints."""

    task: str
    demonstrations: tuple[Demonstration, ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "demonstrations", tuple(self.demonstrations))
        if not self.demonstrations:
            raise DemonstrationError(f"task '{self.task}': no demonstrations, at least 1 expected")
        names = {demonstration.names for demonstration in self.demonstrations}
        if len(names) > 1:
            raise DemonstrationError(
                f"task '{self.task}': demonstrations with different waypoints found: "
                f"{sorted(names)}: keep one kind in a set"
            )

    def __len__(self) -> int:
        return len(self.demonstrations)

    @property
    def waypoints(self) -> tuple[str, ...]:
        """Names of the waypoints."""
        return self.demonstrations[0].names

    def opening(self, waypoint: int) -> float:
        """Median opening of the hand (m) commanded once the waypoint is reached."""
        return float(np.median([d.openings[waypoint] for d in self.demonstrations]))

    def context(self, waypoint: int) -> tuple[Alignment, ...]:
        """What an aligner sees of the demonstrations for one waypoint."""
        if not 0 <= waypoint < len(self.waypoints):
            raise DemonstrationError(
                f"task '{self.task}': waypoint {waypoint} asked for, 0 to "
                f"{len(self.waypoints) - 1} exist: {list(self.waypoints)}"
            )
        return tuple(demonstration.alignment(waypoint) for demonstration in self.demonstrations)

    def first(self, count: int) -> "DemonstrationSet":
        """The first `count` demonstrations."""
        if not 1 <= count <= len(self):
            raise DemonstrationError(
                f"task '{self.task}': {count} demonstrations asked for, 1 to {len(self)} exist: "
                "ask for fewer or record more with `iga demonstrate`"
            )
        return DemonstrationSet(task=self.task, demonstrations=self.demonstrations[:count])


def write_demonstrations(folder: Path | str, demonstrations: DemonstrationSet) -> None:
    """Writes the set as a new folder, or in place of an older set; all of it or nothing.

    Raises `DemonstrationError` where `folder` exists and is not a demonstrations folder.
    """
    folder = Path(folder)
    check_replaceable(folder)
    folder.parent.mkdir(parents=True, exist_ok=True)
    token = secrets.token_hex(4)
    partial = folder.parent / f".{folder.name}.{token}.partial"
    old = folder.parent / f".{folder.name}.{token}.old"
    partial.mkdir()
    try:
        entries = []
        for index, demonstration in enumerate(demonstrations.demonstrations):
            entries.append(
                _write_one(partial / f"demonstration_{index}.safetensors", demonstration)
            )
        manifest = {
            "format": FORMAT,
            "version": VERSION,
            "task": demonstrations.task,
            "frames": FRAMES,
            "units": UNITS,
            "waypoints": list(demonstrations.waypoints),
            "demonstrations": entries,
        }
        text = json.dumps(manifest, indent=2, allow_nan=False) + "\n"
        (partial / MANIFEST).write_text(text, encoding="utf-8")
        if folder.exists():
            os.rename(folder, old)
        try:
            os.rename(partial, folder)
        except OSError:
            if old.exists():
                os.rename(old, folder)
            raise
    except (TypeError, ValueError) as error:
        raise DemonstrationError(
            f"{folder}: metadata must be plain JSON values: {error}"
        ) from error
    finally:
        shutil.rmtree(partial, ignore_errors=True)
        shutil.rmtree(old, ignore_errors=True)


def check_replaceable(folder: Path) -> None:
    """Raises `DemonstrationError` where `folder` exists and is not a demonstrations folder."""
    occupied = folder.exists() and (not folder.is_dir() or any(folder.iterdir()))
    if occupied and not (folder / MANIFEST).is_file():
        raise DemonstrationError(
            f"{folder}: exists and holds no {MANIFEST}, so it is not overwritten: name a new folder"
        )


def _write_one(path: Path, demonstration: Demonstration) -> dict[str, Any]:
    # Clouds are as fine as the cameras: single precision. Poses stay in double.
    arrays = {
        "grasped": np.ascontiguousarray(demonstration.grasped, dtype=np.float32),
        "target": np.ascontiguousarray(demonstration.target, dtype=np.float32),
        "X_WE": np.ascontiguousarray(demonstration.X_WE),
        "openings": np.ascontiguousarray(demonstration.openings),
    }
    data = save_arrays(arrays)
    path.write_bytes(data)
    return {
        "file": path.name,
        "sha256": hashlib.sha256(data).hexdigest(),
        "arrays": {
            name: {"shape": list(array.shape), "dtype": str(array.dtype)}
            for name, array in arrays.items()
        },
        "metadata": demonstration.metadata,
    }


def read_demonstrations(folder: Path | str, *, task: str | None = None) -> DemonstrationSet:
    """Reads a demonstrations folder and checks all of it.

    Raises `DemonstrationError` where a file is missing or truncated, the checksum, task, version or
    an array differs from what the manifest and this code expect, or a number is not finite.
    """
    folder = Path(folder)
    manifest_path = folder / MANIFEST
    manifest = _read_manifest(manifest_path)
    found_task = manifest["task"]
    if task is not None and found_task != task:
        raise DemonstrationError(
            f"{manifest_path}: demonstrations of task '{found_task}' found, '{task}' expected: "
            f"name a folder with demonstrations of '{task}' or record them with `iga demonstrate`"
        )
    demonstrations = []
    for index, entry in enumerate(manifest["demonstrations"]):
        where = f"{manifest_path}: demonstrations[{index}]"
        _check_type(where, entry, dict)
        demonstrations.append(_read_one(folder, where, entry, manifest["waypoints"]))
    try:
        return DemonstrationSet(task=found_task, demonstrations=tuple(demonstrations))
    except DemonstrationError as error:
        raise DemonstrationError(f"{manifest_path}: {error}") from error


def _check_type(where: str, value: Any, kind: type) -> Any:
    if not isinstance(value, kind):
        raise DemonstrationError(
            f"{where}: {type(value).__name__} found, {kind.__name__} expected: the manifest was "
            "changed by hand or truncated: copy the folder again or record it again"
        )
    return value


def _read_manifest(path: Path) -> dict[str, Any]:
    try:
        manifest = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise DemonstrationError(
            f"{path}: can't be read ({error.strerror}): name a folder made by `iga demonstrate`"
        ) from error
    except ValueError as error:
        raise DemonstrationError(
            f"{path}: not JSON ({error}), so truncated or another file: copy the folder again or "
            "record it again with `iga demonstrate`"
        ) from error
    _check_type(str(path), manifest, dict)
    if manifest.get("format") != FORMAT:
        raise DemonstrationError(
            f"{path}: format {manifest.get('format')!r} found, {FORMAT!r} expected: name a folder "
            "made by `iga demonstrate`"
        )
    if manifest.get("version") != VERSION:
        raise DemonstrationError(
            f"{path}: version {manifest.get('version')!r} found, {VERSION} expected: record the "
            "demonstrations again with this release's `iga demonstrate`"
        )
    for key, expected in (("frames", FRAMES), ("units", UNITS)):
        if manifest.get(key) != expected:
            raise DemonstrationError(
                f"{path}: {key} {manifest.get(key)!r} found, {expected!r} expected: convert the "
                "arrays or record again"
            )
    _check_type(f"{path}: task", manifest.get("task"), str)
    _check_type(f"{path}: waypoints", manifest.get("waypoints"), list)
    _check_type(f"{path}: demonstrations", manifest.get("demonstrations"), list)
    return manifest


def _read_one(folder: Path, where: str, entry: dict, waypoints: list[str]) -> Demonstration:
    name = _check_type(f"{where}.file", entry.get("file"), str)
    if Path(name).name != name:
        raise DemonstrationError(f"{where}.file: {name!r} found, a plain file name expected")
    path = folder / name
    try:
        data = path.read_bytes()
    except OSError as error:
        raise DemonstrationError(
            f"{path}: can't be read ({error.strerror}) but the manifest names it: copy the whole "
            "folder again or record it again"
        ) from error
    listed = _check_type(f"{where}.arrays", entry.get("arrays"), dict)
    try:
        expected_size = sum(
            math.prod(array["shape"]) * np.dtype(array["dtype"]).itemsize
            for array in listed.values()
        )
    except (KeyError, TypeError) as error:
        raise DemonstrationError(
            f"{where}.arrays: {listed} found, a shape and a dtype for each array expected "
            f"({error}): copy the folder again or record it again"
        ) from error
    found_sum = hashlib.sha256(data).hexdigest()
    if found_sum != entry.get("sha256"):
        kind = "truncated" if len(data) < expected_size else "changed"
        raise DemonstrationError(
            f"{path}: {kind}: sha256 {found_sum[:12]}... of {len(data)} bytes found, "
            f"{str(entry.get('sha256'))[:12]}... expected: copy the folder again or record it again"
        )
    try:
        arrays = load_arrays(data)
    except safetensors.SafetensorError as error:
        raise DemonstrationError(
            f"{path}: not a safetensors file ({error}): copy the folder again or record it again"
        ) from error
    missing = [array for array in ARRAYS if array not in arrays]
    if missing:
        raise DemonstrationError(
            f"{path}: arrays {sorted(arrays)} found, {missing} missing: record it again with "
            "`iga demonstrate`"
        )
    for array_name, array in arrays.items():
        shape = listed.get(array_name, {}).get("shape")
        if list(array.shape) != shape:
            raise DemonstrationError(
                f"{path}: array '{array_name}' of shape {list(array.shape)} found, {shape} expected"
                " by the manifest: copy the folder again or record it again"
            )
    try:
        return Demonstration(
            **{array_name: arrays[array_name] for array_name in ARRAYS},
            names=tuple(waypoints),
            metadata=_check_type(f"{where}.metadata", entry.get("metadata", {}), dict),
        )
    except DemonstrationError as error:
        raise DemonstrationError(f"{path}: {error}") from error
