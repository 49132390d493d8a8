"""Furniture at a table's scale: chair, stool, table and lamp. They stand on z = 0 about O.

Frames: `base` on the ground; `seat` and `top` on what carries, z up; `back` in the middle of a
chair's back, x forwards; `leg` on the ground under a leg, z up it; `stem` at half a lamp's height;
`shade` in the middle of the shade's opening, z down out of it.
"""

import numpy as np

from iga_drake.shapes.families.blocks import (
    dome,
    hulls,
    rings,
    spline,
    stations,
    straight,
    tubes,
    wall_hulls,
)
from iga_drake.shapes.family import Draft, Family, Parameters, Part
from iga_drake.shapes.instance import frame
from iga_drake.shapes.surfaces import Surface, loft, superellipse
from iga_drake.shapes.symmetry import Symmetry

_CORNERS = np.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]])


def _legs(
    tops: np.ndarray, feet: np.ndarray, *, thick: float, taper: float, exponent: float, bulge: float
) -> Surface:
    """Four legs from `tops` (4, 3) to `feet` (4, 3) on the ground, where they are cut level.

    They are `thick` at the top and `taper` times that at the feet.
    """
    thickness = thick * (1 + (taper - 1) * stations(7) + bulge * np.sin(np.pi * stations(7)))
    legs = tubes(
        straight(feet, tops, 7),
        width=thickness[::-1],
        height=thickness[::-1],
        exponent=exponent,
        up=(1.0, 0.0, 0.0),
        segments=12,
    )
    legs.vertices.reshape(4, -1, 3)[:, :13, 2] = 0.0
    return legs


def _at(xy: np.ndarray, z: float) -> np.ndarray:
    """(K, 3) points over (K, 2)."""
    return np.column_stack([xy, np.full(len(xy), z)])


def _chair(p: Parameters) -> Draft:
    depth, width, high, thick = p["depth"], p["width"], p["seat_height"], p["seat_thickness"]
    s = stations(9)
    rear, front = width * min(1.0, p["seat_taper"]), width * min(1.0, 2 - p["seat_taper"])
    dish = -p["seat_dish"] * np.sin(np.pi * s)
    seat_path = np.column_stack([depth * (s - 0.5), 0 * s, high - 0.5 * thick + dish])
    seat_width = spline([0.85 * rear, rear, 0.5 * (rear + front), front, 0.8 * front], 9)
    seat = tubes(
        seat_path[None], width=seat_width, height=thick, exponent=p["seat_exponent"], segments=24
    )
    leg = p["leg_thickness"]
    inner = 0.5 * np.array([depth, 0.0]) + [-0.6 * leg - 0.004, 0.0]
    tops = _CORNERS * inner[:1]
    tops = np.column_stack([tops, _CORNERS[:, 1] * (0.5 * np.array([front, rear, rear, front]))])
    tops = tops[:, [0, 2]] * [1.0, 0.86]
    feet = tops + _CORNERS * p["splay"] * high
    legs = _legs(
        _at(tops, high - 0.6 * thick),
        _at(feet, 0.0),
        thick=leg,
        taper=p["leg_taper"],
        exponent=p["leg_exponent"],
        bulge=0.0,
    )
    level = p["stretcher_level"]
    joints = _at(feet + level * (tops - feet), level * (high - 0.6 * thick))
    stretchers = tubes(
        straight(joints, np.roll(joints, -1, axis=0), 4),
        width=0.5 * leg,
        height=0.5 * leg,
        exponent=3.0,
        segments=8,
    )
    # The back: two posts that start in the seat, and slats between them.
    post_thickness = 0.65 * leg + 0.002
    tall, lean, bend = p["back_height"], p["back_lean"], p["back_bend"]
    x = tops[1, 0] + 0.1 * leg
    side = tops[1, 1] * np.array([1.0, 1.0, p["back_spread"]])
    post = np.array(
        [
            [x, 0.0, high - 0.7 * thick],
            [x - 0.5 * (lean - bend) * tall, 0.0, high + 0.5 * tall],
            [x - lean * tall, 0.0, high + tall],
        ]
    )
    posts = spline(np.stack([post + np.outer(side, [0, k, 0]) for k in (1, -1)], axis=1), 11)
    posts = posts.transpose(1, 0, 2)
    back = tubes(
        posts,
        width=post_thickness,
        height=post_thickness,
        exponent=p["leg_exponent"],
        up=(1.0, 0.0, 0.0),
        segments=12,
        caps=(0.001, 0.3 * post_thickness),
    )
    low = p["slat_low"]
    which = (low + (0.94 - low) * np.arange(4) / 3) * 10
    left = np.stack([np.interp(which, np.arange(11), posts[0, :, k]) for k in range(3)], axis=1)
    across = straight(left, left * [1, -1, 1], 9)
    bow = 1 - (2 * stations(9) - 1) ** 2
    across[:, :, 0] -= p["slat_bow"] * width * bow
    across[3, :, 2] += p["crest"] * width * bow
    slat = p["slat_height"] * tall * (0.94 - low) / 3
    slats = tubes(
        across,
        width=0.5 * post_thickness,
        height=slat * np.array([[1.0], [1.0], [1.0], [1.3]]),
        exponent=4.0,
        up=(-lean, 0.0, 1.0),
        segments=12,
    )
    middle = across[2, 4]
    return Draft(
        (
            Part("seat", seat, hulls(seat, segments=24)),
            Part("legs", legs, hulls(legs, 4)),
            Part("stretchers", stretchers, hulls(stretchers, 4, segments=8)),
            Part("posts", back, hulls(back, 2, lengths=2)),
            Part("slats", slats, hulls(slats, 4, lengths=2)),
        ),
        {
            "base": frame((0.0, 0.0, 0.0)),
            "seat": frame((0.0, 0.0, high - p["seat_dish"])),
            "back": frame(middle, x=(1.0, 0.0, lean), z=(-lean, 0.0, 1.0)),
            "leg": frame((*feet[0], 0.0)),
        },
    )


def _board(p: Parameters, z: np.ndarray, scale: np.ndarray, dish: float) -> Surface:
    """A seat or table top: level rings at `z`, of the half width times `scale`."""
    half = 0.5 * p["width"]
    section = superellipse(32, p["exponent"])
    levels = rings(section, half * scale, half * p["ratio"] * scale, z)
    return loft(levels, end=np.array([0.0, 0.0, z[-1] - dish]))


def _frame_of_four(p: Parameters, top: float) -> tuple[Surface, Surface, np.ndarray]:
    """Four legs below z = `top`, four rails between them, and the feet (4, 3)."""
    reach = 0.5 * p["width"] * np.array([1.0, p["ratio"]]) * p["leg_inset"]
    # On a round board corners lie at 45 degrees of the circle, on a square one in the corner.
    corner = _CORNERS * reach * 2.0 ** (-1.0 / p["exponent"])
    feet = corner + _CORNERS * p["splay"] * top
    legs = _legs(
        _at(corner, top),
        _at(feet, 0.0),
        thick=p["leg_thickness"],
        taper=p["leg_taper"],
        exponent=p["leg_exponent"],
        bulge=p["leg_bulge"],
    )
    level = p["rail_level"]
    joints = _at(feet + level * (corner - feet), level * top)
    rails = tubes(
        straight(joints, np.roll(joints, -1, axis=0), 5),
        width=p["rail_thickness"],
        height=p["rail_height"],
        exponent=4.0,
        segments=12,
    )
    return legs, rails, _at(feet, 0.0)


def _stool(p: Parameters) -> Draft:
    high, thick = p["height"], p["board"]
    z = high - thick * np.array([1.0, 0.85, 0.5, 0.15, 0.0])
    scale = np.array([p["lower_edge"] - 0.05, p["lower_edge"], 1.0, 0.98, p["upper_edge"]])
    seat = _board(p, z, scale, p["dish"])
    legs, rails, feet = _frame_of_four(p, high - 0.6 * thick)
    return Draft(
        (
            Part("seat", seat, lambda: [seat.vertices]),
            Part("legs", legs, hulls(legs, 4, lengths=2)),
            Part("rails", rails, hulls(rails, 4)),
        ),
        {
            "base": frame((0.0, 0.0, 0.0)),
            "seat": frame((0.0, 0.0, high - p["dish"])),
            "leg": frame(feet[0]),
        },
    )


def _table(p: Parameters) -> Draft:
    high, thick = p["height"], p["board"]
    z = high - thick * np.array([1.0, 0.95, 0.5, 0.05, 0.0])
    scale = np.array([p["lower_edge"] - 0.03, p["lower_edge"], 1.0, 1.0, 0.97])
    top = _board(p, z, scale, 0.0)
    under = high - 0.6 * thick
    legs, rails, feet = _frame_of_four(p, under)
    inset = 0.5 * p["width"] * p["leg_inset"] * 2.0 ** (-1.0 / p["exponent"])
    reach = inset + (1 - p["shelf_level"]) * p["splay"] * under
    reach_y = inset * p["ratio"] + (1 - p["shelf_level"]) * p["splay"] * under
    level = p["shelf_level"] * under
    shelf = tubes(
        straight([[-reach, 0.0, level]], [[reach, 0.0, level]], 7),
        width=2 * reach_y,
        height=p["shelf_thickness"],
        exponent=10.0,
        segments=16,
    )
    return Draft(
        (
            Part("top", top, lambda: [top.vertices]),
            Part("legs", legs, hulls(legs, 4, lengths=2)),
            Part("rails", rails, hulls(rails, 4)),
            Part("shelf", shelf, hulls(shelf, segments=16)),
        ),
        {
            "base": frame((0.0, 0.0, 0.0)),
            "top": frame((0.0, 0.0, high)),
            "leg": frame(feet[0]),
        },
    )


def _lamp(p: Parameters) -> Draft:
    foot_high, foot = p["foot_height"], p["foot_radius"]
    z = foot_high * np.array([0.0, 0.15, 0.45, 0.7, 0.9, 1.0])
    scale = spline([0.96, 1.0, 1.0, p["foot_dome"], 0.5 * p["foot_dome"], 0.25], 6)
    levels = rings(superellipse(32, p["foot_exponent"]), foot * scale, foot * scale, z)
    base = loft(levels)
    high, reach = p["height"], p["reach"]
    path = spline(
        [
            [0.0, 0.0, 0.5 * foot_high],
            [-p["sway"], 0.0, 0.45 * high],
            [-p["sway"], 0.0, 0.85 * high],
            [0.5 * reach, 0.0, high * (1 + p["arch"])],
            [reach, 0.0, high],
        ],
        17,
    )
    pole = p["pole"]
    stem = tubes(
        path[None], width=pole, height=pole * p["pole_ratio"], up=(0.0, 1.0, 0.0), segments=12
    )
    tall, wide = p["shade_height"], p["shade_radius"]
    top = wide * p["shade_top"]
    radius = spline([wide, wide + p["shade_flare"] * wide, top, top], 10)
    s = stations(10)
    section = superellipse(32, p["shade_exponent"])
    wall = 0.0025
    X = frame(
        path[-1] + [0.0, 0.0, 0.3 * pole],
        x=(np.cos(p["tilt"]), 0.0, -np.sin(p["tilt"])),
        z=(np.sin(p["tilt"]), 0.0, np.cos(p["tilt"])),
    )
    down = np.array([0.0, 0.0, tall - 0.5 * wall])  # the crown is at the stem's end
    outer = rings(section, radius, radius, s * tall) - down
    inner = rings(section, radius - wall, radius - wall, s * (tall - wall)) - down
    outer, inner = (ring @ X[:3, :3].T + X[:3, 3] for ring in (outer, inner))
    shade = dome(outer, inner)

    opening = X.copy()
    opening[:3, 3] = outer[0].mean(axis=0)
    opening[:3, 1:3] *= -1.0
    return Draft(
        (
            Part("foot", base, lambda: [base.vertices]),
            Part("stem", stem, hulls(stem, lengths=6)),
            Part("shade", shade, wall_hulls(shade, 10, sectors=16, cuts=(0, 5, 9), domed=True)),
        ),
        {
            "base": frame((0.0, 0.0, 0.0)),
            "stem": frame(path[8], x=(1.0, 0.0, 0.0)),
            "shade": opening,
        },
    )


FURNITURE = (
    Family(
        "chair",
        {
            "depth": (0.10, 0.15),
            "width": (0.10, 0.16),
            "seat_height": (0.07, 0.14),
            "seat_thickness": (0.006, 0.025),
            "seat_taper": (0.75, 1.15),
            "seat_dish": (0.0, 0.004),
            "seat_exponent": (3.5, 9.0),
            "leg_thickness": (0.008, 0.018),
            "leg_taper": (0.45, 1.1),
            "leg_exponent": (2.0, 6.0),
            "splay": (0.0, 0.18),
            "stretcher_level": (0.15, 0.75),
            "back_height": (0.06, 0.165),
            "back_lean": (0.0, 0.35),
            "back_bend": (-0.1, 0.1),
            "back_spread": (0.75, 1.25),
            "slat_low": (0.1, 0.6),
            "slat_height": (0.25, 1.05),
            "slat_bow": (0.0, 0.12),
            "crest": (-0.05, 0.12),
        },
        _chair,
        density=500.0,
    ),
    Family(
        "stool",
        {
            "width": (0.10, 0.18),
            "ratio": (0.65, 1.0),
            "exponent": (2.0, 7.0),
            "height": (0.08, 0.26),
            "board": (0.008, 0.035),
            "lower_edge": (0.7, 1.0),
            "upper_edge": (0.8, 0.95),
            "dish": (0.0, 0.005),
            "leg_inset": (0.5, 0.82),
            "leg_thickness": (0.008, 0.02),
            "leg_taper": (0.45, 1.2),
            "leg_bulge": (-0.2, 0.35),
            "leg_exponent": (2.0, 6.0),
            "splay": (0.0, 0.22),
            "rail_level": (0.15, 0.8),
            "rail_thickness": (0.003, 0.009),
            "rail_height": (0.003, 0.014),
        },
        _stool,
        symmetry=Symmetry("z", 2),
        density=500.0,
    ),
    Family(
        "table",
        {
            "width": (0.18, 0.3),
            "ratio": (0.45, 1.0),
            "exponent": (2.0, 12.0),
            "height": (0.08, 0.22),
            "board": (0.006, 0.022),
            "lower_edge": (0.88, 1.0),
            "leg_inset": (0.55, 0.85),
            "leg_thickness": (0.009, 0.024),
            "leg_taper": (0.4, 1.1),
            "leg_bulge": (-0.15, 0.3),
            "leg_exponent": (2.0, 6.0),
            "splay": (0.0, 0.15),
            "rail_level": (0.75, 0.93),
            "rail_thickness": (0.004, 0.008),
            "rail_height": (0.006, 0.022),
            "shelf_level": (0.1, 0.6),
            "shelf_thickness": (0.003, 0.01),
        },
        _table,
        symmetry=Symmetry("z", 2),
        density=450.0,
    ),
    Family(
        "lamp",
        {
            "foot_radius": (0.035, 0.065),
            "foot_height": (0.01, 0.035),
            "foot_dome": (0.3, 1.0),
            "foot_exponent": (2.0, 6.0),
            "height": (0.16, 0.25),
            "reach": (0.0, 0.11),
            "sway": (-0.01, 0.05),
            "arch": (0.0, 0.15),
            "pole": (0.007, 0.018),
            "pole_ratio": (0.7, 1.3),
            "shade_height": (0.04, 0.085),
            "shade_radius": (0.035, 0.065),
            "shade_top": (0.35, 0.95),
            "shade_flare": (-0.2, 0.1),
            "shade_exponent": (2.0, 5.0),
            "tilt": (-0.5, 0.6),
        },
        _lamp,
        density=600.0,
    ),
)
