"""The oracle of episodes: it knows the task and the true surfaces, and sees the policy's clouds.

It answers with the expert's poses for the objects as the clouds show them. With it an episode lacks
of the expert's success what cameras, calibration and masks cost; what the learned aligner lacks of
the oracle's is due to the alignment.
"""

from collections.abc import Callable

import numpy as np
import trimesh
from pydrake.math import RigidTransform
from scipy.spatial import cKDTree

from iga_drake.aligners.protocol import PoseEstimate
from iga_drake.aligners.registry import ORACLE
from iga_drake.geometry.rigid_fit import rigid_fit
from iga_drake.policy.inference import InferenceAnswer
from iga_drake.shapes.instance import ShapeInstance
from iga_drake.station.simulated.scene import Scene
from iga_drake.tasks.snapshots import Snapshot
from iga_drake.tasks.task import Task

_SAMPLES = 20_000  # points of a surface
_OUTLIER = 0.015  # m from the surface; points of a cloud beyond it take no part
_STEPS = 15
_DAMPING = 1e-2  # of the greatest singular value: what the cloud doesn't tell stays as it is


def seen_pose(cloud: np.ndarray, shape: ShapeInstance, X_FO: RigidTransform) -> RigidTransform:
    """X_FO of an object as `cloud` (P, 3) (m, in F) shows it, near its true pose `X_FO`.

    The true surface is fitted to the cloud, point to plane, from the true pose; about the axis of
    a turned body and the like, where the cloud says nothing, it stays.
    """
    points, faces = trimesh.sample.sample_surface(shape.mesh, _SAMPLES, seed=0)
    normals = shape.mesh.face_normals[faces]
    tree = cKDTree(points)
    X_OF = X_FO.inverse()
    for _ in range(_STEPS):
        cloud_O = X_OF.multiply(cloud.T).T
        distance, nearest = tree.query(cloud_O, distance_upper_bound=_OUTLIER)
        found = np.isfinite(distance)
        if not found.any():
            break
        p, n = cloud_O[found], normals[nearest[found]]
        centre, size = p.mean(axis=0), np.linalg.norm(p.std(axis=0))
        A = np.hstack([np.cross((p - centre) / size, n), n])
        b = np.einsum("ij,ij->i", points[nearest[found]] - p, n)
        U, s, Vt = np.linalg.svd(A, full_matrices=False)
        twist = Vt.T @ (s / (s**2 + (_DAMPING * s[0]) ** 2) * (U.T @ b))
        moved = p + np.cross(twist[:3] / size, p - centre) + twist[3:]
        R, t = rigid_fit(p, moved)
        X_OF = RigidTransform(np.vstack([np.column_stack([R, t]), [0, 0, 0, 1]])) @ X_OF
    return X_OF.inverse()


class OracleInference:
    """Answers with the expert's pose for the objects as the clouds show them."""

    name = ORACLE

    def __init__(self, task: Task, scene: Scene, snapshot: Callable[[], Snapshot]) -> None:
        """`snapshot()` returns the true state now."""
        self._task, self._scene, self._snapshot = task, scene, snapshot
        self._waypoint = 0
        self._clouds = np.zeros((0, 3)), np.zeros((0, 3))

    def start(
        self,
        waypoint: int,
        grasped: np.ndarray,
        target: np.ndarray,
        seed: int,
        *,
        grasped_up: np.ndarray | None = None,
        target_up: np.ndarray | None = None,
    ) -> int:
        """See `Inference.start`."""
        self._waypoint, self._clouds = waypoint, (grasped, target)
        return 0

    def poll(self, question: int, timeout: float) -> InferenceAnswer:
        """The expert's pose, with energy 0."""
        now = self._snapshot()
        shapes = self._scene.truth.shapes
        X_WO = dict(now.X_WO)
        cloud_E, cloud_W = self._clouds
        motion = self._task.motion.waypoints[self._waypoint]
        target, held = self._object(motion.target), self._object(motion.grasped)
        if target is not None:
            X_WO[target] = seen_pose(cloud_W, shapes[target], X_WO[target])
        if held is not None:
            X_EO = now.X_WE.inverse() @ X_WO[held]
            X_WO[held] = now.X_WE @ seen_pose(cloud_E, shapes[held], X_EO)
        X_WE = self._task.expert(self._scene, X_WO, now.X_WE)[self._waypoint].GetAsMatrix4()
        return InferenceAnswer(PoseEstimate(X_WE[None], np.zeros(1), np.ones(1)), 0.0)

    def _object(self, observation: str) -> str | None:
        """The scene's object that an observation shows; None for the gripper."""
        (plan,) = (p for p in self._task.motion.observations if p.name == observation)
        return None if plan.role == "gripper" else self._scene.with_role(plan.role)[0].name

    def cancel(self) -> None:
        """Does nothing: the oracle answers at once."""

    def close(self) -> None:
        """Does nothing: there is no process to end."""
