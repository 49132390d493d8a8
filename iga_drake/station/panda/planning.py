"""The Panda above its table, as inverse kinematics sees it."""

import numpy as np
from pydrake.common import Parallelism
from pydrake.geometry import Box
from pydrake.math import RigidTransform
from pydrake.multibody.plant import CoulombFriction
from pydrake.planning import DofMask, RobotDiagramBuilder, SceneGraphCollisionChecker

from iga_drake.demonstrations.demonstration import HAND_OPENING_MAX
from iga_drake.planning.planning_robot import PlanningConfig, PlanningRobot
from iga_drake.station.panda.model import HOME_POSITION, add_panda
from iga_drake.station.scenario import Table

_THICKNESS = 0.4  # m, of the table in the model: nothing gets through it


def make_panda_planning_robot(
    table: Table | None, config: PlanningConfig | None = None
) -> PlanningRobot:
    """Builds the model that inverse kinematics and differential inverse kinematics work with.

    Args:
      table: what the robot stands on, its top at z = 0; None: there is none. In the model its top
        lies lower by the difference of the two distances that are kept.
      config: the distances.

    The hand is open as wide as it can: that keeps clear in every case.
    """
    config = config or PlanningConfig()
    config.check("PlanningConfig")
    builder = RobotDiagramBuilder(time_step=0.0)
    plant = builder.plant()
    panda = add_panda(plant, visuals="none")
    if table is not None:
        tabletop = plant.AddRigidBody("table", plant.AddModelInstance("table"))
        top = config.table_distance - config.safety_distance
        plant.WeldFrames(
            plant.world_frame(),
            tabletop.body_frame(),
            RigidTransform([*table.center, top - _THICKNESS / 2]),
        )
        plant.RegisterCollisionGeometry(
            tabletop,
            RigidTransform(),
            Box(*table.size[:2], _THICKNESS),
            "table",
            CoulombFriction(1.0, 1.0),
        )
    plant.Finalize()
    checker = SceneGraphCollisionChecker(
        model=builder.Build(),
        robot_model_instances=[panda.instance],
        edge_step_size=0.05,
        implicit_context_parallelism=Parallelism(1),
    )
    plant = checker.plant()
    if table is not None:  # the base stands on the table
        for name in ("panda_link0", "panda_link1", "panda_link2"):
            checker.SetCollisionFilteredBetween(
                plant.GetBodyByName("table"), plant.GetBodyByName(name), True
            )
    return PlanningRobot(
        checker=checker,
        safety_distance=config.safety_distance,
        frame_E=plant.GetFrameByName("panda_tcp"),
        active=DofMask([True] * 7 + [False] * 2),
        position_default=np.array([*HOME_POSITION, HAND_OPENING_MAX / 2, HAND_OPENING_MAX / 2]),
    )
