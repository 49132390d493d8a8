"""Tasks that a scenario file declares: no Python of their own."""

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from scipy.spatial import ConvexHull

from iga_drake.demonstrations.demonstration import HAND_OPENING_MAX
from iga_drake.errors import IgaDrakeError
from iga_drake.policy.motion import ObservationPlan, TaskMotion, WaypointMotion
from iga_drake.shapes.families import FAMILIES
from iga_drake.shapes.instance import ShapeInstance
from iga_drake.shapes.mesh_object import MeshReading, read_mesh_object
from iga_drake.shapes.sdf import write_sdf
from iga_drake.station.declaration import (
    ExpertDeclaration,
    FrameDeclaration,
    ObjectDeclaration,
    Options,
    PlaceDeclaration,
    TaskDeclaration,
    WaypointDeclaration,
)
from iga_drake.station.panda.model import HOME_POSITION
from iga_drake.station.simulated.model_files import (
    model_kind,
    model_shape,
    read_model,
    resolve_uri,
)
from iga_drake.station.simulated.scene import Scene, SceneObject, SceneTruth
from iga_drake.tasks import predicates
from iga_drake.tasks.holding import (
    centred_grip,
    draw_parameters,
    end_effector_pose,
    holding_scene,
)
from iga_drake.tasks.placement import CLEARANCE, WorkArea
from iga_drake.tasks.predicates import AllOf, CountOf, Predicate, WindowPredicate
from iga_drake.tasks.snapshots import ROBOT, TABLE, Snapshot, TaskError
from iga_drake.tasks.task import Split, Task

_GRIPPER = "gripper"
_TEST = 1_000  # seeds of the instances of the test split begin here
_REACH = HAND_OPENING_MAX / 2 + 0.005  # m from E, along the fingers' way, to what they close on
# Where the hand shows what it has picked up, if nothing is stated: pointing down, in the middle.
_PRESENT = RigidTransform(RollPitchYaw(np.pi, 0.0, 0.0), [0.44, 0.0, 0.42])
_PREDICATES: Mapping[str, type[WindowPredicate]] = {
    name: value
    for name, value in vars(predicates).items()
    if isinstance(value, type)
    and issubclass(value, WindowPredicate)
    and not value.__abstractmethods__
}
_NAMES_OF_OBJECTS = ("object", "other", "first", "second")


@dataclass(frozen=True)
class _Loaded:
    """One instance of a declared object."""

    shape: ShapeInstance
    model: str  # empty: written from the shape
    fixed: bool
    source: str


class DeclaredTask(Task):
    """A task made of a declaration; `name` is the one that demonstrations of it have."""

    def __init__(self, name: str, declaration: TaskDeclaration) -> None:
        """Raises `TaskError` and `PolicyError` for a declaration that makes no task."""
        self.name = name  # type: ignore[misc]
        self.declaration = declaration
        counts = declaration.demonstration_instances, declaration.test_instances
        self.seeds = {  # type: ignore[misc]
            "demonstration": tuple(range(counts[0])),
            "test": tuple(range(_TEST, _TEST + counts[1])),
        }
        self._loaded: dict[int, Mapping[str, _Loaded]] = {}
        self.observe_posture = np.array(HOME_POSITION)
        if declaration.posture_deg:
            self.observe_posture = np.radians(declaration.posture_deg)
        held = [name for name, item in declaration.objects.items() if item.held is not None]
        if len(held) > 1:
            raise TaskError(f"{name}: {', '.join(held)} are all held: the hand holds one at most")
        self._held = held[0] if held else None
        self.motion = _motion(declaration)
        self._goal = AllOf(
            predicates=tuple(
                _predicate(f"task.declared.success[{index}]", entry, declaration)
                for index, entry in enumerate(declaration.success)
            )
        )

    # Shapes

    def make_shapes(self, seed: int) -> Mapping[str, ShapeInstance]:  # type: ignore[override]
        """See `Task.make_shapes`."""
        return {name: item.shape for name, item in self._load(seed).items()}

    def instances(self, split: Split) -> tuple[Mapping[str, ShapeInstance], ...]:
        """See `Task.instances`."""
        if split not in self.seeds:
            raise TaskError(f"{self.name}: split '{split}' is none of {', '.join(self.seeds)}")
        return tuple(self.make_shapes(seed) for seed in self.seeds[split])

    def _load(self, seed: int) -> Mapping[str, _Loaded]:
        if seed not in self._loaded:
            loaded = {}
            for index, (name, item) in enumerate(self.declaration.objects.items()):
                rng = np.random.default_rng([seed, index])
                loaded[name] = self._load_object(name, item, seed, rng)
            self._loaded[seed] = loaded
        return self._loaded[seed]

    def _load_object(
        self, name: str, item: ObjectDeclaration, seed: int, rng: np.random.Generator
    ) -> _Loaded:
        where = f"task.declared.objects.{name}"
        model, fixed, source = "", False, ""
        if item.family:
            if item.family not in FAMILIES:
                raise TaskError(
                    f"{where}.family: '{item.family}' is none of {', '.join(sorted(FAMILIES))}"
                )
            limits = {key: (low, high) for key, (low, high) in item.parameters.items()}
            shape = FAMILIES[item.family].build(draw_parameters(item.family, limits, rng))
            if item.density:
                shape = dataclasses.replace(shape, density=item.density)
            if item.mass:
                shape = shape.with_mass(item.mass)
        else:
            files = item.test_files if seed >= _TEST and item.test_files else item.files
            path = self._file(where, files[seed % len(files)])
            source = str(path)
            if model_kind(path) is None:
                shape = _mesh_shape(path, item)
            else:
                if item.mass or item.density or item.unit != 1.0 or item.up:
                    raise TaskError(
                        f"{where}: mass, density, unit and up are for mesh files; {path.name} "
                        "states its own: leave them out"
                    )
                model = read_model(path, self._packages)
                shape, fixed = model_shape(model, name, source)
        frames = {
            key: (_frame(shape, pose.frame, where) @ _pose(pose)).GetAsMatrix4()
            for key, pose in item.frames.items()
        }
        shape = dataclasses.replace(shape, frames={**shape.frames, **frames})
        return _Loaded(shape, model, fixed, source)

    def _file(self, where: str, name: str) -> Path:
        """The file of a path or URI in the declaration."""
        if "://" not in name:
            name = str(self.declaration.path(name))
        try:
            return resolve_uri(name, Path(self.declaration.folder), self._packages)
        except IgaDrakeError as error:
            raise TaskError(f"{where}.files: {error}") from error

    @cached_property
    def _packages(self) -> Mapping[str, Path]:
        return {
            name: self.declaration.path(folder)
            for name, folder in self.declaration.packages.items()
        }

    # Scenes

    def arrange(self, truth: SceneTruth, rng: np.random.Generator, mesh_folder: Path) -> Scene:
        split: Split = "test" if truth.split == "test" else "demonstration"
        loaded = self._load(self.seeds[split][truth.instance])
        poses: dict[str, RigidTransform] = {}
        opening = HAND_OPENING_MAX
        if self._held is not None:
            poses[self._held], opening = self._grip(loaded[self._held].shape)
        footprints: list[np.ndarray] = []
        for name, item in self.declaration.objects.items():
            if name in poses:
                continue
            shape = loaded[name].shape
            if item.place.stands_on:
                poses[name] = self._upon(name, item.place, shape, loaded, poses, rng)
                continue
            try:
                poses[name] = _stand(item.place, shape, footprints, rng)
            except TaskError as error:
                raise TaskError(f"task.declared.objects.{name}.place: {error}") from error
            footprints.append(_footprint(shape, poses[name]))
        objects = tuple(
            SceneObject(
                name,
                item.role,  # type: ignore[arg-type]
                loaded[name].model
                or write_sdf(
                    loaded[name].shape,
                    mesh_folder,
                    name=name,
                    color=tuple(item.color),  # type: ignore[arg-type]
                    friction=item.friction,
                ),
                poses[name],
                loaded[name].source,
            )
            for name, item in self.declaration.objects.items()
        )
        if self._held is None:
            scene = Scene(
                objects=objects,
                panda_position=self.observe_posture.copy(),
                hand_opening=HAND_OPENING_MAX,
                truth=truth,
            )
        else:
            X_WE = end_effector_pose(self.observe_posture)
            scene = holding_scene(
                objects,
                self.observe_posture,
                held=self._held,
                X_EO=X_WE.inverse() @ poses[self._held],
                opening=opening,
                truth=truth,
            )
        self._check(scene)
        return scene

    def _grip(self, shape: ShapeInstance) -> tuple[RigidTransform, float]:
        """X_WO of the object in the hand, and the pads' distance (m)."""
        assert self._held is not None
        declared = self.declaration.objects[self._held].held
        assert declared is not None
        where = f"task.declared.objects.{self._held}.held"
        try:
            X_OE, opening = centred_grip(
                shape, _frame(shape, declared.frame, where) @ _pose(declared), reach=_REACH
            )
        except TaskError as error:
            raise TaskError(f"{where}: {error}: move E onto the object") from error
        if opening > HAND_OPENING_MAX:
            raise TaskError(
                f"{where}: the object is {opening:.3f} m wide between the pads, the hand opens "
                f"{HAND_OPENING_MAX} m: hold it elsewhere"
            )
        return end_effector_pose(self.observe_posture) @ X_OE.inverse(), opening

    def _upon(
        self,
        name: str,
        place: PlaceDeclaration,
        shape: ShapeInstance,
        loaded: Mapping[str, _Loaded],
        poses: Mapping[str, RigidTransform],
        rng: np.random.Generator,
    ) -> RigidTransform:
        """X_WO of an object on a frame of another."""
        where = f"task.declared.objects.{name}.place.stands_on"
        other, _, frame = place.stands_on.partition(".")
        if other not in poses:
            raise TaskError(
                f"{where}: '{place.stands_on}' found, an object that is stated before and its "
                "frame, such as box.top, expected"
            )
        X_WF = poses[other] @ _frame(loaded[other].shape, frame, where)
        x, y = rng.uniform(place.lower, place.upper) if place.lower else (0.0, 0.0)
        yaw = RotationMatrix.MakeZRotation(rng.uniform(*np.radians(place.yaw_deg)))
        return X_WF @ RigidTransform(yaw, [x, y, CLEARANCE]) @ _stood(place, shape)

    def _check(self, scene: Scene) -> None:
        """Asks expert and goal for all that they look up, before minutes of simulation.

        Raises `TaskError` for a frame, an object or a part that isn't there.
        """
        X_WO = {item.name: item.X_WO for item in scene.objects}
        X_WE = end_effector_pose(self.observe_posture)
        self.expert(scene, X_WO, X_WE)
        longest = max((p.for_last for p in self._windows() if math.isfinite(p.for_last)), default=0)
        times = np.arange(0.0, longest + 0.2, 0.1)
        still = [Snapshot(time, X_WO, X_WE, scene.hand_opening) for time in times]
        try:
            self._goal.judge(scene, still)
        except TaskError as error:
            raise TaskError(f"task.declared.success: {error}") from error

    def _windows(self) -> list[WindowPredicate]:
        stated = self._goal.predicates
        each = [p.predicates if isinstance(p, CountOf) else (p,) for p in stated]
        return [p for p in chain.from_iterable(each) if isinstance(p, WindowPredicate)]

    # Expert and goal

    def expert(
        self, scene: Scene, X_WO: Mapping[str, RigidTransform], X_WE: RigidTransform
    ) -> tuple[RigidTransform, ...]:
        return tuple(
            self._expert_pose(index, waypoint, scene.truth.shapes, X_WO, X_WE)
            for index, waypoint in enumerate(self.declaration.waypoints)
        )

    def _expert_pose(
        self,
        index: int,
        waypoint: WaypointDeclaration,
        shapes: Mapping[str, ShapeInstance],
        X_WO: Mapping[str, RigidTransform],
        X_WE: RigidTransform,
    ) -> RigidTransform:
        """X_WE at a waypoint: of those that do the same, the one that turns the hand the least,
        but for the turn of the arm towards it."""
        where = f"task.declared.waypoints[{index}].expert"
        expert: ExpertDeclaration = waypoint.expert
        X_WF = X_WO[waypoint.target] @ _frame(shapes[waypoint.target], expert.at, f"{where}.at")
        X_GE = RigidTransform()
        if waypoint.grasped != _GRIPPER:
            X_AG = _frame(shapes[waypoint.grasped], expert.of, f"{where}.of")
            X_GE = X_AG.inverse() @ X_WO[waypoint.grasped].inverse() @ X_WE
        elif expert.of:
            raise TaskError(f"{where}.of: '{expert.of}' found; the gripper has no frames but its E")
        poses = [
            X_WF
            @ RigidTransform(RotationMatrix.MakeZRotation(2 * np.pi * k / expert.turns), [0, 0, 0])
            @ _pose(expert)
            @ X_GE
            @ X_EE
            for k in range(expert.turns)
            for X_EE in self.motion.waypoints[index].symmetries_E
        ]
        return min(poses, key=lambda pose: _turn(X_WE, pose))

    def goal(self, truth: SceneTruth) -> Predicate:
        """All of the declared predicates."""
        return self._goal


def _turn(X_WE: RigidTransform, X_WE_then: RigidTransform) -> float:
    """Angle (rad) by which the hand turns, besides the arm's own turn towards where it goes."""
    p, q = X_WE.translation(), X_WE_then.translation()
    about = np.arctan2(q[1], q[0]) - np.arctan2(p[1], p[0])
    R = RotationMatrix.MakeZRotation(about) @ X_WE.rotation()
    return float((R.inverse() @ X_WE_then.rotation()).ToAngleAxis().angle())


def _motion(declaration: TaskDeclaration) -> TaskMotion:
    """The motion of the declared waypoints, with the observations that they relate."""
    plans: dict[str, ObservationPlan] = {}
    waypoints = []
    for index, item in enumerate(declaration.waypoints):
        target = declaration.objects[item.target]
        if target.role == "other":
            raise TaskError(
                f"task.declared.objects.{item.target}.role: 'other' found, but a waypoint relates "
                "it: target or grasped expected"
            )
        plans.setdefault(
            item.target,
            ObservationPlan(name=item.target, role=target.role, frame="W", upright=True),  # type: ignore[arg-type]
        )
        grasped = item.grasped
        if grasped == _GRIPPER:
            plan = ObservationPlan(name=grasped, role="gripper", frame="E")
        else:
            plan = _held_plan(declaration, item, index, picked=grasped in plans)
            grasped = plan.name
        plans.setdefault(grasped, plan)
        half_turn = RigidTransform(RotationMatrix.MakeZRotation(np.pi), [0, 0, 0])
        hand_alone = item.grasped == _GRIPPER
        waypoints.append(
            WaypointMotion(
                name=item.name,
                grasped=grasped,
                target=item.target,
                before_E=_three(item.before_E),
                before_W=_three(item.before_W),
                after_E=_three(item.after_E),
                after_W=_three(item.after_W),
                opening_approach=item.opening_approach,
                opening_reached=item.opening_reached,
                settle=item.settle,
                contact_force=item.contact_force or None,
                speed_scale=item.speed_scale,
                symmetries_E=(RigidTransform(), half_turn) if hand_alone else (RigidTransform(),),
            )
        )
    return TaskMotion(observations=tuple(plans.values()), waypoints=tuple(waypoints))


def _held_plan(
    declaration: TaskDeclaration, item: WaypointDeclaration, index: int, *, picked: bool
) -> ObservationPlan:
    """The observation of what the hand holds at a waypoint: from the start, or `picked` up."""
    thing = declaration.objects[item.grasped]
    where = f"task.declared.objects.{item.grasped}"
    if thing.role != "grasped":
        raise TaskError(f"{where}.role: '{thing.role}' found, but waypoint '{item.name}' moves it")
    if not picked and thing.held is None:
        raise TaskError(
            f"{where}: waypoint '{item.name}' moves it, but it is neither `held` at the start nor "
            "taken by the gripper at a waypoint before"
        )
    present = _PRESENT if picked else None
    if thing.present is not None:
        present = _pose(thing.present)
    return ObservationPlan(
        name=f"held {item.grasped}" if picked else item.grasped,
        role="grasped",
        frame="E",
        after=index if picked else 0,
        present=present,
    )


def _three(values: list[float]) -> tuple[float, float, float]:
    x, y, z = values
    return (x, y, z)


def _predicate(where: str, entry: Mapping[str, Options], declaration: TaskDeclaration) -> Predicate:
    """One entry of `success`; of several objects, that it holds of `at_least` so many."""
    ((name, given),) = entry.items()
    if name not in _PREDICATES:
        raise TaskError(f"{where}: '{name}' is no predicate: one of {', '.join(_PREDICATES)}")
    options = dict(given)
    objects = [part.strip() for part in str(options.get("object", "")).split(",")]
    count = options.pop("at_least", None)
    if count is None and len(objects) == 1:
        return _window_predicate(where, name, options, declaration)
    if not isinstance(count, (int, type(None))) or isinstance(count, bool):
        raise TaskError(f"{where}.{name}.at_least: {count!r} found, a whole number expected")
    each = [
        _window_predicate(where, name, {**options, "object": item}, declaration) for item in objects
    ]
    try:
        return CountOf(
            predicates=tuple(each),
            at_least=len(each) if count is None else count,
            name=str(options.get("name", "")),
            otherwise=str(options.get("otherwise", "")),
        )
    except TaskError as error:
        raise TaskError(f"{where}.{name}: {error}") from error


def _window_predicate(
    where: str, name: str, options: Mapping[str, Any], declaration: TaskDeclaration
) -> WindowPredicate:
    kind = _PREDICATES[name]
    known = {item.name: item for item in dataclasses.fields(kind)}
    values: dict[str, Any] = {}
    for key, given in options.items():
        field = key
        value: Any = given
        if key.endswith("_deg") and key.removesuffix("_deg") in known:
            field = key.removesuffix("_deg")
            value = math.radians(_number(f"{where}.{name}.{key}", given))
        if field not in known:
            raise TaskError(f"{where}.{name}: unknown key '{key}'; valid: {', '.join(known)}")
        wanted = known[field].type
        if field in _NAMES_OF_OBJECTS:
            value = _body(f"{where}.{name}.{key}", str(value), declaration)
        elif field == "parts":
            value = tuple(part.strip() for part in str(value).split(","))
        elif field == "for_last" and value == "always":
            value = math.inf
        elif wanted is float:
            value = _number(f"{where}.{name}.{key}", value)
        elif wanted is bool and not isinstance(value, bool):
            raise TaskError(f"{where}.{name}.{key}: {value!r} found, true or false expected")
        elif wanted is str:
            value = str(value)
        values[field] = value
    missing = [
        key
        for key, item in known.items()
        if key not in values and item.default is dataclasses.MISSING
    ]
    if missing:
        raise TaskError(f"{where}.{name}: {', '.join(missing)} not stated; it has to be")
    return kind(**values)


def _number(where: str, value: Any) -> float:
    if isinstance(value, bool):
        raise TaskError(f"{where}: {value!r} found, a number expected")
    try:
        return float(value)
    except ValueError as error:
        raise TaskError(f"{where}: {value!r} found, a number expected") from error


def _body(where: str, name: str, declaration: TaskDeclaration) -> str:
    if name == "table":
        return TABLE
    if name == ROBOT or name in declaration.objects:
        return name
    known = ", ".join([*declaration.objects, ROBOT, "table"])
    raise TaskError(f"{where}: '{name}' found, one of {known} expected")


def _mesh_shape(path: Path, item: ObjectDeclaration) -> ShapeInstance:
    reading = MeshReading(
        unit=item.unit,
        up=item.up,
        density=item.density or MeshReading.density,
        mass=item.mass or None,
        pieces=item.pieces,
    )
    return read_mesh_object(path, reading)


def _pose(pose: FrameDeclaration | ExpertDeclaration) -> RigidTransform:
    return RigidTransform(RollPitchYaw(np.radians(pose.rpy_deg)), pose.xyz)


def _frame(shape: ShapeInstance, name: str, where: str) -> RigidTransform:
    """X_OF of a named frame, the identity for an empty name."""
    if not name:
        return RigidTransform()
    if name not in shape.frames:
        raise TaskError(
            f"{where}: {shape.family} has no frame '{name}': it has "
            f"{', '.join(sorted(shape.frames))}; state others in the object's `frames`"
        )
    return RigidTransform(shape.frames[name])


def _stood(place: PlaceDeclaration, shape: ShapeInstance) -> RigidTransform:
    """The pose of the object, turned as it stands, above the point that it stands on."""
    R = RotationMatrix(RollPitchYaw(np.radians(place.rpy_deg)))
    lowest = (R.matrix() @ shape.vertices.T)[2].min()
    for piece in shape.convex_pieces:
        lowest = min(lowest, (R.matrix() @ piece.T)[2].min())
    return RigidTransform(R, [0.0, 0.0, -lowest])


def _stand(
    place: PlaceDeclaration,
    shape: ShapeInstance,
    footprints: list[np.ndarray],
    rng: np.random.Generator,
) -> RigidTransform:
    """X_WO on the table, away from what stands there already. Raises `TaskError`."""
    low, high = place.lower or (0.4, -0.25), place.upper or (0.65, 0.25)
    area = WorkArea(
        lower=(low[0], low[1]),
        upper=(high[0], high[1]),
        reach=(place.reach[0], place.reach[1]),
        yaw=(math.radians(place.yaw_deg[0]), math.radians(place.yaw_deg[1])),
    )
    stood = _stood(place, shape)

    def free(X_WO: RigidTransform) -> bool:
        own = _footprint(shape, X_WO @ stood)
        return all(_gap(own, other) >= place.clearance for other in footprints)

    return area.draw_pose(rng, serves=free) @ stood


def _footprint(shape: ShapeInstance, X_WO: RigidTransform) -> np.ndarray:
    """(n, 2) corners, in order, of the convex outline (m) of an object on the table."""
    points = X_WO.multiply(shape.vertices.T)[:2].T
    return points[ConvexHull(points).vertices]


def _gap(first: np.ndarray, second: np.ndarray) -> float:
    """The widest strip (m) between two convex outlines; negative where they overlap."""
    best = -np.inf
    for a, b in ((first, second), (second, first)):
        edges = np.roll(a, -1, axis=0) - a
        normals = np.column_stack([edges[:, 1], -edges[:, 0]])
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        gaps = (normals @ b.T).min(axis=1) - (normals @ a.T).max(axis=1)
        best = max(best, float(gaps.max()))
    return best
