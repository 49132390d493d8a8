"""Scenes in a plant, for tests: what touches what, and where things come to rest."""

import numpy as np
from pydrake.geometry import Box
from pydrake.math import RigidTransform
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import (
    AddMultibodyPlant,
    CoulombFriction,
    MultibodyPlant,
    MultibodyPlantConfig,
)
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, Diagram, DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource

from iga_drake.planning.routes import pose_error
from iga_drake.station.panda.command import PandaCommand
from iga_drake.station.panda.model import PandaModel, add_panda
from iga_drake.station.simulated.scene import Scene
from iga_drake.tasks.snapshots import ROBOT, TABLE, read_snapshot


class Rest:
    """The scene's objects on the table with the Panda holding its first posture.

    The hand closes on what it holds at the start, else it keeps its opening.
    """

    def __init__(self, scene: Scene) -> None:
        builder = DiagramBuilder()
        config = MultibodyPlantConfig(
            time_step=0.002,
            contact_model="hydroelastic_with_fallback",
            discrete_contact_approximation="sap",
        )
        self.plant: MultibodyPlant
        self.plant, self.scene_graph = AddMultibodyPlant(config=config, builder=builder)
        self.panda: PandaModel = add_panda(self.plant, visuals="none", controlled=True)
        self.plant.RegisterCollisionGeometry(
            self.plant.world_body(),
            RigidTransform([0.35, 0.0, -0.025]),
            Box(1.5, 1.6, 0.05),
            "table",
            CoulombFriction(0.6, 0.6),
        )
        for item in scene.objects:
            (instance,) = Parser(self.plant).AddModelsFromString(item.model, "sdf")
            body = self.plant.GetBodyByName(item.name, instance)
            self.plant.SetDefaultFloatingBaseBodyPose(body, item.X_WO)
        self.plant.Finalize()
        command = builder.AddSystem(PandaCommand(time_step=0.002))
        opening = 0.0 if scene.truth.X_EO else scene.hand_opening
        for port, value in (("panda.position", scene.panda_position), ("hand.opening", [opening])):
            source = builder.AddSystem(ConstantVectorSource(value))
            builder.Connect(source.get_output_port(), command.GetInputPort(port))
        builder.Connect(
            command.GetOutputPort("desired_state"),
            self.plant.get_desired_state_input_port(self.panda.instance),
        )
        self.diagram: Diagram = builder.Build()
        self.simulator = Simulator(self.diagram)
        root = self.simulator.get_mutable_context()
        self.context: Context = self.plant.GetMyMutableContextFromRoot(root)
        self.panda.set_position(self.context, scene.panda_position)
        self.panda.set_opening(self.context, scene.hand_opening)

    def pose(self, name: str) -> RigidTransform:
        """True pose of an object."""
        body = self.plant.GetBodyByName(name, self.plant.GetModelInstanceByName(name))
        return self.plant.EvalBodyPoseInWorld(self.context, body)

    def penetration(self) -> float:
        """Deepest overlap (m) of any two geometries."""
        query = self.plant.get_geometry_query_input_port().Eval(self.context)
        return max((pair.depth for pair in query.ComputePointPairPenetration()), default=0.0)

    def slip(self, held: str, seconds: float) -> tuple[float, float]:
        """How far (m, rad) what the hand holds, and the table doesn't touch, moves in it."""
        before = self.panda.X_WE(self.context).inverse() @ self.pose(held)
        snapshot = read_snapshot(self.plant, self.context, self.panda)
        assert snapshot.touches(held, ROBOT) and not snapshot.touches(held, TABLE)
        self.simulator.AdvanceTo(self.context.get_time() + seconds)
        after = self.panda.X_WE(self.context).inverse() @ self.pose(held)
        return pose_error(before, after)


def tilt(X_WO: RigidTransform) -> float:
    """Angle (rad) between the object's z axis and the vertical."""
    return float(np.arccos(np.clip(X_WO.rotation().matrix()[2, 2], -1.0, 1.0)))
