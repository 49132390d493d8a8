"""The simulation station: robot, table, objects and cameras behind the one port contract."""

from collections.abc import Mapping
from typing import cast

import numpy as np
from pydrake.geometry import Box, Meshcat, SceneGraph
from pydrake.math import RigidTransform
from pydrake.multibody.plant import AddMultibodyPlant, CoulombFriction, MultibodyPlant
from pydrake.symbolic import Expression, Variable
from pydrake.systems.framework import Diagram, DiagramBuilder, InputPort
from pydrake.systems.lcm import LcmBuses
from pydrake.systems.primitives import ConstantVectorSource, SymbolicVectorSystem

from iga_drake.demonstrations.demonstration import HAND_OPENING_MAX
from iga_drake.station.cameras.clutter import CameraClutter
from iga_drake.station.cameras.rgbd import add_renderer, camera_info
from iga_drake.station.contract import CHEAT, StationError
from iga_drake.station.panda.driver import add_panda_ports
from iga_drake.station.panda.model import PandaModel, Visuals, add_panda
from iga_drake.station.scenario import Scenario, Table
from iga_drake.station.simulated.model_files import (
    AddedObject,
    add_object,
    check_object,
    names_the_world,
)
from iga_drake.station.simulated.scene import Scene, SceneObject
from iga_drake.systems.ports import PANDA_JOINTS, ArmMode, Role
from iga_drake.systems.segmentation import Segmentation
from iga_drake.viewing.meshcat import add_visualizers


def build_simulation_station(
    scenario: Scenario, *, scene: Scene | None, seed: int, meshcat: Meshcat | None = None
) -> Diagram:
    """Builds the diagram "station".

    It exports `station_ports(scenario.camera_names)` and besides, under `cheat.`:
    `cheat.body_poses` (list of X_WB by body index), `cheat.state` (plant state),
    `cheat.contact_results` and `cheat.query_object`. Its default context is the scene: joint
    angles, hand opening, object poses. Objects are held by contact alone, unless their model is
    fixed to the world. The plant is `station.GetSubsystemByName("plant")`; objects are its model
    instances by their names.

    Args:
      seed: >= 0; draws camera noise, clutter and calibration errors, with `scenario.seeds.cameras`
        added.
      meshcat: where to show the scene; None shows nothing.

    Raises:
      StationError: the scene holds what can't be built; the message names the object.
    """
    if scene is None:
        raise StationError("the simulated station needs a scene: what lies where at the start")
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlant(config=scenario.plant, builder=builder)
    plant.set_name("plant")
    for item in scene.objects:
        if item.role not in _ROLES:
            raise StationError(f"object '{item.name}': role '{item.role}', allowed: {[*_ROLES]}")
    first = {id(item) for item in scene.objects if names_the_world(item)}
    added = {item.name: add_object(plant, item) for item in scene.objects if id(item) in first}
    panda = add_panda(plant, controlled=True, visuals=cast(Visuals, scenario.panda.visuals))
    _add_table(plant, scenario.table)
    for item in scene.objects:
        if id(item) not in first:
            added[item.name] = add_object(plant, item)
    roles = {int(body): Role.ROBOT for body in plant.GetBodyIndices(panda.instance)}
    for item in scene.objects:
        for body in added[item.name].bodies:
            roles[int(body.index())] = _ROLES[item.role]
    for item in _neighbours(scene, scenario.clutter.neighbours):
        for body in added[item.name].bodies:
            roles[int(body.index())] = Role.TARGET
    plant.Finalize()
    _set_default_state(plant, panda, scene, added)
    start = plant.CreateDefaultContext()
    for item in scene.objects:
        source = f"object '{item.name}'" + (f" ({item.source})" if item.source else "")
        check_object(plant, scene_graph.model_inspector(), start, added[item.name], source)

    _add_robot_ports(builder, panda, scenario)
    add_renderer(scene_graph)
    cameras = {}
    for index, (name, camera) in enumerate(scenario.cameras.items()):
        cameras[name] = ports = camera.add(
            builder, scene_graph, name=name, seed=(seed + scenario.seeds.cameras, index)
        )
        size = {"width": camera.intrinsics.width, "height": camera.intrinsics.height}
        segmentation = builder.AddNamedSystem(f"{name}.segmentation", Segmentation(roles, **size))
        builder.Connect(ports["label_image"], segmentation.get_input_port())
        ports["label_image"] = segmentation.get_output_port()
    if scenario.clutter.in_images:
        infos = {name: camera_info(each.intrinsics) for name, each in scenario.cameras.items()}
        clutter = builder.AddNamedSystem(
            "clutter", CameraClutter(scenario.clutter, infos, seed=seed + scenario.seeds.cameras)
        )
        for name, ports in cameras.items():
            for port in ("depth_image", "label_image", "pose"):
                builder.Connect(ports[port], clutter.GetInputPort(f"{name}.{port}"))
            for port in ("depth_image", "label_image"):
                ports[port] = clutter.GetOutputPort(f"{name}.{port}")
    for name, ports in cameras.items():
        for port, output in ports.items():
            builder.ExportOutput(output, f"{name}.{port}")
    if meshcat is not None:
        add_visualizers(
            builder,
            config=scenario.visualization,
            plant=plant,
            scene_graph=scene_graph,
            meshcat=meshcat,
        )
    _add_cheat_ports(builder, plant, scene_graph)

    station = builder.Build()
    station.set_name("station")
    return station


_ROLES = {"target": Role.TARGET, "grasped": Role.GRASPED, "other": Role.BACKGROUND}


def _neighbours(scene: Scene, count: int) -> list[SceneObject]:
    """The `count` objects of the role "other" that are nearest to a target."""
    targets = [item.X_WO.translation() for item in scene.with_role("target")]
    others = scene.with_role("other")
    if count > (len(others) if targets else 0):
        raise StationError(
            f"clutter.neighbours: {count}, but the scene has {len(others)} objects beside "
            f"{len(targets)} targets: state more distractors"
        )

    def distance(item: SceneObject) -> float:
        return min(float(np.linalg.norm(item.X_WO.translation() - place)) for place in targets)

    return sorted(others, key=distance)[:count]


def _add_table(plant: MultibodyPlant, table: Table) -> None:
    """Fixes the table to the world, its top at z = 0."""
    body = plant.world_body()
    X_WG = RigidTransform([*table.center, -table.size[2] / 2])
    friction = CoulombFriction(table.friction, table.friction)
    plant.RegisterCollisionGeometry(body, X_WG, Box(*table.size), "table", friction)
    plant.RegisterVisualGeometry(
        body, X_WG, Box(*table.size), "table", np.array([*table.color, 1.0])
    )


def _set_default_state(
    plant: MultibodyPlant, panda: PandaModel, scene: Scene, added: Mapping[str, AddedObject]
) -> None:
    """Makes the plant's default context the scene's initial situation."""
    q = np.asarray(scene.panda_position, dtype=float)
    if q.shape != (PANDA_JOINTS,) or not np.isfinite(q).all():
        raise StationError(f"scene.panda_position: expected 7 finite angles (rad), got {q}")
    if not 0.0 <= scene.hand_opening <= HAND_OPENING_MAX:
        raise StationError(
            f"scene.hand_opening: {scene.hand_opening} m, allowed: 0..{HAND_OPENING_MAX} m"
        )
    for joint, angle in zip(panda.arm_joints, q, strict=True):
        joint.set_default_positions([angle])
    for joint in panda.finger_joints:
        joint.set_default_positions([scene.hand_opening / 2])
    for item in scene.objects:
        if not added[item.name].fixed:
            plant.SetDefaultFloatingBaseBodyPose(added[item.name].base, item.X_WO)


def _add_robot_ports(builder: DiagramBuilder, panda: PandaModel, scenario: Scenario) -> None:
    """Exports the arm's and the hand's commands and measurements."""
    for name, driver in scenario.model_drivers.items():
        url = scenario.lcm_buses[driver.lcm_bus].lcm_url
        if url != LcmBuses.kLcmUrlMemqNull:
            raise StationError(
                f"model_drivers.{name}: the simulated station has ports, no LCM, but "
                f"lcm_buses.{driver.lcm_bus}.lcm_url is '{url}': make it "
                f"'{LcmBuses.kLcmUrlMemqNull}', or choose station 'hardware'"
            )
    for name, port in add_panda_ports(builder, panda, scenario.panda).items():
        if isinstance(port, InputPort):
            builder.ExportInput(port, name)
        else:
            builder.ExportOutput(port, name)
    t = Variable("t")
    now = builder.AddNamedSystem("time", SymbolicVectorSystem(time=t, output=[Expression(t)]))
    for name in ("panda.time", "hand.time"):
        builder.ExportOutput(now.get_output_port(), name)
    mode = builder.AddNamedSystem("panda.mode", ConstantVectorSource([float(ArmMode.READY)]))
    builder.ExportOutput(mode.get_output_port(), "panda.mode")


def _add_cheat_ports(
    builder: DiagramBuilder, plant: MultibodyPlant, scene_graph: SceneGraph
) -> None:
    builder.ExportOutput(plant.get_body_poses_output_port(), f"{CHEAT}body_poses")
    builder.ExportOutput(plant.get_state_output_port(), f"{CHEAT}state")
    builder.ExportOutput(plant.get_contact_results_output_port(), f"{CHEAT}contact_results")
    builder.ExportOutput(scene_graph.get_query_output_port(), f"{CHEAT}query_object")
