"""From boards in images to poses of cameras.

X_WC of every camera and, with the board in the gripper, X_EB, which all cameras share, are those
with the least reprojection error over all corners of all images. They start from OpenCV's closed
form for each camera.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from iga_drake.drivers.calibration.board import opencv
from iga_drake.drivers.calibration.measurements import BoardSight, MeasurementError
from iga_drake.errors import check_bounds
from iga_drake.station.cameras.rgbd import Intrinsics

_HELD_OUT = 3  # every third pose of a camera
_SOFT = 0.5  # px, from which on the loss is linear
_OUTLIER = 1.0  # px, root mean square of an image below which it is never an outlier
_OUTLIER_RATIO = 4.0  # to the median over images
_ROUNDS = 6  # of rejections
_TURN = 0.15  # rad: spread of the hand's orientations about a second axis
_SUBSETS = 20  # of images, for the start


@dataclass
class CalibrationLimits:
    """Largest errors and smallest counts with which a calibration is accepted."""

    # Median error of the board's place (m) and orientation (rad) on held-out poses.
    translation: float = 0.001
    rotation: float = 0.01
    # Root mean square of the reprojection error (px).
    reprojection: float = 3.0
    # Fewest images with the board for each camera.
    images: int = 10
    # Largest share of a camera's images that may be left out as outliers.
    outliers: float = 0.3
    # Largest standard deviation of a camera's place (m) that follows from the errors of the images
    # and the poses chosen.
    uncertainty: float = 0.002

    def check(self, where: str = "CalibrationLimits") -> None:
        """Raises `ConfigError` for a value out of range."""
        bounds = {"translation": (1e-5, 0.1), "rotation": (1e-4, 1.0), "reprojection": (0.01, 50.0)}
        bounds |= {"images": (4, 10_000), "outliers": (0.0, 0.9), "uncertainty": (1e-5, 0.1)}
        check_bounds(self, where, bounds)


@dataclass(frozen=True)
class CameraResult:
    """One camera's pose, and how good it is."""

    X_WC: RigidTransform
    images: int  # used
    rejected: tuple[str, ...]  # files
    reprojection: float  # px, root mean square
    # Of the board's place (m) and orientation (rad) on held-out poses, where the rest was fitted.
    held_out: int
    translation: float
    translation_worst: float
    rotation: float
    rotation_worst: float
    uncertainty: float  # m, of the camera's place
    problems: tuple[str, ...]  # why it isn't accepted, with the remedy

    def lines(self) -> str:
        """The figures in words."""
        text = (
            f"{self.images} images, {len(self.rejected)} left out; reprojection "
            f"{self.reprojection:.2f} px; on {self.held_out} held-out poses "
            f"{1000 * self.translation:.2f} mm (worst {1000 * self.translation_worst:.2f}), "
            f"{np.degrees(self.rotation):.2f} deg (worst {np.degrees(self.rotation_worst):.2f})"
        )
        return "\n".join([text, *(f"left out: {name}" for name in self.rejected)])


def solve_cameras(
    sights: Sequence[BoardSight],
    carriers: Sequence[RigidTransform],
    cameras: Mapping[str, Intrinsics],
    *,
    in_gripper: bool,
    limits: CalibrationLimits | None = None,
) -> dict[str, CameraResult]:
    """The pose of every camera.

    Args:
      sights: of all cameras.
      carriers: X_WE (`in_gripper`) or X_WB of each measured pose.
      in_gripper: whether X_EB is unknown and the same at all poses.

    Raises `MeasurementError` where there is too little to determine a pose at all; what is
    determined but not good enough is said in `CameraResult.problems`.
    """
    limits = limits or CalibrationLimits()
    limits.check()
    for name in cameras:
        mine = [sight for sight in sights if sight.camera == name]
        _check_sights(name, mine, carriers, limits, in_gripper)
    known = [sight for sight in sights if sight.camera in cameras]
    held = {pose for pose in _held_out(known)}
    train = _Fit([s for s in known if s.pose not in held], carriers, cameras, in_gripper)
    train.reject_outliers()
    tests = [s for s in known if s.pose in held]
    limit = train.outlier_limit()
    good = [s for s in tests if train.error(s) <= limit]
    rejected = train.rejected + [s for s in tests if train.error(s) > limit]
    final = _Fit(train.sights + good, carriers, cameras, in_gripper, start=train)
    deviations = final.uncertainties()
    results = {}
    for name in cameras:
        used = [s for s in final.sights if s.camera == name]
        off = np.array([train.board_error(s) for s in good if s.camera == name]).reshape(-1, 2)
        some = len(off) > 0
        median = np.median(off, axis=0) if some else (np.inf, np.inf)
        worst = off.max(axis=0) if some else (np.inf, np.inf)
        result = CameraResult(
            X_WC=final.X_WC(name),
            images=len(used),
            rejected=tuple(s.image for s in rejected if s.camera == name),
            reprojection=_rms([final.error(s) for s in used]),
            held_out=len(off),
            translation=float(median[0]),
            translation_worst=float(worst[0]),
            rotation=float(median[1]),
            rotation_worst=float(worst[1]),
            uncertainty=deviations[name],
            problems=(),
        )
        results[name] = _judged(name, result, limits, in_gripper)
    return results


def _check_sights(
    name: str,
    mine: Sequence[BoardSight],
    carriers: Sequence[RigidTransform],
    limits: CalibrationLimits,
    in_gripper: bool,
) -> None:
    if len(mine) < limits.images:
        raise MeasurementError(
            f"{name}: the board is found in {len(mine)} images, at least {limits.images} are "
            "needed: more poses, nearer, facing the camera, in even light; is it the board that "
            "the file states?"
        )
    if not in_gripper:
        return
    first = carriers[mine[0].pose].rotation().inverse()
    turns = np.array(
        [Rotation.from_matrix((first @ carriers[s.pose].rotation()).matrix()).as_rotvec()
         for s in mine]
    )  # fmt: skip
    spread = np.linalg.svd(turns - turns.mean(axis=0), compute_uv=False) / np.sqrt(len(mine))
    if spread[1] < _TURN:
        raise MeasurementError(
            f"{name}: the hand turns about one axis alone ({np.degrees(spread[0]):.0f} deg about "
            f"it, {np.degrees(spread[1]):.0f} deg about a second): tilt the board by 20 to 40 deg "
            "about several axes from pose to pose"
        )


def _held_out(sights: Sequence[BoardSight]) -> set[int]:
    """Every third pose that is seen."""
    poses = sorted({sight.pose for sight in sights})
    return set(poses[1::_HELD_OUT])


def _judged(
    name: str, result: CameraResult, limits: CalibrationLimits, in_gripper: bool
) -> CameraResult:
    """With the reasons why it isn't accepted."""
    problems = []
    found = result.images + len(result.rejected)
    if len(result.rejected) > limits.outliers * found:
        cause = "does the board slip in the hand?" if in_gripper else "was the board moved?"
        problems.append(
            f"{name}: {len(result.rejected)} of {found} images don't fit the others, at most "
            f"{100 * limits.outliers:g} % may: {cause} Were the arm and the board at rest, and the "
            "joints those of the image?"
        )
    if not result.reprojection <= limits.reprojection:
        problems.append(
            f"{name}: reprojection error {result.reprojection:.2f} px, at most "
            f"{limits.reprojection:g} is allowed: are the intrinsics the camera's, at this size, "
            "and the board's squares as large as stated? Is the board flat?"
        )
    if not result.held_out:
        problems.append(f"{name}: no held-out pose is left: more poses")
    elif not (result.translation <= limits.translation and result.rotation <= limits.rotation):
        problems.append(
            f"{name}: on held-out poses the board is off by {1000 * result.translation:.2f} mm and "
            f"{result.rotation:.4f} rad (median), at most {1000 * limits.translation:g} mm and "
            f"{limits.rotation:g} rad are allowed: a stiffer hold of the board, its true size "
            "(measure the squares), nearer and sharper images, more poses"
        )
    if not result.uncertainty <= limits.uncertainty:
        problems.append(
            f"{name}: these poses leave {1000 * result.uncertainty:.1f} mm open (standard "
            f"deviation of its place), at most {1000 * limits.uncertainty:g} mm are allowed: more "
            "poses, tilted about other axes, over the whole image"
        )
    return CameraResult(**{**vars(result), "problems": tuple(problems)})


def _rms(values: Sequence[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else float("inf")


class _Fit:
    """The poses that fit some sights best."""

    def __init__(
        self,
        sights: Sequence[BoardSight],
        carriers: Sequence[RigidTransform],
        cameras: Mapping[str, Intrinsics],
        in_gripper: bool,
        start: "_Fit | None" = None,
    ) -> None:
        self.sights, self.rejected = list(sights), list[BoardSight]()
        self._carriers, self._cameras, self._in_gripper = carriers, cameras, in_gripper
        self._names = list(cameras)
        for name in cameras:
            if not any(s.camera == name for s in sights):
                raise MeasurementError(f"{name}: all its images disagree with the others'")
        self._X: np.ndarray = self._start() if start is None else start._X.copy()
        self._refine()

    def X_WC(self, name: str) -> RigidTransform:
        """The camera's pose."""
        return _transform(self._X[self._names.index(name)]).inverse()

    def X_CB(self, sight: BoardSight) -> RigidTransform:
        """Where the board is in the image's camera, by the fit."""
        X_HB = _transform(self._X[-1])
        X_CW = _transform(self._X[self._names.index(sight.camera)])
        return X_CW @ self._carriers[sight.pose] @ X_HB

    def error(self, sight: BoardSight) -> float:
        """Root mean square over the corners (px)."""
        p_C = self.X_CB(sight).multiply(sight.corners.T)
        off = _project(p_C, self._cameras[sight.camera]).T - sight.pixels
        return float(np.sqrt((off**2).sum(axis=1).mean())) if (p_C[2] > 0).all() else np.inf

    def board_error(self, sight: BoardSight) -> tuple[float, float]:
        """How far the board (its middle, m; its orientation, rad) is from where the image alone
        shows it."""
        seen = _board_in_camera(sight, self._cameras[sight.camera])
        fitted, middle = self.X_CB(sight), sight.corners.mean(axis=0)
        angle = (seen.rotation().inverse() @ fitted.rotation()).ToAngleAxis().angle()
        return float(np.linalg.norm(seen @ middle - fitted @ middle)), float(abs(angle))

    def outlier_limit(self) -> float:
        """Error (px) above which an image is an outlier."""
        return max(
            _OUTLIER, _OUTLIER_RATIO * float(np.median([self.error(s) for s in self.sights]))
        )

    def reject_outliers(self) -> None:
        """Fits again without the images that don't fit, until all do."""
        for _ in range(_ROUNDS):
            limit = self.outlier_limit()
            bad = [s for s in self.sights if self.error(s) > limit]
            left = [s for s in self.sights if self.error(s) <= limit]
            if not bad or {s.camera for s in left} != set(self._names):
                return
            self.sights, self.rejected = left, self.rejected + bad
            self._refine()

    def uncertainties(self) -> dict[str, float]:
        """Camera -> standard deviation of its place (m). The corners of an image count as one
        measurement: they share the errors of the arm."""
        residual, jacobian = self._solution.fun, self._solution.jac
        share = len(residual) / max(1, 2 * len(self.sights))
        variance = share * float(residual @ residual) / max(1, len(residual))
        covariance = variance * np.linalg.pinv(jacobian.T @ jacobian, rcond=1e-14)
        found = {}
        for k, name in enumerate(self._names):
            X_CW = _transform(self._X[k])
            # p_WC = -R_CW' t; both move it.
            h, columns = 1e-6, []
            for j in range(6):
                step = self._X[k].copy()
                step[j] += h
                columns.append(
                    (_transform(step).inverse().translation() - X_CW.inverse().translation()) / h
                )
            J = np.stack(columns, axis=1)
            block = covariance[6 * k : 6 * k + 6, 6 * k : 6 * k + 6]
            found[name] = float(np.sqrt(np.trace(J @ block @ J.T)))
        return found

    def _start(self) -> np.ndarray:
        """(cameras + 1, 6): X_CW of each and X_HB, from the closed form for each camera."""
        rng = np.random.default_rng(0)
        self._seen = {id(s): _board_in_camera(s, self._cameras[s.camera]) for s in self.sights}
        found, holds = [], []
        for name in self._names:
            mine = [s for s in self.sights if s.camera == name]
            tries = []
            for k in range(_SUBSETS):
                size = len(mine) if k == 0 else min(len(mine), 8)
                some = [mine[i] for i in rng.permutation(len(mine))[:size]]
                X_WC = self._closed_form(some)
                if X_WC is None:
                    continue
                held = [self._carriers[s.pose].inverse() @ X_WC @ self._seen[id(s)] for s in mine]
                middle = np.median([X.translation() for X in held], axis=0)
                off = np.median([np.linalg.norm(X.translation() - middle) for X in held])
                tries.append((float(off), X_WC, held, middle))
                if not self._in_gripper and k >= len(mine):
                    break
            if not tries:
                raise MeasurementError(
                    f"{name}: no camera pose fits its images: tilt the board more"
                )
            off, X_WC, held, middle = min(tries, key=lambda each: each[0])
            found.append(_vector(X_WC.inverse()))
            nearest = min(held, key=lambda X: float(np.linalg.norm(X.translation() - middle)))
            holds.append((off, nearest))
        X_HB = min(holds, key=lambda each: each[0])[1] if self._in_gripper else RigidTransform()
        return np.array([*found, _vector(X_HB)])

    def _closed_form(self, sights: Sequence[BoardSight]) -> RigidTransform | None:
        cv2 = opencv()
        X_CBs = [self._seen[id(s)] for s in sights]
        X_WHs = [self._carriers[s.pose] for s in sights]
        if not self._in_gripper:
            return X_WHs[0] @ X_CBs[0].inverse()
        inverse = [X.inverse() for X in X_WHs]
        try:
            R, t = cv2.calibrateHandEye(
                [X.rotation().matrix() for X in inverse],
                [X.translation() for X in inverse],
                [X.rotation().matrix() for X in X_CBs],
                [X.translation() for X in X_CBs],
                method=cv2.CALIB_HAND_EYE_PARK,
            )
        except cv2.error:  # too few different orientations among these
            return None
        if not (np.isfinite(R).all() and np.isfinite(t).all()):
            return None
        return RigidTransform(RotationMatrix.ProjectToRotationMatrix(R), t.ravel())

    def _refine(self) -> None:
        index = {name: k for k, name in enumerate(self._names)}
        counts = [len(s.corners) for s in self.sights]
        camera = np.repeat([index[s.camera] for s in self.sights], counts)
        X_WH = [self._carriers[s.pose] for s in self.sights]
        R = np.repeat([X.rotation().matrix() for X in X_WH], counts, axis=0)
        p = np.repeat([X.translation() for X in X_WH], counts, axis=0)
        p_B = np.concatenate([s.corners for s in self.sights])
        pixels = np.concatenate([s.pixels for s in self.sights])
        intrinsics = [self._cameras[name] for name in self._names]
        focal = np.array([(k.fx, k.fy) for k in intrinsics])[camera]
        centre = np.array([(k.cx, k.cy) for k in intrinsics])[camera]
        free = len(self._names) + self._in_gripper
        fixed = self._X[free:]

        def residual(flat: np.ndarray) -> np.ndarray:
            X = np.concatenate([flat.reshape(-1, 6), fixed])
            rotation = Rotation.from_rotvec(X[:, :3]).as_matrix()
            p_H = p_B @ rotation[-1].T + X[-1, 3:]
            p_W = np.einsum("nij,nj->ni", R, p_H) + p
            p_C = np.einsum("nij,nj->ni", rotation[camera], p_W) + X[camera, 3:]
            depth = np.maximum(p_C[:, 2:], 1e-3)  # behind the camera: far off, but finite
            return ((focal * p_C[:, :2] / depth + centre) - pixels).ravel()

        self._solution = least_squares(
            residual, self._X[:free].ravel(), loss="soft_l1", f_scale=_SOFT, x_scale="jac"
        )
        self._X = np.concatenate([self._solution.x.reshape(-1, 6), fixed])


def _vector(X: RigidTransform) -> np.ndarray:
    """(6,) rotation vector and translation."""
    turn = Rotation.from_matrix(X.rotation().matrix()).as_rotvec()
    return np.concatenate([turn, X.translation()])


def _transform(vector: np.ndarray) -> RigidTransform:
    R = Rotation.from_rotvec(vector[:3]).as_matrix()
    return RigidTransform(RotationMatrix.ProjectToRotationMatrix(R), vector[3:])


def _project(p_C: np.ndarray, k: Intrinsics) -> np.ndarray:
    """(2, n) pixels of points (3, n) in C."""
    return np.stack([k.fx * p_C[0] / p_C[2] + k.cx, k.fy * p_C[1] / p_C[2] + k.cy])


def _board_in_camera(sight: BoardSight, k: Intrinsics) -> RigidTransform:
    """X_CB by one image alone."""
    cv2 = opencv()
    matrix = np.array([[k.fx, 0, k.cx], [0, k.fy, k.cy], [0, 0, 1]])
    middle = sight.corners.mean(axis=0)
    corners = sight.corners - middle
    _, turn, shift = cv2.solvePnP(corners, sight.pixels, matrix, None, flags=cv2.SOLVEPNP_IPPE)
    turn, shift = cv2.solvePnPRefineLM(corners, sight.pixels, matrix, None, turn, shift)
    R = RotationMatrix.ProjectToRotationMatrix(Rotation.from_rotvec(turn.ravel()).as_matrix())
    return RigidTransform(R, shift.ravel()) @ RigidTransform(-middle)
