"""Which points belong to the robot: those near its collision shapes at the measured joints."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from pydrake.geometry import (
    Box,
    Capsule,
    Convex,
    Cylinder,
    GeometryId,
    Mesh,
    SceneGraphInspector,
    Shape,
    Sphere,
)
from pydrake.geometry import (
    Role as GeometryRole,
)
from pydrake.math import RigidTransform
from pydrake.multibody.tree import Frame, ModelInstanceIndex, RigidBody
from pydrake.planning import RobotDiagram
from scipy.spatial import ConvexHull

from iga_drake.errors import IgaDrakeError


class SelfFilterError(IgaDrakeError):
    """A robot whose shape or joints the filter can't work with."""


@dataclass(frozen=True)
class _Part:
    """One collision geometry of a link."""

    body: RigidBody
    # Centre of the bounding ball in the body's frame (m), and its radius (m).
    centre_B: np.ndarray
    radius: float
    X_GB: RigidTransform
    # Signed distance (n,) (m) of points (3, n) given in G.
    distance: Callable[[np.ndarray], np.ndarray]


class SelfFilter:
    """Finds points on or near a robot, told apart by its collision shapes.

    Spheres, capsules, cylinders and boxes are exact; of meshes it is the convex hull, from whose
    faces' planes the distance is taken: near edges more points count as the robot's.

    Args:
      robot: a plant with the robot and its scene graph; only the geometry of `instances` counts.
      instances: the robot's model instances.
      frame_E: the end-effector frame.
      positions: (arm's joint angles (N,) in rad, opening of the hand in m) -> all positions of the
        plant.

    Raises `SelfFilterError` for a robot without collision shapes, or with one of another kind.
    """

    def __init__(
        self,
        robot: RobotDiagram,
        *,
        instances: Sequence[ModelInstanceIndex],
        frame_E: Frame,
        positions: Callable[[np.ndarray, float], np.ndarray],
    ) -> None:
        self._robot = robot  # owns the plant
        self._plant = robot.plant()
        self._root = robot.CreateDefaultContext()
        self._context = self._plant.GetMyMutableContextFromRoot(self._root)
        self._positions = positions
        self._frame_E = frame_E
        inspector = robot.scene_graph().model_inspector()
        self._parts = [
            _part(inspector, geometry, self._plant.get_body(body))
            for instance in instances
            for body in self._plant.GetBodyIndices(instance)
            for geometry in inspector.GetGeometries(
                self._plant.GetBodyFrameIdOrThrow(body), GeometryRole.kProximity
            )
        ]
        if not self._parts:
            raise SelfFilterError(
                "self-filter: the robot has no collision geometry: give its URDF or SDF some"
            )

    def __deepcopy__(self, memo: dict) -> "SelfFilter":
        """Itself: what it keeps of one call does not matter to the next."""
        return self

    def pose(self, position: np.ndarray, opening: float) -> RigidTransform:
        """X_WE with the arm's joints at `position` (N,) (rad) and the hand at `opening` (m)."""
        self._plant.SetPositions(self._context, self._positions(position, opening))
        return self._frame_E.CalcPoseInWorld(self._context)

    def near(
        self, points: np.ndarray, position: np.ndarray, opening: float, *, margin: float
    ) -> np.ndarray:
        """Which of `points` (3, P) (m, in the plant's world) are inside the robot or within
        `margin` (m) of it: (P,) bool.

        `position` (N,) are the arm's joint angles (rad), `opening` (m) is the hand's.
        """
        self._plant.SetPositions(self._context, self._positions(position, opening))
        found = np.zeros(points.shape[1], dtype=bool)
        for part in self._parts:
            X_WB = self._plant.EvalBodyPoseInWorld(self._context, part.body)
            offset = points - np.asarray(X_WB @ part.centre_B, points.dtype)[:, None]
            reach = part.radius + margin
            left = np.flatnonzero(~found & (np.einsum("ij,ij->j", offset, offset) <= reach * reach))
            if len(left):
                p_G = (part.X_GB @ X_WB.inverse()).multiply(points[:, left].astype(float))
                found[left] = part.distance(p_G) <= margin
        return found


def _part(inspector: SceneGraphInspector, geometry: GeometryId, body: RigidBody) -> _Part:
    shape = inspector.GetShape(geometry)
    X_BG = inspector.GetPoseInFrame(geometry)
    centre_G = np.zeros(3)
    if isinstance(shape, (Convex, Mesh)):
        hull = inspector.GetConvexHull(geometry)
        corners = np.array([hull.vertex(i) for i in range(hull.num_vertices())])
        centre_G = (corners.min(axis=0) + corners.max(axis=0)) / 2
        radius = float(np.linalg.norm(corners - centre_G, axis=1).max())
        planes = ConvexHull(corners).equations
        distance = _distance_to_planes(planes[:, :3], planes[:, 3:])
    else:
        radius, distance = _primitive(shape, f"link '{body.name()}'")
    return _Part(body, X_BG @ centre_G, radius, X_BG.inverse(), distance)


def _distance_to_planes(
    normals: np.ndarray, offsets: np.ndarray
) -> Callable[[np.ndarray], np.ndarray]:
    return lambda p: (normals @ p + offsets).max(axis=0)


def _primitive(shape: Shape, where: str) -> tuple[float, Callable[[np.ndarray], np.ndarray]]:
    """Radius (m) of the bounding ball about the origin, and the signed distance."""
    if isinstance(shape, Sphere):
        r = shape.radius()
        return r, lambda p: np.linalg.norm(p, axis=0) - r
    if isinstance(shape, Capsule):
        r, half = shape.radius(), shape.length() / 2

        def to_capsule(p: np.ndarray) -> np.ndarray:
            z = p[2] - np.clip(p[2], -half, half)
            return np.sqrt(p[0] ** 2 + p[1] ** 2 + z**2) - r

        return r + half, to_capsule
    if isinstance(shape, Cylinder):
        r, half = shape.radius(), shape.length() / 2
        return float(np.hypot(r, half)), lambda p: _to_box(
            np.stack([np.hypot(p[0], p[1]) - r, np.abs(p[2]) - half])
        )
    if isinstance(shape, Box):
        halves = shape.size()[:, None] / 2
        return float(np.linalg.norm(halves)), lambda p: _to_box(np.abs(p) - halves)
    raise SelfFilterError(
        f"self-filter: {where} has a collision geometry of the kind {type(shape).__name__}; "
        "spheres, capsules, cylinders, boxes and meshes are expected"
    )


def _to_box(beyond: np.ndarray) -> np.ndarray:
    """Signed distance from how far points are beyond the faces of a box along each axis (k, n)."""
    outside = np.linalg.norm(np.maximum(beyond, 0.0), axis=0)
    return outside + np.minimum(beyond.max(axis=0), 0.0)
