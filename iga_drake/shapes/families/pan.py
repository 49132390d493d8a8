"""Pans: a turned shell with sloping walls and one handle that can be grasped from above."""

from dataclasses import replace

import numpy as np

from iga_drake.shapes import surfaces
from iga_drake.shapes.errors import ShapeError
from iga_drake.shapes.family import Draft, Family, Parameters, Part
from iga_drake.shapes.instance import ShapeInstance, frame

FAMILY = "pan"
PART_NAMES = ("underside", "wall_outside", "rim", "wall_inside", "floor", "handle")
SEGMENTS = 48
WALL_POINTS = 12
SECTORS = 12
HANDLE_RINGS = 13
HANDLE_SEGMENTS = 16
_CAP_RINGS = 3
# Where along the handle a hand takes it, from 0 at the pan to 1 at the end.
GRASP_AT = 0.42
HOLDABLE = 0.28  # N m, what two pads hold by friction when the pan hangs from them
# Where the handle is cut into convex pieces (ring indices, caps included): from the wall to before
# the pads, between the pads, to the end.
_HANDLE_CUTS = (_CAP_RINGS, 6, 11)
_HANDLE_END = HANDLE_RINGS + 2 * _CAP_RINGS - 1

# name: (least, greatest); lengths in m, angles in rad, ratios without unit
RANGES = {
    "diameter": (0.14, 0.22),  # of the rim, outside
    "height": (0.042, 0.06),
    "base_ratio": (0.68, 0.97),  # base's diameter / rim's diameter
    "bulge": (0.2, 0.9),  # 0: straight wall, 1: round edge between base and wall
    "wall": (0.003, 0.0045),
    "handle_length": (0.10, 0.16),
    "handle_width": (0.015, 0.030),
    "handle_height": (0.014, 0.024),
    "handle_taper": (0.75, 1.25),  # width at the end / width at the pan
    "handle_tilt": (0.06, 0.35),  # rise of the handle where it leaves the pan
    "handle_curve": (-0.25, 0.25),  # change of the tilt along the handle
    "handle_exponent": (2.8, 7.0),  # of its section: 2 round, 7 nearly a box
    "mass": (0.18, 0.40),  # kg
}


def sample_parameters(rng: np.random.Generator) -> dict[str, float]:
    """Draws one pan; larger pans are heavier and have longer handles.

    The mass is bounded so that the weight turns a hand at the handle by at most `HOLDABLE`.
    """
    parameters = {name: float(rng.uniform(*limits)) for name, limits in RANGES.items()}
    size = (parameters["diameter"] - 0.14) / 0.08
    parameters["handle_length"] = float(0.10 + 0.06 * np.clip(size + rng.uniform(-0.4, 0.4), 0, 1))
    instance = build(parameters)
    arm = instance.frames["handle"][0, 3] - instance.mass_properties.p_OCcm[0]
    mass = min(0.24 + 0.11 * size + rng.uniform(0, 0.03), HOLDABLE / (9.81 * arm))
    parameters["mass"] = float(np.clip(mass, *RANGES["mass"]))
    return parameters


def profile(parameters: dict[str, float]) -> surfaces.ShellProfile:
    """The (r, z) outline of the pan's body (m), standing on z = 0."""
    return _profile(_checked(parameters))


def _profile(p: Parameters) -> surfaces.ShellProfile:
    radius = p["diameter"] / 2
    base = p["base_ratio"] * radius
    edge = [base + 0.8 * (radius - base) * p["bulge"] + 0.002, 0.05 * p["height"] + 0.001]
    wall = surfaces.bezier(
        np.array(
            [
                [base, 0.0],
                edge,
                [0.25 * base + 0.75 * radius, 0.5 * p["height"]],
                [radius, p["height"]],
            ]
        ),
        64,
    )
    return surfaces.shell_profile(
        wall, thickness=p["wall"], base_thickness=1.2 * p["wall"], points=WALL_POINTS
    )


def _handle_path(p: Parameters, shell: surfaces.ShellProfile) -> np.ndarray:
    """(HANDLE_RINGS, 3) from the middle of the wall outwards along +x."""
    height = p["height"] - 0.5 * p["handle_height"] - 0.002
    wall = (shell.outer + shell.inner) / 2
    start = np.interp(height, wall[:, 1], wall[:, 0])
    s = np.linspace(0.0, 1.0, HANDLE_RINGS)
    tilt = p["handle_tilt"] + p["handle_curve"] * s
    step = p["handle_length"] / (HANDLE_RINGS - 1)
    middle = (tilt[1:] + tilt[:-1]) / 2
    x = start + step * np.concatenate([[0.0], np.cumsum(np.cos(middle))])
    z = height + step * np.concatenate([[0.0], np.cumsum(np.sin(middle))])
    return np.column_stack([x, np.zeros_like(x), z])


def draft(p: Parameters) -> Draft:
    """The pan's parts and frames from its shape's parameters."""
    shell = _profile(p)
    body = surfaces.lathe(shell.profile, segments=SEGMENTS)
    bands = shell.bands[surfaces.lathe_face_bands(len(shell.profile), SEGMENTS)]
    path = _handle_path(p, shell)
    taper = np.linspace(1.0, p["handle_taper"], HANDLE_RINGS)
    # The inner end keeps inside the wall: a flat cap there, a round one at the free end.
    handle = surfaces.tube(
        path,
        width=p["handle_width"] * taper / taper[HANDLE_RINGS // 2],
        height=p["handle_height"],
        exponent=p["handle_exponent"],
        segments=HANDLE_SEGMENTS,
        caps=(0.2 * p["wall"], 0.35 * p["handle_height"]),
        cap_rings=_CAP_RINGS,
    )
    grasp = round(GRASP_AT * (HANDLE_RINGS - 1))
    parts = (
        Part("pan", body, lambda: _body_pieces(shell), (PART_NAMES[:-1], bands)),
        Part("handle", handle, lambda: _handle_pieces(handle)),
    )
    frames = {
        "base": frame((0.0, 0.0, 0.0)),
        "rim": frame((0.0, 0.0, p["height"])),
        "handle": frame(path[grasp], x=path[grasp + 1] - path[grasp - 1]),
    }
    return Draft(parts, frames)


_FAMILY = Family(FAMILY, {key: RANGES[key] for key in RANGES if key != "mass"}, draft)


def build(parameters: dict[str, float]) -> ShapeInstance:
    """Makes the pan of these `RANGES` parameters. Raises `ShapeError` for a missing or bad one."""
    p = _checked(parameters)
    instance = _FAMILY.build({key: p[key] for key in _FAMILY.ranges})
    return replace(instance, parameters=p).with_mass(p["mass"])


def _body_pieces(shell: surfaces.ShellProfile) -> list[np.ndarray]:
    """Wall sectors and a floor plate raised off the table."""
    levels = (0, 1, 2, 3, 5, 8, WALL_POINTS - 1)
    outer, inner = shell.outer[list(levels)].copy(), shell.inner[list(levels)].copy()
    inner[-1, 1] = outer[-1, 1] = shell.profile[:, 1].max()
    # Each wall sector stands on the table with its own edge, so a pan doesn't rock.
    wall = surfaces.shell_pieces(outer, inner, sectors=SECTORS, cuts=(0, len(levels) - 1))
    ring = np.arange(2 * SECTORS) * (np.pi / SECTORS)
    floor = shell.inner[0]
    radius = max(floor[0], shell.outer[0, 0])
    plate = np.concatenate([surfaces.turn(np.array([radius, z]), ring) for z in (0.0005, floor[1])])
    return [*wall, plate]


def _handle_pieces(handle: surfaces.Surface) -> list[np.ndarray]:
    """Three lengths of handle."""
    # Few facets where the pads touch make contact surfaces quick: ends of the lengths only.
    lengths = surfaces.tube_pieces(
        handle, segments=HANDLE_SEGMENTS, cuts=_HANDLE_CUTS, ends_only=True
    )
    lengths += surfaces.tube_pieces(
        handle, segments=HANDLE_SEGMENTS, cuts=(_HANDLE_CUTS[-1], _HANDLE_END)
    )
    return lengths


def _checked(parameters: dict[str, float]) -> dict[str, float]:
    missing = sorted(set(RANGES) - set(parameters))
    unknown = sorted(set(parameters) - set(RANGES))
    if missing or unknown:
        raise ShapeError(
            f"{FAMILY}: missing parameters {missing}, unknown {unknown}; known: {sorted(RANGES)}"
        )
    return parameters
