import math
from pathlib import Path

import numpy as np
import pytest
from pydrake.geometry import (
    AddContactMaterial,
    AddRigidHydroelasticProperties,
    Box,
    ProximityProperties,
    Role,
)
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import (
    AddMultibodyPlant,
    AddMultibodyPlantSceneGraph,
    CoulombFriction,
    MultibodyPlant,
    MultibodyPlantConfig,
)
from pydrake.multibody.tree import SpatialInertia
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from scipy.spatial import cKDTree

from iga_drake.planning.inverse_kinematics import PoseSolver
from iga_drake.station.panda import model as panda_module
from iga_drake.station.panda.command import PandaCommand
from iga_drake.station.panda.model import (
    ACCELERATION_LIMIT,
    EFFORT_LIMIT,
    HOME_POSITION,
    POSITION_LOWER,
    POSITION_UPPER,
    VELOCITY_LIMIT,
    PandaError,
    add_panda,
    gripper_boxes,
    gripper_cloud,
)
from iga_drake.station.panda.planning import make_panda_planning_robot
from iga_drake.station.scenario import Table


@pytest.fixture(scope="module")
def panda():
    plant = MultibodyPlant(0.0)
    model = add_panda(plant, visuals="none")
    plant.Finalize()
    return model


@pytest.fixture(scope="module")
def pinocchio_model():
    """The same robot from another file, read by another library."""
    import pinocchio

    (prefix,) = {
        p
        for p in Path(pinocchio.__file__).resolve().parents
        if (p / "share/example-robot-data").is_dir()
    }
    urdf = prefix / "share/example-robot-data/robots/panda_description/urdf/panda.urdf"
    return pinocchio.buildModelFromUrdf(str(urdf))


def random_positions(count, seed=0):
    return np.random.default_rng(seed).uniform(POSITION_LOWER, POSITION_UPPER, (count, 7))


def test_forward_kinematics_agrees_with_pinocchio(panda, pinocchio_model):
    import pinocchio

    data = pinocchio_model.createData()
    context = panda.plant.CreateDefaultContext()
    for q in random_positions(50):
        panda.set_position(context, q)
        pinocchio.framesForwardKinematics(pinocchio_model, data, np.r_[q, 0.0, 0.0])
        for name in ("panda_link5", "panda_hand", "panda_leftfinger", "panda_hand_tcp"):
            X_WF = data.oMf[pinocchio_model.getFrameId(name)]
            ours = panda.plant.GetFrameByName(name.replace("hand_tcp", "tcp"))
            np.testing.assert_allclose(
                ours.CalcPoseInWorld(context).GetAsMatrix4(), X_WF.homogeneous, atol=1e-9
            )


def test_gravity_torques_agree_with_pinocchio(panda, pinocchio_model):
    import pinocchio

    data = pinocchio_model.createData()
    context = panda.plant.CreateDefaultContext()
    for q in random_positions(50, seed=1):
        panda.set_position(context, q)
        ours = -panda.plant.CalcGravityGeneralizedForces(context)[:7]
        theirs = pinocchio.computeGeneralizedGravity(pinocchio_model, data, np.r_[q, 0.0, 0.0])[:7]
        # The fingers' centres of mass lie 26 mm further out in ours: 30 g.
        np.testing.assert_allclose(ours, theirs, atol=0.01)


def test_mass_and_limits_agree_with_pinocchio(panda, pinocchio_model):
    plant = panda.plant
    context = plant.CreateDefaultContext()
    # Pinocchio leaves out the mass of the fixed base.
    assert plant.CalcTotalMass(context) == pytest.approx(17.4519, abs=1e-3)
    np.testing.assert_allclose(plant.GetPositionLowerLimits()[:7], POSITION_LOWER)
    np.testing.assert_allclose(pinocchio_model.lowerPositionLimit[:7], POSITION_LOWER)
    np.testing.assert_allclose(plant.GetPositionUpperLimits()[:7], POSITION_UPPER)
    np.testing.assert_allclose(pinocchio_model.upperPositionLimit[:7], POSITION_UPPER)
    np.testing.assert_allclose(plant.GetVelocityUpperLimits()[:7], VELOCITY_LIMIT)
    np.testing.assert_allclose(pinocchio_model.velocityLimit[:7], VELOCITY_LIMIT)
    np.testing.assert_allclose(plant.GetAccelerationUpperLimits()[:7], ACCELERATION_LIMIT)
    np.testing.assert_allclose([a.effort_limit() for a in panda.arm_actuators], EFFORT_LIMIT)
    np.testing.assert_allclose(pinocchio_model.effortLimit[:7], EFFORT_LIMIT)


def test_reference_pose_and_tcp(panda):
    context = panda.plant.CreateDefaultContext()
    panda.set_position(context, HOME_POSITION)
    X_WH = panda.frame_hand.CalcPoseInWorld(context)
    np.testing.assert_allclose(X_WH.translation(), [0.3069, 0, 0.5903], atol=1e-4)
    X_HE = X_WH.inverse() @ panda.X_WE(context)
    np.testing.assert_allclose(X_HE.GetAsMatrix4()[:3, 3], [0, 0, 0.1034], atol=1e-12)
    np.testing.assert_allclose(X_HE.rotation().matrix(), np.eye(3), atol=1e-12)
    np.testing.assert_allclose(panda.get_position(context), HOME_POSITION)


def test_base_pose_moves_the_robot():
    plant = MultibodyPlant(0.0)
    X_WB = RigidTransform(RotationMatrix.MakeZRotation(0.4), [1.0, 2.0, 3.0])
    model = add_panda(plant, visuals="none", X_WB=X_WB)
    plant.Finalize()
    context = plant.CreateDefaultContext()
    assert model.base_body.EvalPoseInWorld(context).IsNearlyEqualTo(X_WB, 1e-12)


def test_opening_is_the_distance_between_the_pads(panda):
    context = panda.plant.CreateDefaultContext()
    panda.set_opening(context, 0.05)
    assert panda.get_opening(context) == pytest.approx(0.05)
    left, right = (b.EvalPoseInWorld(context).translation() for b in panda.finger_bodies)
    assert np.linalg.norm(left - right) == pytest.approx(0.05)
    for bad in (-0.01, 0.09, math.nan):
        with pytest.raises(PandaError, match="opening"):
            panda.set_opening(context, bad)


def build_scene(visuals):
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, 0.002)
    model = add_panda(plant, visuals=visuals)
    plant.Finalize()
    return builder, model, scene_graph


def test_visuals_never_change_what_is_simulated_or_seen(monkeypatch):
    def counts(visuals):
        inspector = build_scene(visuals)[2].model_inspector()
        roles = (Role.kProximity, Role.kPerception, Role.kIllustration)
        return [inspector.NumGeometriesWithRole(role) for role in roles]

    primitives, auto, nothing = counts("primitives"), counts("auto"), counts("none")
    assert auto[:2] == primitives[:2]
    assert nothing == [primitives[0], 0, 0]
    monkeypatch.setattr(panda_module, "mesh_visuals", dict)  # the package is missing
    assert counts("auto") == primitives
    with pytest.raises(PandaError, match="visuals"):
        counts("meshes")


def test_unknown_options_are_refused():
    with pytest.raises(PandaError, match="'shiny'"):
        add_panda(MultibodyPlant(0.0), visuals="shiny")
    with pytest.raises(PandaError, match="discrete"):
        add_panda(MultibodyPlant(0.0), controlled=True)


def test_home_posture_is_free_of_contact():
    builder, model, scene_graph = build_scene("none")
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()
    model.set_position(model.plant.GetMyContextFromRoot(context), HOME_POSITION)
    query = scene_graph.get_query_output_port().Eval(scene_graph.GetMyContextFromRoot(context))
    assert not query.HasCollisions()


def test_gripper_cloud_lies_on_the_gripper():
    cloud = gripper_cloud(0.06)
    np.testing.assert_array_equal(cloud, gripper_cloud(0.06))
    # On the surface of some box, inside of none.
    surface = np.full(len(cloud), np.inf)
    for box in gripper_boxes(0.06):
        p_G = box.X_EG.inverse().multiply(cloud.T).T
        distance = (np.abs(p_G) - box.size / 2).max(axis=1)
        assert (distance > -1e-6).all()
        surface = np.minimum(surface, np.abs(distance))
    assert surface.max() < 1e-9
    # The pads face each other across the opening, around E.
    pads = cloud[(np.abs(cloud[:, 0]) < 0.008) & (np.abs(cloud[:, 2]) < 0.008)]
    assert np.abs(pads[:, 1]).min() == pytest.approx(0.03)
    # Mirror image in the plane between the fingers.
    mirrored = cloud * [1, -1, 1]
    assert cKDTree(cloud).query(mirrored)[0].max() < 1e-9
    assert cloud[:, 2].max() < 0.012 and cloud[:, 2].min() > -0.12
    assert len(gripper_cloud(0.06, spacing=0.01)) < len(cloud) / 2
    for bad in (dict(opening=0.2), dict(opening=0.04, spacing=0.0)):
        with pytest.raises(PandaError):
            gripper_cloud(**bad)


def lift(size, mass=0.3):
    """Closes the hand on a box of this size (m), lifts it by 15 cm and holds it for a second.

    Returns the box's rise (m), its offset from the middle of the hand (m), the opening (m), the
    largest tracking error at rest (rad) and simulated seconds per second.
    """
    builder = DiagramBuilder()
    plant, _ = AddMultibodyPlant(
        MultibodyPlantConfig(
            time_step=0.002,
            discrete_contact_approximation="lagged",
            contact_model="hydroelastic_with_fallback",
        ),
        builder,
    )
    model = add_panda(plant, visuals="none", controlled=True)
    body = plant.AddRigidBody(
        "box", plant.AddModelInstance("box"), SpatialInertia.SolidBoxWithMass(mass, *size)
    )
    properties = ProximityProperties()
    AddRigidHydroelasticProperties(0.01, properties)
    AddContactMaterial(4.0, None, CoulombFriction(0.6, 0.6), properties)
    plant.RegisterCollisionGeometry(body, RigidTransform(), Box(*size), "box", properties)
    table = ProximityProperties()
    AddContactMaterial(4.0, 1e7, CoulombFriction(0.6, 0.6), table)
    plant.RegisterCollisionGeometry(
        plant.world_body(), RigidTransform([0.5, 0, -0.05]), Box(1, 1, 0.1), "table", table
    )
    plant.Finalize()
    command = builder.AddSystem(PandaCommand(time_step=0.002))
    builder.Connect(
        command.GetOutputPort("desired_state"), plant.get_desired_state_input_port(model.instance)
    )
    for name in ("panda.position", "hand.opening"):
        builder.ExportInput(command.GetInputPort(name), name)
    diagram = builder.Build()
    simulator = Simulator(diagram)
    context = simulator.get_mutable_context()
    plant_context = plant.GetMyMutableContextFromRoot(context)
    position_port = diagram.GetInputPort("panda.position")
    opening_port = diagram.GetInputPort("hand.opening")

    solver = PoseSolver(make_panda_planning_robot(Table()))
    R_WE = RotationMatrix.MakeXRotation(math.pi)
    low, high = (
        solver.solve(RigidTransform(R_WE, [0.5, 0, size[2] / 2 + z])) for z in (0.01, 0.16)
    )
    model.set_position(plant_context, low)
    model.set_opening(plant_context, 0.08)
    # Off the middle by 5 mm: the coupled fingers push it there.
    plant.SetFreeBodyPose(plant_context, body, RigidTransform([0.5, 0.005, size[2] / 2]))
    position_port.FixValue(context, low)
    opening_port.FixValue(context, [0.08])
    simulator.AdvanceTo(0.1)
    opening_port.FixValue(context, [0.0])
    simulator.AdvanceTo(1.2)
    z_before = body.EvalPoseInWorld(plant_context).translation()[2]
    for share in np.linspace(0.0, 1.0, 100):
        position_port.FixValue(context, low + share * (high - low))
        simulator.AdvanceTo(context.get_time() + 0.01)
    simulator.AdvanceTo(3.2)
    X_WO = body.EvalPoseInWorld(plant_context)
    offset = (model.X_WE(plant_context).inverse() @ X_WO).translation()[1]
    tracking = np.abs(model.get_position(plant_context) - high).max()
    opening = model.get_opening(plant_context)
    return X_WO.translation()[2] - z_before, offset, opening, tracking


@pytest.mark.parametrize("size", [(0.02, 0.02, 0.06), (0.06, 0.004, 0.06)])
def test_boxes_and_thin_walls_are_held_by_friction_alone(size):
    rise, offset, opening, tracking = lift(size)
    assert rise == pytest.approx(0.15, abs=0.003)
    assert abs(offset) < 0.002
    assert opening == pytest.approx(size[1], abs=0.001)
    assert tracking < 1e-3
