"""RealSense cameras over LCM.

`software_device` is the library's own camera without hardware: frames put into it pass through the
library's syncer and alignment. Where pyrealsense2 isn't installed those tests are left out; what
the bridge does with frames is tested with a stand-in that has the library's methods.
"""

import itertools
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from drake import lcmt_image_array
from pydrake.lcm import DrakeLcm
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.lcm import LcmInterfaceSystem
from pydrake.systems.primitives import ConstantVectorSource

from iga_drake import cli
from iga_drake.drivers.arm import DriverError
from iga_drake.drivers.realsense import (
    CameraBridge,
    FrameReader,
    RealSenseSettings,
    check_link,
    rectification,
    rectify,
)
from iga_drake.errors import ConfigError
from iga_drake.station.cameras.rgbd import Intrinsics
from iga_drake.station.hardware.images import CHANNEL, ImageReceiver, decode_intrinsics
from iga_drake.station.lcm import add_subscriber

W, H = 64, 48
K = Intrinsics(W, H, fx=60.0, fy=61.0, cx=31.0, cy=23.0)
NOW = 1.7e9
RNG = np.random.default_rng(0)
COLOR = RNG.integers(0, 256, (H, W, 3)).astype(np.uint8)
RAW = RNG.integers(300, 3000, (H, W)).astype(np.uint16)
RAW[::7, ::5] = 0
# The library's alignment widens what is near by up to a pixel: blocks, looked at inside alone.
BLOCKS = np.kron(RNG.integers(3, 30, (H // 8, W // 8)), np.full((8, 8), 100)).astype(np.uint16)
BLOCKS[:8, :8] = 0
INSIDE = np.kron(np.ones((H // 8, W // 8)), np.pad(np.ones((4, 4)), 2)) > 0


class FakeFrame:
    """A frame with pyrealsense2's methods."""

    def __init__(self, pixels: np.ndarray, number: int, time: float, units: float = 0.001) -> None:
        self.pixels, self.number, self.time, self.units = pixels, number, time, units
        lens = SimpleNamespace(
            width=W, height=H, fx=K.fx, fy=K.fy, ppx=K.cx, ppy=K.cy, model="none", coeffs=[0.0] * 5
        )
        self.profile = SimpleNamespace(
            as_video_stream_profile=lambda: SimpleNamespace(intrinsics=lens)
        )

    def get_data(self) -> np.ndarray:
        return self.pixels

    def get_units(self) -> float:
        return self.units

    def get_timestamp(self) -> float:
        return 1e3 * self.time

    def get_frame_timestamp_domain(self) -> str:
        return "timestamp_domain.global_time"

    def get_frame_number(self) -> int:
        return self.number


class FakeSource:
    """Delivers what is in `queue`; None is a wait in vain."""

    def __init__(self) -> None:
        self.queue: list[Any] = []

    def put(
        self,
        number: int,
        *,
        color_number: int | None = None,
        late: float = 0.0,
        units: float = 1e-3,
    ) -> None:
        time = NOW + number / 30
        depth = FakeFrame(RAW, number, time, units)
        color = FakeFrame(COLOR, number if color_number is None else color_number, time + late)
        self.queue.append(
            SimpleNamespace(get_depth_frame=lambda: depth, get_color_frame=lambda: color)
        )

    def wait_for_frames(self, timeout_ms: int) -> Any:
        if not self.queue or self.queue[0] is None:
            self.queue[:1] = []
            raise RuntimeError(f"Frame didn't arrive within {timeout_ms}")
        return self.queue.pop(0)


ALIGNED = SimpleNamespace(process=lambda frames: frames)


class Sent:
    """A bridge, and what it publishes and says."""

    def __init__(self, source: Any, align: Any = ALIGNED, **settings: Any) -> None:
        self.lcm, self.said, self.messages = DrakeLcm("memq://"), [], []
        ticks = itertools.count()
        reader = FrameReader(source, align, clock=lambda: NOW + 100 + 0.01 * next(ticks))
        self.bridge = CameraBridge(
            "left", reader, self.lcm, settings=some(settings), log=self.said.append
        )
        self.lcm.Subscribe(
            f"{CHANNEL}left", lambda data: self.messages.append(lcmt_image_array.decode(data))
        )

    def step(self, count: int = 1) -> None:
        for _ in range(count):
            self.bridge.step()
        self.lcm.HandleSubscriptions(0)


def some(settings: dict) -> RealSenseSettings:
    return RealSenseSettings(**({"rate": 300.0, "patience": 0.05} | settings))


def received(data: lcmt_image_array) -> dict[str, Any]:
    """What the station's receiver makes of a message that came over a bus."""
    lcm = DrakeLcm("memq://")
    builder = DiagramBuilder()
    builder.AddSystem(LcmInterfaceSystem(lcm))
    receiver = builder.AddSystem(ImageReceiver("left", K))
    offset = builder.AddSystem(ConstantVectorSource([NOW]))
    builder.Connect(offset.get_output_port(), receiver.GetInputPort("clock_offset"))
    add_subscriber(
        builder, f"{CHANNEL}left", lcmt_image_array, lcm, receiver.GetInputPort("images")
    )
    simulator = Simulator(builder.Build())
    lcm.Publish(f"{CHANNEL}left", data.encode())
    simulator.AdvanceTo(0.01)
    context = receiver.GetMyContextFromRoot(simulator.get_context())
    images = {
        name: receiver.GetOutputPort(f"{name}_image").Eval(context).data.copy()
        for name in ("color", "depth")
    }
    return images | {"time": receiver.GetOutputPort("time").Eval(context)[0]}


def assert_same_images(
    message: lcmt_image_array, units: float, raw: np.ndarray = RAW, where: np.ndarray | None = None
) -> None:
    images = received(message)
    np.testing.assert_array_equal(images["color"][:, :, :3], COLOR)
    where = np.ones((H, W), dtype=bool) if where is None else where
    depth, raw = images["depth"][:, :, 0][where], raw[where]
    assert not (depth[raw == 0] > 0).any()  # 0 or NaN
    seen = depth > 0  # the library's alignment leaves single lines out
    assert seen.sum() > (0.95 if raw.size < RAW.size else 1 - 1e-9) * (raw > 0).sum()
    np.testing.assert_allclose(depth[seen], units * raw[seen], rtol=1e-6)


@pytest.mark.parametrize("units", [0.001, 0.0001])
def test_images_come_out_as_they_were_taken(units: float):
    source = FakeSource()
    source.put(30, units=units)
    sent = Sent(source)
    sent.step()
    (message,) = sent.messages
    assert_same_images(message, units)
    assert received(message)["time"] == pytest.approx(1.0, abs=1e-5)
    assert decode_intrinsics(message) == K
    assert message.header.seq == 30 and not sent.said


def test_what_the_scenario_calls_otherwise_is_refused():
    source = FakeSource()
    source.put(1)
    sent = Sent(source)
    sent.step()
    (message,) = sent.messages
    told = message.images[0].header.frame_name
    for image in message.images:
        image.header.frame_name = told.replace("60.0", "70.0")
    with pytest.raises(Exception, match=r"left: its images have intrinsics.fx 70, the scenario"):
        received(message)


def test_lost_and_repeated_frames_are_said_and_repeated_ones_not_sent():
    source = FakeSource()
    sent = Sent(source)
    for number in (1, 2, 5, 5, 6):
        source.put(number)
    source.put(7, color_number=6)
    source.put(8, late=0.02)
    sent.step(7)
    assert [message.header.seq for message in sent.messages] == [1, 2, 5, 6, 8]
    counts = sent.bridge.counts
    assert (counts["dropped"], counts["repeated"], counts["apart"]) == (2, 2, 1)
    assert "left: 2 images were lost" in sent.said[0] and "came again" in sent.said[1]
    for number in range(10, 400, 2):
        source.put(number)
        sent.step()
    assert counts["dropped"] == 197
    assert len([line for line in sent.said if "lost" in line]) < 9  # doublings, not each


def test_silence_is_said_once_and_its_end():
    source = FakeSource()
    source.queue = [None, None, None]
    source.put(1)
    sent = Sent(source)
    sent.step(4)
    assert len(sent.said) == 2 and len(sent.messages) == 1
    assert "no frame" in sent.said[0] and "come again" in sent.said[1]


def test_no_more_is_sent_than_asked_for():
    source = FakeSource()
    sent = Sent(source, rate=10.0)
    for number in range(1, 61):
        source.put(number)
        sent.step()
    assert 18 <= len(sent.messages) <= 21 and sent.bridge.counts["frames"] == 60


def test_usb2_is_refused_or_said():
    said: list[str] = []
    check_link("left", "3.2", allow_usb2=False, log=said.append)
    check_link("left", "", allow_usb2=False, log=said.append)  # not told: a network camera, say
    assert not said
    with pytest.raises(DriverError, match=r"left is on a USB 2.1 link.*--allow-usb2"):
        check_link("left", "2.1", allow_usb2=False)
    check_link("left", "2.1", allow_usb2=True, log=said.append)
    assert "USB 2.1" in said[0]


def test_settings_are_checked():
    with pytest.raises(ConfigError, match=r"fps: 0 is out of range"):
        some({"fps": 0}).check()


def test_the_command_refuses_what_it_can_not_do(capsys):
    for arguments, words in {
        (): "--camera NAME=SERIAL or --play",
        ("--camera", "left"): "NAME=VALUE",
        ("--camera", "a=1", "--camera", "b=1"): "two names for one camera",
        ("--camera", "a=1", "--play", "a=x.bag"): "each NAME once",
        ("--camera", "a=1", "--lcm-url", "memq://"): "udpm",
    }.items():
        assert cli.main(["drive", "realsense", *arguments]) == cli.BAD_INPUT
        assert words in capsys.readouterr().err


class Software:
    """The library's camera without hardware, depth and colour from one place."""

    def __init__(self, coeffs: list[float], units: float) -> None:
        self.rs = rs = pytest.importorskip("pyrealsense2")
        self.device = rs.software_device()
        self.sensors = self.device.add_sensor("Stereo"), self.device.add_sensor("Color")
        kinds = (rs.stream.depth, rs.format.z16, 2), (rs.stream.color, rs.format.rgb8, 3)
        self.units, self.profiles, self.bytes = units, [], (2, 3)
        for uid, (sensor, (kind, fmt, size)) in enumerate(zip(self.sensors, kinds, strict=True)):
            lens = rs.intrinsics()
            lens.width, lens.height, lens.fx, lens.fy = W, H, K.fx, K.fy
            lens.ppx, lens.ppy, lens.coeffs = K.cx, K.cy, coeffs
            lens.model = rs.distortion.inverse_brown_conrady
            stream = rs.video_stream()
            stream.type, stream.index, stream.uid, stream.fps = kind, 0, uid, 30
            stream.width, stream.height, stream.bpp, stream.fmt = W, H, size, fmt
            stream.intrinsics = lens
            self.profiles.append(sensor.add_video_stream(stream).as_video_stream_profile())
        self.sensors[0].add_read_only_option(rs.option.depth_units, units)
        straight = rs.extrinsics()
        straight.rotation, straight.translation = [1, 0, 0, 0, 1, 0, 0, 0, 1], [0, 0, 0]
        self.profiles[0].register_extrinsics_to(self.profiles[1], straight)
        self.device.create_matcher(rs.matchers.default)
        self.source = rs.syncer(20)  # frames that wait
        for sensor, profile in zip(self.sensors, self.profiles, strict=True):
            sensor.open(profile)
            sensor.start(self.source)

    def put(self, number: int) -> None:
        for sensor, profile, size, pixels in zip(
            self.sensors, self.profiles, self.bytes, (BLOCKS, COLOR), strict=True
        ):
            frame = self.rs.software_video_frame()
            frame.pixels, frame.stride, frame.bpp = pixels, W * size, size
            frame.timestamp, frame.frame_number, frame.profile = 1e3 * number / 30, number, profile
            frame.domain = self.rs.timestamp_domain.hardware_clock
            if size == 2:
                frame.depth_units = self.units
            sensor.on_video_frame(frame)

    def close(self) -> None:
        for sensor in self.sensors:
            sensor.stop()
            sensor.close()


@pytest.mark.parametrize("units", [0.001, 0.0001])
def test_frames_of_the_library_pass_through(units: float):
    camera = Software([0.0] * 5, units)
    sent = Sent(camera.source, camera.rs.align(camera.rs.stream.color), patience=0.3)
    try:
        for number in (1, 2, 3, 6):
            camera.put(number)
        while sent.bridge.step():
            pass
    finally:
        camera.close()
    sent.step()
    numbers = [message.header.seq for message in sent.messages]
    assert numbers[-1] == 6 and sent.bridge.counts["dropped"] == 2, numbers
    assert_same_images(sent.messages[-1], units, BLOCKS, INSIDE)
    # The camera's clock starts at 0: the time of arrival is told in its place.
    assert received(sent.messages[-1])["time"] == pytest.approx(100.0, abs=0.2)
    assert decode_intrinsics(sent.messages[-1]) == K


def test_a_lens_is_rectified():
    """A point of the world is found at its pinhole's pixel."""
    rs = pytest.importorskip("pyrealsense2")
    lens = rs.intrinsics()
    lens.width, lens.height, lens.fx, lens.fy, lens.ppx, lens.ppy = W, H, K.fx, K.fy, K.cx, K.cy
    lens.model, lens.coeffs = rs.distortion.inverse_brown_conrady, [0.0] * 5
    assert rectification(lens) is None
    lens.coeffs = [0.1, -0.05, 0.002, -0.001, 0.01]
    where = rectification(lens)
    assert where is not None
    for u, v in ((5, 7), (40, 30), (60, 45)):
        x, y, _ = rs.rs2_deproject_pixel_to_point(lens, list(where[::-1, v, u]), 1.0)
        np.testing.assert_allclose([x * K.fx + K.cx, y * K.fy + K.cy], [u, v], atol=0.02)
    # Brightness that is a plane in the lens' pixels comes out as the map's own coordinates.
    rows = np.repeat(np.arange(H, dtype=np.float32)[:, None], W, axis=1)
    inside = (where[0] > 0) & (where[0] < H - 1) & (where[1] > 0) & (where[1] < W - 1)
    np.testing.assert_allclose(rectify(rows, where, order=1)[inside], where[0][inside], atol=1e-3)
