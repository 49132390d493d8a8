"""`iga evaluate moved-cameras`: which displacements of a camera the arm's own shape gives away.

Scenes of a task are rendered with the noise of a D415, the arm at random postures above them. For
each camera, the pose that the check is told is off by a displacement of a given size in a random
direction, or by a turn of a given angle about a random axis through the camera.
"""

import argparse
import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix
from scipy.spatial.transform import Rotation

from iga_drake.drivers.calibration.arm_shape import ArmShape, ArmShapeLimits, camera_offset
from iga_drake.errors import check_range
from iga_drake.progress import progress
from iga_drake.station.cameras.rgbd import true_pose
from iga_drake.station.make import make_station
from iga_drake.station.panda.model import HOME_POSITION, find_panda
from iga_drake.station.scenario import Scenario, load_scenario
from iga_drake.tasks.registry import scenario_task

CENTIMETRES = (1.0, 2.0, 3.0, 5.0)
DEGREES = (1.0, 2.0, 5.0)
_SPREAD = np.array([0.4, 0.3, 0.3, 0.3, 0.5, 0.4, 0.8])  # rad, of the joints about home
_POSTURES = 2  # of each scene
# The pose told, beside the true one, where it is as good as `iga calibrate` makes it.
_PLACE, _ANGLE = 0.0006, 0.0005  # m, rad, standard deviations along each axis


@dataclass(frozen=True)
class MovedCameraTrial:
    """One check of one camera."""

    moved: str  # "no", "2 cm", "1 deg"
    seed: int
    camera: str
    found: bool  # said to have moved, or not to fit
    told: bool  # said to have moved, with by how much
    error: float  # m, of the arm's points by the pose that the check found; NaN where it can't tell
    displacement: float  # m, as found


def _views(scenario: Scenario, scene_seed: int) -> Iterator[tuple[np.ndarray, dict]]:
    """Joints and depth images of each camera, of each posture above one scene."""
    scene = scenario_task(scenario).scene(scene_seed)
    scene = replace(scene, hand_opening=0.04) if not scene.truth.X_EO else scene
    station = make_station(scenario, scene=scene, seed=scene_seed)
    context = station.CreateDefaultContext()
    plant = station.GetSubsystemByName("plant")
    panda, state = find_panda(plant), plant.GetMyMutableContextFromRoot(context)
    rng = np.random.default_rng([scene_seed, 77])
    for k in range(_POSTURES):
        context.SetTime(0.1 * k)  # another image's noise
        joints = np.array(HOME_POSITION) + rng.uniform(-1, 1, 7) * _SPREAD
        panda.set_position(state, joints)
        panda.set_opening(state, 0.04)
        yield (
            joints,
            {
                name: station.GetOutputPort(f"{name}.depth_image")
                .Eval(context)
                .data[:, :, 0]
                .copy()
                for name in scenario.camera_names
            },
        )


def moved_camera_trials(
    scenario: Scenario, scene_seed: int, arm: ArmShape, limits: ArmShapeLimits
) -> list[MovedCameraTrial]:
    """All displacements, at each posture of one scene, for each camera."""
    rng = np.random.default_rng([scene_seed, 78])
    kinds = [("no", 0.0, 0.0), *((f"{c:g} cm", c / 100, 0.0) for c in CENTIMETRES)]
    kinds += [(f"{d:g} deg", 0.0, np.radians(d)) for d in DEGREES]
    trials = []
    for joints, depths in _views(scenario, scene_seed):
        for name, depth in depths.items():
            camera = scenario.cameras[name]
            X_WC = true_pose(camera)
            points = arm.points(joints, 0.04, X_WC, camera.intrinsics)[0]
            for moved, shift, turn in kinds:
                R = _turn(turn * _direction(rng) + _ANGLE * rng.standard_normal(3))
                p = shift * _direction(rng) + _PLACE * rng.standard_normal(3)
                told = X_WC @ RigidTransform(R, p)
                found = camera_offset(
                    depth, arm=arm, position=joints, opening=0.04, X_WC=told,
                    intrinsics=camera.intrinsics,
                )  # fmt: skip
                problem = found.problem(limits)
                off = found.X_WC.inverse() @ X_WC
                error = np.sqrt((np.square(off.multiply(points.T).T - points)).sum(axis=1).mean())
                trials.append(
                    MovedCameraTrial(
                        moved, scene_seed, name, bool(problem), problem.startswith("has moved"),
                        float("nan") if problem.startswith("can't") else float(error),
                        found.displacement,
                    )
                )  # fmt: skip
    return trials


def _direction(rng: np.random.Generator) -> np.ndarray:
    v = rng.standard_normal(3)
    return v / np.linalg.norm(v)


def _turn(vector: np.ndarray) -> RotationMatrix:
    return RotationMatrix(Rotation.from_rotvec(vector).as_matrix())


def moved_camera_table(trials: Sequence[MovedCameraTrial]) -> str:
    """Shares found of each displacement, as text."""
    lines = [
        f"{'moved by':<10}{'checks':>8}{'noticed':>9}{'and told':>10}{'error, mm':>11}{'90 %':>7}"
    ]
    for moved in dict.fromkeys(trial.moved for trial in trials):
        mine = [trial for trial in trials if trial.moved == moved]
        errors = np.array([1000 * t.error for t in mine])
        errors = errors[np.isfinite(errors)]
        some = len(errors) > 0
        lines.append(
            f"{moved:<10}{len(mine):>8}{np.mean([t.found for t in mine]):>9.1%}"
            f"{np.mean([t.told for t in mine]):>10.1%}"
            f"{np.median(errors) if some else np.nan:>11.1f}"
            f"{np.percentile(errors, 90) if some else np.nan:>7.1f}"
        )
    return "\n".join(lines)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the command."""
    parser.add_argument("--task", default="grasp", help="whose scenes are rendered")
    parser.add_argument("--count", type=int, default=10, help="scenes, of two postures each")
    parser.add_argument("--seed", type=int, default=0, help="of the first scene")
    parser.add_argument(
        "--seen", choices=("primitives", "meshes"), default="primitives",
        help="what the cameras see of the arm",
    )  # fmt: skip
    parser.add_argument(
        "--model", choices=("primitives", "meshes"), default="primitives",
        help="the arm's shape that the check goes by",
    )  # fmt: skip
    limits = ArmShapeLimits()
    parser.add_argument(
        "--displacement", type=float, default=limits.displacement,
        help="m, of the arm, from which on a camera is said to have moved",
    )  # fmt: skip
    parser.add_argument("--met", type=float, default=limits.met, help="least share of the arm")
    parser.add_argument("--json", action="store_true", help="print one JSON object")


def run(arguments: argparse.Namespace) -> int:
    """Prints how often each displacement is noticed."""
    check_range(1 <= arguments.count <= 10_000, "--count", arguments.count, "1 to 10000")
    check_range(0 <= arguments.seed < 2**31, "--seed", arguments.seed, "0 to 2^31 - 1")
    limits = ArmShapeLimits(arguments.displacement, arguments.met)
    limits.check("--")
    scenario = load_scenario(arguments.task, overrides=[f"panda.visuals={arguments.seen}"])
    arm = ArmShape(arguments.model)
    trials = []
    for k in progress(range(arguments.seed, arguments.seed + arguments.count), "scenes"):
        trials += moved_camera_trials(scenario, k, arm, limits)
    if arguments.json:
        print(json.dumps([asdict(trial) for trial in trials], indent=2))
    else:
        print(moved_camera_table(trials))
    return 0
