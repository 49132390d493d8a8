"""The Panda with its hand: loading it into a plant, its joints, frames and gripper cloud."""

import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Literal

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import (
    Frame,
    JointActuator,
    ModelInstanceIndex,
    PdControllerGains,
    PrismaticJoint,
    RevoluteJoint,
    RigidBody,
)
from pydrake.systems.framework import Context

from iga_drake.demonstrations.demonstration import HAND_OPENING_MAX
from iga_drake.errors import IgaDrakeError
from iga_drake.paths import models_dir
from iga_drake.station.panda.visuals import mesh_visuals
from iga_drake.systems.ports import PANDA_JOINTS

Visuals = Literal["primitives", "meshes", "auto", "none"]

# A comfortable posture: the hand is at (0.307, 0, 0.590) m and points down.
HOME_POSITION = (0.0, -math.pi / 4, 0.0, -3 * math.pi / 4, 0.0, math.pi / 2, math.pi / 4)
# Published limits of the arm (rad, rad/s, rad/s^2, N m).
POSITION_LOWER = (-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973)
POSITION_UPPER = (2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973)
VELOCITY_LIMIT = (2.175, 2.175, 2.175, 2.175, 2.61, 2.61, 2.61)
ACCELERATION_LIMIT = (15.0, 7.5, 10.0, 12.5, 15.0, 20.0, 20.0)
EFFORT_LIMIT = (87.0, 87.0, 87.0, 87.0, 12.0, 12.0, 12.0)

# Implicit position control: stiffness (N m/rad, N/m) and damping of each actuator.
_ARM_GAINS = PdControllerGains(p=10_000.0, d=100.0)
_FINGER_GAINS = PdControllerGains(p=20_000.0, d=200.0)
_DRAKE = "http://drake.mit.edu"  # namespace of Drake's own tags in a URDF
_GRIPPER_LINKS = ("panda_hand", "panda_leftfinger", "panda_rightfinger")


class PandaError(IgaDrakeError):
    """The Panda can't be loaded or was asked for something it can't do."""


@dataclass(frozen=True)
class PandaModel:
    """Handles to one Panda inside a plant. E is the frame `panda_tcp`."""

    plant: MultibodyPlant
    instance: ModelInstanceIndex
    arm_joints: tuple[RevoluteJoint, ...]  # 7
    finger_joints: tuple[PrismaticJoint, ...]  # left, right; their positions add to the opening
    arm_actuators: tuple[JointActuator, ...]  # 7
    finger_actuators: tuple[JointActuator, ...]  # 2
    frame_hand: Frame
    frame_E: Frame
    base_body: RigidBody  # panda_link0
    hand_body: RigidBody
    finger_bodies: tuple[RigidBody, ...]  # left, right

    def set_position(self, context: Context, q: Sequence[float] | np.ndarray) -> None:
        """Sets the seven arm angles (rad) in the plant's `context`."""
        for joint, angle in zip(self.arm_joints, q, strict=True):
            joint.set_angle(context, angle)

    def get_position(self, context: Context) -> np.ndarray:
        """The seven arm angles (rad) in the plant's `context`."""
        return np.array([joint.get_angle(context) for joint in self.arm_joints])

    def set_opening(self, context: Context, opening: float) -> None:
        """Sets both fingers so that the pads are `opening` (m) apart."""
        for joint in self.finger_joints:
            joint.set_translation(context, check_opening(opening) / 2)

    def get_opening(self, context: Context) -> float:
        """Distance between the pads (m)."""
        return sum(joint.get_translation(context) for joint in self.finger_joints)

    def X_WE(self, context: Context) -> RigidTransform:
        """Pose of the end-effector frame E in the plant's world."""
        return self.frame_E.CalcPoseInWorld(context)


def check_opening(opening: float) -> float:
    """Returns `opening` (m) or raises `PandaError` if the hand can't open so far."""
    if not (math.isfinite(opening) and -1e-9 <= opening <= HAND_OPENING_MAX + 1e-9):
        raise PandaError(
            f"hand opening {opening} m is outside [0, {HAND_OPENING_MAX}]: give the distance "
            "between the pads in metres"
        )
    return min(max(float(opening), 0.0), HAND_OPENING_MAX)


def urdf_path() -> Path:
    """The robot's description."""
    return models_dir() / "panda" / "panda.urdf"


def add_panda(
    plant: MultibodyPlant,
    *,
    visuals: Visuals = "auto",
    X_WB: RigidTransform | None = None,
    controlled: bool = False,
    prefix: str = "",
) -> PandaModel:
    """Adds the Panda to `plant` (before Finalize) and welds its base B to the world at `X_WB`.

    Args:
      visuals: what cameras and viewers see. "primitives": both see the URDF's own shapes.
        "meshes": both see the published meshes (needs the extra `visuals`). "auto": cameras see the
        primitives, so that perception is the same on every machine, and viewers the meshes where
        they can be had. "none": nothing. Collision shapes, and so the physics, are always the same.
      X_WB: pose of the robot's base in the world; identity if not given.
      controlled: for a plant that is simulated. Switches the arm's gravity off (the real arm
        compensates its own weight) and gives every actuator an implicit position controller, to be
        driven through `plant.get_desired_state_input_port(model.instance)` with the output of a
        `PandaCommand`. The plant has to be discrete, with one of the SAP contact approximations.
      prefix: put before the model's name where a plant holds several.

    Raises `PandaError` for an unknown option, a continuous plant with `controlled`, or meshes that
    are asked for and can't be had.
    """
    if controlled and not plant.time_step() > 0:
        raise PandaError("add_panda(controlled=True) needs a discrete plant: give it a time step")
    parser = Parser(plant, prefix)
    (instance,) = parser.AddModelsFromString(_urdf_text(visuals, plant.time_step() > 0), "urdf")
    base = plant.GetBodyByName("panda_link0", instance)
    plant.WeldFrames(plant.world_frame(), base.body_frame(), X_WB or RigidTransform())
    model = find_panda(plant, instance)
    if controlled:
        plant.set_gravity_enabled(instance, False)
        for actuator in model.arm_actuators:
            actuator.set_controller_gains(_ARM_GAINS)
        for actuator in model.finger_actuators:
            actuator.set_controller_gains(_FINGER_GAINS)
    return model


def find_panda(plant: MultibodyPlant, instance: ModelInstanceIndex | None = None) -> PandaModel:
    """The Panda that `add_panda` put into `plant`; `instance` where the plant holds several."""
    if instance is None:
        instance = plant.GetBodyByName("panda_link0").model_instance()
    return PandaModel(
        plant=plant,
        instance=instance,
        arm_joints=tuple(
            plant.GetJointByName(f"panda_joint{i + 1}", instance) for i in range(PANDA_JOINTS)
        ),
        finger_joints=tuple(
            plant.GetJointByName(f"panda_finger_joint{i}", instance) for i in (1, 2)
        ),
        arm_actuators=tuple(
            plant.GetJointActuatorByName(f"panda_actuator{i + 1}", instance)
            for i in range(PANDA_JOINTS)
        ),
        finger_actuators=tuple(
            plant.GetJointActuatorByName(f"panda_finger_actuator{i}", instance) for i in (1, 2)
        ),
        frame_hand=plant.GetFrameByName("panda_hand", instance),
        frame_E=plant.GetFrameByName("panda_tcp", instance),
        base_body=plant.GetBodyByName("panda_link0", instance),
        hand_body=plant.GetBodyByName("panda_hand", instance),
        finger_bodies=tuple(
            plant.GetBodyByName(f"panda_{side}finger", instance) for side in ("left", "right")
        ),
    )


def _urdf_text(visuals: Visuals, couple_fingers: bool) -> str:
    """The URDF with the visuals that are asked for."""
    root = ElementTree.parse(urdf_path()).getroot()
    if visuals not in ("primitives", "meshes", "auto", "none"):
        raise PandaError(f"visuals '{visuals}' is none of primitives, meshes, auto, none")
    meshes: dict[str, Path] = {}
    if visuals in ("meshes", "auto"):
        meshes = mesh_visuals()
        if visuals == "meshes" and not meshes:
            raise PandaError(
                "visuals 'meshes': the packages example-robot-data and pycollada are missing; "
                "install the extra 'visuals' or choose 'primitives'"
            )
    for link in root.iter("link"):
        name = link.get("name", "")
        for visual in link.findall("visual"):
            if visuals in ("none", "meshes"):
                link.remove(visual)
            elif name in meshes:
                ElementTree.SubElement(
                    visual, f"{{{_DRAKE}}}illustration_properties", enabled="false"
                )
        if name in meshes:
            visual = ElementTree.SubElement(link, "visual", name=f"{name}_mesh")
            if visuals == "auto":
                ElementTree.SubElement(
                    visual, f"{{{_DRAKE}}}perception_properties", enabled="false"
                )
            if name == "panda_rightfinger":  # the same mesh as the left one, turned about z
                ElementTree.SubElement(visual, "origin", rpy=f"0 0 {math.pi}")
            geometry = ElementTree.SubElement(visual, "geometry")
            ElementTree.SubElement(geometry, "mesh", filename=meshes[name].as_uri())
    if not couple_fingers:  # Drake's coupler constraint exists in discrete plants only
        for joint in root.iter("joint"):
            for mimic in joint.findall("mimic"):
                joint.remove(mimic)
    ElementTree.register_namespace("drake", _DRAKE)
    return ElementTree.tostring(root, encoding="unicode")


@dataclass(frozen=True)
class GripperBox:
    """One box of the gripper's shape in E (m)."""

    link: str
    X_EG: RigidTransform
    size: np.ndarray  # (3,)


@cache
def _gripper_boxes_closed() -> tuple[GripperBox, ...]:
    """The visual boxes of hand and fingers in E with the pads touching, read from the URDF."""
    root = ElementTree.parse(urdf_path()).getroot()
    X_EH = RigidTransform([0.0, 0.0, -_vector(_find(root, "frame", "panda_tcp").get("xyz"))[2]])
    X_HF = {"panda_hand": RigidTransform()}
    for i, side in ((1, "left"), (2, "right")):
        origin = _find(root, "joint", f"panda_finger_joint{i}").find("origin")
        X_HF[f"panda_{side}finger"] = _pose(origin)
    boxes = []
    for name in _GRIPPER_LINKS:
        for visual in _find(root, "link", name).findall("visual"):
            box = visual.find("geometry/box")
            if box is not None:
                X_EG = X_EH @ X_HF[name] @ _pose(visual.find("origin"))
                boxes.append(GripperBox(name, X_EG, _vector(box.get("size"))))
    return tuple(boxes)


def gripper_boxes(opening: float) -> tuple[GripperBox, ...]:
    """The boxes that make up hand and fingers, in E, with the pads `opening` (m) apart."""
    shift = check_opening(opening) / 2
    offset = {"panda_hand": 0.0, "panda_leftfinger": shift, "panda_rightfinger": -shift}
    return tuple(
        GripperBox(box.link, RigidTransform([0.0, offset[box.link], 0.0]) @ box.X_EG, box.size)
        for box in _gripper_boxes_closed()
    )


def gripper_cloud(opening: float, spacing: float = 0.005) -> np.ndarray:
    """Points on the outer surface of hand and fingers.

    Args:
      opening: distance between the pads (m), in [0, 0.08].
      spacing: distance between neighbouring points on a face (m).

    Returns (P, 3) points in E, the same for the same arguments. Points of one box that lie inside
    another are left out. The flange behind the hand (a capsule) isn't part of it.
    """
    if not (math.isfinite(spacing) and spacing > 0):
        raise PandaError(f"gripper_cloud: spacing {spacing} m has to be positive")
    boxes = gripper_boxes(opening)
    kept = []
    for box in boxes:
        points = box.X_EG.multiply(_box_surface(box.size, spacing).T).T
        inside = np.zeros(len(points), dtype=bool)
        for other in boxes:
            if other is not box:
                p_G = other.X_EG.inverse().multiply(points.T).T
                inside |= (np.abs(p_G) < other.size / 2 - 1e-6).all(axis=1)
        kept.append(points[~inside])
    return np.concatenate(kept)


def _box_surface(size: np.ndarray, spacing: float) -> np.ndarray:
    """Grid points (P, 3) on the six faces of a box about the origin, no nearer to an edge than half
    a cell."""
    faces = []
    for axis in range(3):
        u, v = (axis + 1) % 3, (axis + 2) % 3
        steps = [max(1, round(size[k] / spacing)) for k in (u, v)]
        grids = [
            size[k] * ((np.arange(n) + 0.5) / n - 0.5) for k, n in zip((u, v), steps, strict=True)
        ]
        first, second = (g.ravel() for g in np.meshgrid(*grids, indexing="ij"))
        for sign in (-0.5, 0.5):
            face = np.empty((len(first), 3))
            face[:, axis] = sign * size[axis]
            face[:, u] = first
            face[:, v] = second
            faces.append(face)
    return np.concatenate(faces)


def _find(root: ElementTree.Element, tag: str, name: str) -> ElementTree.Element:
    for element in root.findall(tag):
        if element.get("name") == name:
            return element
    raise PandaError(f"{urdf_path()}: no <{tag} name='{name}'>")


def _vector(text: str | None) -> np.ndarray:
    return np.array([float(x) for x in (text or "0 0 0").split()])


def _pose(origin: ElementTree.Element | None) -> RigidTransform:
    if origin is None:
        return RigidTransform()
    return RigidTransform(RollPitchYaw(_vector(origin.get("rpy"))), _vector(origin.get("xyz")))
