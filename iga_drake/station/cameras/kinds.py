"""All kinds of cameras that scenario files may name, as one type."""

import functools
import operator
from typing import Any, Protocol

from pydrake.geometry import SceneGraph
from pydrake.systems.framework import DiagramBuilder, OutputPort

from iga_drake.errors import ConfigError
from iga_drake.registry import Registry
from iga_drake.station.cameras.rgbd import Intrinsics, RgbdCamera


class CameraKind(Protocol):
    """Settings of one camera and how it is added to a simulation."""

    intrinsics: Intrinsics

    def check(self, where: str) -> None:
        """Raises `ConfigError` for values out of range, named by `where` and their key."""
        ...

    def add(
        self, builder: DiagramBuilder, scene_graph: SceneGraph, *, name: str, seed: tuple[int, ...]
    ) -> dict[str, OutputPort]:
        """Adds the camera and returns its ports by the contract's names without the camera's.

        `label_image` holds Drake's labels (body indices), which the station still has to map to
        roles. `seed`: integers >= 0 of this camera alone.
        """
        ...


_REGISTRY: Registry[CameraKind] = Registry(
    "camera",
    package="iga_drake.station.cameras",
    attribute="CAMERAS",
    group="iga_drake.cameras",
    error=ConfigError,
)


def camera_names() -> list[str]:
    """The names of all kinds of cameras, sorted."""
    return _REGISTRY.names()


def camera_type() -> Any:
    """The union of all kinds' dataclasses, the plain RGB-D camera first: it needs no tag."""
    kinds = [_REGISTRY.factory(name) for name in _REGISTRY.names()]
    others = [kind for kind in kinds if kind is not RgbdCamera]
    return functools.reduce(operator.or_, others, RgbdCamera)
