"""Pick and insert: take a bottle from the table by its cap and put it into a shoe."""

from collections.abc import Mapping
from pathlib import Path
from typing import ClassVar

import numpy as np
from pydrake.math import RigidTransform

from iga_drake.demonstrations.demonstration import HAND_OPENING_MAX
from iga_drake.shapes.instance import ShapeInstance
from iga_drake.shapes.sdf import write_sdf
from iga_drake.station.simulated.scene import Scene, SceneObject, SceneTruth
from iga_drake.tasks.grasp import Grasp, pick_first
from iga_drake.tasks.holding import wrist_turn
from iga_drake.tasks.insert import HELD, TARGET, Insert, cap_grip
from iga_drake.tasks.placement import WorkArea
from iga_drake.tasks.predicates import Predicate
from iga_drake.tasks.task import Split, Task

LIFT = 0.22  # m, more than the shoe is high
_GRIP_DEPTH = 0.010  # m from the bottle's top to the middle of the pads
_ROOM = 0.09  # m from the bottle's axis to the shoe: an open finger goes down there
_SHOE_AREA = WorkArea(lower=(0.4, -0.3), upper=(0.66, 0.3), reach=(0.42, 0.64))
_BOTTLE_AREA = WorkArea(lower=(0.35, -0.35), upper=(0.66, 0.35), reach=(0.40, 0.64))
_FRICTION = (0.5, 0.8)
_COLORS = ((0.2, 0.45, 0.3), (0.25, 0.4, 0.62), (0.7, 0.35, 0.15), (0.5, 0.5, 0.52))
_LEATHERS = ((0.36, 0.22, 0.14), (0.16, 0.16, 0.17), (0.72, 0.7, 0.66), (0.45, 0.18, 0.16))
(_GRASP,) = Grasp.motion.waypoints
_INSERT = Insert()


class PickAndInsert(Task):
    """A bottle and a shoe or low boot stand anywhere in the work area; the hand takes the bottle by
    its cap from above, shows it to the cameras and puts it into the shoe, as `Insert` does."""

    name = "pick_and_insert"
    seeds: ClassVar[Mapping[Split, tuple[int, ...]]] = {
        "demonstration": tuple(range(1101, 1107)),
        "test": tuple(range(1201, 1211)),
    }
    observe_posture = _INSERT.observe_posture
    motion = pick_first(_INSERT.motion, held="bottle", target="shoe", lift=LIFT)

    @staticmethod
    def make_shapes(seed: int) -> Mapping[str, ShapeInstance]:
        """A shoe and a bottle that fits, as `Insert` draws them."""
        return Insert.make_shapes(seed)

    def arrange(self, truth: SceneTruth, rng: np.random.Generator, mesh_folder: Path) -> Scene:
        shapes = truth.shapes
        X_WT = _SHOE_AREA.draw_pose(rng, shapes[TARGET].frames["opening"][:3, 3])
        shoe = X_WT.multiply(shapes[TARGET].vertices.T)[:2].T

        def free(X_WO: RigidTransform) -> bool:
            return bool(np.linalg.norm(shoe - X_WO.translation()[:2], axis=1).min() >= _ROOM)

        X_WO_held = _BOTTLE_AREA.draw_pose(rng, serves=free)
        leather, color = (rgbs[rng.integers(len(rgbs))] for rgbs in (_LEATHERS, _COLORS))

        def sdf(name: str, rgb: tuple[float, float, float]) -> str:
            friction = rng.uniform(*_FRICTION)
            return write_sdf(shapes[name], mesh_folder, name=name, color=rgb, friction=friction)

        objects = (
            SceneObject(TARGET, "target", sdf(TARGET, leather), X_WT),
            SceneObject(HELD, "grasped", sdf(HELD, color), X_WO_held),
        )
        return Scene(
            objects=objects,
            panda_position=self.observe_posture.copy(),
            hand_opening=HAND_OPENING_MAX,
            truth=truth,
        )

    def expert(
        self, scene: Scene, X_WO: Mapping[str, RigidTransform], X_WE: RigidTransform
    ) -> tuple[RigidTransform, ...]:
        """The pads on both sides of the cap, across the bottle's narrow side; then as `Insert`'s,
        from where the bottle is in the hand."""
        X_OE, _ = cap_grip(scene.truth.shapes[HELD], depth=_GRIP_DEPTH, yaw=0.0)
        pick = min(
            (X_WO[HELD] @ X_OE @ X_EE for X_EE in _GRASP.symmetries_E),
            key=lambda pose: abs(wrist_turn(pose)),
        )
        return (pick, *_INSERT.expert(scene, X_WO, X_WE))

    def goal(self, truth: SceneTruth) -> Predicate:
        """As `Insert`."""
        return _INSERT.goal(truth)


TASKS = {PickAndInsert.name: PickAndInsert}
