"""What the tests of the control systems share."""

import functools

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw

from iga_drake.planning.inverse_kinematics import PoseSolver
from iga_drake.station.panda.planning import make_panda_planning_robot
from iga_drake.station.scenario import Table


@functools.cache
def panda_robot():
    """The planning robot; building it takes a moment."""
    return make_panda_planning_robot(Table())


@functools.cache
def panda_solver():
    return PoseSolver(panda_robot())


def downward(x, y, z, yaw=0.0):
    """A pose X_WE that points down."""
    return RigidTransform(RollPitchYaw(np.pi, 0.0, yaw), [x, y, z])
