"""A rehearsal in real time: the arm's program on one side of LCM, a simulated cell on the other.

The cell is several processes, as the real one is several machines: the arm with whatever lies
before it, the cameras, and a monitor that notes when commands pass; where the arm speaks the
robot's own protocol, its servers and `iga drive panda`'s driver besides. Their clock is this
machine's, or, at a rate below 1, one that runs slower by that rate, so that a machine that is too
slow for the real pace can rehearse everything else: all limits are in seconds of that clock.
"""

import contextlib
import datetime
import itertools
import multiprocessing
import os
import signal
import sys
import tempfile
import threading
import time as wall
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any, cast

import numpy as np
from drake import lcmt_drake_signal, lcmt_panda_command
from pydrake.lcm import DrakeLcm, DrakeLcmParams
from pydrake.math import RollPitchYaw
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, DiagramBuilder
from pydrake.systems.lcm import LcmBuses, LcmInterfaceSystem

from iga_drake.aligners.registry import EXPERT, ORACLE
from iga_drake.drivers.franka_rs import FrankaRsArm, FrankaRsHand, connect_franka
from iga_drake.drivers.panda import DriverLimits, HandBridge, PandaBridge
from iga_drake.errors import IgaDrakeError, error_text
from iga_drake.policy.inference import Inference
from iga_drake.policy.motion import Phase
from iga_drake.station.cameras.rgbd import Pose
from iga_drake.station.hardware.boot import boot_panda
from iga_drake.station.hardware.calibration import CameraCalibration, write_calibration
from iga_drake.station.hardware.images import CHANNEL, encode_images
from iga_drake.station.hardware.station import build_hardware_station
from iga_drake.station.lcm import check_receive_buffer, decoded, udp_url, utime_of
from iga_drake.station.log.writer import EpisodeLogWriter
from iga_drake.station.panda import messages
from iga_drake.station.panda.driver import connect_server
from iga_drake.station.panda.fci import FciArm, FciHand, loopback_address
from iga_drake.station.panda.fci_port import FciPort, SharedFciPlant
from iga_drake.station.panda.messages import ControlMode
from iga_drake.station.panda.model import find_panda
from iga_drake.station.panda.server import PandaServer, add_panda_server
from iga_drake.station.scenario import Scenario, load_scenario
from iga_drake.station.simulated.scene import Scene
from iga_drake.station.simulated.station import build_simulation_station
from iga_drake.systems.messages import Cause
from iga_drake.tasks.arm_episode import ArmEpisode, ArmResult
from iga_drake.tasks.distractors import with_distractors
from iga_drake.tasks.episode import (
    AFTER_DONE,
    SNAPSHOT_PERIOD,
    TEST_SEED_OFFSET,
    ExpertInference,
    LogRequest,
)
from iga_drake.tasks.registry import scenario_task
from iga_drake.tasks.snapshots import Snapshot, read_snapshot
from iga_drake.tasks.task import Split

STATE_CHANNEL = "REHEARSAL_STATE"  # the simulated plant's positions, for the cameras alone
_STATE_PERIOD = 1.0 / 30.0  # s
_SLICE = 0.01  # s between two looks at what the cell is asked for
_START_LIMIT = 300.0  # s (wall clock) for the cell's processes to be built
_ANSWER_LIMIT = 60.0  # s (wall clock)
# Share of the arm's limits at which the driver's library follows: above those of the commands.
_DRIVER_SPEED = 0.9
# That library accelerates the arm so that it could stop at every target, and follows late by half
# the time that it takes for it: s after which the arm has to be near what was sent, and rad by
# which it may be behind the present command.
_DRIVER_FOLLOWS, _DRIVER_BEHIND = 0.15, 0.1
_NICENESS = 10  # of the cameras: the arm comes first


class RehearsalError(IgaDrakeError):
    """The rehearsed cell can't be built, or one of its processes has ended."""


@dataclass(frozen=True)
class RehearsalClock:
    """A clock (s since 1970) that runs at `rate` from `epoch` on."""

    epoch: float
    rate: float

    def now(self) -> float:
        """What it shows."""
        return self.epoch + self.rate * (wall.time() - self.epoch)

    def __call__(self, context: Context) -> float:
        """What it shows, as the systems of a diagram ask for it."""
        return self.now()


@dataclass(frozen=True)
class CellRequest:
    """What the cell's processes are built from."""

    scenario: str  # YAML
    seed: int
    split: Split
    url: str
    clock: RehearsalClock
    # Where the arm speaks the robot's own protocol, with a driver's process before it; empty: it
    # speaks LCM itself.
    robot_address: str = ""

    def read(self) -> Scenario:
        """The scenario, for the simulated station."""
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "scenario.yaml"
            file.write_text(self.scenario, encoding="utf-8")
            scenario = load_scenario(file)
        buses = {"default": DrakeLcmParams(lcm_url=LcmBuses.kLcmUrlMemqNull)}
        driver = replace(scenario.model_drivers["panda"], lcm_bus="default")
        return replace(
            scenario,
            lcm_buses=buses,
            model_drivers={"panda": driver},
            hardware=replace(scenario.hardware, camera_bus="default"),
        )


@dataclass(frozen=True)
class Timing:
    """How commands reached the arm; triples are median, 99th percentile and most, in milliseconds
    of the wall clock."""

    count: int
    # From the first to the last, in seconds of the rehearsal's clock.
    seconds: float
    # Difference of the time between two commands from the control period: of all, and of those that
    # came while an aligner was at work.
    jitter: tuple[float, float, float]
    jitter_inferring: tuple[float, float, float]
    # From a command's stamp to its arrival.
    latency: tuple[float, float, float]
    # How often a driver's watchdog would have run out, no command for `expiry` or one that was
    # older than that when it came: in all, and while commands changed.
    missed: int
    missed_moving: int

    def row(self) -> dict[str, Any]:
        """The timing as plain JSON values."""
        return {
            "commands": self.count,
            "command_seconds": self.seconds,
            "jitter_ms": list(self.jitter),
            "jitter_inferring_ms": list(self.jitter_inferring),
            "latency_ms": list(self.latency),
            "missed": self.missed,
            "missed_moving": self.missed_moving,
        }

    def __str__(self) -> str:
        def words(values: tuple[float, float, float]) -> str:
            return " / ".join(f"{value:.2f}" for value in values)

        return (
            f"{self.count} commands in {self.seconds:.1f} s; median / 99 % / most: jitter "
            f"{words(self.jitter)} ms, while an aligner is at work "
            f"{words(self.jitter_inferring)} ms, latency {words(self.latency)} ms; watchdog missed "
            f"{self.missed} times, {self.missed_moving} of them while commands changed"
        )


def timing_of(
    arrivals: np.ndarray,
    stamps: np.ndarray,
    *,
    clock: RehearsalClock,
    period: float,
    expiry: float,
    changes: np.ndarray | None = None,
    inferring: Sequence[tuple[float, float]] = (),
) -> Timing:
    """The timing of commands that arrived at `arrivals` (K,) and were stamped `stamps` (K,), both
    s on the clock, as are the beginnings and ends of `inferring`, when an aligner was at work.

    `period` and `expiry` (s): commands are sent each period without a pause, and the driver waits
    for the next no longer than its expiry. `changes` (K,): which commands differ from the one
    before; None: all.
    """
    nothing = (0.0, 0.0, 0.0)
    if len(arrivals) < 2:
        return Timing(len(arrivals), 0.0, nothing, nothing, nothing, 0, 0)
    gaps, late = np.diff(arrivals), arrivals - stamps
    beside = np.zeros(len(gaps), bool)
    for begin, end in inferring:
        beside |= (arrivals[1:] >= begin) & (arrivals[1:] <= end)
    scale = 1000.0 / clock.rate
    jitter = scale * np.abs(gaps - period)
    changes = np.ones(len(arrivals), bool) if changes is None else changes.astype(bool)
    # A gap lies in a motion where the command before it or that after it differs.
    moving = changes | np.append(changes[1:], False)
    silent, old = np.flatnonzero(gaps > expiry), np.flatnonzero(np.abs(late) > expiry)
    in_motion = (changes[silent] | changes[silent + 1]).sum() + moving[old].sum()
    return Timing(
        count=len(arrivals),
        seconds=float(arrivals[-1] - arrivals[0]),
        jitter=_quantiles(jitter),
        jitter_inferring=_quantiles(jitter[beside]) if beside.any() else nothing,
        latency=_quantiles(scale * late),
        missed=len(silent) + len(old),
        missed_moving=int(in_motion),
    )


def _quantiles(values: np.ndarray) -> tuple[float, float, float]:
    median, most_of_all, most = np.quantile(values, [0.5, 0.99, 1.0])
    return float(median), float(most_of_all), float(most)


# The cell's processes


def _scene_of(request: CellRequest, scenario: Scenario) -> Any:
    seed = request.seed + scenario.seeds.scene
    task = scenario_task(scenario)
    return with_distractors(task.scene(seed, request.split), scenario.distractors, seed)


def _cell(request: CellRequest, scenario: Scenario, scene: Any) -> Any:
    draws = request.seed + (TEST_SEED_OFFSET if request.split == "test" else 0)
    cell = build_simulation_station(scenario, scene=scene, seed=draws)
    cell.set_name("simulated")
    return cell


def run_arm(
    connection: Connection, request: CellRequest, robot: SharedFciPlant | None = None
) -> None:
    """The process of the arm: physics and the arm's server, until the pipe is closed. With `robot`
    its server is another process.

    It answers through the pipe: "expert" with the expert's present poses, "state" with the present
    snapshot, "snapshots" with all.
    """
    _begin_process()
    with _told(connection):
        scenario = request.read()
        scene, task = _scene_of(request, scenario), scenario_task(scenario)
        driver = scenario.model_drivers["panda"]
        lcm, clock = DrakeLcm(request.url), request.clock
        builder = DiagramBuilder()
        cell = builder.AddSystem(_cell(request, scenario, scene))
        builder.AddSystem(LcmInterfaceSystem(lcm))
        server: PandaServer | FciPort
        if robot is None:
            server = PandaServer(
                lcm,
                control_mode=cast(ControlMode, driver.control_mode),
                expiry=driver.expiry,
                opening=_first_opening(scene),
                clock=clock,
            )
            add_panda_server(builder, server, lcm)
        else:
            server = builder.AddSystem(FciPort(robot))
        ports = {
            port.get_name(): port
            for port in (
                *(cell.get_input_port(i) for i in range(cell.num_input_ports())),
                *(cell.get_output_port(i) for i in range(cell.num_output_ports())),
            )
        }
        connect_server(builder, server, ports)
        simulator = Simulator(builder.Build())
        simulator.set_target_realtime_rate(clock.rate)
        simulator.Initialize()
        plant = cell.GetSubsystemByName("plant")
        context = plant.GetMyContextFromRoot(simulator.get_context())
        panda = find_panda(plant)

        def snapshot() -> Snapshot:
            return read_snapshot(plant, context, panda)

        sender = DrakeLcm(request.url)
        snapshots, published = [snapshot()], -np.inf
        connection.send(("ready", None))
        simulator.ResetStatistics()
        while True:
            now = simulator.get_context().get_time()
            simulator.AdvanceTo(now + _SLICE)
            now = simulator.get_context().get_time()
            if now >= SNAPSHOT_PERIOD * len(snapshots) - 1e-9:
                snapshots.append(snapshot())
            if now - published >= _STATE_PERIOD:
                published = now
                _publish_state(sender, plant.GetPositions(context), clock.now())
            while connection.poll():
                asked = connection.recv()
                if asked == "expert":
                    seen = snapshot()
                    poses = task.expert(scene, seen.X_WO, seen.X_WE)
                    connection.send(("ready", [X.GetAsMatrix4() for X in poses]))
                elif asked == "state":
                    connection.send(("ready", snapshot()))
                else:
                    connection.send(("ready", snapshots))


def _first_opening(scene: Scene) -> float:
    """What the hand was told before the first command (m): what it holds was grasped before."""
    return 0.0 if scene.truth.X_EO else scene.hand_opening


def run_robot(connection: Connection, request: CellRequest, plant: SharedFciPlant) -> None:
    """The process of the robot's own servers, arm and hand, until the pipe is closed."""
    _begin_process()
    with _told(connection):
        arm = FciArm(plant, address=request.robot_address, rate=request.clock.rate)
        hand = FciHand(plant, address=request.robot_address, rate=request.clock.rate)
        connection.send(("ready", None))
        try:
            while not connection.poll(1.0):
                pass
        finally:
            arm.close()
            hand.close()


def _log_driver(text: str) -> None:
    print(f"the arm's driver: {text}", file=sys.stderr, flush=True)


def run_driver(connection: Connection, request: CellRequest) -> None:
    """The process of the arm's driver, as `iga drive panda` is one, until the pipe is closed."""
    _begin_process()
    os.environ["FRANKA_REALTIME"] = "ignore"  # no kernel of a rehearsal is a real-time one
    with _told(connection):
        clock, rate = request.clock.now, request.clock.rate
        robot = connect_franka(request.robot_address)
        arm = FrankaRsArm(robot, speed=_DRIVER_SPEED)
        hand = HandBridge(
            FrankaRsHand(robot, home=False), DrakeLcm(request.url), clock=clock, log=_log_driver
        )
        # The simulated arm's controller follows less closely than the real one's.
        limits = DriverLimits(tracking=_DRIVER_BEHIND)
        bridge = PandaBridge(
            arm, DrakeLcm(request.url), limits=limits, clock=clock, log=_log_driver
        )
        arm.start()
        ended = threading.Event()

        def drive_hand() -> None:
            try:
                while not ended.is_set():
                    hand.step(round(100 / rate))
            except IgaDrakeError as error:
                print(f"the rehearsed hand: {error_text(error)}", file=sys.stderr, flush=True)

        beside = threading.Thread(target=drive_hand, daemon=True)
        beside.start()
        connection.send(("ready", None))
        try:
            while not connection.poll():
                bridge.step(round(2 / rate))
        finally:
            ended.set()
            bridge.stop()


def _publish_state(lcm: DrakeLcm, q: np.ndarray, now: float) -> None:
    message = lcmt_drake_signal()
    message.dim, message.val = len(q), [float(value) for value in q]
    message.coord = [""] * len(q)
    message.timestamp = utime_of(now)
    lcm.Publish(STATE_CHANNEL, message.encode())


def run_cameras(connection: Connection, request: CellRequest, period: float) -> None:
    """The process of the cameras: each sends its images every `period` (s) at most, of the last
    state that the arm's process has told, until the pipe is closed."""
    _begin_process(niceness=_NICENESS)
    with _told(connection):
        scenario = request.read()
        cell = _cell(request, scenario, _scene_of(request, scenario))
        context = cell.CreateDefaultContext()
        plant = cell.GetSubsystemByName("plant")
        plant_context = plant.GetMyMutableContextFromRoot(context)
        poses = {
            name: cell.GetOutputPort(f"{name}.pose").Eval(context).GetAsMatrix4()
            for name in scenario.cameras
        }
        kinds = ("color", "depth", "label")
        for name in scenario.cameras:  # the first image of each takes seconds
            for kind in kinds:
                cell.GetOutputPort(f"{name}.{kind}_image").Eval(context)
        connection.send(("ready", poses))
        lcm, last = DrakeLcm(request.url), lcmt_drake_signal()
        states: list[lcmt_drake_signal] = []

        def receive(data: bytes) -> None:
            message = decoded(lcmt_drake_signal, data)
            if message is not None:
                states[:] = [message]

        lcm.Subscribe(STATE_CHANNEL, receive)
        clock, due = request.clock, dict.fromkeys(scenario.cameras, 0.0)
        begin = clock.now()
        while not connection.poll():
            for name in scenario.cameras:
                lcm.HandleSubscriptions(20)
                while lcm.HandleSubscriptions(0):
                    pass
                if not states or clock.now() < due[name]:
                    continue
                last = states[0]
                due[name] = clock.now() + period
                context.SetTime(max(1e-6 * last.timestamp - begin, 0.0))
                plant.SetPositions(plant_context, np.array(last.val))
                images = {
                    kind: cell.GetOutputPort(f"{name}.{kind}_image").Eval(context).data
                    for kind in kinds
                }
                message = encode_images(images, utime=last.timestamp)
                lcm.Publish(f"{CHANNEL}{name}", message.encode())


def run_monitor(connection: Connection, url: str, clock: RehearsalClock) -> None:
    """The process that notes when commands arrive, what they are stamped with (s on the clock) and
    whether they differ from the one before, and tells it when it is asked."""
    _begin_process()
    with _told(connection):
        lcm = DrakeLcm(url)
        noted: list[tuple[float, float, bool]] = []
        last: list[tuple[Any, Any]] = []

        def receive(data: bytes) -> None:
            now = clock.now()
            message = decoded(lcmt_panda_command, data)
            if message is not None:
                values = message.joint_position, message.joint_velocity
                noted.append((now, 1e-6 * message.utime, last != [values]))
                last[:] = [values]

        lcm.Subscribe(messages.COMMAND_CHANNEL, receive)
        connection.send(("ready", None))
        while True:
            lcm.HandleSubscriptions(20)
            if connection.poll():
                connection.recv()
                connection.send(("ready", np.array(noted, float).reshape(-1, 3)))


def _begin_process(niceness: int = 0) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # who rehearses is interrupted, and ends these
    with contextlib.suppress(OSError):
        os.nice(niceness)


@contextlib.contextmanager
def _told(connection: Connection) -> Iterator[None]:
    """Ends quietly where nobody listens any more, and tells of any other error."""
    try:
        yield
    except (EOFError, BrokenPipeError, ConnectionResetError):
        return
    except BaseException as error:
        with contextlib.suppress(OSError):
            connection.send(("failed", error_text(error)))


# The side of the arm's program


class RehearsedCell:
    """The cell's processes, and what may be asked of them. Use it as a context manager."""

    def __init__(self, request: CellRequest, *, image_period: float) -> None:
        """Starts the processes and waits until all are built. Raises `RehearsalError`."""
        self._context = multiprocessing.get_context("spawn")
        self._processes: dict[str, BaseProcess] = {}
        self._connections: dict[str, Connection] = {}
        plant: SharedFciPlant | None = None
        if request.robot_address:
            scene = _scene_of(request, request.read())
            plant = SharedFciPlant(
                self._context, position=scene.panda_position, opening=_first_opening(scene)
            )
        try:
            self._start("arm", run_arm, request, plant)
            self._start("cameras", run_cameras, request, image_period)
            self._start("monitor", run_monitor, request.url, request.clock)
            self._receive("arm", _START_LIMIT)
            # Camera -> X_WC (4, 4) as a calibration would have found it, error included.
            self.poses: Mapping[str, np.ndarray] = self._receive("cameras", _START_LIMIT)
            self._receive("monitor", _START_LIMIT)
            if plant is not None:
                self._start("robot", run_robot, request, plant)
                self._receive("robot", _START_LIMIT)
                self._start("driver", run_driver, request)
                self._receive("driver", _START_LIMIT)
        except BaseException:
            self.close()
            raise

    def _start(self, name: str, target: Callable[..., None], *arguments: Any) -> None:
        mine, theirs = self._context.Pipe()
        process = self._context.Process(
            target=target, args=(theirs, *arguments), name=f"rehearsed {name}", daemon=True
        )
        process.start()
        theirs.close()
        self._processes[name], self._connections[name] = process, mine

    def _receive(self, name: str, limit: float) -> Any:
        connection = self._connections[name]
        try:
            if not connection.poll(limit):
                raise RehearsalError(f"the rehearsed {name} doesn't answer within {limit:g} s")
            kind, value = connection.recv()
        except (EOFError, OSError) as error:
            code = self._processes[name].exitcode
            raise RehearsalError(
                f"the process of the rehearsed {name} has ended ({code})"
            ) from error
        if kind == "failed":
            raise RehearsalError(f"the rehearsed {name}: {value}")
        return value

    def ask(self, name: str, question: str) -> Any:
        """The answer of one process. Raises `RehearsalError` where there is none."""
        try:
            self._connections[name].send(question)
        except OSError as error:
            raise RehearsalError(f"the process of the rehearsed {name} has ended") from error
        return self._receive(name, _ANSWER_LIMIT)

    def close(self) -> None:
        """Ends the processes, the driver's first, which lets go of the arm."""
        for name in reversed(self._processes):
            self._connections[name].close()
            process = self._processes[name]
            process.join(2.0)
            if process.is_alive():
                process.kill()
                process.join()

    def __enter__(self) -> "RehearsedCell":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def poses_of(scene: Scene, snapshot: Snapshot) -> dict[str, np.ndarray]:
    """Poses X_WO (4, 4) by name of the objects that are grasped or a target: of no marbles, nor of
    what else lies around."""
    return {
        name: X.GetAsMatrix4()
        for name, X in snapshot.X_WO.items()
        if any(item.name == name and item.role != "other" for item in scene.objects)
    }


@dataclass(frozen=True)
class RehearsalResult:
    """The verdict on the true state, and how commands travelled."""

    result: ArmResult
    measures: Mapping[str, float]
    timing: Timing
    rate: float
    # True poses (4, 4) at the end of the objects with a role, and of the end effector.
    X_WO: Mapping[str, np.ndarray]
    X_WE: np.ndarray

    def row(self) -> dict[str, Any]:
        """The result as plain JSON values."""
        return {
            **self.result.row(),
            "measures": {name: float(value) for name, value in self.measures.items()},
            "rate": self.rate,
            **self.timing.row(),
            "X_WO": {name: X.tolist() for name, X in self.X_WO.items()},
            "X_WE": self.X_WE.tolist(),
        }

    def __str__(self) -> str:
        return f"{self.result}\n  {self.timing} (rate {self.rate:g})"


def rehearse(
    scenario: Scenario,
    *,
    seed: int = 0,
    split: Split = "test",
    rate: float = 1.0,
    image_period: float = 0.25,
    record: LogRequest | None = None,
    on_event: Callable[[str], None] | None = None,
    proceed: Callable[[], bool] | None = None,
    on_log: Callable[[EpisodeLogWriter], None] | None = None,
    driver: bool = False,
) -> RehearsalResult:
    """Runs one episode on a cell of processes, through LCM, at `rate`.

    Boot checks, calibration files, hardware station, supervisor, policy and aligner are those of
    the real arm. The aligner may be "expert". `on_event` and `proceed` are `ArmEpisode.run`'s,
    `on_log` is called with the log once it is whole. With `driver` the arm speaks the robot's own
    protocol, and a driver's process, with the library of a real arm, is between it and LCM.

    Raises `RehearsalError`, and what `ArmEpisode` raises.
    """
    from pydrake.math import RigidTransform

    task = scenario_task(scenario)
    if scenario.aligner.name == ORACLE:
        raise RehearsalError("the oracle knows the clouds' true shapes, not those behind LCM")
    url = udp_url(20_000 + os.getpid() % 20_000)
    check_receive_buffer(url)
    clock = RehearsalClock(wall.time(), rate)
    scenario = replace(scenario, lcm_buses={"default": DrakeLcmParams(lcm_url=url)})
    panda = replace(scenario.model_drivers["panda"], lcm_bus="default")
    if driver and panda.control_mode != "position":
        raise RehearsalError(
            f"control mode {panda.control_mode}: this package's driver is for position"
        )
    if driver:
        panda = replace(panda, following_time=max(panda.following_time, _DRIVER_FOLLOWS))
        least = max(scenario.supervisor.tracking_error, _DRIVER_BEHIND)
        scenario = replace(scenario, supervisor=replace(scenario.supervisor, tracking_error=least))
    address = loopback_address() if driver else ""
    request = CellRequest(scenario.to_yaml(), seed, split, url, clock, address)
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        cell = stack.enter_context(RehearsedCell(request, image_period=image_period))
        for name, X in cell.poses.items():
            X_WC = RigidTransform(X)
            pose = Pose(
                [float(v) for v in X_WC.translation()],
                [float(v) for v in RollPitchYaw(X_WC.rotation()).vector()],
            )
            date = datetime.datetime.now(datetime.UTC).isoformat()
            write_calibration(
                folder / f"{name}.yaml",
                CameraCalibration(date, pose, scenario.cameras[name].intrinsics),
            )
        scenario = replace(
            scenario,
            station="hardware",
            model_drivers={"panda": panda},
            hardware=replace(scenario.hardware, camera_bus="default", calibration=str(folder)),
        )
        start = boot_panda(
            DrakeLcm(url), panda, limit=scenario.hardware.boot_limit / rate, clock=clock.now
        )
        inference: Inference | None = None
        if scenario.aligner.name == EXPERT:
            inference = ExpertInference(
                lambda: tuple(RigidTransform(X) for X in cell.ask("arm", "expert"))
            )
        with ArmEpisode(
            scenario,
            seed=seed,
            station=build_hardware_station(scenario, start=start, clock=clock),
            inference=inference,
            rate=rate,
            record=record,
        ) as episode:
            result = episode.run(on_event, proceed=proceed, after_done=AFTER_DONE)
            begin = clock.now() - episode.time
            snapshots = cell.ask("arm", "snapshots")
            scene = with_distractors(
                task.scene(seed + scenario.seeds.scene, split),
                scenario.distractors,
                seed + scenario.seeds.scene,
            )
            measures: Mapping[str, float] = {}
            if result.finished:
                verdict = task.success(scene, snapshots)
                measures = dict(verdict.measures)
                cause = None if verdict.success else Cause.CONTACT
                result = replace(
                    result, success=verdict.success, reason=verdict.reason, cause=cause
                )
            episode.note(result)
        if on_log and episode.log:
            on_log(episode.log)
        noted = cell.ask("monitor", "commands")
    inferring = [
        (begin + entry.time, begin + after.time)
        for entry, after in itertools.pairwise(result.timeline)
        if entry.phase is Phase.INFER
    ]
    timing = timing_of(
        noted[:, 0],
        noted[:, 1],
        clock=clock,
        period=scenario.control.period,
        expiry=panda.expiry,
        changes=noted[:, 2],
        inferring=inferring,
    )
    return RehearsalResult(
        result=result,
        measures=measures,
        timing=timing,
        rate=rate,
        X_WO=poses_of(scene, snapshots[-1]),
        X_WE=snapshots[-1].X_WE.GetAsMatrix4(),
    )
