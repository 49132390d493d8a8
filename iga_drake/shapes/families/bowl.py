"""Bowls: a turned shell with a foot ring, a curved wall and a rim that may lean outwards."""

from dataclasses import replace
from itertools import pairwise

import numpy as np

from iga_drake.shapes import surfaces
from iga_drake.shapes.errors import ShapeError
from iga_drake.shapes.family import Draft, Family, Parameters, Part
from iga_drake.shapes.instance import ShapeInstance, frame
from iga_drake.shapes.symmetry import Symmetry

FAMILY = "bowl"
PART_NAMES = ("underside", "wall_outside", "rim", "wall_inside", "floor")
SEGMENTS = 48
WALL_POINTS = 16
SECTORS = 14
# The collision pieces' inner chords lie half inside the wall, half in the cavity: what is free of
# them is the cavity with its radius times this.
CAVITY_SHARE = (1 + np.cos(np.pi / SECTORS)) / 2
# Indices of the WALL_POINTS points that pieces take.
_LEVELS = (0, 3, 6, 9, 12, 15)

# name: (least, greatest); lengths in m, ratios without unit
RANGES = {
    "diameter": (0.11, 0.18),  # of the rim, outside
    "height_ratio": (0.34, 0.52),  # height / diameter
    "base_ratio": (0.38, 0.56),  # foot's diameter / rim's diameter
    "bulge": (0.25, 0.85),  # how far the wall starts outwards before it rises
    "lean": (0.12, 0.6),  # how far the wall still goes outwards at the rim
    "wall": (0.003, 0.005),
    "foot_height": (0.002, 0.007),
    "foot_width": (0.004, 0.008),
    "mass": (0.10, 0.25),  # kg
}


def sample_parameters(rng: np.random.Generator) -> dict[str, float]:
    """Draws one bowl; larger bowls are heavier."""
    parameters = {name: float(rng.uniform(*limits)) for name, limits in RANGES.items()}
    size = (parameters["diameter"] - 0.11) / 0.07
    parameters["mass"] = float(np.clip(0.10 + 0.12 * size + rng.uniform(0, 0.03), 0.10, 0.25))
    return parameters


def profile(parameters: dict[str, float]) -> surfaces.ShellProfile:
    """The (r, z) outline of a bowl (m), z = 0 under the foot ring."""
    return _profile(_checked(parameters))


def _profile(p: Parameters) -> surfaces.ShellProfile:
    radius = p["diameter"] / 2
    height = p["height_ratio"] * p["diameter"]
    base, foot = p["base_ratio"] * radius, p["foot_height"]
    reach = radius - base
    wall = surfaces.bezier(
        np.array(
            [
                [base, foot],
                [base + p["bulge"] * reach, foot + 0.08 * height],
                [radius - p["lean"] * reach, foot + 0.5 * (height - foot)],
                [radius, height],
            ]
        ),
        64,
    )
    underside = np.array(
        [
            [0.5 * (base - p["foot_width"]), foot],
            [base - p["foot_width"], foot],
            [base - 0.8 * p["foot_width"], 0.0],
            [base - 0.2 * p["foot_width"], 0.0],
        ]
    )
    return surfaces.shell_profile(
        wall,
        thickness=p["wall"],
        base_thickness=1.2 * p["wall"],
        underside=underside,
        points=WALL_POINTS,
    )


def draft(parameters: Parameters) -> Draft:
    """The bowl's part and frames from its shape's parameters."""
    shell = _profile(parameters)
    surface = surfaces.lathe(shell.profile, segments=SEGMENTS)
    bands = shell.bands[surfaces.lathe_face_bands(len(shell.profile), SEGMENTS)]
    rim = float(shell.profile[:, 1].max())
    floor = float(shell.inner[0, 1])
    frames = {
        "base": frame((0.0, 0.0, 0.0)),
        "opening": frame((0.0, 0.0, rim)),
        "rim": _rim_frame(shell),
        "floor": frame((0.0, 0.0, floor)),
    }
    return Draft((Part("bowl", surface, lambda: _pieces(shell), (PART_NAMES, bands)),), frames)


_FAMILY = Family(
    FAMILY,
    {key: RANGES[key] for key in RANGES if key != "mass"},
    draft,
    symmetry=Symmetry(order=0),
)


def build(parameters: dict[str, float]) -> ShapeInstance:
    """Makes the bowl of these `RANGES` parameters. Raises `ShapeError` for a missing or bad one."""
    p = _checked(parameters)
    instance = _FAMILY.build({key: p[key] for key in _FAMILY.ranges})
    return replace(instance, parameters=p).with_mass(p["mass"])


def _rim_frame(shell: surfaces.ShellProfile) -> np.ndarray:
    """Frame X_OF at the rim's top at azimuth 0, x outwards across the wall, z up along the wall."""
    middle = (shell.outer + shell.inner) / 2
    along = middle[-1] - middle[-4]
    along /= np.linalg.norm(along)
    top = shell.profile[shell.profile[:, 1].argmax()]
    return frame(
        (middle[-1, 0], 0.0, top[1]),
        x=(along[1], 0.0, -along[0]),
        z=(along[0], 0.0, along[1]),
    )


def cavity(shell: surfaces.ShellProfile) -> np.ndarray:
    """Outline (WALL_POINTS, 2) (r, z) m of the cavity that the collision pieces leave free.

    It goes from the floor's edge to the rim, a little inside `shell.inner`.
    """
    cut = _cut_levels(shell)
    free = np.interp(shell.inner[:, 1], shell.inner[cut, 1], shell.inner[cut, 0])
    radius = np.minimum(free, shell.inner[:, 0]) * CAVITY_SHARE
    return np.column_stack([radius, shell.inner[:, 1]])


def _cut_levels(shell: surfaces.ShellProfile) -> list[int]:
    """Wall points at which the wall is cut into two rings, so that chords stay near the wall."""
    last = WALL_POINTS - 1
    middle = min(
        _LEVELS[1:-1], key=lambda k: max(_sagitta(shell.inner[: k + 1]), _sagitta(shell.inner[k:]))
    )
    return [0, middle, last]


def _pieces(shell: surfaces.ShellProfile) -> tuple[np.ndarray, ...]:
    """Wall sectors in two rings, the lower with the foot, and a floor plate off the table."""
    rim = shell.profile[4 + 1 + WALL_POINTS :][:3]  # outside, top, inside
    outer = np.vstack([shell.outer[list(_LEVELS)], rim[:2]])
    inner = np.vstack([shell.inner[list(_LEVELS)], rim[:0:-1]])
    inner[:, 0] *= CAVITY_SHARE / np.cos(np.pi / SECTORS)
    cut = _LEVELS.index(_cut_levels(shell)[1])
    wall = surfaces.shell_pieces(outer, inner, sectors=SECTORS, cuts=(0, cut, len(outer) - 1))
    # Each foot sector touches the table with its own edge, so a bowl stands without rocking.
    foot = [
        np.concatenate(
            [surfaces.turn(edge, np.linspace(start, end, 3)) for edge in shell.profile[3:5]]
        )
        for start, end in pairwise(np.linspace(0, 2 * np.pi, SECTORS + 1))
    ]
    lower = [np.concatenate(both) for both in zip(wall[0::2], foot, strict=True)]
    floor = shell.inner[0]
    low = max(shell.profile[0, 1], 0.0005)
    ring = np.arange(2 * SECTORS) * (np.pi / SECTORS)
    plate = [surfaces.turn(np.array([floor[0], z]), ring) for z in (low, floor[1])]
    return (*lower, *wall[1::2], np.concatenate(plate))


def _sagitta(curve: np.ndarray) -> float:
    """Greatest distance (m) of a curve's points (n, 2) from its chord."""
    chord = curve[-1] - curve[0]
    arm = curve - curve[0]
    return float(np.abs(arm[:, 0] * chord[1] - arm[:, 1] * chord[0]).max() / np.linalg.norm(chord))


def _checked(parameters: dict[str, float]) -> dict[str, float]:
    missing = sorted(set(RANGES) - set(parameters))
    unknown = sorted(set(parameters) - set(RANGES))
    if missing or unknown:
        raise ShapeError(
            f"{FAMILY}: missing parameters {missing}, unknown {unknown}; known: {sorted(RANGES)}"
        )
    return parameters
