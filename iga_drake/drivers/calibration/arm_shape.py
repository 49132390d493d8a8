"""A check that a camera still stands where it was calibrated, by the arm's shape in its image.

The depth image of the arm alone is rendered from the calibrated pose at the measured joints. Its
points are laid onto the measured ones (point to plane, iterated closest points); what they have to
be moved by is by how much the camera's pose is off. No board is needed, and the arm may hold
nothing.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from pydrake.geometry import (
    ClippingRange,
    DepthRange,
    DepthRenderCamera,
    RenderCameraCore,
)
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.planning import RobotDiagramBuilder
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from iga_drake.demonstrations.demonstration import HAND_OPENING_MAX
from iga_drake.errors import check_bounds
from iga_drake.station.cameras.rgbd import RENDERER, Intrinsics, add_renderer, rendering_info
from iga_drake.station.panda.model import add_panda
from iga_drake.station.panda.visuals import mesh_visuals

_NEAR, _FAR = 0.05, 5.0  # m, of what is rendered and measured
_STEP = 2  # pixels, of which one is used in each direction
_FLOOR = 0.10  # m, below which the arm's base meets the table and what lies on it
_SEE_THROUGH = 0.02  # m, of neighbouring pixels' depths, across an edge
_GATES = (0.15, 0.10, 0.06, 0.04, 0.025, 0.015, 0.015)  # m, of the distance to the closest point
_ROUNDS = 5  # at each gate
_SETTLED = 1e-4  # m, rad: a smaller step ends a gate
_MOST = 1500  # points of the arm that are laid onto measured ones
_ROOM = 0.2  # m, about the arm, in which measured points count
_FITS = 0.01  # m, within which a point of the arm is met by a measured one
_FEWEST = 300  # points of the arm that a camera has to see
_DAMPING = 1e-3


@dataclass
class ArmShapeLimits:
    """From what on a camera counts as moved."""

    # By how much the arm's points are displaced (m, root mean square).
    displacement: float = 0.008
    # Share of the arm's visible points that measured ones meet, once the pose is put right.
    met: float = 0.6

    def check(self, where: str = "ArmShapeLimits") -> None:
        """Raises `ConfigError` for a value out of range."""
        check_bounds(self, where, {"displacement": (1e-4, 1.0), "met": (0.0, 1.0)})


@dataclass(frozen=True)
class CameraOffset:
    """By how much a camera's pose is off, as far as the arm's shape tells."""

    # True pose by the arm's shape: X_WC of the optical frame.
    X_WC: RigidTransform
    displacement: float  # m, root mean square, of the arm's visible points
    translation: float  # m, of the camera
    rotation: float  # rad
    met: float  # share of the arm's visible points that measured ones meet
    points: int  # of the arm that the camera should see

    def problem(self, limits: ArmShapeLimits) -> str:
        """Why the camera has to be calibrated anew or can't be judged; "" if it is well."""
        if self.points < _FEWEST:
            return "can't tell: it hardly sees the arm; move the arm into its middle"
        if self.met < limits.met:
            return (
                f"can't tell: only {100 * self.met:.0f} % of the arm that it should see is there: "
                "the camera has moved far, something stands before the arm, or the arm isn't where "
                "its joints say"
            )
        if self.displacement > limits.displacement:
            return (
                f"has moved: the arm appears {1000 * self.displacement:.0f} mm off (the camera by "
                f"about {1000 * self.translation:.0f} mm, {np.degrees(self.rotation):.1f} deg): "
                "calibrate it anew"
            )
        return ""


class ArmShape:
    """The Panda's surface as cameras see it.

    `visuals`: the published meshes, which look as the real arm does (extra `visuals`), or the
    primitives that simulated cameras see; by default meshes where they are there.
    """

    def __init__(self, visuals: Literal["meshes", "primitives"] | None = None) -> None:
        visuals = visuals or ("meshes" if mesh_visuals() else "primitives")
        self.visuals = visuals
        builder = RobotDiagramBuilder(time_step=0.0)
        add_renderer(builder.scene_graph())
        self._panda = add_panda(builder.plant(), visuals=visuals)
        builder.plant().Finalize()
        self._robot = builder.Build()
        self._root = self._robot.CreateDefaultContext()

    def points(
        self, position: np.ndarray, opening: float, X_WC: RigidTransform, intrinsics: Intrinsics
    ) -> tuple[np.ndarray, np.ndarray]:
        """Points (N, 3) m and normals (N, 3), in C, of what this camera sees of the arm."""
        context = self._robot.plant().GetMyMutableContextFromRoot(self._root)
        self._panda.set_position(context, position)
        self._panda.set_opening(context, float(np.clip(opening, 0.0, HAND_OPENING_MAX)))
        scene_graph = self._robot.scene_graph()
        scene_context = scene_graph.GetMyContextFromRoot(self._root)
        query = scene_graph.get_query_output_port().Eval(scene_context)
        k = _thinned(intrinsics)
        core = RenderCameraCore(
            RENDERER, rendering_info(k), ClippingRange(_NEAR / 2, 2 * _FAR), RigidTransform()
        )
        camera = DepthRenderCamera(core, DepthRange(_NEAR, _FAR))
        frame = scene_graph.world_frame_id()
        depth = query.RenderDepthImage(camera, frame, X_WC).data[:, :, 0].astype(float)
        depth[~np.isfinite(depth)] = 0.0
        grid = _grid(depth, k)
        right, down = np.zeros_like(grid), np.zeros_like(grid)
        right[:, 1:-1], down[1:-1] = grid[:, 2:] - grid[:, :-2], grid[2:] - grid[:-2]
        normals = np.cross(down, right)  # towards the camera
        length = np.linalg.norm(normals, axis=2)
        inside = (depth > 0) & (length > 0)
        for axis in (0, 1):
            for shift in (-1, 1):
                there = np.roll(depth, shift, axis)
                inside &= (there > 0) & (np.abs(there - depth) < _SEE_THROUGH)
        inside[[0, -1]] = inside[:, [0, -1]] = False
        inside &= X_WC.multiply(grid.reshape(-1, 3).T)[2].reshape(depth.shape) > _FLOOR
        thinned = slice(None, None, 1 + np.count_nonzero(inside) // _MOST)
        return grid[inside][thinned], (normals[inside] / length[inside, None])[thinned]


def _thinned(k: Intrinsics) -> Intrinsics:
    """The intrinsics of every `_STEP`th pixel."""
    return Intrinsics(
        (k.width + _STEP - 1) // _STEP, (k.height + _STEP - 1) // _STEP,
        fx=k.fx / _STEP, fy=k.fy / _STEP, cx=k.cx / _STEP, cy=k.cy / _STEP,
    )  # fmt: skip


def _grid(depth: np.ndarray, k: Intrinsics) -> np.ndarray:
    """(H, W, 3) points in C."""
    v, u = np.indices(depth.shape)
    return np.stack([(u - k.cx) / k.fx * depth, (v - k.cy) / k.fy * depth, depth], axis=2)


def camera_offset(
    depth: np.ndarray,
    *,
    arm: ArmShape,
    position: np.ndarray,
    opening: float,
    X_WC: RigidTransform,
    intrinsics: Intrinsics,
) -> CameraOffset:
    """By how much the camera that measured `depth` (H, W; m) is off its pose X_WC.

    Args:
      position: (7,) measured joint angles (rad).
      opening: of the hand (m).
    """
    thin = np.nan_to_num(depth[::_STEP, ::_STEP].astype(float), nan=0.0, posinf=0.0, neginf=0.0)
    measured = _grid(thin, _thinned(intrinsics))[(thin > _NEAR) & (thin < _FAR)]
    X_CM = RigidTransform()  # from the calibrated camera to where it really is
    points, normals = arm.points(position, opening, X_WC, intrinsics)
    if len(points) < _FEWEST or len(measured) < _FEWEST:
        return CameraOffset(X_WC, 0.0, 0.0, 0.0, 0.0, min(len(points), len(measured)))
    lower, upper = points.min(axis=0) - _ROOM, points.max(axis=0) + _ROOM
    measured = measured[((measured > lower) & (measured < upper)).all(axis=1)]
    if len(measured) < _FEWEST:
        return CameraOffset(X_WC, 0.0, 0.0, 0.0, 0.0, len(points))
    tree = KDTree(measured, leafsize=16, balanced_tree=False, compact_nodes=False)
    for gates in (_GATES, _GATES[3:]):  # then once more with what is seen from the better pose
        for gate in gates:
            for _ in range(_ROUNDS):
                X_CM, change = _closer(X_CM, points, normals, tree, gate)
                if change < _SETTLED:
                    break
        seen = arm.points(position, opening, X_WC @ X_CM, intrinsics)
        if len(seen[0]) < _FEWEST:
            break
        # These are in the moved camera's frame; `points` are in the calibrated one's.
        points = X_CM.multiply(seen[0].T).T
        normals = seen[1] @ X_CM.rotation().matrix().T
    distance, _ = tree.query(X_CM.inverse().multiply(points.T).T)
    moved = points - X_CM.inverse().multiply(points.T).T
    return CameraOffset(
        X_WC=X_WC @ X_CM,
        displacement=float(np.sqrt((moved**2).sum(axis=1).mean())),
        translation=float(np.linalg.norm(X_CM.translation())),
        rotation=float(abs(X_CM.rotation().ToAngleAxis().angle())),
        met=float(np.mean(distance < _FITS)),
        points=len(points),
    )


def _closer(
    X_CM: RigidTransform, points: np.ndarray, normals: np.ndarray, tree: KDTree, gate: float
) -> tuple[RigidTransform, float]:
    """One step of point to plane; the better X_CM, and by how much it changed (m, rad).

    `points` and `normals` are the arm's, in C; the tree holds what was measured, in M.
    """
    p_M = X_CM.inverse().multiply(points.T).T
    distance, nearest = tree.query(p_M, distance_upper_bound=gate)
    met = np.isfinite(distance)
    if met.sum() < _FEWEST // 3:
        return X_CM, 0.0
    target, n = points[met], normals[met]
    source = X_CM.multiply(tree.data[nearest[met]].T).T
    residual = ((target - source) * n).sum(axis=1)
    weight = np.square(np.clip(1 - np.square(distance[met] / gate), 0, 1))
    centre = target.mean(axis=0)
    J = np.concatenate([np.cross(source - centre, n), n], axis=1)
    A = (J * weight[:, None]).T @ J
    scale = np.sqrt(np.diag(A)) + 1e-12
    A = A / scale / scale[:, None] + _DAMPING * np.eye(6)
    step = np.linalg.solve(A, (J * weight[:, None]).T @ residual / scale) / scale
    R = RotationMatrix.ProjectToRotationMatrix(Rotation.from_rotvec(step[:3]).as_matrix())
    turn = RigidTransform(centre) @ RigidTransform(R, step[3:]) @ RigidTransform(-centre)
    return turn @ X_CM, float(np.abs(step).max())
