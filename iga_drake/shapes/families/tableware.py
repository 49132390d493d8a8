"""Tableware: glass, plate, candle holder, spoon, ladle, and the bowl and pan of the tasks.

All but the spoon stand upright on z = 0 with the body's axis on z; a handle is at +x. Frames: base
(below), opening (its z out of the opening), handle (in its middle, x away from the body), tip or
bowl of a spoon (z out of the hollow).
"""

import numpy as np

from iga_drake.shapes import surfaces
from iga_drake.shapes.families import bowl, pan
from iga_drake.shapes.families.attachments import in_plane, leaf, ring_handle, swept
from iga_drake.shapes.families.turned import outline, solid, vessel
from iga_drake.shapes.family import Draft, Family, Parameters
from iga_drake.shapes.instance import frame
from iga_drake.shapes.symmetry import Symmetry

# The tasks' bowls and pans have narrower ranges: what a hand can take.
BOWL = Family(
    "bowl",
    {
        "diameter": (0.1, 0.22),
        "height_ratio": (0.28, 0.62),
        "base_ratio": (0.3, 0.7),
        "bulge": (0.0, 1.0),
        "lean": (0.0, 0.65),
        "wall": (0.0025, 0.006),
        "foot_height": (0.001, 0.012),
        "foot_width": (0.003, 0.009),
    },
    bowl.draft,
    symmetry=Symmetry("z", 0),
    density=1500.0,
)
PAN = Family(
    "pan",
    {
        "diameter": (0.1, 0.19),
        "height": (0.03, 0.07),
        "base_ratio": (0.62, 0.97),
        "bulge": (0.0, 1.0),
        "wall": (0.0025, 0.0045),
        "handle_length": (0.07, 0.14),
        "handle_width": (0.012, 0.032),
        "handle_height": (0.009, 0.022),
        "handle_taper": (0.6, 1.5),
        "handle_tilt": (0.0, 0.5),
        "handle_curve": (-0.5, 0.4),
        "handle_exponent": (2.0, 7.0),
    },
    pan.draft,
    density=1800.0,
)


def _glass(p: Parameters) -> Draft:
    h, cup = p["height"], p["radius"]
    rise = p["stem_height"] * h
    stem = p["stem_ratio"] * 0.5 * cup
    foot = max(p["foot_ratio"] * cup, stem + 0.004)
    slope = p["foot_slope"] * foot
    underside = np.concatenate(
        [
            [[0.5 * foot, 0.0], [foot - 0.001, 0.0], [foot, 0.001]],
            outline(
                [0.003, 0.003 + 0.4 * slope, 0.005 + slope, 0.5 * rise, rise, rise + 0.008],
                [foot - 0.002, 0.55 * foot + 0.45 * stem, stem, stem * p["waist"], stem, stem],
                9,
            ),
        ]
    )
    low = underside[-1, 1] + 0.001
    at = p["belly_height"]
    wall = outline(
        low + (h - low) * np.array([0.0, 0.06, at, 0.5 + 0.5 * at, 0.92, 1.0]),
        [
            stem + 0.001,
            stem + p["fill"] * (cup - stem),
            cup * p["belly_ratio"],
            0.5 * cup * (1 + p["belly_ratio"]),
            cup,
            cup * (1 + p["flare"]),
        ],
        48,
    )
    body = vessel(
        wall,
        thickness=p["wall"],
        base_thickness=p["base_thickness"],
        underside=underside,
        segments=32,
    )
    stem_top = len(underside) - 1
    frames = {
        "base": frame((0.0, 0.0, 0.0)),
        "opening": frame((0.0, 0.0, body.top)),
        "rim": frame((cup * (1 + p["flare"]), 0.0, body.top)),
        "stem": frame((0.0, 0.0, 0.5 * (rise + 0.008))),
    }
    return Draft((body.part(base_cuts=(0, 4, 6, stem_top)),), frames)


GLASS = Family(
    "glass",
    {
        "height": (0.1, 0.2),
        "radius": (0.028, 0.048),
        "stem_height": (0.06, 0.5),
        "stem_ratio": (0.2, 1.5),
        "waist": (0.8, 1.15),
        "foot_ratio": (0.7, 1.05),
        "foot_slope": (0.0, 0.2),
        "belly_height": (0.3, 0.65),
        "belly_ratio": (0.75, 1.35),
        "fill": (0.15, 0.9),
        "flare": (-0.12, 0.3),
        "wall": (0.0018, 0.0032),
        "base_thickness": (0.003, 0.012),
    },
    _glass,
    symmetry=Symmetry("z", 0),
    density=1800.0,
)


def _plate(p: Parameters) -> Draft:
    rim = p["diameter"] / 2
    base = p["base_ratio"] * rim
    h = p["height_ratio"] * rim
    foot = p["foot_height"]
    well = base + p["well"] * (rim - base)
    level = foot + p["well_height"] * (h - foot)
    wall = outline(
        [foot, foot + 0.0005, 0.5 * (foot + level), level, 0.5 * (level + h), h],
        [base, 0.6 * base + 0.4 * well, well, well, 0.5 * (well + rim), rim],
        48,
    )
    width = p["foot_width"]
    underside = np.array(
        [
            [0.5 * (base - width), foot - 0.0003],
            [base - width, foot - 0.0003],
            [base - 0.8 * width, 0.0],
            [base - 0.2 * width, 0.0],
        ]
    )
    body = vessel(
        wall,
        thickness=p["wall"],
        base_thickness=p["wall"],
        underside=underside,
        exponent=max(2.0, p["exponent"]),
    )
    frames = {
        "base": frame((0.0, 0.0, 0.0)),
        "opening": frame((0.0, 0.0, body.top)),
        "rim": frame((rim, 0.0, body.top)),
        "floor": frame((0.0, 0.0, foot + p["wall"])),
    }
    return Draft((body.part(),), frames)


PLATE = Family(
    "plate",
    {
        "diameter": (0.14, 0.28),
        "base_ratio": (0.45, 0.75),
        "height_ratio": (0.12, 0.4),
        "well": (0.05, 0.7),
        "well_height": (0.25, 0.95),
        "wall": (0.003, 0.006),
        "foot_height": (0.001, 0.0045),
        "foot_width": (0.004, 0.01),
        "exponent": (0.5, 5.0),  # of the section; at most 2: round
    },
    _plate,
    symmetry=Symmetry("z", 4),
    density=1800.0,
)


def _candle_holder(p: Parameters) -> Draft:
    rim = p["radius"]
    h = p["height_ratio"] * rim
    base = p["base_ratio"] * rim
    wall = outline(
        np.array([0.0, 0.05, 0.4, 0.8, 1.0]) * h,
        [base - 0.002, base, 0.5 * (base + rim) + 0.1 * rim, rim, rim * (1 + p["flare"])],
        40,
    )
    dish = vessel(wall, thickness=p["wall"], base_thickness=0.003, points=10)
    post, collar = p["post_radius"], p["post_radius"] + p["collar"]
    tall = 0.002 + p["post_height"]
    candle = min(p["candle_radius"], post - 0.001)
    top = tall + p["candle_height"]
    middle = solid(
        ("post", "candle"),
        [
            outline(
                [0.002, 0.25 * tall, 0.5 * tall, 0.8 * tall, tall - 0.002, tall],
                [1.3 * post, post, post * p["post_waist"], post, collar, collar],
                12,
            ),
            np.array(
                [
                    [candle + 0.0006, tall + 0.0004],
                    [candle, tall + 0.001],
                    [candle, top],
                    [0.85 * candle, top + 0.002],
                    [0.3 * candle, top + 0.003],
                ]
            ),
        ],
        segments=24,
    )
    # A finger ring that meets the wall below its middle and stays off the table.
    inner = dish.anchor(0.8 * h).point
    loop, thickness = p["ring_radius"], p["ring_thickness"]
    tall_loop = p["ring_height"] * loop
    least = 1.0 - (inner[1] - 0.5 * thickness - 0.0005) / tall_loop
    lift = max(p["ring_lift"], np.arcsin(np.clip(least, -1.0, 1.0)))
    centre = inner + [loop * np.cos(lift), tall_loop * np.sin(lift)]
    angle = np.linspace(0.0, 2 * np.pi, 24, endpoint=False)
    ring = in_plane(centre + np.column_stack([loop * np.cos(angle), tall_loop * np.sin(angle)]))
    handle = ring_handle("handle", ring, width=thickness, height=p["ring_breadth"])
    frames = {
        "base": frame((0.0, 0.0, 0.0)),
        "opening": frame((0.0, 0.0, tall)),
        "candle_tip": frame((0.0, 0.0, top + 0.003)),
        "handle": frame(np.array([centre[0] + loop, 0.0, centre[1]])),
    }
    return Draft((dish.part(), middle, handle), frames)


CANDLE_HOLDER = Family(
    "candle_holder",
    {
        "radius": (0.035, 0.065),
        "height_ratio": (0.36, 0.8),
        "base_ratio": (0.5, 0.95),
        "flare": (0.0, 0.25),
        "wall": (0.002, 0.004),
        "post_radius": (0.009, 0.014),
        "post_height": (0.015, 0.07),
        "post_waist": (0.5, 1.2),
        "collar": (0.0, 0.01),
        "candle_radius": (0.005, 0.013),
        "candle_height": (0.01, 0.11),
        "ring_radius": (0.017, 0.028),
        "ring_lift": (-0.1, 1.2),
        "ring_height": (0.65, 1.05),
        "ring_thickness": (0.005, 0.01),
        "ring_breadth": (0.006, 0.014),
    },
    _candle_holder,
    density=900.0,
)


def _spoon(p: Parameters) -> Draft:
    length, half = p["bowl_length"], 0.5 * p["bowl_width"]
    depth = p["bowl_depth"] * half
    count, around = 17, 20
    t = np.linspace(0.0, 1.0, count)
    u = (1 - np.cos(np.pi * t)) / 2
    egg = np.sqrt(np.maximum(u * (1 - u), 0.0)) * 2
    width = half * egg * (1 + p["bowl_taper"] * (0.5 - u))
    width = np.maximum(width, 0.0015)
    # Sections across x: an upper and a lower arc, both hollow upwards, a wall apart.
    angle = np.arange(around) * (2 * np.pi / around)
    side = np.cos(angle)
    fall = depth * np.outer((width / half) ** p["bowl_section"], side**2 - 1.0)
    wall = p["wall"] * (0.35 + 0.65 * np.minimum(1.0, width / half))
    rings = np.empty((count, around, 3))
    rings[..., 0] = -length * u[:, None]
    rings[..., 1] = -width[:, None] * side
    rings[..., 2] = fall + 0.5 * wall[:, None] * np.sin(angle)
    rings[..., 2] += p["tip_rise"] * depth * (u[:, None] ** 3)
    hollow = leaf("bowl", rings)
    reach = p["handle_length"]
    start = np.array([-0.06 * length, 0.0])
    control = np.array(
        [
            start,
            [0.15 * reach, p["neck_rise"] * 0.15 * reach],
            [0.35 * reach, p["handle_arch"] * reach],
            [0.75 * reach, p["handle_arch"] * reach + 0.4 * p["end_rise"] * reach],
            [reach, p["end_rise"] * reach],
        ]
    )
    path = in_plane(surfaces.resample(surfaces.bspline(control, 54), 18))
    s = np.linspace(0.0, 1.0, len(path))
    neck, end = p["neck_width"], p["end_width"]
    broad = neck + (end - neck) * s ** p["end_start"]
    thick = p["handle_thickness"] * (1 - 0.35 * s)
    handle = swept(
        "handle", path, width=thick, height=broad, exponent=p["handle_exponent"],
        caps=(0.001, 0.35 * end), segments=12,
    )  # fmt: skip
    lowest = float(min(hollow.surface.vertices[:, 2].min(), handle.surface.vertices[:, 2].min()))
    middle = path[11]
    frames = {
        "bowl": frame((-0.5 * length, 0.0, 0.0)),
        "tip": frame(rings[-1].mean(axis=0), x=(-1.0, 0.0, 0.0)),
        "handle": frame(middle, x=path[12] - path[10]),
        "base": frame((-0.5 * length, 0.0, lowest)),
    }
    return Draft((hollow, handle), frames)


SPOON = Family(
    "spoon",
    {
        "bowl_length": (0.045, 0.085),
        "bowl_width": (0.03, 0.06),
        "bowl_depth": (0.4, 0.95),
        "bowl_taper": (-0.5, 0.6),
        "bowl_section": (0.8, 1.8),
        "tip_rise": (-0.5, 0.5),
        "wall": (0.0025, 0.005),
        "handle_length": (0.08, 0.19),
        "handle_arch": (0.02, 0.2),
        "neck_rise": (0.0, 0.6),
        "end_rise": (-0.12, 0.3),
        "neck_width": (0.005, 0.012),
        "end_width": (0.008, 0.028),
        "end_start": (0.8, 3.0),
        "handle_thickness": (0.004, 0.01),
        "handle_exponent": (2.0, 4.0),
    },
    _spoon,
    density=3000.0,
)


def _ladle(p: Parameters) -> Draft:
    rim = p["cup_radius"]
    h = p["cup_depth"] * rim
    base = p["base_ratio"] * rim
    wall = outline(
        np.array([0.0, 0.02, 0.3, 0.7, 1.0]) * h,
        [base, 0.5 * (base + rim), rim * p["belly_ratio"], rim, rim],
        40,
    )
    cup = vessel(
        wall, thickness=p["wall"], base_thickness=p["wall"], ratio=p["oval"], points=12,
        segments=32,
    )  # fmt: skip
    root = cup.anchor(0.85 * h).point
    lean = p["lean"]
    along, across = np.array([np.sin(lean), np.cos(lean)]), np.array([np.cos(lean), -np.sin(lean)])
    length = p["handle_length"]
    end = root + length * along
    hook = p["hook"] * length
    control = np.array(
        [
            root,
            root + 0.006 * np.array([1.0, 0.3]) + 0.1 * length * along,
            root + 0.5 * length * along + p["bow"] * length * across,
            end - 0.05 * length * along,
            end + 0.5 * hook * along,
            end + hook * (0.4 * along + p["hook_side"] * across),
        ]
    )
    path = in_plane(surfaces.resample(surfaces.bspline(control, 60), 20))
    s = np.linspace(0.0, 1.0, len(path))
    broad = p["neck_width"] + (p["end_width"] - p["neck_width"]) * s ** p["end_start"]
    handle = swept(
        "handle", path, width=p["handle_thickness"], height=broad, exponent=2.6,
        caps=(0.0005, 0.3 * p["end_width"]),
    )  # fmt: skip
    frames = {
        "base": frame((0.0, 0.0, 0.0)),
        "opening": frame((0.0, 0.0, cup.top)),
        "handle": frame(path[11], x=path[12] - path[10], z=(1.0, 0.0, 0.0)),
        "tip": frame(path[-1], x=path[-1] - path[-2], z=(1.0, 0.0, 0.1)),
    }
    return Draft((cup.part(), handle), frames)


LADLE = Family(
    "ladle",
    {
        "cup_radius": (0.022, 0.045),
        "cup_depth": (0.5, 1.2),
        "base_ratio": (0.25, 0.6),
        "belly_ratio": (0.8, 1.15),
        "oval": (0.7, 1.0),
        "wall": (0.0018, 0.003),
        "handle_length": (0.1, 0.2),
        "lean": (0.0, 1.1),
        "bow": (-0.08, 0.12),
        "hook": (0.0, 0.2),
        "hook_side": (-1.0, 1.0),
        "neck_width": (0.006, 0.012),
        "end_width": (0.008, 0.026),
        "end_start": (0.6, 3.0),
        "handle_thickness": (0.004, 0.009),
    },
    _ladle,
    density=2000.0,
)

TABLEWARE = (BOWL, PAN, GLASS, PLATE, CANDLE_HOLDER, SPOON, LADLE)
