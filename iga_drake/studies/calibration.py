"""`iga evaluate calibration`: calibrations with rendered boards, beside the true camera poses.

Each set-up has three cameras about the work area. For each, random postures of the arm show it the
board in the hand ("gripper"), and the board lies at random known places ("world"). The images are
those of a D415's colour camera as `ImageErrors` has it; the joints, and the known places, are
measured with errors.
"""

import argparse
import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from PIL import Image
from pydrake.math import RigidTransform, RotationMatrix
from scipy.spatial.transform import Rotation

from iga_drake.drivers.calibration.board import CharucoBoard, opencv
from iga_drake.drivers.calibration.measurements import BoardSight, hand_poses
from iga_drake.drivers.calibration.solve import solve_cameras
from iga_drake.errors import check_range
from iga_drake.files import output_file, replacing
from iga_drake.progress import progress
from iga_drake.station.cameras.rgbd import Intrinsics, look_at
from iga_drake.station.panda.model import HOME_POSITION

_FINE = 2  # rays to a pixel along each axis
_TEXTURE = 64  # px of the board's picture to a square
_CAMERAS = {
    "front": ([1.25, 0.0, 0.8], [0.45, 0.0, 0.35]),
    "left": ([0.25, 0.95, 0.8], [0.45, 0.0, 0.35]),
    "right": ([0.25, -0.95, 0.8], [0.45, 0.0, 0.35]),
}
_FARTHEST = 1.2  # m, of the board
_WORK_AREA = np.array([0.5, 0.0, 0.15])
_SPREAD = np.array([0.9, 0.5, 0.6, 0.5, 1.2, 0.8, 1.6])  # rad, of the joints about home
_TILT = np.radians(50)  # of the board's normal from the line of sight, at most


@dataclass
class ImageErrors:
    """What is wrong with a colour image of the board, and with what else is measured."""

    # Standard deviations of the blur (px) and of the noise (grey levels of 255).
    blur: float = 0.8
    noise: float = 3.0
    # Grey levels of black and white print; the light falls off by up to `shading` across the image.
    black: float = 35.0
    white: float = 200.0
    shading: float = 0.3
    # Radial distortion that the intrinsics don't tell: standard deviation of its first coefficient
    # (0.004: 0.6 px at the corners of 640 x 480).
    distortion: float = 0.002
    # Standard deviation of the focal length's relative error.
    focal: float = 0.0005
    # Standard deviations of a joint's angle (rad): of its zero, and from posture to posture.
    joint_zero: float = 0.0003
    joint: float = 0.0001
    # The same of a known place of the board (m) and its orientation (rad).
    place: float = 0.0003
    orientation: float = 0.001


@dataclass(frozen=True)
class CalibrationTrial:
    """One camera of one set-up."""

    mounting: str
    setup: int
    camera: str
    images: int
    translation: float  # m, of the camera's place
    rotation: float  # rad
    work_area: float  # m, of a point in the middle of the work area
    held_out: float  # m, as the calibration itself says
    accepted: bool


def render_board(
    board: CharucoBoard,
    X_CB: RigidTransform,
    intrinsics: Intrinsics,
    errors: ImageErrors,
    rng: np.random.Generator,
    *,
    distortion: float = 0.0,
) -> np.ndarray:
    """A grey image (H, W) uint8 of the board, with a margin of half a square, before a plain wall.

    `distortion` is the lens': the ray of the pixel (x, y) from the centre, in focal lengths, is
    that of a pinhole at (x, y) (1 - distortion (x^2 + y^2)).
    """
    cv2 = opencv()
    H, W, k = intrinsics.height, intrinsics.width, intrinsics
    margin = _TEXTURE // 2
    texture = np.pad(board.draw(_TEXTURE), margin, constant_values=255)
    corner = board.square / 2
    outline = np.array(
        [[x, y, 0] for x in (-corner, board.size[0] + corner)
         for y in (-corner, board.size[1] + corner)]
    )  # fmt: skip
    seen = X_CB.multiply(outline.T)
    u = np.clip(k.fx * seen[0] / seen[2] + k.cx, 0, W - 1)
    v = np.clip(k.fy * seen[1] / seen[2] + k.cy, 0, H - 1)
    left, right = max(0, int(u.min()) - 4), min(W, int(u.max()) + 6)
    top, bottom = max(0, int(v.min()) - 4), min(H, int(v.max()) + 6)
    fine = (np.arange(_FINE) + 0.5) / _FINE - 0.5
    columns = (np.arange(left, right)[:, None] + fine).ravel()
    rows = (np.arange(top, bottom)[:, None] + fine).ravel()
    x = ((columns - k.cx) / k.fx).astype(np.float32)
    y = ((rows - k.cy) / k.fy).astype(np.float32)[:, None]
    if distortion:
        factor = 1 - np.float32(distortion) * (x * x + y * y)
        x, y = x * factor, y * factor
    # The ray (x, y, 1) meets the board's plane where its z in B is 0.
    X_BC = X_CB.inverse()
    R, o = X_BC.rotation().matrix().astype(np.float32), X_BC.translation().astype(np.float32)
    t = -o[2] / (R[2, 0] * x + R[2, 1] * y + R[2, 2])
    scale = np.float32(_TEXTURE / board.square)
    places = [
        (o[i] + t * (R[i, 0] * x + R[i, 1] * y + R[i, 2])) * scale + np.float32(margin - 0.5)
        for i in range(2)
    ]
    wall = rng.uniform(60, 150)
    found = cv2.remap(texture, *places, interpolation=cv2.INTER_LINEAR).astype(np.float32)
    inside = (places[0] >= 0) & (places[0] < texture.shape[1] - 1)
    inside &= (places[1] >= 0) & (places[1] < texture.shape[0] - 1)
    found = errors.black + (errors.white - errors.black) / 255 * found
    found = np.where(inside, found, wall)
    shape = bottom - top, _FINE, right - left, _FINE
    image = np.full((H, W), wall, dtype=np.float32)
    image[top:bottom, left:right] = found.reshape(shape).mean(axis=(1, 3))
    slope = rng.uniform(-1, 1, 2) * errors.shading / 2
    light = 1 + slope[0] * np.linspace(-1, 1, W) + slope[1] * np.linspace(-1, 1, H)[:, None]
    image = cv2.GaussianBlur(image * light.astype(np.float32), (0, 0), errors.blur)
    image += errors.noise * rng.standard_normal(image.shape, dtype=np.float32)
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


@dataclass(frozen=True)
class _SetUp:
    """True cameras, and what the calibration is told of their lenses."""

    poses: dict[str, RigidTransform]  # X_WC
    lenses: dict[str, tuple[Intrinsics, float]]  # true
    told: dict[str, Intrinsics]


def _make_setup(rng: np.random.Generator, errors: ImageErrors) -> _SetUp:
    poses, lenses, told = {}, {}, {}
    for name, (position, target) in _CAMERAS.items():
        poses[name] = look_at(
            np.array(position) + rng.uniform(-0.1, 0.1, 3),
            np.array(target) + rng.uniform(-0.05, 0.05, 3),
        )
        told[name] = Intrinsics(cx=319.5 + rng.uniform(-8, 8), cy=239.5 + rng.uniform(-8, 8))
        focal = 616.0 * (1 + errors.focal * rng.standard_normal())
        true = Intrinsics(fx=focal, fy=focal, cx=told[name].cx, cy=told[name].cy)
        lenses[name] = true, errors.distortion * rng.standard_normal()
    return _SetUp(poses, lenses, told)


def _visible(board: CharucoBoard, X_CB: RigidTransform, k: Intrinsics) -> bool:
    """Whether the whole board is in the image, from the front and not too tilted."""
    width, height = board.size
    corners = np.array([[0, 0, 0], [width, 0, 0], [0, height, 0], [width, height, 0]])
    seen = X_CB.multiply(corners.T)
    if seen[2].min() < 0.35 or seen[2].max() > _FARTHEST:
        return False
    u, v = k.fx * seen[0] / seen[2] + k.cx, k.fy * seen[1] / seen[2] + k.cy
    inside = u.min() > 5 and u.max() < k.width - 6 and v.min() > 5 and v.max() < k.height - 6
    middle = seen.mean(axis=1)
    facing = X_CB.rotation().matrix()[:, 2] @ middle / np.linalg.norm(middle)
    return bool(inside and facing > np.cos(_TILT))


def _random_turn(rng: np.random.Generator, size: float) -> RotationMatrix:
    return RotationMatrix(Rotation.from_rotvec(size * rng.standard_normal(3)).as_matrix())


def _in_gripper(
    rng: np.random.Generator, setup: _SetUp, board: CharucoBoard, errors: ImageErrors
) -> Iterator[tuple[RigidTransform, RigidTransform]]:
    """X_WB true and X_WE measured, of random postures that show a camera the board."""
    # The board is clamped between the fingers, so its normal is along y of the hand.
    flat = RotationMatrix(np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])) @ _random_turn(rng, 0.1)
    middle = np.array([*board.size, 0]) / 2
    held = np.array([0.0, 0.0, 0.5 * board.size[1]]) + rng.uniform(-0.02, 0.02, 3)
    X_EB = RigidTransform(flat, held) @ RigidTransform(-middle)
    zero = errors.joint_zero * rng.standard_normal(7)
    while True:
        joints = np.array(HOME_POSITION) + rng.uniform(-1, 1, (100, 7)) * _SPREAD
        measured = hand_poses(joints + errors.joint * rng.standard_normal(joints.shape))
        for X_WE, X_WE_measured in zip(hand_poses(joints + zero), measured, strict=True):
            X_WB = X_WE @ X_EB
            place = X_WB @ middle
            if place[2] > 0.2 and 0.25 < np.hypot(*place[:2]) < 0.75:
                yield X_WB, X_WE_measured


def _in_world(
    rng: np.random.Generator, setup: _SetUp, board: CharucoBoard, errors: ImageErrors
) -> Iterator[tuple[RigidTransform, RigidTransform]]:
    """X_WB true and measured, at random places, turned to one camera after the other."""
    middle = np.array([*board.size, 0]) / 2
    while True:
        for X_WC in setup.poses.values():
            place = np.array([0.45, 0.0, 0.3]) + rng.uniform(-0.2, 0.2, 3)
            facing = look_at(X_WC.translation(), place).rotation() @ _random_turn(rng, 0.4)
            X_WB = RigidTransform(facing, place) @ RigidTransform(-middle)
            turn = _random_turn(rng, errors.orientation)
            off = RigidTransform(turn, errors.place * rng.standard_normal(3))
            yield X_WB, RigidTransform(place) @ off @ RigidTransform(-place) @ X_WB


def calibration_trials(
    setup_seed: int, mounting: str, *, images: int = 15, errors: ImageErrors | None = None
) -> list[CalibrationTrial]:
    """All cameras of the set-up with this seed, each calibrated with `images` images in which the
    board is found."""
    errors = errors or ImageErrors()
    rng = np.random.default_rng([setup_seed, mounting == "gripper"])
    board, setup = CharucoBoard(), _make_setup(rng, errors)
    poses = _in_gripper if mounting == "gripper" else _in_world
    carriers: list[RigidTransform] = []
    sights: list[BoardSight] = []
    left = dict.fromkeys(setup.poses, images)
    for X_WB, carrier in poses(rng, setup, board, errors):
        found = []
        for name, X_WC in setup.poses.items():
            X_CB = X_WC.inverse() @ X_WB
            if left[name] and _visible(board, X_CB, setup.told[name]):
                lens, distortion = setup.lenses[name]
                image = render_board(board, X_CB, lens, errors, rng, distortion=distortion)
                numbers, pixels = board.find(image)
                if len(numbers):
                    left[name] -= 1
                    file = f"{name}_{len(carriers):03d}.png"
                    corners = board.corners[numbers]
                    found.append(BoardSight(len(carriers), name, file, corners, pixels))
        if found:
            sights += found
            carriers.append(carrier)
        if not any(left.values()):
            break
    results = solve_cameras(sights, carriers, setup.told, in_gripper=mounting == "gripper")
    trials = []
    for name, result in results.items():
        X_WC = setup.poses[name]
        off = result.X_WC @ X_WC.inverse()
        trials.append(
            CalibrationTrial(
                mounting=mounting,
                setup=setup_seed,
                camera=name,
                images=result.images,
                translation=_length(result.X_WC.translation() - X_WC.translation()),
                rotation=float(abs(off.rotation().ToAngleAxis().angle())),
                work_area=_length(off @ _WORK_AREA - _WORK_AREA),
                held_out=result.translation,
                accepted=not result.problems,
            )
        )
    return trials


def _length(vector: np.ndarray) -> float:
    return float(np.linalg.norm(vector))


def calibration_table(trials: Sequence[CalibrationTrial]) -> str:
    """Median, 90th percentile and worst of each mounting, as text."""
    lines = [
        f"{'board':<9}{'cameras':>8}{'images':>8}  {'':<22}{'median':>8}{'90 %':>8}{'worst':>8}"
    ]
    for mounting in dict.fromkeys(trial.mounting for trial in trials):
        mine = [trial for trial in trials if trial.mounting == mounting]
        rows = {
            "camera's place, mm": [1000 * t.translation for t in mine],
            "orientation, deg": [np.degrees(t.rotation) for t in mine],
            "work area, mm": [1000 * t.work_area for t in mine],
            "held out, mm": [1000 * t.held_out for t in mine],
        }
        images = int(np.median([t.images for t in mine]))
        for k, (name, values) in enumerate(rows.items()):
            head = f"{mounting:<9}{len(mine):>8}{images:>8}  " if k == 0 else " " * 27
            numbers = (np.median(values), np.percentile(values, 90), np.max(values))
            lines.append(f"{head}{name:<22}" + "".join(f"{each:>8.3f}" for each in numbers))
        refused = sum(not t.accepted for t in mine)
        lines.append(f"{'':<27}refused by the limits: {refused} of {len(mine)}")
    return "\n".join(lines)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the command."""
    parser.add_argument("--count", type=int, default=20, help="set-ups of three cameras each")
    parser.add_argument("--seed", type=int, default=0, help="of the first set-up")
    parser.add_argument("--images", type=int, default=15, help="of the board, for each camera")
    parser.add_argument(
        "--mounting", choices=("gripper", "world", "both"), default="both",
        help="the board in the hand, or at known places",
    )  # fmt: skip
    for name, value in asdict(ImageErrors()).items():
        parser.add_argument(
            f"--{name.replace('_', '-')}", type=float, default=value,
            help="see ImageErrors in iga_drake/studies/calibration.py",
        )  # fmt: skip
    parser.add_argument("--png", type=output_file, help="write one of the rendered images")
    parser.add_argument("--json", action="store_true", help="print one JSON object")


def run(arguments: argparse.Namespace) -> int:
    """Prints the errors of the cameras' poses."""
    check_range(1 <= arguments.count <= 10_000, "--count", arguments.count, "1 to 10000")
    check_range(0 <= arguments.seed < 2**31, "--seed", arguments.seed, "0 to 2^31 - 1")
    check_range(4 <= arguments.images <= 1000, "--images", arguments.images, "4 to 1000")
    errors = ImageErrors(**{name: getattr(arguments, name) for name in asdict(ImageErrors())})
    mountings = ("gripper", "world") if arguments.mounting == "both" else (arguments.mounting,)
    trials = []
    if arguments.png is not None:
        _write_example(arguments.png, arguments.seed, errors)
    seeds = range(arguments.seed, arguments.seed + arguments.count)
    for mounting, k in progress([(m, k) for m in mountings for k in seeds], "set-ups"):
        trials += calibration_trials(k, mounting, images=arguments.images, errors=errors)
    if arguments.json:
        print(json.dumps([asdict(trial) for trial in trials], indent=2))
    else:
        print(calibration_table(trials))
    return 0


def _write_example(path: Path, setup_seed: int, errors: ImageErrors) -> None:
    rng = np.random.default_rng(setup_seed)
    board, setup = CharucoBoard(), _make_setup(rng, errors)
    for X_WB, _ in _in_gripper(rng, setup, board, errors):
        for name, X_WC in setup.poses.items():
            X_CB = X_WC.inverse() @ X_WB
            if _visible(board, X_CB, setup.told[name]):
                lens, distortion = setup.lenses[name]
                image = render_board(board, X_CB, lens, errors, rng, distortion=distortion)
                with replacing(path) as partial:
                    Image.fromarray(image).save(partial, "PNG")
                return
