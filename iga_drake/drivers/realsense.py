"""RealSense cameras: aligned depth and colour, with intrinsics, over LCM.

`open_realsense` and `play_realsense` start a camera or a recording through `pyrealsense2`, which is
imported only there; `CameraBridge` publishes what it delivers.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from pydrake.lcm import DrakeLcm
from scipy.ndimage import map_coordinates

from iga_drake.drivers.arm import DriverError
from iga_drake.errors import check_bounds, error_text, missing_extra
from iga_drake.station.cameras.rgbd import Intrinsics
from iga_drake.station.hardware.images import CHANNEL, encode_images
from iga_drake.station.lcm import utime_of

_APART = 0.3  # of the time between two images, between depth and colour
_USB3 = "3"
_ROUNDS = 8  # of the fixed-point iteration that inverts a lens


class FrameSource(Protocol):
    """What delivers frames that belong together: a RealSense pipeline or a syncer."""

    def wait_for_frames(self, timeout_ms: int) -> Any:
        """The next frames; raises `RuntimeError` where none comes in time."""
        ...


@dataclass
class RealSenseSettings:
    """The streams that are asked for, and what is passed on of them."""

    # Size of depth and colour (px); what the camera has is listed where it lacks this.
    width: int = 640
    height: int = 480
    # Images that the camera takes in a second.
    fps: int = 30
    # Messages that are sent in a second at most; the station needs one every 0.5 s.
    rate: float = 10.0
    # How long to wait for a frame (s).
    patience: float = 2.0

    def check(self, where: str = "RealSenseSettings") -> None:
        """Raises `ConfigError` for a value out of range."""
        bounds = {"width": (64, 4096), "height": (64, 4096), "fps": (1, 300)}
        check_bounds(self, where, bounds | {"rate": (0.1, 300.0), "patience": (0.01, 60.0)})


@dataclass(frozen=True)
class CameraFrame:
    """Depth and colour of one moment, as one pinhole without distortion sees them."""

    color: np.ndarray  # (H, W, 3) uint8, RGB
    depth: np.ndarray  # (H, W) m, float32; 0 where nothing was measured
    intrinsics: Intrinsics
    number: int  # the depth image's, counted by the camera
    color_number: int
    time: float  # when it was taken (s since 1970)
    spread: float  # s, between the colour and the depth image


@dataclass(frozen=True)
class RealSenseCamera:
    """A camera that delivers, with what to call when it is no longer needed."""

    name: str
    source: FrameSource
    align: Any  # `rs.align` to colour
    stop: Callable[[], None]
    about: str  # model, serial number, link
    # Whether the frames' own stamps are of another day: those of a recording.
    played: bool = False


class FrameReader:
    """Turns the library's frames into `CameraFrame`s.

    Args:
      source: of the frames.
      align: has `process(frames)`, which lays the depth onto the colour image.
      restamp: take the time of arrival for the time at which frames were taken.
      clock: this machine's (s since 1970).
    """

    def __init__(
        self,
        source: FrameSource,
        align: Any,
        *,
        restamp: bool = False,
        clock: Callable[[], float] = time.time,
    ) -> None:
        self._source, self._align = source, align
        self._restamp, self._clock = restamp, clock
        self._lens: Any = None
        self._map: np.ndarray | None = None

    def read(self, patience: float) -> CameraFrame | None:
        """The next frame that has depth and colour; None where none came within `patience` (s)."""
        end = time.monotonic() + patience
        while True:
            left = end - time.monotonic()
            if left <= 0:
                return None
            try:
                frames = self._source.wait_for_frames(max(1, round(1000 * left)))
            except RuntimeError:  # the library's words for "none came"
                return None
            arrived = self._clock()
            if not frames.get_depth_frame() or not frames.get_color_frame():
                continue  # a half of a pair, as at the beginning
            frames = self._align.process(frames)
            depth, color = frames.get_depth_frame(), frames.get_color_frame()
            if depth and color:
                return self._frame(depth, color, arrived)

    def _frame(self, depth: Any, color: Any, arrived: float) -> CameraFrame:
        lens = color.profile.as_video_stream_profile().intrinsics
        pixels = np.asarray(color.get_data())[:, :, :3].copy()
        metres = np.asarray(depth.get_data()).astype(np.float32) * np.float32(depth.get_units())
        told = _lens_values(lens)
        if told != self._lens:
            self._lens, self._map = told, rectification(lens)
        if self._map is not None:
            pixels, metres = rectify(pixels, self._map, order=1), rectify(metres, self._map)
        stamps = 1e-3 * depth.get_timestamp(), 1e-3 * color.get_timestamp()
        taken = min(stamps)
        if self._restamp or "hardware" in str(depth.get_frame_timestamp_domain()):
            taken = arrived
        return CameraFrame(
            color=pixels,
            depth=metres,
            intrinsics=Intrinsics(
                lens.width, lens.height, fx=lens.fx, fy=lens.fy, cx=lens.ppx, cy=lens.ppy
            ),
            number=depth.get_frame_number(),
            color_number=color.get_frame_number(),
            time=taken,
            spread=abs(stamps[0] - stamps[1]),
        )


def _lens_values(lens: Any) -> tuple:
    return (
        lens.width, lens.height, lens.fx, lens.fy, lens.ppx, lens.ppy, str(lens.model),
        *lens.coeffs,
    )  # fmt: skip


def rectification(lens: Any) -> np.ndarray | None:
    """Where (2, H, W: row, column) each pixel of the pinhole is found in the image of a lens with
    distortion (`rs.intrinsics`); None where the lens has none."""
    if not any(lens.coeffs):
        return None
    import pyrealsense2 as rs

    H, W = lens.height, lens.width
    pinhole = np.empty((2, H, W))  # of each pixel of the lens: row, column
    for v in range(H):
        for u in range(W):
            x, y, _ = rs.rs2_deproject_pixel_to_point(lens, [u, v], 1.0)
            pinhole[:, v, u] = y * lens.fy + lens.ppy, x * lens.fx + lens.ppx
    grid = np.indices((H, W)).astype(float)
    shift, found = pinhole - grid, grid.copy()
    for _ in range(_ROUNDS):  # found + shift(found) = grid
        found = grid - np.stack(
            [map_coordinates(part, found, order=1, mode="nearest") for part in shift]
        )
    return found


def rectify(image: np.ndarray, where: np.ndarray, *, order: int = 0) -> np.ndarray:
    """The image (H, W) or (H, W, C) as the pinhole sees it; `order` 0 takes the nearest pixel, 1
    interpolates. Outside there is 0."""
    channels = np.atleast_3d(image)
    parts = [
        map_coordinates(channels[:, :, c], where, order=order, mode="constant")
        for c in range(channels.shape[2])
    ]
    return np.stack(parts, axis=2).reshape(image.shape)


class CameraBridge:
    """Publishes one camera's frames over LCM, one step at a time, and says what is wrong with them.

    The message is what `station/hardware/images.py` reads: colour (RGB), depth aligned with it in
    mm of 16 bits where the camera's unit is that, else in m of 32 bits, intrinsics, frame number,
    and the time at which it was taken. A frame that was delivered before is not sent again.
    """

    def __init__(
        self,
        name: str,
        reader: FrameReader,
        lcm: DrakeLcm,
        *,
        settings: RealSenseSettings,
        log: Callable[[str], None] = print,
    ) -> None:
        """`name`: the camera's in the scenario. Raises `ConfigError`."""
        settings.check()
        self._name, self._reader, self._lcm = name, reader, lcm
        self._settings, self._log = settings, log
        self._last: CameraFrame | None = None
        self._sent = -np.inf  # when the last frame that was sent was taken (s)
        self._silent = False
        self.counts = dict.fromkeys(("frames", "sent", "dropped", "repeated", "apart"), 0)
        self._told: dict[str, int] = {}

    def step(self) -> bool:
        """Waits for one frame, and publishes it unless its turn hasn't come; whether one came."""
        frame = self._reader.read(self._settings.patience)
        if frame is None:
            if not self._silent:
                self._log(
                    f"{self._name}: no frame for {self._settings.patience:g} s: check cable, port "
                    "and power; other programs must not have the camera open"
                )
            self._silent = True
            return False
        if self._silent:
            self._silent = False
            self._log(f"{self._name}: frames come again")
        if self._is_new(frame):
            self.counts["frames"] += 1
            if frame.time - self._sent >= 0.9 / self._settings.rate or frame.time < self._sent:
                self._publish(frame)
        return True

    def _is_new(self, frame: CameraFrame) -> bool:
        """Whether the frame wasn't there before; counts what is lost and repeated."""
        last, self._last = self._last, frame
        if last is not None and frame.number > last.number + 1:
            advice = "a port of its own for each camera, a shorter cable, fewer images (--fps)"
            number = frame.number - last.number - 1
            self._count("dropped", number, f"images were lost on the way: {advice}")
        if frame.spread > _APART / self._settings.fps:
            self._count("apart", 1, "frames have colour and depth of different moments")
        if last is not None and frame.number == last.number:
            self._count("repeated", 1, "frames came again and weren't sent")
            return False
        if last is not None and frame.color_number == last.color_number:
            self._count("repeated", 1, "frames had the colour of the frame before: not sent")
            return False
        return True

    def _count(self, what: str, number: int, words: str) -> None:
        """Says the first, then each time that there are twice as many."""
        self.counts[what] += number
        if self.counts[what] >= 2 * self._told.get(what, 0):
            self._told[what] = self.counts[what]
            self._log(f"{self._name}: {self.counts[what]} {words}")

    def _publish(self, frame: CameraFrame) -> None:
        depth = frame.depth[:, :, None]
        millimetres = np.rint(1000.0 * depth)
        if millimetres.max() < 2**16 and np.allclose(millimetres, 1000.0 * depth, atol=1e-3):
            depth = millimetres.astype(np.uint16)  # half as many bytes
        message = encode_images(
            {"color": frame.color, "depth": depth},
            utime=utime_of(frame.time),
            intrinsics=frame.intrinsics,
            number=frame.number,
        )
        self._lcm.Publish(f"{CHANNEL}{self._name}", message.encode())
        self._sent = frame.time
        self.counts["sent"] += 1


def _library() -> Any:
    try:
        import pyrealsense2
    except ImportError as error:
        raise DriverError(missing_extra(error) or error_text(error)) from error
    return pyrealsense2


def open_realsense(
    name: str,
    serial: str,
    settings: RealSenseSettings,
    *,
    allow_usb2: bool = False,
    log: Callable[[str], None] = print,
) -> RealSenseCamera:
    """Starts the camera with this serial number.

    Raises `DriverError` where the library, the camera, or a stream of this size isn't there, or
    where the camera is on a USB 2 link, unless `allow_usb2`.
    """
    rs = _library()
    context = rs.context()
    devices = {_info(rs, each, "serial_number"): each for each in context.query_devices()}
    if serial not in devices:
        raise DriverError(
            f"{name}: no RealSense camera has the serial number {serial}; there are "
            f"{', '.join(sorted(devices)) or 'none'}: check cable and number, and that this user "
            "may open it (librealsense's udev rules)"
        )
    device = devices[serial]
    link = _info(rs, device, "usb_type_descriptor")
    check_link(f"{name} ({serial})", link, allow_usb2=allow_usb2, log=log)
    config = rs.config()
    config.enable_device(serial)
    size = settings.width, settings.height
    config.enable_stream(rs.stream.depth, *size, rs.format.z16, settings.fps)
    config.enable_stream(rs.stream.color, *size, rs.format.rgb8, settings.fps)
    pipeline = rs.pipeline(context)
    try:
        pipeline.start(config)
    except RuntimeError as error:
        raise DriverError(
            f"{name}: the camera {serial} doesn't deliver {size[0]} x {size[1]} px at "
            f"{settings.fps} images a second ({error_text(error)}): on a USB 2 link it has fewer "
            f"sizes; it has {_sizes(rs, device)}; no other program may have it open"
        ) from error
    about = f"{_info(rs, device, 'name')} {serial}, USB {link or 'unknown'}"
    return RealSenseCamera(name, pipeline, rs.align(rs.stream.color), pipeline.stop, about)


def play_realsense(name: str, path: str, *, once: bool = False) -> RealSenseCamera:
    """Plays a recording (.bag of the RealSense viewer or SDK), over and over unless `once`.

    Raises `DriverError` where it can't be played.
    """
    rs = _library()
    config, pipeline = rs.config(), rs.pipeline()
    try:
        config.enable_device_from_file(path, repeat_playback=not once)
        pipeline.start(config)
    except RuntimeError as error:
        raise DriverError(
            f"{path}: can't be played ({error_text(error)}): name a .bag file with a depth and a "
            "colour stream"
        ) from error
    align = rs.align(rs.stream.color)
    return RealSenseCamera(name, pipeline, align, pipeline.stop, f"recording {path}", played=True)


def check_link(
    where: str, link: str, *, allow_usb2: bool, log: Callable[[str], None] = print
) -> None:
    """Raises `DriverError` for a link slower than USB 3, or says so where it is allowed."""
    if not link or link.startswith(_USB3):
        return
    problem = (
        f"{where} is on a USB {link} link: fewer sizes, lost images; use its own cable and a USB 3 "
        "port (blue, or marked SS), and turn the plug over once"
    )
    if not allow_usb2:
        raise DriverError(f"{problem}; --allow-usb2 takes it as it is")
    log(problem)


def _info(rs: Any, device: Any, name: str) -> str:
    key = getattr(rs.camera_info, name)
    return device.get_info(key) if device.supports(key) else ""


def _sizes(rs: Any, device: Any) -> str:
    """The sizes and rates of depth that a device has, in words."""
    found = {
        (each.width(), each.height(), profile.fps())
        for sensor in device.query_sensors()
        for profile in sensor.get_stream_profiles()
        if profile.stream_type() == rs.stream.depth
        for each in [profile.as_video_stream_profile()]
    }
    return ", ".join(f"{w} x {h} at {fps}" for w, h, fps in sorted(found)) or "no depth stream"


def list_realsense() -> list[str]:
    """A line for each camera that is plugged in: model, serial number, link, firmware."""
    rs = _library()
    return [
        f"{_info(rs, each, 'name')}  serial {_info(rs, each, 'serial_number')}  USB "
        f"{_info(rs, each, 'usb_type_descriptor') or '?'}  firmware "
        f"{_info(rs, each, 'firmware_version')}"
        for each in rs.context().query_devices()
    ]
