"""Turned bodies of families, vessels and solids, with their bands and convex pieces."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from iga_drake.shapes import surfaces
from iga_drake.shapes.family import Part
from iga_drake.shapes.surfaces import BAND_RIM, BAND_UNDERSIDE, ShellProfile, Surface

SEGMENTS = 36
VESSEL_BANDS = ("underside", "wall_outside", "rim", "wall_inside", "floor")


class Anchor(NamedTuple):
    """A point and normal at which a part is fixed to a wall, in the half plane (r, z)."""

    point: np.ndarray  # (2,) m, some way below the outer surface
    normal: np.ndarray  # (2,) outwards

    def opposite(self) -> "Anchor":
        """The anchor at the wall's other side (azimuth pi), in the plane (x, z)."""
        flip = np.array([-1.0, 1.0])
        return Anchor(self.point * flip, self.normal * flip)


def wall_anchor(outer: np.ndarray, height: float, depth: float) -> Anchor:
    """The place `depth` (m) below a wall (K, 2) (r, z), z rising, where it has `height` (m)."""
    index = int(np.clip(np.searchsorted(outer[:, 1], height), 1, len(outer) - 1))
    low, high = outer[index - 1], outer[index]
    along = (high - low) / np.linalg.norm(high - low)
    normal = np.array([along[1], -along[0]])
    share = (height - low[1]) / (high[1] - low[1])
    return Anchor(low + share * (high - low) - depth * normal, normal)


@dataclass(frozen=True)
class Vessel:
    """A wall turned about z, on which other parts are placed; segment 0 is at +x."""

    shell: ShellProfile
    surface: Surface
    segments: int
    thickness: float  # m, of the wall

    @property
    def rings(self) -> np.ndarray:
        """Rings (R, S, 3) m, from the underside over the rim to the floor: views of vertices."""
        return self.surface.vertices[1:-1].reshape(-1, self.segments, 3)

    @property
    def top(self) -> float:
        """Height (m) of the rim."""
        return float(self.surface.vertices[:, 2].max())

    def anchor(self, height: float) -> "Anchor":
        """The anchor in the middle of the wall at a height (m), at azimuth 0."""
        return wall_anchor(self.shell.outer, height, 0.5 * self.thickness)

    def part(self, base_cuts: Sequence[int] | None = None) -> Part:
        """The vessel as a part with bands; `base_cuts`: see `pieces`."""
        bands = self.shell.bands[surfaces.lathe_face_bands(len(self.shell.profile), self.segments)]
        return Part("vessel", self.surface, lambda: self.pieces(base_cuts), (VESSEL_BANDS, bands))

    def pieces(self, base_cuts: Sequence[int] | None = None) -> list[np.ndarray]:
        """Wall sectors and the floor; a solid base below the wall (a stem) is cut at the underside
        rings `base_cuts`."""
        rings = self.rings
        first = int((self.shell.bands == BAND_UNDERSIDE).sum()) - 1
        count, rim = len(self.shell.outer), int((self.shell.bands == BAND_RIM).sum()) - 1
        outer = rings[first : first + count]
        above = rings[first + count : first + count + rim]
        inner = rings[first + count + rim :][:count][::-1]
        cuts = [0] if base_cuts is None else list(base_cuts)
        base = [rings[low : high + 1].reshape(-1, 3) for low, high in pairwise(cuts)]
        floor = np.concatenate([rings[cuts[-1] : first + 1].reshape(-1, 3), inner[0]])
        return [*surfaces.wall_pieces(outer, inner, above[rim // 2]), *base, floor]


def vessel(
    outer: np.ndarray,
    *,
    thickness: float,
    base_thickness: float,
    underside: np.ndarray | None = None,
    points: int = 14,
    segments: int = SEGMENTS,
    ratio: float = 1.0,
    exponent: float = 2.0,
) -> Vessel:
    """Turns an outer wall (M, 2) (r, z) m with an inside; see `shell_profile` and `lathe`."""
    shell = surfaces.shell_profile(
        outer,
        thickness=thickness,
        base_thickness=base_thickness,
        underside=underside,
        points=points,
    )
    surface = surfaces.lathe(shell.profile, segments=segments, ratio=ratio, exponent=exponent)
    return Vessel(shell, surface, segments, thickness)


def solid(
    names: tuple[str, ...],
    outlines: Sequence[np.ndarray],
    *,
    segments: int = SEGMENTS,
    ratio: float = 1.0,
    exponent: float | np.ndarray = 2.0,
) -> Part:
    """A solid turned about z from outlines (n, 2) (r > 0, z) from below to above, one a band.

    Its poles close the first and the last ring.
    """
    outline = np.concatenate(list(outlines))
    profile = np.concatenate([[[0.0, outline[0, 1]]], outline, [[0.0, outline[-1, 1]]]])
    surface = surfaces.lathe(profile, segments=segments, ratio=ratio, exponent=exponent)
    counts = [len(part) for part in outlines]
    counts[0] += 1
    bands = np.repeat(np.arange(len(names)), counts)
    labels = bands[surfaces.lathe_face_bands(len(profile), segments)]

    def pieces() -> list[np.ndarray]:
        rings = surface.vertices[1:-1].reshape(-1, segments, 3)
        cuts = surfaces.chord_cuts(rings[:, [0, segments // 8]].swapaxes(0, 1), 0.002)
        lowest, *above = surfaces.tube_pieces(surface, segments=segments, cuts=cuts)
        # Quarters below, each of which touches what it stands on at a place of its own.
        levels = lowest[: (cuts[1] + 1) * segments].reshape(-1, segments, 3)
        axis = levels.mean(axis=1)
        quarters = [
            np.arange(start, start + segments // 4 + 1) % segments
            for start in range(0, segments, segments // 4)
        ]
        low = [np.concatenate([levels[:, q].reshape(-1, 3), axis]) for q in quarters]
        return [*low, *above]

    return Part(names[0], surface, pieces, (names, labels))


def outline(
    heights: Sequence[float] | np.ndarray, radii: Sequence[float], count: int
) -> np.ndarray:
    """(count, 2) (r, z) of the smooth outline with these control points (m)."""
    return surfaces.bspline(np.column_stack([radii, heights]), count)
