"""Demonstrations on disk, format version 2.

A folder holds `manifest.json` (format, version, task, frames, units, and for each demonstration its
waypoints, observations, provenance, and the sha256, shapes and dtypes of its arrays) beside one
safetensors file for each demonstration. The arrays are `waypoints.X_WE` (T, 4, 4),
`waypoints.opening` (T,), `observations.NAME` (P, 3) for each observation, and where the dense
trajectory was kept `trajectory.times` (K,), `trajectory.X_WE` (K, 4, 4), `trajectory.openings`
(K,). Simulated experts, teaching and the real arm write the same format.
"""

import dataclasses
import hashlib
import json
import math
import os
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import safetensors
from safetensors.numpy import load as load_arrays
from safetensors.numpy import save as save_arrays

from iga_drake.demonstrations.demonstration import (
    Demonstration,
    DemonstrationError,
    DemonstrationSet,
    Observation,
    Provenance,
    Trajectory,
    Waypoint,
)
from iga_drake.demonstrations.plausibility import check_plausible
from iga_drake.errors import shortened
from iga_drake.files import check_output_folder

FORMAT = "iga-drake demonstrations"
VERSION = 2
MANIFEST = "manifest.json"
UNITS = {"length": "m", "time": "s"}
_AGAIN = "copy the folder again or record it again with `iga demonstrate`"


def write_demonstrations(folder: Path | str, demonstrations: DemonstrationSet) -> None:
    """Writes the set as a new folder, or in place of an older set; all of it or nothing.

    A process that is ended meanwhile leaves the older set, at the latest when this is called again.
    Raises `DemonstrationError` where `folder` exists and holds anything but demonstrations
    (`check_replaceable`), where a demonstration can't be true (`check_plausible`), or where the
    folder can't be written.
    """
    folder = Path(folder)
    check_replaceable(folder)
    folder = folder.resolve()  # what a link points to is replaced, not the link
    partial, old = (folder.parent / f".{folder.name}.{kind}" for kind in ("partial", "old"))
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        shutil.rmtree(partial, ignore_errors=True)
        partial.mkdir()
        entries = []
        for index, demonstration in enumerate(demonstrations.demonstrations):
            path = folder / _file_name(index)
            try:
                check_plausible(demonstration)
            except DemonstrationError as error:
                raise DemonstrationError(f"{path}: not written: {error}") from error
            entries.append(_write_one(partial / path.name, demonstration))
        manifest = {
            "format": FORMAT,
            "version": VERSION,
            "task": demonstrations.task,
            "units": UNITS,
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
            f"{folder}: names and provenance must be plain JSON values: {error}"
        ) from error
    except OSError as error:
        raise DemonstrationError(f"{folder}: can't be written ({error.strerror})") from error
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    shutil.rmtree(old, ignore_errors=True)


def check_replaceable(folder: Path) -> None:
    """Raises `DemonstrationError` where `folder` exists and holds anything but demonstrations.

    An older set that a process left beside it when it was ended while replacing it is put back.
    """
    folder = Path(folder)
    try:
        folder = folder.resolve()
        old = folder.parent / f".{folder.name}.old"
        if (old / MANIFEST).is_file():
            if folder.exists():
                _check_own(old)
                shutil.rmtree(old, ignore_errors=True)
            else:
                os.rename(old, folder)
        if folder.exists() and not folder.is_dir():
            raise DemonstrationError(
                f"{folder}: is no folder, so it is not overwritten: name another"
            )
        if folder.exists() and any(folder.iterdir()):
            _check_own(folder)
    except (OSError, RuntimeError) as error:  # the latter: links in a circle
        raise DemonstrationError(f"{folder}: can't be written ({error})") from error
    check_output_folder(folder)


def _check_own(folder: Path) -> None:
    """Raises `DemonstrationError` unless a folder holds demonstrations and nothing else."""
    if not (folder / MANIFEST).is_file():
        raise DemonstrationError(
            f"{folder}: exists and holds no {MANIFEST}, so it is not overwritten: name a new folder"
        )
    try:
        manifest = json.loads((folder / MANIFEST).read_text(encoding="utf-8"))
        own = manifest["format"] == FORMAT
        files = {MANIFEST, *(str(entry["file"]) for entry in manifest["demonstrations"])}
    except (OSError, ValueError, TypeError, KeyError, RecursionError):
        own, files = False, set()
    if not own:
        raise DemonstrationError(
            f"{folder}: its {MANIFEST} is not one of demonstrations, so it is not overwritten: "
            "name a new folder"
        )
    others = sorted(entry.name for entry in folder.iterdir() if entry.name not in files)
    if others:
        raise DemonstrationError(
            f"{folder}: holds {shortened(others)} besides demonstrations, so it is not "
            "overwritten: move that away or name a new folder"
        )


def _file_name(index: int) -> str:
    return f"demonstration_{index}.safetensors"


def _write_one(path: Path, demonstration: Demonstration) -> dict[str, Any]:
    arrays = {
        "waypoints.X_WE": np.stack([w.X_WE for w in demonstration.waypoints]),
        "waypoints.opening": np.array([w.opening for w in demonstration.waypoints]),
    }
    for name, observation in demonstration.observations.items():
        # Clouds are as fine as the cameras, and the dense trajectory is there to be looked at:
        # single precision. The waypoints' poses stay in double.
        arrays[f"observations.{name}"] = observation.points.astype(np.float32)
    if demonstration.trajectory is not None:
        for field in dataclasses.fields(Trajectory):
            dense = getattr(demonstration.trajectory, field.name)
            arrays[f"trajectory.{field.name}"] = dense.astype(np.float32)
    arrays = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
    data = save_arrays(arrays)
    path.write_bytes(data)
    return {
        "file": path.name,
        "sha256": hashlib.sha256(data).hexdigest(),
        "waypoints": [
            {"name": w.name, "grasped": w.grasped, "target": w.target}
            for w in demonstration.waypoints
        ],
        "observations": {
            name: {
                "role": observation.role,
                "frame": observation.frame,
                "time": observation.time,
                "gravity": observation.gravity.tolist(),
                "upright": observation.upright,
                "points": len(observation.points),
            }
            for name, observation in demonstration.observations.items()
        },
        "provenance": dataclasses.asdict(demonstration.provenance),
        "arrays": {
            name: {"shape": list(array.shape), "dtype": str(array.dtype)}
            for name, array in arrays.items()
        },
    }


def read_demonstrations(folder: Path | str, *, task: str | None = None) -> DemonstrationSet:
    """Reads a demonstrations folder and checks all of it.

    Raises `DemonstrationError` where a file is missing or truncated, the checksum, task, version or
    an array differs from what the manifest and this code expect, or a demonstration can't be true
    (`check_plausible`).
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
        demonstrations.append(_read_one(folder, where, entry))
    try:
        return DemonstrationSet(task=found_task, demonstrations=tuple(demonstrations))
    except DemonstrationError as error:
        raise DemonstrationError(f"{manifest_path}: {error}") from error


def _check_type(where: str, value: Any, kind: type | tuple[type, ...]) -> Any:
    kinds = kind if isinstance(kind, tuple) else (kind,)
    if not isinstance(value, kinds) or (isinstance(value, bool) and bool not in kinds):
        expected = " or ".join(k.__name__ for k in kinds)
        raise DemonstrationError(
            f"{where}: {type(value).__name__} found, {expected} expected: the manifest was "
            f"changed by hand or truncated: {_AGAIN}"
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
            f"{path}: not JSON ({error}), so truncated or another file: {_AGAIN}"
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
    if manifest.get("units") != UNITS:
        raise DemonstrationError(
            f"{path}: units {manifest.get('units')!r} found, {UNITS!r} expected: convert the "
            "arrays or record again"
        )
    _check_type(f"{path}: task", manifest.get("task"), str)
    _check_type(f"{path}: demonstrations", manifest.get("demonstrations"), list)
    return manifest


def _read_one(folder: Path, where: str, entry: dict[str, Any]) -> Demonstration:
    name = _check_type(f"{where}.file", entry.get("file"), str)
    if Path(name).name != name:
        raise DemonstrationError(f"{where}.file: {name!r} found, a plain file name expected")
    path = folder / name
    arrays = _read_arrays(path, where, entry)
    try:
        demonstration = _make(where, entry, arrays)
        check_plausible(demonstration)
    except DemonstrationError as error:
        raise DemonstrationError(f"{path}: {error}") from error
    return demonstration


def _read_arrays(path: Path, where: str, entry: dict[str, Any]) -> dict[str, np.ndarray]:
    """The arrays of one file, which are what the manifest says."""
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
            f"({error}): {_AGAIN}"
        ) from error
    found_sum = hashlib.sha256(data).hexdigest()
    if found_sum != entry.get("sha256"):
        kind = "truncated" if len(data) < expected_size else "changed"
        raise DemonstrationError(
            f"{path}: {kind}: sha256 {found_sum[:12]}... of {len(data)} bytes found, "
            f"{str(entry.get('sha256'))[:12]}... expected: {_AGAIN}"
        )
    try:
        arrays = load_arrays(data)
    except safetensors.SafetensorError as error:
        raise DemonstrationError(f"{path}: not a safetensors file ({error}): {_AGAIN}") from error
    for array_name, array in arrays.items():
        shape = listed.get(array_name, {}).get("shape")
        if list(array.shape) != shape:
            raise DemonstrationError(
                f"{path}: array '{array_name}' of shape {list(array.shape)} found, {shape} expected"
                f" by the manifest: {_AGAIN}"
            )
    return arrays


def _make(where: str, entry: dict[str, Any], arrays: dict[str, np.ndarray]) -> Demonstration:
    """The demonstration of one manifest entry and its arrays."""

    def array(name: str) -> np.ndarray:
        if name not in arrays:
            raise DemonstrationError(
                f"arrays {sorted(arrays)} found, '{name}' missing: record it again with "
                "`iga demonstrate`"
            )
        return arrays[name]

    observations = {}
    listed = _check_type(f"{where}.observations", entry.get("observations"), dict)
    for name, described in listed.items():
        at = f"{where}.observations.{name}"
        _check_type(at, described, dict)
        _check_type(f"{at}.time", described.get("time"), (int, float))
        _check_type(f"{at}.gravity", described.get("gravity"), list)
        points = array(f"observations.{name}")
        if described.get("points") != len(points):
            raise DemonstrationError(
                f"observation '{name}': {len(points)} points found, the manifest says "
                f"{described.get('points')!r}: {_AGAIN}"
            )
        try:
            observations[name] = Observation(
                points=points,
                role=_check_type(f"{at}.role", described.get("role"), str),
                frame=_check_type(f"{at}.frame", described.get("frame"), str),
                time=described["time"],
                gravity=described["gravity"],
                # Sets recorded before there was this key don't say.
                upright=_check_type(f"{at}.upright", described.get("upright", False), bool),
            )
        except DemonstrationError as error:
            raise DemonstrationError(f"observation '{name}': {error}") from error
    poses, openings = array("waypoints.X_WE"), array("waypoints.opening")
    described_waypoints = _check_type(f"{where}.waypoints", entry.get("waypoints"), list)
    if not len(poses) == len(openings) == len(described_waypoints):
        raise DemonstrationError(
            f"{len(poses)} poses, {len(openings)} openings and {len(described_waypoints)} "
            f"described waypoints found, equally many expected: {_AGAIN}"
        )
    waypoints = []
    for k, described in enumerate(described_waypoints):
        at = f"{where}.waypoints[{k}]"
        _check_type(at, described, dict)
        words = {
            key: _check_type(f"{at}.{key}", described.get(key), str)
            for key in ("name", "grasped", "target")
        }
        waypoints.append(Waypoint(X_WE=poses[k], opening=openings[k], **words))
    trajectory = None
    if any(name.startswith("trajectory.") for name in arrays):
        fields = [field.name for field in dataclasses.fields(Trajectory)]
        trajectory = Trajectory(**{name: array(f"trajectory.{name}") for name in fields})
    return Demonstration(
        observations=observations,
        waypoints=tuple(waypoints),
        trajectory=trajectory,
        provenance=_provenance(f"{where}.provenance", entry.get("provenance")),
    )


def _provenance(where: str, described: Any) -> Provenance:
    _check_type(where, described, dict)
    known = {field.name for field in dataclasses.fields(Provenance)}
    values = {name: value for name, value in described.items() if name in known}
    kinds: dict[str, type | tuple[type, ...]] = {
        "source": str, "seed": (int, type(None)), "scenario": str, "sensors": list,
        "instances": dict, "code": str,
    }  # fmt: skip
    for name, value in values.items():
        _check_type(f"{where}.{name}", value, kinds[name])
    if "sensors" in values:
        values["sensors"] = tuple(values["sensors"])
    return Provenance(**values)
