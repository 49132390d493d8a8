import numpy as np
from control_fixtures import panda_robot
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant

from iga_drake.station.panda.model import add_panda
from iga_drake.systems.forward_kinematics import ForwardKinematics


def denavit_hartenberg(q):
    """X_WE from the manufacturer's table: (a, d, alpha) before each joint (Craig's convention)."""
    table = [
        (0, 0.333, 0),
        (0, 0, -np.pi / 2),
        (0, 0.316, np.pi / 2),
        (0.0825, 0, np.pi / 2),
        (-0.0825, 0.384, -np.pi / 2),
        (0, 0, np.pi / 2),
        (0.088, 0, np.pi / 2),
        (0, 0.107 + 0.1034, 0),
    ]
    X = np.eye(4)
    for (a, d, alpha), angle in zip(table, [*q, -np.pi / 4], strict=True):
        ca, sa, ct, st = np.cos(alpha), np.sin(alpha), np.cos(angle), np.sin(angle)
        X = X @ [
            [ct, -st, 0, a],
            [st * ca, ct * ca, -sa, -d * sa],
            [st * sa, ct * sa, ca, d * ca],
            [0, 0, 0, 1],
        ]
    return X


def test_pose_agrees_with_the_published_table():
    system = ForwardKinematics(panda_robot())
    context = system.CreateDefaultContext()
    limits = panda_robot().limits
    random = np.random.default_rng(0)
    for _ in range(30):
        q = random.uniform(limits.position_lower(), limits.position_upper())
        system.GetInputPort("position").FixValue(context, q)
        X_WE = system.GetOutputPort("pose").Eval(context)
        assert isinstance(X_WE, RigidTransform)
        np.testing.assert_allclose(X_WE.GetAsMatrix4(), denavit_hartenberg(q), atol=1e-9)


def test_pose_agrees_with_a_plant_of_its_own():
    plant = MultibodyPlant(0.0)
    panda = add_panda(plant, visuals="none")
    plant.Finalize()
    context = plant.CreateDefaultContext()
    panda.set_position(context, panda_robot().home)
    assert panda_robot().pose(panda_robot().home).IsNearlyEqualTo(panda.X_WE(context), 1e-9)
