"""The ICP baseline: registers a demonstration's objects with the test objects, rigidly.

Per demonstration the grasped and the target cloud are registered with the test's; with `X_A`, `X_B`
from demonstration to test the answer is `X_B X_A^-1`. Many starts descend together on few points
(point-to-point), the worse ones are given up on the way, and the best are finished on all points
(Open3D, point-to-plane). The best demonstration is the one with the smallest mean distance of both
registrations. Where an object's way up is known, its registrations start from turns about it.
"""

from typing import Any

import numpy as np

from iga_drake.aligners.protocol import AlignerError, PoseEstimate, check_question
from iga_drake.demonstrations.alignment import Alignment, check_direction
from iga_drake.geometry.rigid_fit import rigid_fit

_MOST_STARTS = 1000
_COARSE_POINTS = 64  # of a cloud, on which the starts descend
# Iterations of the starts, and the share of them that goes on after each.
_COARSE = ((3, 0.25), (8, 1.0))
_Ups = tuple[np.ndarray, np.ndarray]  # ways up (3,) of a source and of a goal


def _open3d():
    try:
        import open3d
    except ImportError as error:
        raise AlignerError(
            "icp: Open3D is not installed: pip install 'iga-drake[icp]' (needs libusb-1.0-0)"
        ) from error
    return open3d


def _starts(count: int, rng: np.random.Generator, ups: _Ups | None) -> np.ndarray:
    """Rotations (count, 3, 3): the identity and Haar-uniform ones; with the ways up of source and
    goal, turns about them by equal angles, the first one drawn."""
    from scipy.spatial.transform import Rotation

    if ups is None:
        rotations = Rotation.random(count - 1, rng=rng).as_matrix()
        return np.concatenate((np.eye(3)[None], rotations))
    angles = 2 * np.pi * (rng.uniform() + np.arange(count)) / count
    upright, _ = Rotation.align_vectors(ups[1][None], ups[0][None])
    return (Rotation.from_rotvec(angles[:, None] * ups[1]) * upright).as_matrix()


def _ups(
    demonstrated: list[np.ndarray | None], test: np.ndarray | None, name: str
) -> list[_Ups | None]:
    """For each demonstration its way up and the test's; None unless all are known."""
    if test is None:
        return [None] * len(demonstrated)
    test = check_direction(test, name)
    known = [(up, test) for up in demonstrated if up is not None]
    return list(known) if len(known) == len(demonstrated) else [None] * len(demonstrated)


def _descended(
    source: np.ndarray, goal: np.ndarray, R: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Point-to-point ICP of a cloud (n, 3) to another (m, 3) from rotations (S, 3, 3) about the
    centres, all together.

    Returns rotations and shifts of those that were not given up, and their symmetric mean distances
    (m), the best first.
    """
    from scipy.spatial import cKDTree  # aligners are listed without it

    onto, back = cKDTree(goal), cKDTree(source)
    p = goal.mean(0) - R @ source.mean(0)

    def moved() -> np.ndarray:
        return source @ np.swapaxes(R, 1, 2) + p[:, None]

    for iterations, share in _COARSE:
        for _ in range(iterations):
            R, p = rigid_fit(source, goal[onto.query(moved())[1]])
        there = onto.query(moved())[0].mean(1)
        distance = 0.5 * (there + back.query((goal - p[:, None]) @ R)[0].mean(1))
        order = np.argsort(distance)[: max(1, round(share * len(R)))]
        R, p, distance = R[order], p[order], distance[order]
    return R, p, distance


class IcpAligner:
    """`Aligner` by multi-start ICP. `starts` rotations, of which `refined` are finished
    point-to-plane."""

    name = "icp"

    def __init__(self, *, starts: int = 96, refined: int = 3, voxel: float = 0.01):
        for name, value in (("starts", starts), ("refined", refined)):
            if not (float(value).is_integer() and 1 <= value <= _MOST_STARTS):
                raise AlignerError(f"icp: {name} {value}, an integer from 1 to 1000 expected")
        if not 1e-4 <= voxel <= 1:
            raise AlignerError(f"icp: voxel {voxel} m, 0.0001 to 1 expected")
        _open3d()  # not when the first object waits
        self.starts = int(starts)
        self.refined = int(refined)
        self.voxel = voxel

    def _register(
        self, source, goal, rng: np.random.Generator, ups: _Ups | None
    ) -> tuple[np.ndarray, float]:
        """Motion (4, 4) of the source cloud onto the goal and the symmetric mean distance (m)."""
        o3d = _open3d()
        reg = o3d.pipelines.registration

        def few(cloud: Any) -> np.ndarray:
            points = np.asarray(cloud.voxel_down_sample(self.voxel).points)
            return points[rng.permutation(len(points))[:_COARSE_POINTS]]

        R, p, _ = _descended(few(source), few(goal), _starts(self.starts, rng, ups))
        best: tuple[float, np.ndarray] | None = None
        for k in range(min(self.refined, len(R))):
            X = np.eye(4)
            X[:3, :3], X[:3, 3] = R[k], p[k]
            result = reg.registration_icp(
                source, goal, 0.03, X, reg.TransformationEstimationPointToPlane(),
                reg.ICPConvergenceCriteria(max_iteration=40),
            )  # fmt: skip
            moved = o3d.geometry.PointCloud(source).transform(result.transformation)
            distance = 0.5 * (
                np.mean(moved.compute_point_cloud_distance(goal))
                + np.mean(goal.compute_point_cloud_distance(moved))
            )
            if best is None or distance < best[0]:
                best = (float(distance), np.asarray(result.transformation))
        assert best is not None
        return best[1], best[0]

    def align(
        self,
        context: tuple[Alignment, ...],
        grasped: np.ndarray,
        target: np.ndarray,
        *,
        grasped_up: np.ndarray | None = None,
        target_up: np.ndarray | None = None,
        seed: int = 0,
    ) -> PoseEstimate:
        """See `Aligner.align`. One mode per demonstration; the energy is the mean distance in
        cm."""
        grasped, target = check_question("icp", context, grasped, target, seed=seed)
        o3d = _open3d()
        rng = np.random.default_rng(seed)

        def cloud(points: np.ndarray):
            pcd = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
            pcd.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(radius=0.02, max_nn=30))
            return pcd

        test_A = cloud(grasped)
        test_B = cloud(target)
        ups_A = _ups([a.grasped_up for a in context], grasped_up, "grasped_up")
        ups_B = _ups([a.target_up for a in context], target_up, "target_up")
        poses, energies = [], []
        for alignment, up_A, up_B in zip(context, ups_A, ups_B, strict=True):
            X_A, error_A = self._register(cloud(alignment.grasped), test_A, rng, up_A)
            X_B, error_B = self._register(cloud(alignment.target), test_B, rng, up_B)
            poses.append(X_B @ np.linalg.inv(X_A))
            energies.append(100 * (error_A + error_B))
        order = np.argsort(energies)
        energy = np.array(energies)[order]
        probability = np.exp(-(energy - energy[0]) / 0.1)
        return PoseEstimate(np.array(poses)[order], energy, probability / probability.sum())


ALIGNERS = {"icp": IcpAligner}
