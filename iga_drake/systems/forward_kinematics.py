"""Forward kinematics: measured joint angles become the measured end-effector pose."""

import numpy as np
from pydrake.common.value import AbstractValue, Value
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context, LeafSystem

from iga_drake.planning.planning_robot import PlanningRobot


class ForwardKinematics(LeafSystem):
    """The pose of the end effector.

    .. pydrake_system::

        name: ForwardKinematics
        input_ports:
        - position
        output_ports:
        - pose

    - `position` (N, rad): angles of the arm's joints.
    - `pose` (RigidTransform): X_WE; its translation is NaN where an angle isn't finite.
    """

    def __init__(self, robot: PlanningRobot) -> None:
        super().__init__()
        self.set_name("ForwardKinematics")
        self._robot = robot
        self._position_input = self.DeclareVectorInputPort("position", len(robot.indices))
        self.DeclareAbstractOutputPort(
            "pose",
            lambda: Value(RigidTransform()),
            self._calc_pose,
            {self._position_input.ticket()},
        )

    def _calc_pose(self, context: Context, output: AbstractValue) -> None:
        position = self._position_input.Eval(context)
        finite = np.isfinite(position).all()
        output.set_value(
            self._robot.pose(position) if finite else RigidTransform(np.full(3, np.nan))
        )
