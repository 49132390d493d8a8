"""Success predicates: statements about the true states of an episode that hold or don't.

A task's success is a composition of them (`AllOf`, `CountOf`). Each judges the snapshots of the
last `for_last` seconds, or the last snapshot alone where that is 0, and says in words why it does
not hold.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import ClassVar, Literal

import numpy as np
from pydrake.math import RigidTransform
from scipy.spatial import ConvexHull, QhullError

from iga_drake.shapes.instance import ShapeInstance
from iga_drake.station.simulated.scene import Scene
from iga_drake.tasks.snapshots import ROBOT, TABLE, Snapshot, TaskError, last_seconds


@dataclass(frozen=True)
class Verdict:
    """Whether an episode succeeded, the first reason why not, and what was measured (SI)."""

    success: bool
    reason: str = ""
    measures: Mapping[str, float] = field(default_factory=dict)


class Predicate(ABC):
    """A statement about an episode."""

    @abstractmethod
    def judge(self, scene: Scene, snapshots: Sequence[Snapshot]) -> Verdict:
        """Judges true states in order of time.

        Raises `TaskError` where the snapshots are too few or too far apart, and where the scene has
        no such object, frame or part.
        """


@dataclass(frozen=True, kw_only=True)
class AllOf(Predicate):
    """Every one of `predicates` holds; the first in order that doesn't gives the reason."""

    predicates: tuple[Predicate, ...]

    def __post_init__(self) -> None:
        _require_predicates(self, self.predicates)

    def judge(self, scene: Scene, snapshots: Sequence[Snapshot]) -> Verdict:
        """Measures of all predicates together; `TaskError` where two have the same name."""
        verdicts = [predicate.judge(scene, snapshots) for predicate in self.predicates]
        measures: dict[str, float] = {}
        for verdict in verdicts:
            for name, value in verdict.measures.items():
                if name in measures:
                    raise TaskError(
                        f"AllOf: two predicates measure '{name}': give one of them a `name`"
                    )
                measures[name] = value
        reason = next((verdict.reason for verdict in verdicts if not verdict.success), "")
        return Verdict(all(verdict.success for verdict in verdicts), reason, measures)


@dataclass(frozen=True, kw_only=True)
class CountOf(Predicate):
    """At least `at_least` of `predicates` hold (one for each marble, say).

    Its one measure "count" is the number that hold; the predicates' own measures are dropped.
    """

    predicates: tuple[Predicate, ...]
    at_least: int
    # Prefix of the measure's name.
    name: str = ""
    # Replaces the general words of the failure reason; empty keeps them.
    otherwise: str = ""

    def __post_init__(self) -> None:
        _require_predicates(self, self.predicates)
        if not 1 <= self.at_least <= len(self.predicates):
            raise TaskError(
                f"CountOf.at_least: {self.at_least} found, 1 to {len(self.predicates)} expected"
            )

    def judge(self, scene: Scene, snapshots: Sequence[Snapshot]) -> Verdict:
        verdicts = [predicate.judge(scene, snapshots) for predicate in self.predicates]
        count = sum(verdict.success for verdict in verdicts)
        measures = {_measure_name(self.name, "count"): float(count)}
        if count >= self.at_least:
            return Verdict(True, "", measures)
        first = next(verdict.reason for verdict in verdicts if not verdict.success)
        text = self.otherwise or "too few hold"
        reason = f"{text} ({count} of {len(verdicts)}, at least {self.at_least}): {first}"
        return Verdict(False, reason, measures)


@dataclass(frozen=True, kw_only=True)
class WindowPredicate(Predicate):
    """A predicate about the end of an episode."""

    # How long it has to hold (s), up to the last snapshot; 0: at the last snapshot alone; infinite:
    # from the first snapshot on.
    for_last: float = 0.0
    # Prefix of the measure's name, for compositions in which two predicates measure the same.
    name: str = ""
    # Replaces the general words of the failure reason; empty keeps them.
    otherwise: str = ""

    def __post_init__(self) -> None:
        for item in fields(self):
            value = getattr(self, item.name)
            # An angle or a length below zero is never meant; neither is NaN.
            if isinstance(value, (float, int)) and not value >= 0:
                raise TaskError(f"{type(self).__name__}.{item.name}: {value} found, >= 0 expected")

    def judge(self, scene: Scene, snapshots: Sequence[Snapshot]) -> Verdict:
        if not snapshots:
            raise TaskError(f"{type(self).__name__}: there are no snapshots: record the episode")
        window: Sequence[Snapshot] = snapshots[-1:]
        if math.isinf(self.for_last):
            window = snapshots
        elif self.for_last > 0:
            window = last_seconds(scene.truth.task, snapshots, self.for_last)
        return self._judge_window(scene, window)

    @abstractmethod
    def _judge_window(self, scene: Scene, window: Sequence[Snapshot]) -> Verdict:
        """The verdict on the snapshots of the window, of which there is at least one."""

    def _during(self) -> str:
        return self._span("within the last {:g} s", "since the start")

    def _always(self) -> str:
        return self._span("for all of the last {:g} s", "for all of the time")

    def _span(self, seconds: str, whole: str) -> str:
        if not self.for_last > 0:
            return ""
        return " " + (whole if math.isinf(self.for_last) else seconds.format(self.for_last))


@dataclass(frozen=True, kw_only=True)
class Touching(WindowPredicate):
    """Two of the objects, `ROBOT` and `TABLE` touch at every time of the window, or at some time of
    it: what hangs or leans may rock from one point of contact to another."""

    first: str
    second: str
    # Whether every time of the window counts, else one is enough.
    always: bool = True

    def _judge_window(self, scene: Scene, window: Sequence[Snapshot]) -> Verdict:
        _require_bodies(window[-1], self.first, self.second)
        touches = [snapshot.touches(self.first, self.second) for snapshot in window]
        if all(touches) if self.always else any(touches):
            return Verdict(True)
        text = self.otherwise or f"{_spoken(self.first)} doesn't touch {_spoken(self.second)}"
        return Verdict(False, text + (self._always() if self.always else self._during()))


@dataclass(frozen=True, kw_only=True)
class NotTouching(WindowPredicate):
    """Two of the objects, `ROBOT` and `TABLE` touch at no time of the window."""

    first: str
    second: str

    def _judge_window(self, scene: Scene, window: Sequence[Snapshot]) -> Verdict:
        _require_bodies(window[-1], self.first, self.second)
        if not any(snapshot.touches(self.first, self.second) for snapshot in window):
            return Verdict(True)
        text = self.otherwise or f"{_spoken(self.first)} touches {_spoken(self.second)}"
        return Verdict(False, text + self._during())


@dataclass(frozen=True, kw_only=True)
class MeasuredPredicate(WindowPredicate):
    """A predicate that compares the worst value of a quantity in the window with a limit."""

    quantity: ClassVar[str]
    unit: ClassVar[Literal["m", "rad"]] = "m"
    bound: ClassVar[Literal["at most", "at least"]] = "at most"

    def _judge_window(self, scene: Scene, window: Sequence[Snapshot]) -> Verdict:
        values = self._values(scene, window)
        worst = float(values.max() if self.bound == "at most" else values.min())
        measures = {_measure_name(self.name, self.quantity): worst}
        limit = self._limit()
        if worst <= limit if self.bound == "at most" else worst >= limit:
            return Verdict(True, "", measures)
        text = self.otherwise or self._text()
        found, allowed = (self._quantity_text(value) for value in (worst, limit))
        return Verdict(False, f"{text}: {found}, {self.bound} {allowed} asked for", measures)

    def _quantity_text(self, value: float) -> str:
        return f"{np.degrees(value):.0f} deg" if self.unit == "rad" else f"{value:.3f} m"

    @abstractmethod
    def _values(self, scene: Scene, window: Sequence[Snapshot]) -> np.ndarray:
        """(n,) the quantity at each of n snapshots."""

    @abstractmethod
    def _limit(self) -> float:
        """The greatest or least value at which the predicate holds."""

    @abstractmethod
    def _text(self) -> str:
        """The failure reason in words, without the numbers."""


@dataclass(frozen=True, kw_only=True)
class Lifted(MeasuredPredicate):
    """An object's centre of mass is at least `height` (m) higher than at the start."""

    quantity = "lift"
    bound = "at least"
    object: str
    height: float

    def _values(self, scene: Scene, window: Sequence[Snapshot]) -> np.ndarray:
        p_OC = _point(scene, self.object, "")
        poses = {item.name: item.X_WO for item in scene.objects}
        if self.object not in poses:
            raise _unknown_object(self.object, poses)
        start = poses[self.object].multiply(p_OC)[2]
        return _positions(window, self.object, p_OC)[:, 2] - start

    def _limit(self) -> float:
        return self.height

    def _text(self) -> str:
        return f"{self.object} is not lifted enough"


@dataclass(frozen=True, kw_only=True)
class Upright(MeasuredPredicate):
    """The angle between an object's z axis and the vertical, or the z axis of the object `other`,
    is at most `tilt` (rad)."""

    quantity = "tilt"
    unit = "rad"
    object: str
    tilt: float
    other: str = ""

    def _values(self, scene: Scene, window: Sequence[Snapshot]) -> np.ndarray:
        axis = _axes(window, self.object)
        other = _axes(window, self.other) if self.other else np.array([0.0, 0.0, 1.0])
        sine = np.linalg.norm(np.cross(axis, other), axis=1)
        return np.arctan2(sine, (axis * other).sum(axis=1))

    def _limit(self) -> float:
        return self.tilt

    def _text(self) -> str:
        against = f" against {self.other}'s" if self.other else ""
        return f"{self.object}'s axis is tilted{against}"


@dataclass(frozen=True, kw_only=True)
class AtRest(MeasuredPredicate):
    """An object's origin was within `motion` (m) of its last position for the whole window."""

    quantity = "motion"
    object: str
    motion: float

    def __post_init__(self) -> None:
        super().__post_init__()
        _require_window(self)

    def _values(self, scene: Scene, window: Sequence[Snapshot]) -> np.ndarray:
        p_WO = _positions(window, self.object, np.zeros(3))
        return np.linalg.norm(p_WO - p_WO[-1], axis=1)

    def _limit(self) -> float:
        return self.motion

    def _text(self) -> str:
        return f"{self.object} still moves{self._during()}"


@dataclass(frozen=True, kw_only=True)
class HeldStill(MeasuredPredicate):
    """An object's centre of mass moved in the end effector frame E by at most `slip` (m) since the
    window began. Whether the hand touches it is for `Touching`."""

    quantity = "slip"
    object: str
    slip: float

    def __post_init__(self) -> None:
        super().__post_init__()
        _require_window(self)

    def _values(self, scene: Scene, window: Sequence[Snapshot]) -> np.ndarray:
        return _slips(scene, window, self.object)

    def _limit(self) -> float:
        return self.slip

    def _text(self) -> str:
        return f"{self.object} slipped in the hand{self._during()}"


@dataclass(frozen=True, kw_only=True)
class CarriedStill(MeasuredPredicate):
    """An object moved in the end effector frame E by at most `slip` (m), its centre of mass, while
    the hand carried it: the longest time in which the robot touched it and nothing else did. It
    holds where it was never carried."""

    quantity = "carrying_slip"
    object: str
    slip: float

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.for_last > 0:
            raise TaskError(
                f"CarriedStill.for_last: {self.for_last} s found, none expected: it judges the way "
                "for which the hand carries it"
            )

    def judge(self, scene: Scene, snapshots: Sequence[Snapshot]) -> Verdict:
        if not snapshots:
            raise TaskError("CarriedStill: there are no snapshots: record the episode")
        _require_bodies(snapshots[0], self.object)
        held = frozenset((self.object, ROBOT))
        carried: list[Snapshot] = []  # the longest time so far
        alone: list[Snapshot] = []  # since something else last touched it
        for snapshot in snapshots:
            touching = {pair for pair in snapshot.contacts if self.object in pair}
            alone = [] if touching - {held} else [*alone, snapshot]
            if len(alone) > len(carried) and any(held in s.contacts for s in alone):
                carried = alone
        return self._judge_window(scene, carried or snapshots[:1])

    def _values(self, scene: Scene, window: Sequence[Snapshot]) -> np.ndarray:
        return _slips(scene, window, self.object)

    def _limit(self) -> float:
        return self.slip

    def _text(self) -> str:
        return f"{self.object} slipped in the hand on the way"


@dataclass(frozen=True, kw_only=True)
class NearAxis(MeasuredPredicate):
    """A point of an object is at most `offset` (m) from the z axis of a frame of `other`."""

    quantity = "offset"
    object: str
    other: str
    offset: float
    # A named frame of the object, whose origin is the point; "": the centre of mass.
    point: str = ""
    # A named frame of the other.
    frame: str = "opening"

    def _values(self, scene: Scene, window: Sequence[Snapshot]) -> np.ndarray:
        p_FP = _positions_in_frame(scene, window, self.object, self.point, self.other, self.frame)
        return np.hypot(p_FP[:, 0], p_FP[:, 1])

    def _limit(self) -> float:
        return self.offset

    def _text(self) -> str:
        return f"{self.object} is off the axis of {self.other}'s {self.frame}"


@dataclass(frozen=True, kw_only=True)
class Below(MeasuredPredicate):
    """A point of an object is at least `depth` (m) below the xy plane of a frame of `other`, its
    rim's say: along the frame's -z."""

    quantity = "depth"
    bound = "at least"
    object: str
    other: str
    depth: float
    # Name of the point, as `NearAxis.point`.
    point: str = ""
    frame: str = "opening"

    def _values(self, scene: Scene, window: Sequence[Snapshot]) -> np.ndarray:
        p_FP = _positions_in_frame(scene, window, self.object, self.point, self.other, self.frame)
        return -p_FP[:, 2]

    def _limit(self) -> float:
        return self.depth

    def _text(self) -> str:
        return f"{self.object} is not far enough below {self.other}'s {self.frame}"


@dataclass(frozen=True, kw_only=True)
class Within(MeasuredPredicate):
    """A point of an object is at most `distance` (m) from the origin of a frame of `other`."""

    quantity = "distance"
    object: str
    other: str
    distance: float
    frame: str
    # Name of the point, as `NearAxis.point`.
    point: str = ""

    def _values(self, scene: Scene, window: Sequence[Snapshot]) -> np.ndarray:
        p_FP = _positions_in_frame(scene, window, self.object, self.point, self.other, self.frame)
        return np.linalg.norm(p_FP, axis=1)

    def _limit(self) -> float:
        return self.distance

    def _text(self) -> str:
        return f"{self.object} is away from {self.other}'s {self.frame}"


@dataclass(frozen=True, kw_only=True)
class Inside(MeasuredPredicate):
    """A point of an object is in the convex hull of parts of `other`, at least `margin` (m) from
    the hull's planes: in a vessel's cavity, between a dustpan's walls.

    The measure is below 0 outside; there its size is at most the distance from the hull.
    """

    quantity = "margin_inside"
    bound = "at least"
    object: str
    other: str
    margin: float = 0.0
    # Names of the parts of `other` that span the hull; empty: all its parts.
    parts: tuple[str, ...] = ()
    # Name of the point, as `NearAxis.point`.
    point: str = ""

    def _values(self, scene: Scene, window: Sequence[Snapshot]) -> np.ndarray:
        shape = _shape(scene, self.other)
        unknown = sorted(set(self.parts) - set(shape.part_names))
        if unknown:
            raise TaskError(
                f"Inside.parts: {', '.join(unknown)} found, {self.other} has "
                f"{', '.join(shape.part_names)}"
            )
        corners = shape.part_vertices(*(self.parts or shape.part_names))
        try:
            planes = ConvexHull(corners).equations  # (f, 4): outward normal, offset
        except QhullError as error:
            raise TaskError(
                f"Inside.parts: {', '.join(self.parts)} of {self.other} is flat: name a part more"
            ) from error
        p_BP = _positions_relative(scene, window, self.object, self.point, self.other)
        return -(p_BP @ planes[:, :3].T + planes[:, 3]).max(axis=1)

    def _limit(self) -> float:
        return self.margin

    def _text(self) -> str:
        return f"{self.object} is not inside {self.other}"


def _spoken(name: str) -> str:
    return {ROBOT: "the robot", TABLE: "the table"}.get(name, name)


def _measure_name(prefix: str, quantity: str) -> str:
    return f"{prefix}_{quantity}" if prefix else quantity


def _require_predicates(owner: Predicate, predicates: tuple[Predicate, ...]) -> None:
    if not predicates:
        raise TaskError(f"{type(owner).__name__}.predicates: none found, at least 1 expected")


def _require_window(predicate: WindowPredicate) -> None:
    if not predicate.for_last > 0:
        raise TaskError(
            f"{type(predicate).__name__}.for_last: {predicate.for_last} s found, > 0 expected"
        )


def _unknown_object(name: str, known: Iterable[str]) -> TaskError:
    return TaskError(f"there is no object '{name}': the scene has {', '.join(sorted(known))}")


def _require_bodies(snapshot: Snapshot, *names: str) -> None:
    known = {*snapshot.X_WO, ROBOT, TABLE}
    for name in names:
        if name not in known:
            raise _unknown_object(name, known)


def _shape(scene: Scene, name: str) -> ShapeInstance:
    if name not in scene.truth.shapes:
        raise _unknown_object(name, scene.truth.shapes)
    return scene.truth.shapes[name]


def _frame(scene: Scene, name: str, frame: str) -> RigidTransform:
    """X_OF of a named frame of an object."""
    frames = _shape(scene, name).frames
    if frame not in frames:
        raise TaskError(f"{name} has no frame '{frame}': it has {', '.join(sorted(frames))}")
    return RigidTransform(frames[frame])


def _point(scene: Scene, name: str, point: str) -> np.ndarray:
    """p_OP (3,) m, the origin of a named frame of an object; "": its centre of mass."""
    if not point:
        return _shape(scene, name).mass_properties.p_OCcm
    return _frame(scene, name, point).translation()


def _pose(snapshot: Snapshot, name: str) -> RigidTransform:
    if name not in snapshot.X_WO:
        raise _unknown_object(name, snapshot.X_WO)
    return snapshot.X_WO[name]


def _positions(window: Sequence[Snapshot], name: str, p_OP: np.ndarray) -> np.ndarray:
    """(n, 3) p_WP (m) of a point of an object at each of n snapshots."""
    return np.array([_pose(snapshot, name).multiply(p_OP) for snapshot in window])


def _slips(scene: Scene, window: Sequence[Snapshot], name: str) -> np.ndarray:
    """(n,) distances (m) that an object's centre of mass has moved in E since the window began."""
    p_WC = _positions(window, name, _point(scene, name, ""))
    p_EC = np.array([s.X_WE.inverse().multiply(p) for s, p in zip(window, p_WC, strict=True)])
    return np.linalg.norm(p_EC - p_EC[0], axis=1)


def _axes(window: Sequence[Snapshot], name: str) -> np.ndarray:
    """(n, 3) an object's z axis in W at each of n snapshots."""
    return np.array([_pose(snapshot, name).rotation().matrix()[:, 2] for snapshot in window])


def _positions_relative(
    scene: Scene, window: Sequence[Snapshot], name: str, point: str, other: str
) -> np.ndarray:
    """(n, 3) a point of an object in the frame of another (m) at each of n snapshots."""
    p_WP = _positions(window, name, _point(scene, name, point))
    return np.array(
        [_pose(s, other).inverse().multiply(p) for s, p in zip(window, p_WP, strict=True)]
    )


def _positions_in_frame(
    scene: Scene, window: Sequence[Snapshot], name: str, point: str, other: str, frame: str
) -> np.ndarray:
    """(n, 3) a point of an object in a named frame of another (m) at each of n snapshots."""
    X_FB = _frame(scene, other, frame).inverse()
    return X_FB.multiply(_positions_relative(scene, window, name, point, other).T).T
