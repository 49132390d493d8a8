"""Rotations that carry a shape onto itself."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from iga_drake.shapes.errors import ShapeError

Axis = Literal["x", "y", "z"]


@dataclass(frozen=True)
class Symmetry:
    """Rotations about one axis through the origin of the object frame O.

    `exact` means that the surface is carried onto itself; otherwise nearly so, in the sense that a
    view with noise seldom tells the difference (a hammer turned half about its handle).
    """

    axis: Axis = "z"
    order: int = 1  # n-fold: multiples of 360 / n degrees; 0: any angle; 1: none
    exact: bool = True

    def __post_init__(self) -> None:
        if self.axis not in ("x", "y", "z") or self.order < 0:
            raise ShapeError(
                f"Symmetry: axis {self.axis!r}, order {self.order}; expected x, y or z and >= 0"
            )

    @property
    def is_trivial(self) -> bool:
        """Whether no rotation but the identity belongs to the group."""
        return self.order == 1

    @property
    def direction(self) -> np.ndarray:
        """(3,) unit vector of the axis in O."""
        return np.eye(3)["xyz".index(self.axis)]

    def angles(self, steps: int = 72) -> np.ndarray:
        """(n,) rad, of the group's rotations, 0 first; `steps` of them for any angle."""
        count = self.order or steps
        return 2 * np.pi / count * np.arange(count)

    def rotations(self, steps: int = 72) -> np.ndarray:
        """(n, 3, 3) the group's rotations, identity first; `steps` of them for any angle."""
        vectors = self.angles(steps)[:, None] * self.direction
        return Rotation.from_rotvec(vectors).as_matrix()


NO_SYMMETRY = Symmetry()
