"""The schema of a task that a scenario file declares: objects, waypoints, success.

What it means is for `iga_drake.tasks.declared`. SI units, but angles are in degrees where the key
ends with `_deg`.
"""

import dataclasses
import hashlib
from dataclasses import dataclass, field
from pathlib import Path

from iga_drake.errors import check_bounds, check_range

Options = dict[str, bool | int | float | str]

_TAKEN = ("world", "table", "robot", "gripper", "panda")
_ROLES = ("target", "grasped", "other")
_XYZ, _RPY = (-10.0, 10.0), (-360.0, 360.0)


@dataclass
class FrameDeclaration:
    """A frame F in another one, or a pose."""

    # Origin (m), and roll, pitch and yaw (deg) in this order about fixed axes.
    xyz: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    rpy_deg: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    # Named frame of the object that these are given in; empty: the object's own.
    frame: str = ""

    def check(self, where: str) -> None:
        """Raises `ConfigError` for a value out of range."""
        _check_lists(self, where, {"xyz": 3, "rpy_deg": 3})
        check_bounds(self, where, {"xyz": _XYZ, "rpy_deg": _RPY})


@dataclass
class PlaceDeclaration:
    """Where an object may stand at the start."""

    # Corners of the rectangle that its origin is in: x and y in W (m), or in the frame that it
    # `stands_on`. Empty: [0.4, -0.25] to [0.65, 0.25], or that frame's origin.
    lower: list[float] = field(default_factory=list)
    upper: list[float] = field(default_factory=list)
    # Least and greatest distance (m) from W's z axis.
    reach: list[float] = field(default_factory=lambda: [0.3, 0.7])
    # Range of its turn about the vertical (deg).
    yaw_deg: list[float] = field(default_factory=lambda: [-180.0, 180.0])
    # How it stands before it is turned so: roll, pitch and yaw (deg).
    rpy_deg: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    # Another object stated before, and one of its frames, "box.top": it stands there. Empty: on
    # the table.
    stands_on: str = ""
    # Least distance (m) from the other objects on the table.
    clearance: float = 0.02

    def check(self, where: str) -> None:
        """Raises `ConfigError` for a value out of range."""
        corners = len(self.lower), len(self.upper)
        ok = corners in ((0, 0), (2, 2))
        check_range(ok, f"{where}.lower", [self.lower, self.upper], "2 numbers, and 2 of `upper`")
        _check_lists(self, where, {"reach": 2, "yaw_deg": 2, "rpy_deg": 3})
        bounds = {"lower": (-2.0, 2.0), "upper": (-2.0, 2.0), "reach": (0.0, 3.0)}
        check_bounds(
            self, where, bounds | {"yaw_deg": _RPY, "rpy_deg": _RPY, "clearance": (0.0, 1.0)}
        )
        ok = all(a <= b for a, b in zip(self.lower, self.upper, strict=True))
        check_range(ok, f"{where}.lower", self.lower, f"at most {self.upper}, its `upper`")
        for name in ("reach", "yaw_deg"):
            value = getattr(self, name)
            check_range(value[0] <= value[1], f"{where}.{name}", value, "the lesser one first")


@dataclass
class ObjectDeclaration:
    """An object: a parametric family, or files. Exactly one of the two is stated."""

    # Whose cloud it belongs to: "target", "grasped" or "other" (seen as background).
    role: str = "other"
    # Name of a family (`iga shapes list`), and ranges of parameters inside the family's own.
    family: str = ""
    parameters: dict[str, list[float]] = field(default_factory=dict)
    # Mesh files (.obj, .gltf, .glb, .ply, .stl) or models (.sdf, .urdf, .dmd.yaml), of which each
    # scene has one: paths relative to the scenario file, or package://NAME/... URIs.
    files: list[str] = field(default_factory=list)
    # Those of the test scenes, where they are not the same.
    test_files: list[str] = field(default_factory=list)
    # Of mesh files: metres per unit, the axis that points up ("x", "y", "z"; empty: y for glTF, z
    # for the others), and how many convex pieces collide at most.
    unit: float = 1.0
    up: str = ""
    pieces: int = 24
    # Of families and mesh files: kg / m^3 (0: the family's own, 500 for a mesh), or kg in its place
    # (0: not stated), Coulomb's friction coefficient, and diffuse colour (r, g, b in [0, 1]).
    density: float = 0.0
    mass: float = 0.0
    friction: float = 0.8
    color: list[float] = field(default_factory=lambda: [0.7, 0.7, 0.68])
    # Further frames, by name.
    frames: dict[str, FrameDeclaration] = field(default_factory=dict)
    # Where it stands.
    place: PlaceDeclaration = field(default_factory=PlaceDeclaration)
    # Where the end effector E is on it at the start, if it is in the hand: instead of `place`.
    held: FrameDeclaration | None = None
    # Where the hand shows it to the cameras while it is held (of E in W): none if it is seen so.
    present: FrameDeclaration | None = None

    def check(self, where: str) -> None:
        """Raises `ConfigError` for a value out of range."""
        check_range(self.role in _ROLES, f"{where}.role", self.role, ", ".join(_ROLES))
        one = bool(self.family) != bool(self.files)
        found = f"family '{self.family}' and {len(self.files)} files"
        check_range(one, where, found, "a family or files, one of the two")
        plain = not self.test_files or bool(self.files)
        check_range(plain, f"{where}.test_files", self.test_files, "none beside a family")
        bounds = {"unit": (1e-6, 1e3), "density": (0.0, 3e4), "mass": (0.0, 100.0)}
        check_bounds(self, where, bounds | {"friction": (0.0, 10.0), "pieces": (1, 500)})
        check_range(self.up in ("", "x", "y", "z"), f"{where}.up", self.up, "x, y, z")
        one = not (self.density and self.mass)
        check_range(one, f"{where}.mass", self.mass, "a mass or a density, one of the two")
        _check_lists(self, where, {"color": 3})
        check_bounds(self, where, {"color": (0.0, 1.0)})
        for name, limits in self.parameters.items():
            ok = len(limits) == 2 and limits[0] <= limits[1]
            check_range(ok, f"{where}.parameters.{name}", limits, "[least, greatest]")
        for name, frame in self.frames.items():
            frame.check(f"{where}.frames.{name}")
        self.place.check(f"{where}.place")
        for name in ("held", "present"):
            frame = getattr(self, name)
            if frame is not None:
                frame.check(f"{where}.{name}")


@dataclass
class ExpertDeclaration:
    """The pose that the expert goes to: a frame of the grasped object in one of the target's."""

    # Named frames of the grasped object (empty: its own; for the gripper E) and of the target.
    of: str = ""
    at: str = ""
    # Where the former is in the latter: origin (m), roll, pitch and yaw (deg).
    xyz: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    rpy_deg: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    # So many turns about the z axis of the target's frame do the same: the one that turns the hand
    # the least is taken. 1: none but this; 36 and more stand for any.
    turns: int = 1

    def check(self, where: str) -> None:
        """Raises `ConfigError` for a value out of range."""
        _check_lists(self, where, {"xyz": 3, "rpy_deg": 3})
        check_bounds(self, where, {"xyz": _XYZ, "rpy_deg": _RPY, "turns": (1, 360)})


@dataclass
class WaypointDeclaration:
    """A waypoint: what is related there, and how the hand moves around it (`WaypointMotion`)."""

    name: str = ""
    # "gripper" or an object that the hand holds then; an object that stands.
    grasped: str = "gripper"
    target: str = ""
    # Offsets (m) of the poses before and after it, along the axes of E there and of W.
    before_E: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    before_W: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    after_E: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    after_W: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    # Opening (m) on the way and at the waypoint.
    opening_approach: float = 0.08
    opening_reached: float = 0.0
    # Time for the hand there (s), change of force (N) that ends the way early (0: none), share of
    # the speed.
    settle: float = 1.0
    contact_force: float = 0.0
    speed_scale: float = 0.5
    expert: ExpertDeclaration = field(default_factory=ExpertDeclaration)

    def check(self, where: str) -> None:
        """Raises `ConfigError` for a value out of range."""
        offsets = dict.fromkeys(("before_E", "before_W", "after_E", "after_W"), 3)
        _check_lists(self, where, offsets)
        bounds = dict.fromkeys(offsets, (-1.0, 1.0))
        openings = dict.fromkeys(("opening_approach", "opening_reached"), (0.0, 0.08))
        rest = {"settle": (0.0, 60.0), "contact_force": (0.0, 100.0), "speed_scale": (0.01, 1.0)}
        check_bounds(self, where, bounds | openings | rest)
        check_range(bool(self.name), f"{where}.name", self.name, "a name")
        self.expert.check(f"{where}.expert")


@dataclass
class TaskDeclaration:
    """A whole task: its name is `task.name` of the scenario."""

    objects: dict[str, ObjectDeclaration] = field(default_factory=dict)
    waypoints: list[WaypointDeclaration] = field(default_factory=list)
    # Predicates that all have to hold at the end, each by its name with its fields.
    success: list[dict[str, Options]] = field(default_factory=list)
    # Joint angles at the start (deg); empty: those at which the hand points down before the robot.
    posture_deg: list[float] = field(default_factory=list)
    # Number of instances (draws of families, files in turn) of the two splits.
    demonstration_instances: int = 6
    test_instances: int = 8
    # Folders of packages that URIs name, by name; relative ones start at the scenario file.
    packages: dict[str, str] = field(default_factory=dict)
    # Folder at which relative paths start; empty: the one of the scenario file.
    folder: str = ""

    def check(self, where: str) -> None:
        """Raises `ConfigError` for a value out of range."""
        check_range(0 < len(self.objects) <= 50, f"{where}.objects", len(self.objects), "1 to 50")
        for name, item in self.objects.items():
            plain = name.isidentifier() and name.isascii()
            ok = plain and name not in _TAKEN
            allowed = f"letters, digits and _, a letter first, and not {', '.join(_TAKEN)}"
            check_range(ok, f"{where}.objects", name, allowed)
            item.check(f"{where}.objects.{name}")
        count = len(self.waypoints)
        check_range(0 < count <= 20, f"{where}.waypoints", count, "1 to 20")
        known = ", ".join(self.objects)
        for index, waypoint in enumerate(self.waypoints):
            at = f"{where}.waypoints[{index}]"
            waypoint.check(at)
            check_range(waypoint.target in self.objects, f"{at}.target", waypoint.target, known)
            ok = waypoint.grasped == "gripper" or waypoint.grasped in self.objects
            check_range(ok, f"{at}.grasped", waypoint.grasped, f"gripper, {known}")
        check_range(bool(self.success), f"{where}.success", self.success, "at least one predicate")
        for index, predicate in enumerate(self.success):
            ok = len(predicate) == 1
            check_range(
                ok, f"{where}.success[{index}]", list(predicate), "the name of one predicate"
            )
        check_range(
            len(self.posture_deg) in (0, 7),
            f"{where}.posture_deg",
            self.posture_deg,
            "7 angles (deg)",
        )
        counts = {"demonstration_instances": (1, 1000), "test_instances": (1, 1000)}
        check_bounds(self, where, counts | {"posture_deg": (-360.0, 360.0)})

    def path(self, name: str) -> Path:
        """A path of the file, relative ones from the folder."""
        try:
            path = Path(name).expanduser()
        except RuntimeError:  # no such user
            path = Path(name)
        return path if path.is_absolute() else Path(self.folder) / path

    def portable(self) -> "TaskDeclaration":
        """A copy that says the same wherever it is: without the folder, each local file with the
        digest of its content."""
        objects = {}
        for name, item in self.objects.items():
            objects[name] = dataclasses.replace(
                item,
                files=[f"{file} {self._digest(file)}" for file in item.files],
                test_files=[f"{file} {self._digest(file)}" for file in item.test_files],
            )
        return dataclasses.replace(self, folder="", objects=objects)

    def _digest(self, file: str) -> str:
        """Of a file's content; empty for what can't be read here."""
        try:
            return hashlib.sha256(self.path(file).read_bytes()).hexdigest()[:16]
        except (OSError, ValueError):
            return ""


def _check_lists(config: object, where: str, lengths: dict[str, int]) -> None:
    for name, length in lengths.items():
        value = getattr(config, name)
        check_range(len(value) == length, f"{where}.{name}", value, f"{length} numbers")
