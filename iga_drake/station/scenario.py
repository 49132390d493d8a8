"""The typed schema of the files in `diagrams/`: one scenario says how a diagram is wired.

Read with `load_scenario`, in the manner of Drake's hardware_sim: every field has a default, a file
states only what differs from it. SI units throughout (m, rad, s, N); W is the world = robot base.
"""

import dataclasses
import math
import types
import typing
from dataclasses import dataclass, field
from pathlib import Path

import yaml
from pydrake.common.yaml import yaml_dump_typed, yaml_load, yaml_load_typed
from pydrake.multibody.plant import MultibodyPlantConfig

from iga_drake.errors import IgaDrakeError


class ScenarioError(IgaDrakeError):
    """A scenario file is missing, is no YAML, or says something that the schema does not allow."""


def _plant() -> MultibodyPlantConfig:
    return MultibodyPlantConfig(
        time_step=0.002,
        contact_model="hydroelastic_with_fallback",
        discrete_contact_approximation="sap",
    )


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


@dataclass
class Panda:
    """The robot in simulation."""

    # What is drawn: "primitives" (simple shapes), "meshes" (the published meshes, needs the extra
    # `visuals`), or "auto": primitives for the cameras, so that perception is the same on every
    # machine, and meshes for viewers where they can be had. Collisions are the same in all.
    visuals: str = "auto"


@dataclass
class LookAt:
    """A camera pose given by where it stands and what it looks at; image "up" is W's +z."""

    # Origin of the optical frame C in W (m).
    position: list[float] = field(default_factory=lambda: [1.25, 0.0, 0.8])
    # Point on the optical axis (m, in W); neither `position` itself nor straight above or below it.
    target: list[float] = field(default_factory=lambda: [0.5, 0.0, 0.18])


@dataclass
class Pose:
    """A camera pose X_WC given outright; C is optical: z forward, x right, y down."""

    # p_WC (m).
    translation: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    # Roll, pitch, yaw of R_WC (rad), Drake's convention.
    rpy: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])


@dataclass
class Intrinsics:
    """A pinhole without distortion; the colour, depth and label images share it.

    The defaults are a RealSense D415's: the data sheet's colour field of view of 69.4 x 42.5 deg
    at 1920x1080, cropped to 4:3 and scaled to 640x480, gives 616 px.
    """

    # Image size (px), > 0.
    width: int = 640
    height: int = 480
    # Focal lengths (px), > 0.
    fx: float = 616.0
    fy: float = 616.0
    # Principal point (px), inside the image; the centre of the first pixel is (0, 0).
    cx: float = 319.5
    cy: float = 239.5


@dataclass
class DepthNoise:
    """How a depth image gets worse than the rendered one; formulas in `camera_noise`."""

    # Gaussian noise whose deviation grows with the square of the distance.
    gaussian: bool = True
    # Deviation at a distance of 1 m (m), >= 0.
    sigma_at_one_metre: float = 0.0024
    # Pixels beside a jump in depth get lost.
    dropouts: bool = True
    # Chance that such a pixel is lost, in [0, 1].
    dropout_probability: float = 0.5
    # A jump is a difference between neighbours above this (m), > 0.
    dropout_jump: float = 0.02
    # Depth comes in whole steps.
    quantisation: bool = True
    # The step (m), > 0.
    quantisation_step: float = 0.001
    # Time for which the noise of one image stays the same: one over the frame rate (s), > 0.
    frame_period: float = 1.0 / 30.0


@dataclass
class CalibrationError:
    """How far the exported camera pose is from the true one."""

    # Whether there is an error at all.
    enabled: bool = True
    # Every point of the work area is displaced by at least and at most this (m),
    # 0 <= minimum <= maximum. Drawn once for a seed.
    minimum: float = 0.002
    maximum: float = 0.005
    # Angle of the rotation part (rad), >= 0; `rotation * radius` at most (maximum - minimum) / 2.
    rotation: float = 0.002
    # The work area is the ball around this point of W (m), the rotation's pivot...
    center: list[float] = field(default_factory=lambda: [0.5, 0.0, 0.15])
    # ...with this radius (m), > 0.
    radius: float = 0.35


@dataclass
class Camera:
    """One fixed RGB-D camera."""

    # Where it stands: `!LookAt {position, target}` (default) or `!Pose {translation, rpy}`.
    pose: LookAt | Pose = field(default_factory=LookAt)
    intrinsics: Intrinsics = field(default_factory=Intrinsics)
    # Range of valid depth (m), 0 < near < far; a D415 measures from about 0.45 m at full
    # resolution and 0.3 m at this one.
    near: float = 0.3
    far: float = 3.0
    noise: DepthNoise = field(default_factory=DepthNoise)
    calibration: CalibrationError = field(default_factory=CalibrationError)


def _cameras() -> dict[str, Camera]:
    return {
        "camera_0": Camera(pose=LookAt(position=[1.25, 0.0, 0.8], target=[0.5, 0.0, 0.18])),
        "camera_1": Camera(pose=LookAt(position=[0.25, 0.95, 0.8], target=[0.5, 0.0, 0.15])),
        "camera_2": Camera(pose=LookAt(position=[0.25, -0.95, 0.8], target=[0.5, 0.0, 0.15])),
    }


@dataclass
class Fusion:
    """How depth images become clouds; see `iga_drake.systems.fusion.PointCloudFusion`."""

    # Edge length of a voxel (m), > 0.
    voxel_size: float = 0.005
    # Corners of the box in W outside of which points are dropped (m), lower < upper.
    crop_lower: list[float] = field(default_factory=lambda: [0.1, -0.6, -0.02])
    crop_upper: list[float] = field(default_factory=lambda: [0.95, 0.6, 0.8])
    # Pixels nearer than this to a jump in depth or label are dropped (px), >= 0.
    erosion: int = 1
    # A jump is a difference between neighbours above this (m), > 0.
    depth_jump: float = 0.02
    # Connected groups of fewer voxels than this are dropped, >= 1 (1: none is dropped).
    min_cluster: int = 8


@dataclass
class Visualization:
    """What a person may look at while it runs."""

    # Starts a Meshcat server (on this machine only).
    meshcat: bool = False
    # Its port; null takes the first free one from 7000 on.
    port: int | None = None
    # Time between two updates of the scene (s), > 0.
    publish_period: float = 1.0 / 32.0
    # Also shows collision geometry (hidden at first) and contact forces.
    proximity: bool = True
    contacts: bool = False


@dataclass
class Task:
    """Which task is done."""

    # Name in the task registry of `iga_drake.tasks`.
    name: str = "grasp"
    # Simulated time after which the episode has failed (s), > 0.
    time_limit: float = 120.0


@dataclass
class Aligner:
    """Which alignment method predicts the waypoints."""

    # Name in the aligner registry of `iga_drake.aligners`.
    name: str = "iga"
    # What that aligner lets one choose, as numbers or text; it refuses names it doesn't know.
    options: dict[str, float | str] = field(default_factory=dict)
    # Probability, in [0, 1], that the demonstrations show such objects at all, below which the
    # policy refuses; 0 refuses nothing. Aligners that can't tell are not asked.
    minimum_familiarity: float = 0.0


@dataclass
class Control:
    """How the arm follows waypoints."""

    # Speed of the end-effector frame's origin (m/s), > 0.
    linear_speed: float = 0.2
    # Angular speed of the end-effector frame (rad/s), > 0.
    angular_speed: float = 0.8
    # Fraction of the robot's joint velocity limits that may be used, in (0, 1].
    joint_speed_scale: float = 0.9
    # Time between two commands to the arm (s), > 0.
    period: float = 0.01


@dataclass
class PhaseTimeLimits:
    """Time after which a phase of the policy has failed (s), each > 0.

    Simulated time, but for `infer`: that is wall-clock time.
    """

    observe_target: float = 20.0
    present: float = 20.0
    observe_grasped: float = 10.0
    infer: float = 60.0
    execute: float = 60.0


@dataclass
class Seeds:
    """Added to the episode's seed, so that one source of chance varies and the others stay.

    Each >= 0.
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

    # Physics: time step (s), contact model and solver.
    plant: MultibodyPlantConfig = field(default_factory=_plant)
    panda: Panda = field(default_factory=Panda)
    table: Table = field(default_factory=Table)
    # Name -> camera, at least one. A file that has this section states all cameras it wants.
    cameras: dict[str, Camera] = field(default_factory=_cameras)
    fusion: Fusion = field(default_factory=Fusion)
    visualization: Visualization = field(default_factory=Visualization)
    task: Task = field(default_factory=Task)
    aligner: Aligner = field(default_factory=Aligner)
    # Folder with the demonstrations; a relative path starts at `models/`.
    demonstrations: str = "demonstrations/grasp"
    control: Control = field(default_factory=Control)
    time_limits: PhaseTimeLimits = field(default_factory=PhaseTimeLimits)
    seeds: Seeds = field(default_factory=Seeds)

    @property
    def camera_names(self) -> tuple[str, ...]:
        """The cameras in the file's order."""
        return tuple(self.cameras)

    def to_yaml(self) -> str:
        """The whole scenario, defaults included, as text that `load_scenario` reads back."""
        return yaml_dump_typed(self, schema=Scenario)


def load_scenario(path: str | Path) -> Scenario:
    """Reads a scenario file.

    Raises `ScenarioError`, naming the file and the key, for a missing file, broken YAML, an unknown
    key (the valid ones are listed), a value of a wrong type and a value out of its range.
    """
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8") or "{}"
    except (OSError, UnicodeDecodeError) as e:
        raise ScenarioError(
            f"{path}: scenario can't be read ({e}): give the path of a .yaml"
        ) from e
    try:
        data = yaml_load(data=text, private=True)
    except yaml.YAMLError as e:
        raise ScenarioError(f"{path}: not valid YAML: {e}") from e
    if data is None:
        data, text = {}, "{}"
    try:
        _check_node(Scenario, data, "")
        scenario = yaml_load_typed(
            schema=Scenario, data=text, defaults=Scenario(), retain_map_defaults=False
        )
        _check_values(scenario)
    except ScenarioError as e:
        raise ScenarioError(f"{path}: {e}") from None
    except Exception as e:  # yaml_load_typed raises many kinds
        raise ScenarioError(f"{path}: {e}") from e
    return scenario


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
            raise ScenarioError(f"{name}: unknown tag {tag}; valid tags: {valid}")
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
                raise ScenarioError(f"unknown key '{key}' in {name}; valid keys: {valid}")
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
    return ScenarioError(f"{where}: expected {expected}, found {type(node).__name__} {node!r}")


_PANDA_VISUALS = ("auto", "meshes", "primitives")
# Drake itself looks at these names only when the plant is built.
_PLANT_CHOICES = {
    "contact_model": ("point", "hydroelastic", "hydroelastic_with_fallback"),
    "discrete_contact_approximation": ("tamsi", "sap", "similar", "lagged"),
    "contact_surface_representation": ("triangle", "polygon"),
}


def _check_values(s: Scenario) -> None:
    """Ranges and lengths; types are right already."""

    def need(ok: bool, where: str, value: typing.Any, allowed: str) -> None:
        if not ok:
            raise ScenarioError(f"{where}: {value!r} is out of range; allowed: {allowed}")

    def vector(value: list[float], where: str, size: int = 3) -> None:
        need(len(value) == size, where, value, f"{size} numbers")

    def positive(owner: typing.Any, where: str, *names: str) -> None:
        for name in names:
            need(getattr(owner, name) > 0, f"{where}.{name}", getattr(owner, name), "> 0")

    positive(s.plant, "plant", "time_step")
    for key, valid in _PLANT_CHOICES.items():
        value = getattr(s.plant, key)
        need(value in valid, f"plant.{key}", value, ", ".join(valid))
    look = s.panda.visuals
    need(look in _PANDA_VISUALS, "panda.visuals", look, ", ".join(_PANDA_VISUALS))
    vector(s.table.size, "table.size")
    need(min(s.table.size) > 0, "table.size", s.table.size, "3 numbers > 0")
    vector(s.table.center, "table.center", 2)
    vector(s.table.color, "table.color")
    need(s.table.friction >= 0, "table.friction", s.table.friction, ">= 0")
    need(len(s.cameras) > 0, "cameras", s.cameras, "at least one camera")
    for name, camera in s.cameras.items():
        at = f"cameras.{name}"
        pose = camera.pose
        if isinstance(pose, LookAt):
            vector(pose.position, f"{at}.pose.position")
            vector(pose.target, f"{at}.pose.target")
            sideways = math.dist(pose.position[:2], pose.target[:2])
            need(sideways > 1e-6, f"{at}.pose.target", pose.target, "not above or below position")
        else:
            vector(pose.translation, f"{at}.pose.translation")
            vector(pose.rpy, f"{at}.pose.rpy")
        k = camera.intrinsics
        positive(k, f"{at}.intrinsics", "width", "height", "fx", "fy")
        need(0 < k.cx < k.width, f"{at}.intrinsics.cx", k.cx, "inside the image")
        need(0 < k.cy < k.height, f"{at}.intrinsics.cy", k.cy, "inside the image")
        need(0 < camera.near < camera.far, f"{at}.near", camera.near, "0 < near < far")
        n, c = camera.noise, camera.calibration
        need(n.sigma_at_one_metre >= 0, f"{at}.noise.sigma_at_one_metre", n, ">= 0")
        p = n.dropout_probability
        need(0 <= p <= 1, f"{at}.noise.dropout_probability", p, "0..1")
        positive(n, f"{at}.noise", "dropout_jump", "quantisation_step", "frame_period")
        vector(c.center, f"{at}.calibration.center")
        positive(c, f"{at}.calibration", "radius")
        need(0 <= c.minimum <= c.maximum, f"{at}.calibration.minimum", c.minimum, "0..maximum")
        most = (c.maximum - c.minimum) / 2 / c.radius
        need(
            0 <= c.rotation <= most + 1e-12,
            f"{at}.calibration.rotation",
            c.rotation,
            f"0..(maximum - minimum) / (2 radius) = {most:.4g} rad",
        )
    f = s.fusion
    positive(f, "fusion", "voxel_size", "depth_jump", "min_cluster")
    need(f.erosion >= 0, "fusion.erosion", f.erosion, ">= 0")
    vector(f.crop_lower, "fusion.crop_lower")
    vector(f.crop_upper, "fusion.crop_upper")
    ordered = all(lo < up for lo, up in zip(f.crop_lower, f.crop_upper, strict=True))
    need(ordered, "fusion.crop_lower", f.crop_lower, f"below crop_upper = {f.crop_upper}")
    positive(s.visualization, "visualization", "publish_period")
    positive(s.task, "task", "time_limit")
    least = s.aligner.minimum_familiarity
    need(0 <= least <= 1, "aligner.minimum_familiarity", least, "0..1")
    positive(s.control, "control", "linear_speed", "angular_speed", "joint_speed_scale", "period")
    scale = s.control.joint_speed_scale
    need(scale <= 1, "control.joint_speed_scale", scale, "0..1")
    positive(s.time_limits, "time_limits", *vars(s.time_limits))
    for name, seed in vars(s.seeds).items():
        need(seed >= 0, f"seeds.{name}", seed, ">= 0")
