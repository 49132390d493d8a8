"""The Panda above its table, as inverse kinematics sees it."""

import numpy as np
from pydrake.common import Parallelism
from pydrake.geometry import Box
from pydrake.math import RigidTransform
from pydrake.multibody.plant import CoulombFriction
from pydrake.planning import DofMask, RobotDiagramBuilder, SceneGraphCollisionChecker

from iga_drake.planning.planning_robot import PlanningRobot
from iga_drake.station.panda.model import HOME_POSITION, add_panda
from iga_drake.systems.ports import HAND_OPENING_MAX

_TABLE_SIZE = (2.4, 2.4, 0.4)  # m; its top is the plane z = 0


def make_panda_planning_robot(
    *,
    hand_opening: float = HAND_OPENING_MAX,
    safety_distance: float = 0.01,
    table_distance: float = 0.002,
    table: bool = True,
) -> PlanningRobot:
    """Builds the model that inverse kinematics and differential inverse kinematics work with.

    Args:
      hand_opening: opening (m) of the hand in the model; the widest keeps clear in every case.
      safety_distance: distance (m) that links keep from each other.
      table_distance: distance (m) that links keep from the table's top z = 0. The table of the
        model lies lower than the real one by the difference of the two.
      table: whether there is a table.
    """
    builder = RobotDiagramBuilder(time_step=0.0)
    plant = builder.plant()
    panda = add_panda(plant, visuals="none")
    if table:
        tabletop = plant.AddRigidBody("table", plant.AddModelInstance("table"))
        plant.WeldFrames(
            plant.world_frame(),
            tabletop.body_frame(),
            RigidTransform([0.0, 0.0, table_distance - safety_distance - _TABLE_SIZE[2] / 2]),
        )
        plant.RegisterCollisionGeometry(
            tabletop, RigidTransform(), Box(*_TABLE_SIZE), "table", CoulombFriction(1.0, 1.0)
        )
    plant.Finalize()
    checker = SceneGraphCollisionChecker(
        model=builder.Build(),
        robot_model_instances=[panda.instance],
        edge_step_size=0.05,
        implicit_context_parallelism=Parallelism(1),
    )
    plant = checker.plant()
    if table:  # the base stands on the table
        for name in ("panda_link0", "panda_link1", "panda_link2"):
            checker.SetCollisionFilteredBetween(
                plant.GetBodyByName("table"), plant.GetBodyByName(name), True
            )
    return PlanningRobot(
        checker=checker,
        safety_distance=safety_distance,
        frame_E=plant.GetFrameByName("panda_tcp"),
        active=DofMask([True] * 7 + [False] * 2),
        position_default=np.array([*HOME_POSITION, hand_opening / 2, hand_opening / 2]),
    )
