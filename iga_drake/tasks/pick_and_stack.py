"""Pick and stack: take a bowl from the table by its rim and put it into another one."""

from collections.abc import Mapping
from pathlib import Path
from typing import ClassVar

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix

from iga_drake.demonstrations.demonstration import HAND_OPENING_MAX
from iga_drake.shapes.families import bowl
from iga_drake.shapes.instance import ShapeInstance
from iga_drake.shapes.sdf import write_sdf
from iga_drake.station.simulated.scene import Scene, SceneObject, SceneTruth
from iga_drake.tasks.grasp import pick_first
from iga_drake.tasks.placement import WorkArea
from iga_drake.tasks.predicates import AllOf, CarriedStill, Predicate
from iga_drake.tasks.stack import HELD, TARGET, WORK_AREA, Stack, grip, nesting_bowls
from iga_drake.tasks.task import Split, Task

# m in the hand, on the way: a bowl that is not held right above its middle swings in the fingers
# when it is lifted, and is seen again after that.
SLIP = 0.04
LIFT = 0.2  # m, more than the other bowl is high
_GRIP_DEPTH = 0.010  # m from the rim to the middle of the pads: as much above it as below is left
_ASIDE = 0.12  # m, least distance of the lower bowl from the robot's plane of symmetry
_HAND = 0.12  # m between the two rims: half the hand goes down there
_UPPER_AREA = WorkArea(lower=(0.42, -0.3), upper=(0.65, 0.3), reach=(0.55, 0.68))
_COLORS = ((0.85, 0.83, 0.76), (0.2, 0.42, 0.6), (0.72, 0.35, 0.24), (0.35, 0.55, 0.4))
_STACK = Stack()


class PickAndStack(Task):
    """Two bowls stand anywhere in the work area; the hand takes one by its rim from above, shows it
    to the cameras and puts it into the other one, as `Stack` does."""

    name = "pick_and_stack"
    seeds: ClassVar[Mapping[Split, tuple[int, ...]]] = {
        "demonstration": tuple(range(901, 907)),
        "test": tuple(range(1001, 1011)),
    }
    observe_posture = _STACK.observe_posture
    motion = pick_first(_STACK.motion, held="upper bowl", target="lower bowl", lift=LIFT)

    @staticmethod
    def make_shapes(seed: int) -> Mapping[str, ShapeInstance]:
        return nesting_bowls(seed, depth=_GRIP_DEPTH)

    def arrange(self, truth: SceneTruth, rng: np.random.Generator, mesh_folder: Path) -> Scene:
        shapes = truth.shapes
        colors = rng.permutation(len(_COLORS))
        # The lower bowl to the left or the right, so that there is room for the other one.
        X_WT = WORK_AREA.draw_pose(rng, serves=lambda X: abs(X.translation()[1]) >= _ASIDE)
        radii = sum(shape.parameters["diameter"] / 2 for shape in shapes.values())

        def free(X_WO: RigidTransform) -> bool:
            distance = np.linalg.norm(X_WO.translation() - X_WT.translation())
            return bool(distance >= radii + _HAND)

        X_WO_held = _UPPER_AREA.draw_pose(rng, serves=free)

        def sdf(name: str, color: int) -> str:
            rgb = _COLORS[colors[color]]
            return write_sdf(shapes[name], mesh_folder, name=name, color=rgb, friction=0.7)

        objects = (
            SceneObject(TARGET, "target", sdf(TARGET, 0), X_WT),
            SceneObject(HELD, "grasped", sdf(HELD, 1), X_WO_held),
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
        """The fingers along the wall on the side of the robot's base, one inside and one outside;
        then as `Stack`'s, from where the bowl is in the hand."""
        X_OE, _ = grip(scene.truth.shapes[HELD], depth=_GRIP_DEPTH, roll=0.0)
        # The same hold in the middle of each of the wall's flat sectors.
        turns = np.arange(bowl.SECTORS) * 2 * np.pi / bowl.SECTORS
        pick = min(
            (
                X_WO[HELD] @ RigidTransform(RotationMatrix.MakeZRotation(turn), [0, 0, 0]) @ X_OE
                for turn in turns
            ),
            key=lambda pose: float(np.linalg.norm(pose.translation()[:2])),
        )
        return (pick, *_STACK.expert(scene, X_WO, X_WE))

    def goal(self, truth: SceneTruth) -> Predicate:
        """As `Stack`, and the bowl didn't slip far in the hand on its way."""
        carried = CarriedStill(object=HELD, slip=SLIP, otherwise="the bowl slipped in the hand")
        return AllOf(predicates=(carried, _STACK.goal(truth)))


TASKS = {PickAndStack.name: PickAndStack}
