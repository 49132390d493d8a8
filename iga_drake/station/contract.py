"""Whether a station exports the one port contract."""

from pydrake.math import RigidTransform
from pydrake.systems.framework import Diagram, InputPort, OutputPort, PortDataType
from pydrake.systems.sensors import ImageDepth32F, ImageLabel16I, ImageRgba8U

from iga_drake.errors import IgaDrakeError
from iga_drake.systems.ports import station_ports

# Ports that no hardware has start with this: only experts, success predicates and tests use them.
CHEAT = "cheat."


class StationError(IgaDrakeError):
    """A station can't be built, or breaks the port contract."""


def check_port_contract(station: Diagram, cameras: tuple[str, ...]) -> None:
    """Raises `StationError` unless `station` exports exactly the contract (`cheat.` ports aside).

    Compares names, directions, the sizes of vectors and the kinds of abstract values.
    """
    found = {}
    for i in range(station.num_input_ports()):
        port = station.get_input_port(i)
        found[port.get_name()] = ("input", _kind(port))
    for i in range(station.num_output_ports()):
        port = station.get_output_port(i)
        if not port.get_name().startswith(CHEAT):
            found[port.get_name()] = ("output", _kind(port))
    wanted = {p.name: (p.direction, p.kind) for p in station_ports(cameras)}
    problems = [f"'{n}' is missing" for n in wanted if n not in found]
    problems += [f"'{n}' is not in the contract" for n in found if n not in wanted]
    problems += [
        f"'{n}' is {found[n]}, the contract says {wanted[n]}"
        for n in wanted
        if n in found and found[n] != wanted[n]
    ]
    if problems:
        raise StationError(f"station '{station.get_name()}': " + "; ".join(problems))


_KINDS = {
    ImageRgba8U: "ImageRgba8U",
    ImageDepth32F: "ImageDepth32F",
    ImageLabel16I: "ImageLabel16I",
    RigidTransform: "RigidTransform",
}


def _kind(port: InputPort | OutputPort) -> str:
    """The contract's word for what a port carries."""
    if port.get_data_type() == PortDataType.kVectorValued:
        return f"vector({port.size()})"
    value = type(port.Allocate().get_value())
    return _KINDS.get(value, value.__name__)
