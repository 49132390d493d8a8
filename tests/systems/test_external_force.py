import numpy as np
from control_fixtures import panda_robot
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import Context

from iga_drake.station.panda.model import add_panda
from iga_drake.systems.external_force import ExternalForce


def evaluate(system: ExternalForce, q: np.ndarray, torque: np.ndarray) -> np.ndarray:
    context: Context = system.CreateDefaultContext()
    system.GetInputPort("position").FixValue(context, q)
    system.GetInputPort("torque_external").FixValue(context, torque)
    return system.GetOutputPort("force").Eval(context)


def torque_of(q: np.ndarray, p_EP: np.ndarray, force_W: np.ndarray) -> np.ndarray:
    """Joint torques of a force at P, by virtual work: differences of P's position."""
    plant = MultibodyPlant(0.0)
    panda = add_panda(plant, visuals="none")
    plant.Finalize()
    context = plant.CreateDefaultContext()

    def position(angles: np.ndarray) -> np.ndarray:
        panda.set_position(context, angles)
        return panda.X_WE(context) @ p_EP

    step = 1e-6
    columns = [(position(q + e) - position(q - e)) / (2 * step) for e in step * np.eye(len(q))]
    return np.array(columns) @ force_W


def test_a_force_anywhere_on_the_hand_is_found_from_the_torques():
    system, home = ExternalForce(panda_robot()), panda_robot().home
    random = np.random.default_rng(0)
    for _ in range(10):
        q = home + random.uniform(-0.3, 0.3, 7)
        force = random.uniform(-40.0, 40.0, 3)
        torque = torque_of(q, random.uniform(-0.1, 0.1, 3), force)
        np.testing.assert_allclose(evaluate(system, q, torque), force, atol=1e-4)


def test_no_torque_is_no_force():
    force = evaluate(ExternalForce(panda_robot()), panda_robot().home, np.zeros(7))
    np.testing.assert_array_equal(force, np.zeros(3))


def test_a_stretched_arm_gives_finite_forces():
    # Nearly straight up: the torques tell nothing about the force along the arm.
    q = np.array([0.0, 0.0, 0.0, -0.07, 0.0, 0.07, 0.0])
    torque = torque_of(q, np.zeros(3), np.array([5.0, 0.0, 0.0])) + 0.1
    assert np.linalg.norm(evaluate(ExternalForce(panda_robot()), q, torque)) < 50.0
