"""Demonstrations as values: what was seen, and the waypoints that the end effector went through.

Frames: W is the robot's base, E the end-effector frame between the finger pads. Lengths are in m,
times in s. `store` reads and writes demonstrations, `plausibility` judges whether they can be true.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from types import MappingProxyType
from typing import Literal, get_args

import numpy as np

from iga_drake.demonstrations.alignment import Alignment
from iga_drake.errors import IgaDrakeError

HAND_OPENING_MAX = 0.08  # m, both fingers of the Franka Hand together
Frame = Literal["E", "W"]
ObservedRole = Literal["target", "grasped", "gripper"]
FRAMES: tuple[Frame, ...] = get_args(Frame)
_WHERE = {"E": "in the hand", "W": "where it stood"}
OBSERVED_ROLES: tuple[ObservedRole, ...] = get_args(ObservedRole)


class DemonstrationError(IgaDrakeError):
    """A demonstration can't be made, read or written; says the file, found, expected, remedy."""


def _finite(name: str, value: object, shape: tuple[int | None, ...]) -> np.ndarray:
    """A copy of `value` as finite float64 numbers of this shape (None: any length)."""
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise DemonstrationError(f"{name}: not an array of numbers ({error})") from error
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


def _rigid(name: str, pose: object) -> np.ndarray:
    """A copy of `pose` (4, 4) that is known to be a rotation over (0, 0, 0, 1)."""
    X = _finite(name, pose, (4, 4))
    R = X[:3, :3]
    if (
        not np.abs(R.T @ R - np.eye(3)).max() <= 1e-6
        or np.linalg.det(R) < 0
        or not np.array_equal(X[3], [0, 0, 0, 1])
    ):
        raise DemonstrationError(
            f"{name}: not a rigid transform: expected a rotation matrix (orthonormal, "
            "determinant 1) over the row (0, 0, 0, 1)"
        )
    return X


@dataclass(frozen=True, eq=False)
class Observation:
    """The cloud of one object, or of the gripper, as it was seen at one time."""

    # (P, 3) m, in `frame`.
    points: np.ndarray
    # What the cloud was segmented as. "gripper": the points of the hand's own model.
    role: ObservedRole
    # "E": the end-effector frame when it was seen, for what moves with the hand. "W": the world.
    frame: Frame
    # When it was seen (s since the demonstration began).
    time: float = 0.0
    # (3,) unit vector that points down, in `frame`, when it was seen.
    gravity: np.ndarray = field(default_factory=lambda: np.array([0.0, 0.0, -1.0]))
    # Whether the task always has the object this way up when it is seen: standing, or held alike.
    # Only then does `up` tell one part of it from another.
    upright: bool = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "points", _finite("points", self.points, (None, 3)))
        object.__setattr__(self, "gravity", _finite("gravity", self.gravity, (3,)))
        object.__setattr__(self, "time", float(_finite("time", self.time, ())))
        if not isinstance(self.upright, bool):
            raise DemonstrationError(f"upright: {self.upright!r} found, True or False expected")
        for name, value, allowed in (
            ("role", self.role, OBSERVED_ROLES),
            ("frame", self.frame, FRAMES),
        ):
            if value not in allowed:
                raise DemonstrationError(
                    f"{name}: {value!r} found, one of {', '.join(allowed)} expected"
                )
        if not abs(np.linalg.norm(self.gravity) - 1) <= 1e-6:
            raise DemonstrationError(
                f"gravity: {self.gravity} has length {np.linalg.norm(self.gravity):.4g}, a unit "
                "vector that points down is expected"
            )

    @property
    def up(self) -> np.ndarray | None:
        """(3,) unit vector against gravity in `frame`, fixed to the object; None where the object
        may be any way up."""
        return -self.gravity if self.upright else None


@dataclass(frozen=True, eq=False)
class Waypoint:
    """A pose of the end effector that relates two observed clouds, and what the hand does there."""

    name: str
    # (4, 4) pose of the end effector in W.
    X_WE: np.ndarray
    # Opening of the hand (m) commanded once the pose is reached.
    opening: float
    # Names of the demonstration's observations that the pose relates: one that moves with the hand
    # (in E) and one that stands still (in W).
    grasped: str
    target: str

    def __post_init__(self) -> None:
        object.__setattr__(self, "X_WE", _rigid(f"waypoint '{self.name}': X_WE", self.X_WE))
        opening = _finite(f"waypoint '{self.name}': opening", self.opening, ())
        object.__setattr__(self, "opening", float(opening))


@dataclass(frozen=True, eq=False)
class Trajectory:
    """The way of the end effector through the whole demonstration, K samples in order of time."""

    times: np.ndarray  # (K,) s since the demonstration began, never falling
    X_WE: np.ndarray  # (K, 4, 4)
    openings: np.ndarray  # (K,) m, measured

    def __post_init__(self) -> None:
        times = _finite("trajectory: times", self.times, (None,))
        object.__setattr__(self, "times", times)
        object.__setattr__(self, "X_WE", _finite("trajectory: X_WE", self.X_WE, (len(times), 4, 4)))
        openings = _finite("trajectory: openings", self.openings, (len(times),))
        object.__setattr__(self, "openings", openings)
        if (np.diff(times) < 0).any():
            raise DemonstrationError("trajectory: times fall, they must be in order")


@dataclass(frozen=True, kw_only=True)
class Provenance:
    """Where a demonstration comes from."""

    # "simulated expert", "taught on the arm", ...
    source: str = ""
    # Seed of the scene, the noise and all else that was drawn.
    seed: int | None = None
    # `Scenario.digest` of what it was recorded with.
    scenario: str = ""
    # Names of the cameras.
    sensors: tuple[str, ...] = ()
    # Name of each object -> what it was, such as "pan 3".
    instances: Mapping[str, str] = field(default_factory=dict)
    # `iga_drake.version.code_version()` of the software that recorded it.
    code: str = ""


@dataclass(frozen=True, eq=False)
class Demonstration:
    """One demonstrated task: waypoints in order, and the clouds that they relate."""

    # Name -> cloud. Every one is related by at least one waypoint.
    observations: Mapping[str, Observation]
    # One or more, in the order in which they were reached.
    waypoints: tuple[Waypoint, ...]
    trajectory: Trajectory | None = None
    provenance: Provenance = field(default_factory=Provenance)

    def __post_init__(self) -> None:
        object.__setattr__(self, "observations", MappingProxyType(dict(self.observations)))
        object.__setattr__(self, "waypoints", tuple(self.waypoints))
        if not self.waypoints:
            raise DemonstrationError("waypoints: none found, at least 1 expected")
        names = [waypoint.name for waypoint in self.waypoints]
        if len(set(names)) < len(names):
            raise DemonstrationError(f"waypoints: {names} found, each name must be there once")
        used = set()
        for waypoint in self.waypoints:
            for role, frame in (("grasped", "E"), ("target", "W")):
                name = getattr(waypoint, role)
                if name not in self.observations:
                    raise DemonstrationError(
                        f"waypoint '{waypoint.name}': relates the {role} observation '{name}', "
                        f"the demonstration has {sorted(self.observations)}"
                    )
                found = self.observations[name].frame
                if found != frame:
                    raise DemonstrationError(
                        f"waypoint '{waypoint.name}': the {role} observation '{name}' is in frame "
                        f"{found}, {frame} expected: relate the one that was made of it "
                        f"{_WHERE[frame]}"
                    )
                used.add(name)
        unused = sorted(set(self.observations) - used)
        if unused:
            raise DemonstrationError(f"observations: no waypoint relates {unused}: leave them out")

    @property
    def relations(self) -> tuple[tuple[str, str, str], ...]:
        """Name, grasped and target observation of each waypoint."""
        return tuple((w.name, w.grasped, w.target) for w in self.waypoints)

    def alignment(self, waypoint: int) -> Alignment:
        """Both clouds in W at a waypoint, with the ways up of upright objects: what is in E is
        carried there by the waypoint's X_WE."""
        at = self.waypoints[waypoint]
        grasped, target = self.observations[at.grasped], self.observations[at.target]
        R_WE, p_WE = at.X_WE[:3, :3], at.X_WE[:3, 3]
        return Alignment(
            grasped=grasped.points @ R_WE.T + p_WE,
            target=target.points,
            grasped_up=None if grasped.up is None else R_WE @ grasped.up,
            target_up=target.up,
        )


@dataclass(frozen=True, eq=False)
class DemonstrationSet:
    """Demonstrations of one task, all with the same waypoints that relate the same observations."""

    task: str
    demonstrations: tuple[Demonstration, ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "demonstrations", tuple(self.demonstrations))
        if not self.demonstrations:
            raise DemonstrationError(f"task '{self.task}': no demonstrations, at least 1 expected")
        kinds = {demonstration.relations for demonstration in self.demonstrations}
        if len(kinds) > 1:
            raise DemonstrationError(
                f"task '{self.task}': demonstrations with different waypoints found: "
                f"{sorted(kinds)}: keep one kind in a set"
            )

    def __len__(self) -> int:
        return len(self.demonstrations)

    @property
    def waypoints(self) -> tuple[str, ...]:
        """Names of the waypoints."""
        return tuple(waypoint.name for waypoint in self.demonstrations[0].waypoints)

    def opening(self, waypoint: int) -> float:
        """Median opening of the hand (m) commanded once the waypoint is reached."""
        return float(np.median([d.waypoints[waypoint].opening for d in self.demonstrations]))

    def turns(self, waypoint: int) -> np.ndarray:
        """Rotations R_EE' (D, 3, 3) of the hand from the waypoint before to this one, which isn't
        the first, one a demonstration."""
        R_WE = np.stack(
            [[w.X_WE[:3, :3] for w in d.waypoints[waypoint - 1 :][:2]] for d in self.demonstrations]
        )
        return np.swapaxes(R_WE[:, 0], 1, 2) @ R_WE[:, 1]

    @cached_property
    def contexts(self) -> tuple[tuple[Alignment, ...], ...]:
        """The aligner's context for each waypoint: one alignment a demonstration."""
        return tuple(
            tuple(demonstration.alignment(t) for demonstration in self.demonstrations)
            for t in range(len(self.waypoints))
        )

    def context(self, waypoint: int) -> tuple[Alignment, ...]:
        """The aligner's context for one waypoint: one alignment a demonstration.

        Raises `DemonstrationError` for an index out of range.
        """
        if not 0 <= waypoint < len(self.waypoints):
            raise DemonstrationError(
                f"task '{self.task}': waypoint {waypoint} asked for, 0 to "
                f"{len(self.waypoints) - 1} exist: {list(self.waypoints)}"
            )
        return self.contexts[waypoint]

    def first(self, count: int) -> "DemonstrationSet":
        """The first `count` demonstrations."""
        if not 1 <= count <= len(self):
            raise DemonstrationError(
                f"task '{self.task}': {count} demonstrations asked for, 1 to {len(self)} exist: "
                "ask for fewer or record more with `iga demonstrate`"
            )
        return DemonstrationSet(task=self.task, demonstrations=self.demonstrations[:count])
