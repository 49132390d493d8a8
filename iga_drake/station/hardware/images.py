"""Images over LCM: `lcmt_image_array` to the port contract's images and back.

The message has no field for intrinsics. Each image's `header.frame_name` holds them, as a JSON
object with the fields of `Intrinsics`; other senders may leave the name as they like.
`header.seq` is the camera's frame number.
"""

import json
import zlib
from collections.abc import Callable
from dataclasses import asdict, fields
from typing import Any

import numpy as np
from drake import lcmt_header, lcmt_image, lcmt_image_array
from pydrake.common.value import AbstractValue, Value
from pydrake.lcm import DrakeLcm
from pydrake.systems.framework import BasicVector, Context, EventStatus, LeafSystem, ValueProducer
from pydrake.systems.sensors import ImageDepth32F, ImageLabel16I, ImageRgba8U

from iga_drake.station.cameras.rgbd import Intrinsics
from iga_drake.station.contract import StationError
from iga_drake.station.hardware.calibration import differing_intrinsic
from iga_drake.station.lcm import Clock, utime_of, wall_clock

# The channel of a camera is this and its name, as in Drake's `CameraConfig`.
CHANNEL = "DRAKE_RGBD_CAMERA_IMAGES_"

_MILLIMETRE = 0.001
_FORMATS = {
    lcmt_image.PIXEL_FORMAT_RGB: ("color", 3),
    lcmt_image.PIXEL_FORMAT_BGR: ("color", 3),
    lcmt_image.PIXEL_FORMAT_RGBA: ("color", 4),
    lcmt_image.PIXEL_FORMAT_BGRA: ("color", 4),
    lcmt_image.PIXEL_FORMAT_DEPTH: ("depth", 1),
    lcmt_image.PIXEL_FORMAT_LABEL: ("label", 1),
}
_TYPES: dict[int, np.dtype] = {
    lcmt_image.CHANNEL_TYPE_UINT8: np.dtype("u1"),
    lcmt_image.CHANNEL_TYPE_INT16: np.dtype("i2"),
    lcmt_image.CHANNEL_TYPE_UINT16: np.dtype("u2"),
    lcmt_image.CHANNEL_TYPE_FLOAT32: np.dtype("f4"),
}
_PIXELS = {
    ("color", 3): lcmt_image.PIXEL_FORMAT_RGB,
    ("color", 4): lcmt_image.PIXEL_FORMAT_RGBA,
    ("depth", 1): lcmt_image.PIXEL_FORMAT_DEPTH,
    ("label", 1): lcmt_image.PIXEL_FORMAT_LABEL,
}
_CHANNELS = {dtype.str[1:]: number for number, dtype in _TYPES.items()}
_WANTED = {"color": ("u1",), "depth": ("f4", "u2"), "label": ("i2",)}


def decode_images(message: lcmt_image_array, camera: str) -> dict[str, np.ndarray]:
    """The images of a message by what they show.

    Returns "color" (H, W, 4) uint8 RGBA, "depth" (H, W, 1) float32 m, "label" (H, W, 1) int16, as
    far as the message has them; depth of 16 bits is in millimetres, where 0 becomes NaN. Raises
    `StationError`, which names the camera, for what can't be read.
    """
    found = {}
    for image in message.images:
        kind, channels = _FORMATS.get(image.pixel_format, ("", 0))
        pixel = _TYPES.get(image.channel_type)
        if not kind or pixel is None or pixel.str[1:] not in _WANTED[kind]:
            raise StationError(
                f"{camera}: an image of pixel format {image.pixel_format} and channel type "
                f"{image.channel_type} can't be read: send RGB(A) of 8 bits, depth of 32-bit float "
                "(m) or 16 bits (mm), labels of 16 bits"
            )
        found[kind] = _pixels(image, pixel, channels, camera)
    if "color" in found and found["color"].shape[2] == 3:
        opaque = np.full((*found["color"].shape[:2], 1), 255, dtype=np.uint8)
        found["color"] = np.concatenate([found["color"], opaque], axis=2)
    depth = found.get("depth")
    if depth is not None and depth.dtype == np.uint16:
        metres = depth.astype(np.float32) * np.float32(_MILLIMETRE)
        metres[depth == 0] = np.nan
        found["depth"] = metres
    return found


def _pixels(image: lcmt_image, pixel: np.dtype, channels: int, camera: str) -> np.ndarray:
    """(H, W, channels) of one image."""
    data = bytes(image.data)
    try:
        if image.compression_method == lcmt_image.COMPRESSION_METHOD_ZLIB:
            data = zlib.decompress(data)
        elif image.compression_method != lcmt_image.COMPRESSION_METHOD_NOT_COMPRESSED:
            raise ValueError(f"compression method {image.compression_method}")
        if image.bigendian:
            raise ValueError("big-endian pixels")
        row = image.width * channels * pixel.itemsize
        lines = np.frombuffer(data, dtype=np.uint8).reshape(image.height, -1)
        stride = image.row_stride
        if lines.shape[1] != stride or stride < row:
            raise ValueError(f"rows of {lines.shape[1]} bytes where {stride} are stated")
        pixels = np.ascontiguousarray(lines[:, :row]).view(pixel)
    except (ValueError, zlib.error) as error:
        raise StationError(
            f"{camera}: an image of {image.width} x {image.height} px can't be read ({error}): "
            "send it little-endian, plain or compressed by zlib"
        ) from error
    pixels = pixels.reshape(image.height, image.width, channels)
    if image.pixel_format in (lcmt_image.PIXEL_FORMAT_BGR, lcmt_image.PIXEL_FORMAT_BGRA):
        pixels = pixels[:, :, [2, 1, 0, 3][:channels]]
    return pixels


def decode_intrinsics(message: lcmt_image_array) -> Intrinsics | None:
    """The intrinsics that the sender told with its first image; None where it told none."""
    name = message.images[0].header.frame_name if message.images else ""
    try:
        values = json.loads(name)
        numbers = {field.name: float(values[field.name]) for field in fields(Intrinsics)}
        width, height = int(numbers.pop("width")), int(numbers.pop("height"))
        return Intrinsics(width, height, **numbers)
    except (ValueError, KeyError, TypeError):  # a name like any other
        return None


def encode_images(
    images: dict[str, np.ndarray],
    *,
    utime: int,
    intrinsics: Intrinsics | None = None,
    number: int = 0,
) -> lcmt_image_array:
    """The message of images, compressed by zlib.

    Args:
      images: as `decode_images` returns them; colour may be RGB without A, depth may be uint16 mm.
      utime: when they were taken, in microseconds since 1970.
      intrinsics: of all of them; None: not told.
      number: the camera's frame number.
    """
    message = lcmt_image_array()
    message.header = lcmt_header()
    message.header.utime = utime
    message.header.seq = number & 0x7FFFFFFF
    if intrinsics is not None:
        message.header.frame_name = json.dumps(asdict(intrinsics))
    for kind, pixels in images.items():
        image = lcmt_image()
        image.header = message.header
        image.height, image.width, channels = pixels.shape
        image.row_stride = image.width * channels * pixels.itemsize
        image.pixel_format = _PIXELS[kind, channels]
        image.channel_type = _CHANNELS[pixels.dtype.str[1:]]
        image.compression_method = lcmt_image.COMPRESSION_METHOD_ZLIB
        image.data = zlib.compress(np.ascontiguousarray(pixels).tobytes(), level=1)
        image.size = len(image.data)
        message.images.append(image)
    message.num_images = len(message.images)
    return message


class ImageReceiver(LeafSystem):
    """One camera's ports of the contract, from its last message.

    .. pydrake_system::

        name: ImageReceiver
        input_ports:
        - images
        - clock_offset
        output_ports:
        - color_image
        - depth_image
        - label_image
        - time

    - `images` (lcmt_image_array): what was received. `clock_offset` (1, s): this machine's clock
      minus the diagram's.
    - `label_image`: the labels in the message; where it has none, all is background.
    - `time` (1, s): the message's stamp on the diagram's clock; NaN before there is a message.

    Images before the first message are empty: no depth. A message without depth, that tells
    another focal length or principal point than the scenario's, or that can't be read, raises
    `StationError` where its images are asked for.
    """

    def __init__(self, camera: str, intrinsics: Intrinsics) -> None:
        super().__init__()
        self.set_name(f"{camera}.images")
        self._camera, self._size = camera, (intrinsics.height, intrinsics.width)
        self._intrinsics = intrinsics
        self._images_input = self.DeclareAbstractInputPort("images", Value(lcmt_image_array()))
        self._offset_input = self.DeclareVectorInputPort("clock_offset", 1)
        decoded = self.DeclareCacheEntry(
            "decoded",
            ValueProducer(allocate=lambda: Value[object]({}), calc=self._decode),
            {self._images_input.ticket()},
        )

        def declare(name: str, kind: Any, missing: Callable[[], np.ndarray]) -> None:
            def calc(context: Context, output: AbstractValue) -> None:
                pixels = decoded.Eval(context).get(name)
                pixels = missing() if pixels is None else pixels
                image = kind(pixels.shape[1], pixels.shape[0])
                image.mutable_data[:] = pixels
                output.SetFrom(Value(image))

            self.DeclareAbstractOutputPort(
                f"{name}_image",
                lambda: Value(kind(self._size[1], self._size[0])),
                calc,
                {self._images_input.ticket()},
            )

        declare("color", ImageRgba8U, lambda: np.zeros((*self._size, 4), np.uint8))
        declare("depth", ImageDepth32F, lambda: np.full((*self._size, 1), np.nan, np.float32))
        declare("label", ImageLabel16I, lambda: np.zeros((*self._size, 1), np.int16))
        self.DeclareVectorOutputPort(
            "time", 1, self._calc_time, {self._images_input.ticket(), self._offset_input.ticket()}
        )

    def _decode(self, context: Context, output: AbstractValue) -> None:
        message = self._images_input.Eval(context)
        images = decode_images(message, self._camera)
        if message.num_images and "depth" not in images:
            raise StationError(f"{self._camera}: its messages have no depth image: send it as well")
        told = decode_intrinsics(message)
        name = "" if told is None else differing_intrinsic(told, self._intrinsics)
        if name not in ("", "width", "height"):  # those who use images see their size
            raise StationError(
                f"{self._camera}: its images have intrinsics.{name} {getattr(told, name):g}, the "
                f"scenario says {getattr(self._intrinsics, name):g}: state the camera's own in the "
                "scenario, or start its driver with the scenario's size"
            )
        output.set_value(images)

    def _calc_time(self, context: Context, output: BasicVector) -> None:
        message = self._images_input.Eval(context)
        offset = self._offset_input.Eval(context)[0]
        time = 1e-6 * message.header.utime - offset if message.num_images else np.nan
        output.SetFromVector([time])


class ImageSender(LeafSystem):
    """Publishes one camera's images over LCM, as a camera's driver does.

    .. pydrake_system::

        name: ImageSender
        input_ports:
        - color_image
        - depth_image
        - label_image
    """

    def __init__(
        self,
        camera: str,
        intrinsics: Intrinsics,
        lcm: DrakeLcm,
        *,
        period: float,
        clock: Clock = wall_clock,
    ) -> None:
        """`period` (s) between two messages."""
        super().__init__()
        self.set_name(f"{camera}.sender")
        self._channel, self._lcm, self._clock = f"{CHANNEL}{camera}", lcm, clock
        self._intrinsics = intrinsics
        size = intrinsics.width, intrinsics.height
        self._inputs = {
            name: self.DeclareAbstractInputPort(f"{name}_image", Value(kind(*size)))
            for name, kind in (
                ("color", ImageRgba8U), ("depth", ImageDepth32F), ("label", ImageLabel16I)
            )
        }  # fmt: skip
        self.DeclarePeriodicPublishEvent(period, 0.0, self._publish)

    def send(self, context: Context, channel: str, data: bytes) -> None:
        """Publishes one message; a rehearsal of a bad link overrides it."""
        self._lcm.Publish(channel, data)

    def _publish(self, context: Context) -> EventStatus:
        images = {name: port.Eval(context).data for name, port in self._inputs.items()}
        utime = utime_of(self._clock(context))
        message = encode_images(images, utime=utime, intrinsics=self._intrinsics)
        self.send(context, self._channel, message.encode())
        return EventStatus.Succeeded()
