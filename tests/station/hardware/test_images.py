"""Images over LCM, against Drake's own encoder and decoder."""

import numpy as np
import pytest
from drake import lcmt_image, lcmt_image_array
from pydrake.common.value import Value
from pydrake.lcm import DrakeLcm
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.lcm import LcmInterfaceSystem, LcmPublisherSystem, LcmSubscriberSystem
from pydrake.systems.primitives import ConstantValueSource
from pydrake.systems.sensors import (
    ImageDepth32F,
    ImageLabel16I,
    ImageRgba8U,
    ImageToLcmImageArrayT,
    LcmImageArrayToImages,
)

from iga_drake.station.cameras.rgbd import Intrinsics
from iga_drake.station.contract import StationError
from iga_drake.station.hardware.images import ImageReceiver, decode_images, encode_images

K = Intrinsics(5, 4, fx=5.0, fy=5.0, cx=2.0, cy=1.5)
RNG = np.random.default_rng(0)
COLOR = RNG.integers(0, 256, (4, 5, 4)).astype(np.uint8)
DEPTH = RNG.uniform(0.3, 2.0, (4, 5, 1)).astype(np.float32)
LABEL = RNG.integers(0, 4, (4, 5, 1)).astype(np.int16)
IMAGES = {"color": COLOR, "depth": DEPTH, "label": LABEL}


def drake_images() -> tuple:
    kinds = ImageRgba8U, ImageDepth32F, ImageLabel16I
    made = []
    for kind, pixels in zip(kinds, IMAGES.values(), strict=True):
        image = kind(5, 4)
        image.mutable_data[:] = pixels
        made.append(image)
    return tuple(made)


@pytest.mark.parametrize("compress", [False, True])
def test_reads_what_drake_sends(compress: bool):
    builder = DiagramBuilder()
    lcm = DrakeLcm("memq://")
    sender = builder.AddSystem(
        ImageToLcmImageArrayT("color", "depth", "label", do_compress=compress)
    )
    for i, image in enumerate(drake_images()):
        source = builder.AddSystem(ConstantValueSource(Value(image)))
        builder.Connect(source.get_output_port(), sender.get_input_port(i))
    publisher = builder.AddSystem(
        LcmPublisherSystem.Make("X", lcmt_image_array, lcm, use_cpp_serializer=True)
    )
    builder.Connect(sender.get_output_port(), publisher.get_input_port())
    diagram = builder.Build()
    got: list[bytes] = []
    lcm.Subscribe("X", got.append)
    diagram.ForcedPublish(diagram.CreateDefaultContext())
    lcm.HandleSubscriptions(0)
    found = decode_images(lcmt_image_array.decode(got[0]), "left")
    for name, pixels in IMAGES.items():
        np.testing.assert_array_equal(found[name], pixels)


def test_drake_reads_what_is_sent():
    builder = DiagramBuilder()
    lcm = DrakeLcm("memq://")
    builder.AddSystem(LcmInterfaceSystem(lcm))
    subscriber = builder.AddSystem(
        LcmSubscriberSystem.Make("X", lcmt_image_array, lcm, use_cpp_serializer=True)
    )
    reader = builder.AddSystem(LcmImageArrayToImages())
    builder.Connect(subscriber.get_output_port(), reader.get_input_port())
    diagram = builder.Build()
    simulator = Simulator(diagram)
    lcm.Publish("X", encode_images(IMAGES, utime=1).encode())
    simulator.AdvanceTo(0.01)
    context = reader.GetMyContextFromRoot(simulator.get_context())
    for name, pixels in IMAGES.items():
        image = reader.GetOutputPort(f"{name}_image").Eval(context)
        np.testing.assert_array_equal(image.data, pixels)


def test_sixteen_bits_are_millimetres_and_bgr_is_turned():
    message = encode_images({"depth": DEPTH}, utime=1)
    depth = np.array([[0, 1500], [65535, 300]], dtype=np.uint16)
    image = message.images[0]
    image.width, image.height, image.row_stride = 2, 2, 6  # two bytes of padding
    image.channel_type = lcmt_image.CHANNEL_TYPE_UINT16
    image.compression_method = lcmt_image.COMPRESSION_METHOD_NOT_COMPRESSED
    image.data = b"".join(row.tobytes() + b"\xff\xff" for row in depth)
    color = lcmt_image()
    color.header, color.width, color.height, color.row_stride = message.header, 1, 1, 3
    color.pixel_format = lcmt_image.PIXEL_FORMAT_BGR
    color.channel_type = lcmt_image.CHANNEL_TYPE_UINT8
    color.compression_method = lcmt_image.COMPRESSION_METHOD_NOT_COMPRESSED
    color.data, color.size = bytes([1, 2, 3]), 3
    message.images.append(color)
    message.num_images, image.size = 2, len(image.data)
    found = decode_images(lcmt_image_array.decode(message.encode()), "left")
    np.testing.assert_allclose(found["depth"][:, :, 0], [[np.nan, 1.5], [65.535, 0.3]], rtol=1e-6)
    np.testing.assert_array_equal(found["color"], [[[3, 2, 1, 255]]])


@pytest.mark.parametrize(
    ("name", "value", "reason"),
    [
        ("compression_method", lcmt_image.COMPRESSION_METHOD_PNG, "compression method 3"),
        ("pixel_format", lcmt_image.PIXEL_FORMAT_DISPARITY, "pixel format 8"),
        ("channel_type", lcmt_image.CHANNEL_TYPE_FLOAT64, "channel type 7"),
        ("bigendian", True, "big-endian"),
        ("row_stride", 7, "where 7 are stated"),
        ("height", 3, "5 x 3 px"),
        ("data", b"no zlib", "5 x 4 px can't be read"),
    ],
)
def test_what_can_not_be_read_is_named(name: str, value: object, reason: str):
    message = encode_images({"depth": DEPTH}, utime=1)
    setattr(message.images[0], name, value)
    with pytest.raises(StationError, match=reason) as error:
        decode_images(message, "left")
    assert "left" in str(error.value)


class _Received:
    def __init__(self) -> None:
        self.system = ImageReceiver("left", K)
        self.context = self.system.CreateDefaultContext()
        self.system.GetInputPort("clock_offset").FixValue(self.context, [1e9])
        self.send(lcmt_image_array())

    def send(self, message: lcmt_image_array) -> None:
        self.system.GetInputPort("images").FixValue(self.context, Value(message))

    def read(self, name: str):
        return self.system.GetOutputPort(name).Eval(self.context)


def test_the_ports_of_a_camera():
    received = _Received()
    assert np.isnan(received.read("time")[0])
    assert np.isnan(received.read("depth_image").data).all()
    received.send(encode_images({"color": COLOR, "depth": DEPTH}, utime=1_000_000_002_500_000))
    np.testing.assert_allclose(received.read("time"), [2.5], atol=1e-6)
    np.testing.assert_array_equal(received.read("depth_image").data, DEPTH)
    np.testing.assert_array_equal(received.read("color_image").data, COLOR)
    assert not received.read("label_image").data.any()
    received.send(encode_images(IMAGES, utime=1))
    np.testing.assert_array_equal(received.read("label_image").data, LABEL)
    received.send(encode_images({"color": COLOR}, utime=2))
    with pytest.raises(StationError, match="left: its messages have no depth"):
        received.read("depth_image")
