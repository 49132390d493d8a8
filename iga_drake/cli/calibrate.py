"""`iga calibrate`: prints a board, collects images of it, solves for the cameras' poses, and checks
by the arm's own shape whether they still hold."""

import argparse
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING

from iga_drake.cli.scenarios import add_scenario_arguments, scenario_of
from iga_drake.cli.status import FAILURE, SUCCESS, CommandError
from iga_drake.cli.subcommands import Subcommand, add_subcommands, run_subcommand
from iga_drake.errors import IgaDrakeError, check_range
from iga_drake.files import output_file, output_folder

if TYPE_CHECKING:
    from iga_drake.drivers.calibration.board import CharucoBoard
    from iga_drake.station.cameras.rgbd import Pose

_HERE = "iga_drake.cli.calibrate"
SUBCOMMANDS = {
    "board": Subcommand(
        _HERE, "write a board to print", "add_board_arguments", "run_board"
    ),
    "collect": Subcommand(
        _HERE, "take images of the board, and the arm's joints", "add_collect_arguments",
        "run_collect",
    ),
    "solve": Subcommand(
        _HERE, "find the cameras' poses, and write their files", "add_solve_arguments", "run_solve"
    ),
    "check": Subcommand(
        _HERE, "does the arm appear where the calibration says?", "add_check_arguments", "run_check"
    ),
}  # fmt: skip
_URL = "udpm://239.255.76.67:7667?ttl=0&recv_buf_size=4194304"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the name of the step and takes its options unparsed."""
    add_subcommands(parser, SUBCOMMANDS)


def run(arguments: argparse.Namespace) -> int:
    """Runs the step."""
    return run_subcommand("calibrate", SUBCOMMANDS, arguments)


def _add_board_options(parser: argparse.ArgumentParser) -> None:
    from iga_drake.drivers.calibration.board import CharucoBoard

    helps = {
        "columns": "squares along the short side", "rows": "squares along the long side",
        "square": "side of a square as measured on the print (m)",
        "marker": "side of a marker (m)", "dictionary": "OpenCV's name of the markers",
    }  # fmt: skip
    for field in fields(CharucoBoard):
        parser.add_argument(
            f"--{field.name}", type=type(field.default), default=field.default,
            help=helps[field.name],
        )  # fmt: skip


def _board_of(arguments: argparse.Namespace) -> "CharucoBoard":
    from iga_drake.drivers.calibration.board import CharucoBoard

    board = CharucoBoard(**{f.name: getattr(arguments, f.name) for f in fields(CharucoBoard)})
    board.check("--")
    return board


def add_board_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `iga calibrate board`."""
    parser.add_argument("--out", type=output_file, default="board.pdf", help=".pdf or .png")
    _add_board_options(parser)


def run_board(arguments: argparse.Namespace) -> int:
    """Writes the board in its true size."""
    from iga_drake.drivers.calibration.board import write_board

    board = _board_of(arguments)
    print(write_board(arguments.out, board))
    return SUCCESS


def add_collect_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `iga calibrate collect`."""
    parser.add_argument(
        "--out", type=output_folder, required=True, help="folder; what is there is kept"
    )
    parser.add_argument("--cameras", required=True, help="names in the scenario, between commas")
    parser.add_argument("--lcm-url", default=_URL, help="bus of cameras and arm")
    parser.add_argument(
        "--board-at", metavar="X,Y,Z,ROLL,PITCH,YAW",
        help="the board lies there (X_WB, m and rad) rather than in the gripper; no arm is needed",
    )  # fmt: skip
    parser.add_argument("--wait", type=float, default=10.0, help="for arm and images (s)")
    _add_board_options(parser)


def run_collect(arguments: argparse.Namespace) -> int:
    """Takes a look at each press of Enter, until `q`."""
    from pydrake.lcm import DrakeLcm

    from iga_drake.cli.options import names
    from iga_drake.drivers.calibration.collect import CellWatcher, add_look, begin_measurements
    from iga_drake.drivers.calibration.measurements import Measurements

    url, folder = arguments.lcm_url, arguments.out
    check_range(url.startswith("udpm://"), "--lcm-url", url, "a udpm:// URL")
    check_range(0 < arguments.wait <= 3600, "--wait", arguments.wait, "above 0 to 3600")
    lying = _pose_of(arguments.board_at)
    mounting = "gripper" if lying is None else "world"
    measurements = begin_measurements(
        folder, Measurements(mounting=mounting, board=_board_of(arguments))
    )
    watcher = CellWatcher(DrakeLcm(url), names(arguments.cameras), arm=lying is None)
    print(
        f"{len(measurements.poses)} poses in {folder}. Move the arm by hand or let others move it; "
        "let go, then press Enter. 15 poses with the board in each camera are enough: all over the "
        "image, tilted by 20 to 40 degrees about several axes. q ends."
    )
    while True:
        try:
            if input("> ").strip().lower() in ("q", "quit", "exit"):
                break
        except EOFError:
            break
        try:
            counts = add_look(folder, measurements, watcher.look(arguments.wait), board=lying)
        except IgaDrakeError as error:
            print(error)
            continue
        seen = ", ".join(f"{name}: {count} corners" for name, count in counts.items())
        print(f"{len(measurements.poses)} poses; {seen}")
    total = {
        name: sum(name in pose.images for pose in measurements.poses)
        for name in measurements.cameras
    }
    print(f"images with the board: {total}; next: iga calibrate solve {folder}")
    return SUCCESS


def _pose_of(text: str | None) -> "Pose | None":
    from iga_drake.station.cameras.rgbd import Pose

    if text is None:
        return None
    try:
        numbers = [float(each) for each in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) != 6:
        raise CommandError(f"--board-at {text}: six numbers X,Y,Z,ROLL,PITCH,YAW are expected")
    return Pose(numbers[:3], numbers[3:])


def add_solve_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `iga calibrate solve`."""
    from iga_drake.drivers.calibration.solve import CalibrationLimits

    parser.add_argument("folder", type=Path, help="with measurements.yaml and its images")
    parser.add_argument(
        "--out", type=output_folder, default="calibration", help="folder for CAMERA.yaml"
    )
    helps = {
        "translation": "largest median error on held-out poses (m)",
        "rotation": "the same (rad)",
        "reprojection": "largest root mean square error (px)",
        "images": "fewest images with the board for each camera",
        "outliers": "largest share of a camera's images that may be left out",
        "uncertainty": "largest standard deviation of a camera's place (m)",
    }
    for field in fields(CalibrationLimits):
        parser.add_argument(
            f"--{field.name}", type=type(field.default), default=field.default,
            help=helps[field.name],
        )  # fmt: skip


def run_solve(arguments: argparse.Namespace) -> int:
    """Writes the file of every camera that meets the limits; 1 where one doesn't."""
    from iga_drake.drivers.calibration.measurements import (
        as_pose,
        carrier_poses,
        find_boards,
        read_measurements,
    )
    from iga_drake.drivers.calibration.solve import CalibrationLimits, solve_cameras
    from iga_drake.station.hardware.calibration import CameraCalibration, write_calibration

    limits = CalibrationLimits(
        **{field.name: getattr(arguments, field.name) for field in fields(CalibrationLimits)}
    )
    limits.check("--")
    measurements = read_measurements(arguments.folder)
    sights, without = find_boards(arguments.folder, measurements)
    for name in without:
        print(f"{name}: no board found")
    results = solve_cameras(
        sights,
        carrier_poses(measurements),
        measurements.cameras,
        in_gripper=measurements.mounting == "gripper",
        limits=limits,
    )
    refused = False
    for name, result in results.items():
        print(f"{name}: {result.lines()}")
        if result.problems:
            refused = True
            print("\n".join(f"refused: {problem}" for problem in result.problems))
            continue
        path = arguments.out / f"{name}.yaml"
        calibration = CameraCalibration(
            date=measurements.date,
            pose=as_pose(result.X_WC),
            intrinsics=measurements.cameras[name],
        )
        write_calibration(path, calibration, about=f"iga calibrate solve: {result.lines()}")
        print(f"{name}: {path}")
    return FAILURE if refused else SUCCESS


def add_check_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `iga calibrate check`."""
    from iga_drake.drivers.calibration.arm_shape import ArmShapeLimits

    limits = ArmShapeLimits()
    add_scenario_arguments(parser)
    parser.add_argument(
        "--calibration", type=Path, help="folder of CAMERA.yaml (default: the scenario's)"
    )
    parser.add_argument(
        "--displacement", type=float, default=limits.displacement,
        help="a camera in which the arm appears off by more (m) has moved",
    )  # fmt: skip
    parser.add_argument(
        "--met", type=float, default=limits.met,
        help="least share of the arm's visible points that have to be seen",
    )  # fmt: skip
    parser.add_argument(
        "--shape", choices=("meshes", "primitives"),
        help="the arm's shape to go by (default: meshes where the extra visuals is installed)",
    )  # fmt: skip
    parser.add_argument("--wait", type=float, default=10.0, help="for arm and images (s)")


def run_check(arguments: argparse.Namespace) -> int:
    """Says of every camera of the scenario whether it stands where its file says; 1 where one
    doesn't."""
    from pydrake.lcm import DrakeLcm

    from iga_drake.drivers.calibration.arm_shape import ArmShape, ArmShapeLimits, camera_offset
    from iga_drake.drivers.calibration.collect import CellWatcher
    from iga_drake.station.hardware.calibration import read_calibration

    scenario = scenario_of(arguments)
    limits = ArmShapeLimits(arguments.displacement, arguments.met)
    limits.check("--")
    buses = {scenario.hardware.camera_bus, scenario.model_drivers["panda"].lcm_bus}
    if len(buses) > 1:
        raise CommandError(f"cameras and arm are on different buses: {', '.join(sorted(buses))}")
    (bus,) = buses
    url = scenario.lcm_buses[bus].lcm_url or _URL
    check_range(url.startswith("udpm://"), f"lcm_buses.{bus}.lcm_url", url, "a udpm:// URL: "
                "lay hardware.yaml over the scenario (--with hardware)")  # fmt: skip
    folder = arguments.calibration or Path(scenario.hardware.calibration)
    calibrations = {
        name: read_calibration(
            folder / f"{name}.yaml",
            intrinsics=scenario.cameras[name].intrinsics,
            age=scenario.hardware.calibration_age,
        )
        for name in scenario.cameras
    }
    arm = ArmShape(arguments.shape)
    look = CellWatcher(DrakeLcm(url), list(scenario.cameras)).look(arguments.wait)
    bad = False
    for name, calibration in calibrations.items():
        offset = camera_offset(
            look.cameras[name].depth, arm=arm, position=look.joints, opening=look.opening,
            X_WC=calibration.X_WC, intrinsics=calibration.intrinsics,
        )  # fmt: skip
        problem = offset.problem(limits)
        bad |= bool(problem)
        good = f"holds: the arm appears {1000 * offset.displacement:.1f} mm off"
        print(f"{name}: {problem or good} (shape: {arm.visuals})")
    return FAILURE if bad else SUCCESS
