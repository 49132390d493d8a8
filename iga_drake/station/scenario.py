"""The typed schema of the files in `diagrams/`: one scenario says how a diagram is wired.

Read with `load_scenario`, in the manner of Drake's hardware_sim: every field has a default, a file
states only what differs from it. SI units throughout (m, rad, s, N); W is the world = robot base.
"""

import dataclasses
import functools
import hashlib
import json
import math
import types
import typing
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml
from pydrake.common.yaml import yaml_dump_typed, yaml_load, yaml_load_typed
from pydrake.lcm import DrakeLcmParams
from pydrake.multibody.plant import MultibodyPlantConfig
from pydrake.systems.lcm import LcmBuses

from iga_drake.errors import IgaDrakeError, check_bounds, check_range, error_text, shortened
from iga_drake.paths import diagrams_dir
from iga_drake.planning.planning_robot import PlanningConfig
from iga_drake.policy.machine import PolicyConfig
from iga_drake.station.cameras.clutter import Clutter
from iga_drake.station.cameras.kinds import camera_type
from iga_drake.station.cameras.rgbd import LookAt, RgbdCamera
from iga_drake.station.declaration import TaskDeclaration
from iga_drake.station.hardware.config import Hardware
from iga_drake.station.panda.command import Panda
from iga_drake.station.panda.driver import PandaDriver
from iga_drake.systems.differential_ik import DifferentialIkConfig
from iga_drake.systems.fusion import FusionConfig
from iga_drake.systems.geometric_segmentation import SegmentationConfig
from iga_drake.systems.ports import PANDA_JOINTS
from iga_drake.systems.supervisor import SupervisorConfig
from iga_drake.systems.waypoint_follower import WaypointFollowerConfig
from iga_drake.viewing.meshcat import Visualization


class ScenarioError(IgaDrakeError):
    """A scenario file is missing, is no YAML, or says something that the schema does not allow."""


_LARGEST_FILE = 1_000_000  # bytes


def _plant() -> MultibodyPlantConfig:
    return MultibodyPlantConfig(
        time_step=0.002,
        contact_model="hydroelastic_with_fallback",
        discrete_contact_approximation="sap",
    )


def _lcm_buses() -> dict[str, DrakeLcmParams]:
    return {"default": DrakeLcmParams(lcm_url=LcmBuses.kLcmUrlMemqNull)}


@dataclass
class Table:
    """A box whose top is the plane z = 0 of W; the robot stands on it."""

    # Edge lengths along x, y, z of W (m), all > 0.
    size: list[float] = field(default_factory=lambda: [1.5, 1.6, 0.05])
    # Centre of the top in x, y of W (m).
    center: list[float] = field(default_factory=lambda: [0.35, 0.0])
    # Coulomb friction coefficient, static = dynamic, >= 0.
    friction: float = 0.6
    # Diffuse colour, r, g, b in [0, 1].
    color: list[float] = field(default_factory=lambda: [0.55, 0.45, 0.36])

    def check(self, where: str) -> None:
        """Raises `ConfigError` for a value out of range."""
        for name, length in (("size", 3), ("center", 2), ("color", 3)):
            value = getattr(self, name)
            check_range(len(value) == length, f"{where}.{name}", value, f"{length} numbers")
        bounds = {"size": (1e-3, 10.0), "center": (-2.0, 2.0), "friction": (0.0, 10.0)}
        check_bounds(self, where, bounds | {"color": (0.0, 1.0)})


def _cameras() -> dict[str, RgbdCamera]:
    return {
        "camera_0": RgbdCamera(pose=LookAt(position=[1.25, 0.0, 0.8], target=[0.5, 0.0, 0.18])),
        "camera_1": RgbdCamera(pose=LookAt(position=[0.25, 0.95, 0.8], target=[0.5, 0.0, 0.15])),
        "camera_2": RgbdCamera(pose=LookAt(position=[0.25, -0.95, 0.8], target=[0.5, 0.0, 0.15])),
    }


@dataclass
class TaskChoice:
    """The task to do, by name, and its time limit."""

    # Name in the task registry of `iga_drake.tasks`, or, with `declared`, a new one.
    name: str = "grasp"
    # Simulated time after which the episode has failed (s), > 0.
    time_limit: float = 120.0
    # The task itself, where no registered one is meant.
    declared: TaskDeclaration | None = None


@dataclass
class AlignerChoice:
    """The aligner that predicts the waypoints, by name, and its options."""

    # Name in the aligner registry of `iga_drake.aligners`.
    name: str = "iga"
    # The aligner's options by name; it raises `AlignerError` for a name it doesn't know.
    options: dict[str, float | str] = field(default_factory=dict)


@dataclass
class Seeds:
    """Offsets, each >= 0, added to the episode's seed for one source of chance each, so that one
    varies while the others stay.
    """

    # Objects and their poses.
    scene: int = 0
    # Camera noise and calibration error.
    cameras: int = 0
    # Random choices inside the aligner.
    aligner: int = 0


@dataclass
class Scenario:
    """Everything that a diagram is built from, apart from the seeded scene."""

    # Name in the station registry of `iga_drake.station`.
    station: str = "simulated"
    # Physics: time step (s), contact model and solver.
    plant: MultibodyPlantConfig = field(default_factory=_plant)
    panda: Panda = field(default_factory=Panda)
    # Name -> LCM bus. "memq://null" is Drake's word for none: what would be sent are ports instead.
    lcm_buses: dict[str, DrakeLcmParams] = field(default_factory=_lcm_buses)
    # Name of the arm's model ("panda") -> its driver.
    model_drivers: dict[str, PandaDriver] = field(default_factory=lambda: {"panda": PandaDriver()})
    # The real cell; only the station `hardware` reads it.
    hardware: Hardware = field(default_factory=Hardware)
    table: Table = field(default_factory=Table)
    # Name -> camera of any kind, at least one. A file that has this section states all cameras it
    # wants; what is no plain RGB-D camera has a tag, the name of its kind's class.
    cameras: dict[str, RgbdCamera] = field(default_factory=_cameras)
    # Number of further objects on the table, of families that the task isn't about, out of the way
    # and background to the cameras (`iga_drake.tasks.distractors`).
    distractors: int = 0
    # Errors of the simulated cameras at the objects: wrong masks, stray depth.
    clutter: Clutter = field(default_factory=Clutter)
    fusion: FusionConfig = field(default_factory=FusionConfig)
    # Whose labels tell the objects apart: the station's, or those of the geometric segmenter.
    segmentation: SegmentationConfig = field(default_factory=SegmentationConfig)
    planning: PlanningConfig = field(default_factory=PlanningConfig)
    control: WaypointFollowerConfig = field(default_factory=WaypointFollowerConfig)
    differential_ik: DifferentialIkConfig = field(default_factory=DifferentialIkConfig)
    supervisor: SupervisorConfig = field(default_factory=SupervisorConfig)
    policy: PolicyConfig = field(default_factory=PolicyConfig)
    task: TaskChoice = field(default_factory=TaskChoice)
    aligner: AlignerChoice = field(default_factory=AlignerChoice)
    # Folder with the demonstrations; a relative path starts where the file that states it lies, or
    # at `models/` where there is no such folder.
    demonstrations: str = "demonstrations/grasp"
    # The first so many demonstrations make up the aligner's context; all if there are fewer.
    context_size: int = 3
    visualization: Visualization = field(default_factory=Visualization)
    seeds: Seeds = field(default_factory=Seeds)

    @property
    def camera_names(self) -> tuple[str, ...]:
        """The cameras in the file's order."""
        return tuple(self.cameras)

    @property
    def digest(self) -> str:
        """First 16 hexadecimal digits of the SHA-256 of `to_yaml()`; files' places don't matter
        and the content of the objects' files does."""
        said = dataclasses.replace(self, demonstrations=Path(self.demonstrations).name)
        if self.task.declared is not None:
            declared = self.task.declared.portable()
            said = dataclasses.replace(said, task=dataclasses.replace(self.task, declared=declared))
        return hashlib.sha256(said.to_yaml().encode()).hexdigest()[:16]

    def to_yaml(self) -> str:
        """The whole scenario, defaults included, as text that `load_scenario` reads back."""
        _allow_all_cameras()
        return yaml_dump_typed(self, schema=Scenario)


@functools.cache
def _allow_all_cameras() -> None:
    """Lets files name every kind of camera that there is. Not when this module is imported: a kind
    of another package may import it in turn."""
    kinds: Any = camera_type()
    Scenario.__dataclass_fields__["cameras"].type = dict[str, kinds]


def load_scenario(
    path: str | Path, *overlays: str | Path, overrides: Sequence[str] = ()
) -> Scenario:
    """Reads a scenario file, then further files and settings on top of it.

    Args:
      path: a file, or the name of one in `diagrams/`, with or without ".yaml".
      overlays: files that state what differs from those before them.
      overrides: settings "key.path=value", the value as in YAML; the last word.

    Raises `ScenarioError`, naming the file and the key, for a missing file, broken YAML, a key that
    is unknown (the valid ones are listed) or stated twice, a value of a wrong type and a value out
    of its range.
    """
    _allow_all_cameras()
    scenario = Scenario()
    for file in (path, *overlays):
        file = scenario_path(file)
        try:
            size = file.stat().st_size
            text = file.read_text(encoding="utf-8") if size <= _LARGEST_FILE else ""
        except (OSError, UnicodeDecodeError) as e:
            raise ScenarioError(
                f"{file}: scenario can't be read ({e}): give the path of a .yaml"
            ) from e
        if size > _LARGEST_FILE:
            raise ScenarioError(
                f"{file}: {size} bytes, a scenario has at most {_LARGEST_FILE}: is it another file?"
            )
        scenario = _layered(scenario, text, str(file))
        declared = scenario.task.declared
        if declared is not None and not Path(declared.folder).is_absolute():
            declared.folder = str((file.resolve().parent / declared.folder).resolve())
        if _states(text, "demonstrations"):
            beside = _beside(file, scenario.demonstrations)
            scenario = dataclasses.replace(scenario, demonstrations=beside)
    for override in overrides:
        text = _override_text(override, scenario)
        scenario = _layered(scenario, text, _cut(override), keep_maps=True)
    return scenario


def scenario_path(name: str | Path) -> Path:
    """`name` as a path, or as the name of a file in `diagrams/`, with or without ".yaml"."""
    path = Path(name)
    try:
        path.is_file()
    except (OSError, ValueError) as e:  # too long, a null character
        raise ScenarioError(f"scenario {_cut_path(name)}: no path ({error_text(e)})") from e
    named = diagrams_dir() / f"{path.name.removesuffix('.yaml')}.yaml"
    if not path.is_file() and path.name == str(name) and named.is_file():
        return named
    if not path.is_file():
        known = ", ".join(sorted(p.stem for p in diagrams_dir().glob("*.yaml")))
        raise ScenarioError(
            f"scenario {_cut_path(name)}: no such file; name a YAML file or one of: {known}"
        )
    return path


def _states(text: str, key: str) -> bool:
    """Whether YAML text has a key at its top level."""
    node = yaml.compose(text, Loader=yaml.SafeLoader)
    return isinstance(node, yaml.MappingNode) and any(k.value == key for k, _ in node.value)


def _beside(file: Path, folder: str) -> str:
    """A relative folder as an absolute one, where it lies beside `file`; else as it is."""
    try:
        place = file.absolute().parent / folder
        return str(place.resolve()) if not Path(folder).is_absolute() and place.is_dir() else folder
    except (OSError, ValueError, RuntimeError):  # no path
        return folder


def _override_text(override: str, scenario: Scenario) -> str:
    """The YAML text `{a: {b: c}}` of a setting "a.b=c".

    A value whose field takes several types keeps the type that it has in `scenario`. Raises
    `ScenarioError` where the setting is not of this form.
    """
    key, found, value = override.partition("=")
    names = key.strip().split(".")
    if not found or not all(names):
        raise ScenarioError(
            f"{_cut(override)}: expected key.path=value, such as control.linear_speed=0.1"
        )
    text = ""
    now: Any = scenario
    schema: Any = Scenario
    for name in names:
        tag = f"!{type(now).__name__} " if _is_union(schema) and now is not None else ""
        text += f"{tag}{{{json.dumps(name)}: "
        fields = _fields(type(now))
        if isinstance(now, dict):
            now, schema = now.get(name), (*typing.get_args(schema), Any)[1]
        else:
            now, schema = getattr(now, name, None), (fields or {}).get(name, Any)
    return f"{text}{value}{'}' * len(names)}"


def _is_union(schema: Any) -> bool:
    return typing.get_origin(schema) in (typing.Union, types.UnionType)


def _layered(scenario: Scenario, text: str, where: str, *, keep_maps: bool = False) -> Scenario:
    """`scenario` with what `text` (YAML) says on top; maps are replaced, or, with `keep_maps`,
    added to."""
    try:
        node = yaml.compose(text, Loader=yaml.SafeLoader)
        _check_keys(node, "", set())
        data = None if node is None else yaml_load(data=text, private=True)
    except yaml.YAMLError as e:
        raise ScenarioError(f"{where}: not valid YAML: {error_text(e)}") from e
    except ScenarioError as e:
        raise ScenarioError(f"{where}: {e}") from None
    except Exception as e:  # values that Python can't make, nesting too deep
        raise ScenarioError(f"{where}: can't be read: {error_text(e)}") from e
    if data is None:
        return scenario
    try:
        _check_node(Scenario, data, "")
        layered = yaml_load_typed(
            schema=Scenario, data=text, defaults=scenario, retain_map_defaults=keep_maps
        )
        _check_values(layered)
    except IgaDrakeError as e:
        raise ScenarioError(f"{where}: {e}") from None
    except Exception as e:  # yaml_load_typed raises many kinds
        raise ScenarioError(f"{where}: {error_text(e)}") from e
    return layered


def _check_keys(node: yaml.Node | None, where: str, seen: set[int]) -> None:
    """Raises `ScenarioError` where a mapping states a key twice: YAML itself takes the last.

    Nodes that were `seen`, by their ids, are left out: aliases make many of a few.
    """
    if id(node) in seen:
        return
    seen.add(id(node))
    if isinstance(node, yaml.MappingNode):
        lines: dict[str, int] = {}
        for key, value in node.value:
            name = str(key.value)
            line = key.start_mark.line + 1
            if name in lines:
                raise ScenarioError(
                    f"key '{_cut(f'{where}.{name}' if where else name)}' is stated twice, in lines "
                    f"{lines[name]} and {line}: remove one"
                )
            lines[name] = line
            _check_keys(value, f"{where}.{name}" if where else name, seen)
    elif isinstance(node, yaml.SequenceNode):
        for i, item in enumerate(node.value):
            _check_keys(item, f"{where}[{i}]", seen)


def _fields(schema: type) -> dict[str, typing.Any] | None:
    """Field name -> type of a dataclass or of a Drake config struct; None for anything else."""
    if dataclasses.is_dataclass(schema):
        return {f.name: f.type for f in dataclasses.fields(schema)}
    if hasattr(schema, "__fields__"):
        return {f.name: f.type for f in schema.__fields__}
    return None


def _check_node(schema: typing.Any, node: typing.Any, where: str) -> None:
    """Compares a parsed YAML node with its type; `yaml_load_typed` says no key's full path."""
    name = where or "the file"
    origin, arguments = typing.get_origin(schema), typing.get_args(schema)
    if origin in (typing.Union, types.UnionType):
        if node is None and type(None) in arguments:
            return
        choices = [a for a in arguments if a is not type(None)]
        structs = {a.__name__: a for a in choices if _fields(a) is not None}
        if not structs:
            if not any(_accepts(choice, node) for choice in choices):
                raise _wrong_type(name, " or ".join(c.__name__ for c in choices), node)
            return
        tag = node.get("_tag", f"!{choices[0].__name__}") if isinstance(node, dict) else None
        if tag is not None and tag[1:] not in structs:
            valid = ", ".join(f"!{c}" for c in structs)
            raise ScenarioError(f"{name}: unknown tag {_cut(tag)}; valid tags: {valid}")
        return _check_node(structs[tag[1:]] if tag else choices[0], node, where)
    fields = _fields(schema)
    if fields is not None or origin is dict:
        if not isinstance(node, dict):
            raise _wrong_type(name, "a mapping of keys to values", node)
        for key, value in node.items():
            if key == "_tag" and fields is not None:
                continue
            if not isinstance(key, str) or (fields is not None and key not in fields):
                valid = ", ".join(fields) if fields is not None else "any text"
                raise ScenarioError(f"unknown key '{_cut(key)}' in {name}; valid keys: {valid}")
            child = fields[key] if fields is not None else arguments[1]
            _check_node(child, value, f"{where}.{key}" if where else key)
    elif origin is list:
        if not isinstance(node, list):
            raise _wrong_type(name, f"a list of {arguments[0].__name__}", node)
        for i, value in enumerate(node):
            _check_node(arguments[0], value, f"{where}[{i}]")
    elif not _accepts(schema, node):
        raise _wrong_type(name, schema.__name__, node)


def _accepts(schema: type, node: typing.Any) -> bool:
    if schema is float and isinstance(node, str):  # YAML 1.1 reads 1e-3 as text
        try:
            return math.isfinite(float(node))
        except ValueError:
            return False
    if schema is float:
        return isinstance(node, int | float) and not isinstance(node, bool) and math.isfinite(node)
    if schema is int:
        return isinstance(node, int) and not isinstance(node, bool)
    return isinstance(node, schema)


def _wrong_type(where: str, expected: str, node: typing.Any) -> ScenarioError:
    kind = type(node).__name__
    return ScenarioError(f"{_cut(where)}: expected {expected}, found {kind} {shortened(node)}")


def _cut(key: object) -> str:
    """A key that may be anything, in few characters."""
    text = key if isinstance(key, str) else shortened(key)
    return text if len(text) <= 80 else f"{text[:60]}..."


def _cut_path(name: object) -> str:
    """A path that may be anything: of a very long one, its beginning and its end."""
    text = str(name)
    return text if len(text) <= 300 else f"{text[:100]}...{text[-100:]}"


# Drake itself looks at these values only when the plant is built.
_MOST_SEED = 2**31 - 1
_PLANT_BOUNDS = {
    "time_step": (1e-5, 0.02),
    "penetration_allowance": (1e-6, 0.1),
    "stiction_tolerance": (1e-6, 1.0),
    "sap_near_rigid_threshold": (0.0, 100.0),
}
_PLANT_CHOICES = {
    "contact_model": ("point", "hydroelastic", "hydroelastic_with_fallback"),
    "discrete_contact_approximation": ("tamsi", "sap", "similar", "lagged"),
    "contact_surface_representation": ("triangle", "polygon"),
}


def _check_values(s: Scenario) -> None:
    """Raises `ConfigError` for ranges and lengths; types are right already."""
    check_bounds(s.plant, "plant", _PLANT_BOUNDS)
    for key, valid in _PLANT_CHOICES.items():
        value = getattr(s.plant, key)
        check_range(value in valid, f"plant.{key}", value, ", ".join(valid))
    s.panda.check("panda")
    s.table.check("table")
    good = list(s.model_drivers) == ["panda"]
    check_range(good, "model_drivers", list(s.model_drivers), "one driver, that of 'panda'")
    for name, driver in s.model_drivers.items():
        driver.check(f"model_drivers.{name}")
        _check_bus(s, f"model_drivers.{name}.lcm_bus", driver.lcm_bus)
    _check_bus(s, "hardware.camera_bus", s.hardware.camera_bus)
    s.hardware.check("hardware")
    check_range(0 < len(s.cameras) <= 32, "cameras", list(s.cameras), "1 to 32 cameras")
    for name in s.cameras:
        good = 0 < len(name) <= 64 and name.isprintable()
        check_range(good, "cameras", name, "names of 1 to 64 printable characters")
    for name, camera in s.cameras.items():
        camera.check(f"cameras.{name}")
    check_range(0 <= s.distractors <= 20, "distractors", s.distractors, "0 to 20")
    s.clutter.check("clutter")
    s.fusion.check("fusion")
    s.segmentation.check("segmentation")
    s.planning.check("planning")
    s.control.check("control")
    s.differential_ik.check(s.control.period, "differential_ik")
    s.supervisor.check(PANDA_JOINTS, "supervisor")
    s.policy.check("policy")
    s.visualization.check("visualization")
    check_bounds(s.task, "task", {"time_limit": (1e-3, 86_400.0)})
    if s.task.declared is not None:
        s.task.declared.check("task.declared")
    check_range(1 <= s.context_size <= 1000, "context_size", s.context_size, "1 to 1000")
    check_bounds(s.seeds, "seeds", dict.fromkeys(vars(s.seeds), (0, _MOST_SEED)))


def _check_bus(s: Scenario, key: str, name: str) -> None:
    check_range(name in s.lcm_buses, key, name, f"one of: {', '.join(s.lcm_buses)}")
