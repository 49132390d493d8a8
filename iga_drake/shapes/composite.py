"""Abstract composite shapes: random assemblies of closed parts, with part-wise variation.

A category is drawn once (which parts, where they sit); its instances vary each part's size, bend
and place. All instances of a category share faces and vertex order.
"""

import math
from dataclasses import dataclass

import numpy as np

from iga_drake.shapes.surfaces import (
    Surface,
    bezier,
    ellipsoid,
    join,
    lathe,
    rounded_box,
    shell_profile,
    transformed,
    tube,
)

_KINDS = ("box", "ellipsoid", "turned", "vessel", "rod", "loop", "horn")


@dataclass(frozen=True)
class _Part:
    kind: str
    size: np.ndarray  # (3,) m
    direction: np.ndarray  # (3,) unit, where it leaves its parent
    spin: float
    parent: int
    form: np.ndarray  # (5,) in [0, 1], what is common to all instances of the part


@dataclass(frozen=True)
class CompositeCategory:
    """A drawn category; `instance(rng, spread)` gives vertices and faces of one member."""

    parts: tuple[_Part, ...]

    @staticmethod
    def draw(rng: np.random.Generator) -> "CompositeCategory":
        parts = []
        for k in range(int(rng.integers(2, 5))):
            direction = rng.normal(size=3)
            kinds = _KINDS[:4] if k == 0 else _KINDS
            size = np.exp(rng.uniform(np.log(0.35), 0.0, 3))
            parts.append(
                _Part(
                    kind=str(rng.choice(kinds)),
                    size=0.1 * size * (1.0 if k == 0 else rng.uniform(0.4, 0.9)),
                    direction=direction / np.linalg.norm(direction),
                    spin=float(rng.uniform(0, 2 * np.pi)),
                    parent=int(rng.integers(0, k)) if k else -1,
                    form=rng.random(5),
                )
            )
        return CompositeCategory(tuple(parts))

    def instance(self, rng: np.random.Generator, spread: float) -> tuple[np.ndarray, np.ndarray]:
        """Vertices (V, 3) m and faces (F, 3); `spread` is the sigma of the log sizes."""
        surfaces: list[Surface] = []
        frames: list[np.ndarray] = []
        reaches: list[np.ndarray] = []
        for part in self.parts:
            size = part.size * np.exp(rng.normal(size=3) * spread)
            surface = _surface(part.kind, size, part.form, rng, spread)
            direction = part.direction + rng.normal(size=3) * 0.25 * spread
            direction /= np.linalg.norm(direction)
            X = np.eye(4)
            if part.parent >= 0:
                parent = frames[part.parent]
                reach = reaches[part.parent]
                place = direction / np.linalg.norm(direction / reach)
                X[:3, :3] = _frame_along(direction, part.spin)
                X[:3, 3] = place * 0.92
                X = parent @ X
            surfaces.append(transformed(surface, X))
            frames.append(X)
            reaches.append(np.maximum(np.abs(surface.vertices).max(0), 0.005))
        whole, _ = join(surfaces)
        return whole.vertices, whole.faces


def _frame_along(direction: np.ndarray, spin: float) -> np.ndarray:
    """A rotation (3, 3) whose z axis is the unit vector `direction`; written out for speed."""
    a, b, c = direction.tolist()
    # x0 is perpendicular to z and to the world's x (or y) axis, y0 = z x x0.
    x0 = (0.0, -c, b) if abs(a) < 0.7 else (c, 0.0, -a)
    norm = math.sqrt(x0[0] ** 2 + x0[1] ** 2 + x0[2] ** 2)
    p, q, r = x0[0] / norm, x0[1] / norm, x0[2] / norm
    u, v, w = b * r - c * q, c * p - a * r, a * q - b * p
    k, s = math.cos(spin), math.sin(spin)
    return np.array(
        [
            [k * p + s * u, k * u - s * p, a],
            [k * q + s * v, k * v - s * q, b],
            [k * r + s * w, k * w - s * r, c],
        ]
    )


def _surface(
    kind: str, size: np.ndarray, form: np.ndarray, rng: np.random.Generator, spread: float
) -> Surface:
    """A closed part; roots of attached kinds are at the origin, growing along +z."""
    vary = 1 + spread * rng.normal(size=4) * 0.5
    if kind == "box":
        return rounded_box(size, radius=float(0.15 * size.min()), flat=3, arc=2)
    if kind == "ellipsoid":
        return ellipsoid(size / 2, rings=11, segments=20)
    if kind == "turned":
        z = np.linspace(0, 1, 12)
        waves = 0.35 * (2 * form[:3] - 1)
        r = 1 + sum(w * np.sin((k + 1) * np.pi * z + k) for k, w in enumerate(waves)) * vary[0]
        r = np.clip(r, 0.25, 2.0) * size[0] / 2
        z = (z - 0.5) * size[2]
        profile = np.column_stack(
            (np.concatenate(([0], r, [0])), np.concatenate(([z[0]], z, [z[-1]])))
        )
        return lathe(profile, segments=20, ratio=float(np.clip(size[1] / size[0], 0.4, 1.5)))
    if kind == "vessel":
        z = np.linspace(0, 1, 10)
        low, bulge = 0.5 + 0.6 * form[0], (0.5 * form[1] - 0.1) * vary[0]
        r = (low + (1 - low) * z + bulge * np.sin(np.pi * z)) * size[0] / 2
        outer = np.column_stack((np.maximum(r, 0.01), z * size[2]))
        wall = float(min(0.004, 0.2 * size.min()))
        shell = shell_profile(outer, thickness=wall, base_thickness=wall * 1.2)
        body = lathe(shell.profile, segments=24)
        return Surface(body.vertices - [0, 0, size[2] / 2], body.faces)
    width, height = size[0] * 0.3, size[1] * 0.3
    length = float(size[2]) * 1.4
    bend = 0.6 * (2 * form[:2] - 1) * vary[:2]
    if kind == "loop":
        path = bezier(
            length * np.array([[-0.3, 0, 0], [-0.3 + bend[0], 0, 1.0], [0.3, 0, 1.0], [0.3, 0, 0]]),
            14,
        )
        return tube(path, width=width, height=height, up=(0.0, 1.0, 0.01), segments=10)
    path = bezier(length * np.array([[0, 0, 0], [0, 0, 0.5], [bend[0], bend[1], 1.0]]), 12)
    taper = np.linspace(1, 1.0 if kind == "rod" else (0.15 + 0.35 * form[2]) * vary[2], 12)
    taper = np.clip(taper, 0.1, 2)
    return tube(path, width=width * taper, height=height * taper, up=(1.0, 0.05, 0.0), segments=10)
