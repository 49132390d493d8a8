"""External force on the hand, from the external torques at the joints."""

import numpy as np
from pydrake.multibody.tree import JacobianWrtVariable
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from iga_drake.planning.planning_robot import PlanningRobot

# Directions in which the arm moves less than this share of its best one carry no force estimate:
# near a singularity the torques say nothing about them.
_SINGULAR = 0.02


class ExternalForce(LeafSystem):
    """The force on the hand that explains the joints' external torques.

    .. pydrake_system::

        name: ExternalForce
        input_ports:
        - position
        - torque_external
        output_ports:
        - force

    - `position` (N, rad), `torque_external` (N, N m): of the arm's joints.
    - `force` (3, N in W): the force part of the wrench F at E of least norm with torque = J^T F. It
      is the sum of all forces on hand and held object if nothing else touches the arm; a moment is
      told apart from it. A held object's weight is part of it. NaN where an input isn't finite.

    Computed where it is asked for, once per time.
    """

    def __init__(self, robot: PlanningRobot) -> None:
        super().__init__()
        self.set_name("ExternalForce")
        self._robot = robot
        count = len(robot.indices)
        self._position_input = self.DeclareVectorInputPort("position", count)
        self._torque_input = self.DeclareVectorInputPort("torque_external", count)
        self.DeclareVectorOutputPort(
            "force",
            3,
            self._calc_force,
            {self._position_input.ticket(), self._torque_input.ticket()},
        )

    def _calc_force(self, context: Context, output: BasicVector) -> None:
        robot, plant = self._robot, self._robot.checker.plant()
        position, torque = self._position_input.Eval(context), self._torque_input.Eval(context)
        if not (np.isfinite(position).all() and np.isfinite(torque).all()):
            output.SetFromVector(np.full(3, np.nan))
            return
        plant_context = robot.checker.UpdatePositions(robot.full(position))
        world = plant.world_frame()
        jacobian = plant.CalcJacobianSpatialVelocity(
            plant_context, JacobianWrtVariable.kV, robot.frame_E, np.zeros(3), world, world
        )[:, robot.indices]
        output.SetFromVector((np.linalg.pinv(jacobian.T, rcond=_SINGULAR) @ torque)[3:])
