"""Toys and fixtures: airplane, car, guitar and tap. They stand on z = 0.

Frames: `nose`, `tail`, `front` and `rear` at the ends of an airplane or car, x outwards; `wing` at
the end of a wing and `wheel` in the middle of a wheel's outside, x outwards; `roof` on a car's
cabin, z up; `neck` in the middle of a guitar's neck, x along it to the head; `bridge` and `body` on
its front, x off it; `spout` in a tap's outlet, x out of it; `lever` at the end of its lever, x
outwards; `base` on the ground.
"""

from itertools import pairwise

import numpy as np

from iga_drake.shapes.families.blocks import (
    closed_outline,
    hulls,
    rings,
    spline,
    stand,
    stations,
    straight,
    tubes,
)
from iga_drake.shapes.family import Draft, Family, Parameters, Part
from iga_drake.shapes.instance import frame
from iga_drake.shapes.surfaces import Surface, loft, loft_face_bands, superellipse
from iga_drake.shapes.symmetry import Symmetry


def _wing(
    root: np.ndarray, span: float, chord: float, p: Parameters, *, dihedral: float, sweep: float
) -> tuple[Surface, np.ndarray]:
    """A wing across y about `root`, `chord` long in the middle, and its tip at +y."""
    s = np.linspace(-1, 1, 17)
    away = np.abs(s)
    path = root + np.stack([-sweep * span * away, 0.5 * span * s, dihedral * span * away], axis=1)
    long = chord * (1 - (1 - p["wing_taper"]) * away)
    # Sections are cut across the path's mean direction y, so that both halves are mirrored.
    wing = tubes(
        path[None],
        width=long,
        height=np.maximum(p["wing_thickness"] * long, 0.003),
        segments=14,
        exponent=2.0,
        caps=(0.003, 0.003),
    )
    return wing, path[-1]


def _toy_airplane(p: Parameters) -> Draft:
    long, wide = p["length"], p["fuselage"]
    s = stations(24)
    swell = spline([p["nose"], 1.0, 1.0, p["waist"], p["tail"], 0.6 * p["tail"]], 24)
    z = p["tail_lift"] * wide * s**2
    path = np.stack([long * (0.45 - s), 0 * s, z], axis=1)
    body = tubes(
        path[None],
        width=wide * swell,
        height=wide * p["fuselage_ratio"] * swell,
        exponent=p["fuselage_exponent"],
        segments=18,
        caps=(0.3 * wide, 0.1 * wide),
    )
    root = np.array([long * p["wing_at"], 0.0, p["wing_level"] * 0.35 * wide])
    wings, tip = _wing(
        root,
        p["span"],
        p["chord"],
        p,
        dihedral=p["dihedral"],
        sweep=p["sweep"],
    )
    aft = path[-2] + [0.0, 0.0, 0.1 * wide * p["tail"]]
    tail, _ = _wing(
        aft,
        p["tail_span"] * p["span"],
        0.55 * p["chord"],
        p,
        dihedral=0.0,
        sweep=p["sweep"],
    )
    high = p["fin_height"]
    fin_path = spline(
        [aft, aft + [-0.1 * high, 0, 0.5 * high], aft + [-p["fin_sweep"] * high, 0, high]], 8
    )
    fin = tubes(
        fin_path[None],
        width=0.55 * p["chord"] * np.linspace(1.1, p["wing_taper"], 8),
        height=0.005,
        up=(0.0, 1.0, 0.0),
        segments=12,
        caps=(0.001, 0.004),
    )
    # An engine under each wing; small ones are all but hidden in it.
    away = 0.55
    out = 0.5 * away * p["span"]
    centre = root + [
        -p["sweep"] * p["span"] * away + 0.2 * p["chord"],
        0.0,
        p["dihedral"] * p["span"] * away - 0.4 * p["engine"],
    ]
    t = stations(8)
    lines = straight(
        [centre + [-0.3 * p["chord"], side * out, 0.0] for side in (1, -1)],
        [centre + [0.3 * p["chord"], side * out, 0.0] for side in (1, -1)],
        8,
    )
    engines = tubes(
        lines,
        width=p["engine"] * (0.75 + 0.25 * np.sin(np.pi * t)),
        height=p["engine"] * (0.75 + 0.25 * np.sin(np.pi * t)),
        segments=14,
        caps=(0.002, 0.002),
    )
    return stand(
        Draft(
            (
                Part("fuselage", body, hulls(body, segments=18, lengths=6)),
                Part("wings", wings, hulls(wings, segments=14, lengths=2)),
                Part("tailplane", tail, hulls(tail, segments=14, lengths=2)),
                Part("fin", fin, hulls(fin, lengths=2)),
                Part("engines", engines, hulls(engines, 2, segments=14)),
            ),
            {
                "nose": frame(path[0] + [0.3 * wide, 0.0, 0.0]),
                "tail": frame(aft - [0.3 * p["chord"], 0.0, 0.0], x=(-1.0, 0.0, 0.0)),
                "wing": frame(tip, x=(0.0, 1.0, 0.0)),
            },
        )
    )


def _toy_car(p: Parameters) -> Draft:
    long, wide, high = p["length"], p["width"], p["body_height"]
    wheel = p["wheel"]
    s = stations(24)
    top = high * spline([p["rear_end"], 1.0, 1.0, p["hood"], p["hood"], p["front_end"]], 24)
    floor = 0.55 * wheel - p["drop"] * wheel * 4 * s * (1 - s) * 0.3
    path = np.stack([long * (s - 0.5), 0 * s, floor + 0.5 * top], axis=1)
    body = tubes(
        path[None],
        width=wide * spline([p["tail_width"], 1.0, 1.0, 1.0, p["nose_width"]], 24),
        height=top,
        exponent=p["exponent"],
        segments=20,
        caps=(0.004, 0.004),
    )
    cabin_long, cabin_high = p["cabin_length"] * long, p["cabin_height"]
    middle = p["cabin_at"] * long
    base_z = floor[12] + 0.8 * high
    section = superellipse(28, 4.0)
    t = stations(7)
    scale = spline([1.0, 0.97, 0.5 * (1 + p["cabin_taper"]), p["cabin_taper"]], 7)
    levels = rings(section, 0.5 * cabin_long * scale, 0.46 * wide * scale, base_z + t * cabin_high)
    levels[..., 0] += middle + (p["rake"] * cabin_high * t)[:, None]
    cabin = loft(levels)
    axle = p["axles"] * np.array([1.0, -0.95]) * long
    y = 0.5 * wide - 0.4 * p["tyre"]
    places = [[x, side * y, 0.5 * wheel] for x in axle for side in (1, -1)]
    outside = [[x, side * (y + p["tyre"]), 0.5 * wheel] for x in axle for side in (1, -1)]
    round_ = wheel * np.array([0.94, 1.0, 1.0, 0.95, 0.7])
    wheels = tubes(
        straight(places, outside, 5),
        width=round_ * np.array([[1.0], [1.0], [p["rear_wheel"]], [p["rear_wheel"]]]),
        height=round_ * np.array([[1.0], [1.0], [p["rear_wheel"]], [p["rear_wheel"]]]),
        segments=20,
    )
    # Rear wheels of another size stand on the same ground.
    wheels.vertices.reshape(4, -1, 3)[2:, :, 2] += 0.5 * wheel * (p["rear_wheel"] - 1)
    spoiler_x = -0.47 * long
    wing = tubes(
        straight(
            [[spoiler_x, -0.4 * wide, 0.0]],
            [[spoiler_x, 0.4 * wide, 0.0]],
            5,
        )
        + [0.0, 0.0, floor[0] + top[2] + p["spoiler"] - 0.004],
        width=0.1 * long,
        height=0.006 + 1.2 * p["spoiler"],
        exponent=4.0,
        segments=12,
    )
    return stand(
        Draft(
            (
                Part("body", body, hulls(body, segments=20, lengths=6)),
                Part("cabin", cabin, hulls(cabin, segments=28, lengths=2)),
                Part("wheels", wheels, hulls(wheels, 4, segments=20)),
                Part("spoiler", wing, hulls(wing)),
            ),
            {
                "front": frame(path[-1] + [0.004, 0.0, 0.0]),
                "rear": frame(path[0] - [0.004, 0.0, 0.0], x=(-1.0, 0.0, 0.0)),
                "roof": frame(levels[-1].mean(axis=0)),
                "wheel": frame(np.array(outside[0]), x=(0.0, 1.0, 0.0)),
            },
        )
    )


_GUITAR_ROUND, _GUITAR_RINGS = 44, 9


def _guitar(p: Parameters) -> Draft:
    # The neck up along z, the front towards +x, the body across y.
    tall, wide, deep = p["body_length"], p["body_width"], p["depth"]
    widths = wide * np.array([0.5, 1.0, 1.1, p["waist"], p["upper"], p["upper"], 0.3])
    plan, t = closed_outline(tall, widths.tolist(), _GUITAR_ROUND)
    # A cutaway beside the neck, on the side at +y.
    cut = np.where(plan[:, 1] > 0, np.exp(-(((t - 0.92) / 0.09) ** 2)), 0.0)
    plan = plan * np.column_stack([np.ones_like(t), 1 - p["cutaway"] * cut])
    edge = min(p["edge"], 0.4 * deep)
    x = np.concatenate([[0.0, 0.3], np.linspace(1.0, 0.5 * deep / edge, 3)]) * edge - 0.5 * deep
    x = np.concatenate([x, -x[-2::-1]])
    scale = 1 - edge / wide * np.array([2.0, 0.6, 0, 0, 0, 0, 0, 0.6, 2.0])
    levels = np.empty((_GUITAR_RINGS, _GUITAR_ROUND, 3))
    levels[..., 0] = x[:, None]
    # Counterclockwise seen from +x: y, then z.
    levels[..., 1] = -plan[:, 1] * scale[:, None]
    levels[..., 2] = plan[:, 0] * scale[:, None] + 0.5 * tall
    levels[..., 0] -= 0.3 * p["arch"] * (levels[..., 2] / tall - 0.5) * deep
    body = loft(levels)
    neck, thick = p["neck_length"], p["neck_width"]
    front = 0.5 * deep
    start = np.array([front - 0.002, 0.0, 0.8 * tall])
    end = np.array([front - 0.002, 0.0, tall + neck])
    stem = tubes(
        straight([start], [end], 14),
        width=thick * np.linspace(1.15, 0.9, 14),
        height=0.6 * thick,
        exponent=2.6,
        up=(1.0, 0.0, 0.0),
        segments=14,
    )
    head, tilt = p["head_length"], p["head_tilt"]
    line = end + head * stations(7)[:, None] * [-np.sin(tilt), 0.0, np.cos(tilt)]
    head_width = thick * spline([0.95, p["head_width"], p["head_width"], p["head_end"]], 7)
    headstock = tubes(
        (line - [0.0, 0.0, 0.004])[None],
        width=head_width,
        height=0.007,
        exponent=5.0,
        up=(1.0, 0.0, 0.0),
        segments=14,
        caps=(0.001, 0.002),
    )
    pegs_at = line[[2, 3, 5]]
    half = 0.5 * head_width[[2, 3, 5]]
    roots = np.concatenate([pegs_at + half[:, None] * [0, s * 0.8, 0] for s in (1, -1)])
    tips = np.concatenate([pegs_at + (half + p["peg"])[:, None] * [0, s, 0] for s in (1, -1)])
    pegs = tubes(
        straight(roots, tips, 4),
        width=0.005 * np.array([0.7, 0.7, 1.2, 1.2]),
        height=0.005 * np.array([0.7, 0.7, 1.0, 1.0]),
        segments=8,
    )
    bridge_z = p["bridge_at"] * tall
    lean = 0.3 * p["arch"] * deep * (p["bridge_at"] - 0.5)
    bridge = tubes(
        straight(
            [[front - lean, -0.5 * p["bridge"] * wide, bridge_z]],
            [[front - lean, 0.5 * p["bridge"] * wide, bridge_z]],
            5,
        ),
        width=0.010,
        height=0.012,
        exponent=3.0,
        up=(1.0, 0.0, 0.0),
        segments=12,
    )
    band = loft_face_bands(_GUITAR_RINGS, _GUITAR_ROUND)
    return stand(
        Draft(
            (
                Part(
                    "body",
                    body,
                    lambda: _outline_pieces(body.vertices, _GUITAR_ROUND),
                    bands=(("back", "side", "front"), np.repeat([0, 1, 2], [2, 6, 2])[band]),
                ),
                Part("neck", stem, hulls(stem, segments=14)),
                Part("head", headstock, hulls(headstock, segments=14)),
                Part("pegs", pegs, hulls(pegs, 6, segments=8)),
                Part("bridge", bridge, hulls(bridge)),
            ),
            {
                "base": frame((0.0, 0.0, 0.0)),
                "neck": frame(
                    (front, 0.0, tall + 0.5 * neck), x=(0.0, 0.0, 1.0), z=(1.0, 0.0, 0.0)
                ),
                "bridge": frame((front - lean + 0.006, 0.0, bridge_z)),
                "body": frame((front, 0.0, 0.5 * tall)),
            },
        )
    )


def _outline_pieces(vertices: np.ndarray, segments: int, lengths: int = 7) -> list[np.ndarray]:
    """Convex pieces of a body lofted from an `outline`, cut across the outline's length."""
    levels = vertices[1:-1].reshape(-1, segments, 3)
    cuts = np.linspace(0, segments // 2, lengths + 1).round().astype(int)
    pieces = []
    for a, b in pairwise(cuts):
        side = np.arange(a, b + 1)
        pieces.append(levels[:, np.concatenate([side, -side])].reshape(-1, 3))
    return pieces


def _tap(p: Parameters) -> Draft:
    foot, high = p["foot"], p["height"]
    flange = 0.5 * foot
    z = p["flange"] * np.array([0.0, 0.2, 0.8, 1.0])
    scale = np.array([0.98, 1.0, 1.0, 0.85])
    section = superellipse(28, p["exponent"])
    base = loft(rings(section, flange * scale, flange * scale, z))
    wide = p["column"] * foot
    swell = spline([1.0, p["waist"], p["waist"], 1.0, 0.9], 14)
    column = tubes(
        straight([[0, 0, 0.5 * p["flange"]]], [[0, 0, high]], 14),
        width=wide * swell,
        height=wide * swell,
        exponent=p["exponent"],
        up=(1.0, 0.0, 0.0),
        segments=20,
        caps=(0.001, 0.12 * wide),
    )
    reach, rise, fall = p["reach"], p["rise"], p["fall"]
    start = np.array([0.0, 0.0, p["spout_at"] * high])
    line = spline(
        [
            start,
            start + [0.3 * reach, 0.0, 0.6 * rise],
            start + [0.55 * reach, 0.0, 1.3 * rise],
            start + [reach, 0.0, 1.3 * rise],
            start + [reach, 0.0, rise - 0.4 * fall],
            start + [reach, 0.0, rise - fall],
        ],
        24,
    )
    bore = p["spout"] * wide
    thick = bore * np.interp(stations(24), [0, 0.85, 0.9, 1], [1.15, 1, p["nozzle"], p["nozzle"]])
    spout = tubes(
        line[None],
        width=thick,
        height=thick,
        exponent=p["spout_exponent"],
        up=(0.0, 1.0, 0.0),
        segments=16,
        caps=(0.001, 0.001),
    )
    long, tilt, turn = p["lever"], p["lever_tilt"], p["lever_turn"]
    out = np.array([-np.cos(tilt) * np.cos(turn), -np.cos(tilt) * np.sin(turn), np.sin(tilt)])
    at = np.array([0.0, 0.0, high])
    arm = spline([at, at + 0.4 * long * out + [0, 0, 0.006], at + long * out], 12)
    grip = p["lever_width"]
    lever = tubes(
        arm[None],
        width=grip * spline([0.9, 0.8, 1.0, p["lever_end"]], 12),
        height=0.55 * grip * spline([1.3, 0.8, 0.8, 0.8], 12),
        exponent=3.0,
        segments=14,
        caps=(0.001, 0.3 * grip),
    )
    return Draft(
        (
            Part("foot", base, lambda: [base.vertices]),
            Part("column", column, hulls(column, segments=20, lengths=3)),
            Part("spout", spout, hulls(spout, segments=16, lengths=8)),
            Part("lever", lever, hulls(lever, segments=14, lengths=3)),
        ),
        {
            "base": frame((0.0, 0.0, 0.0)),
            "spout": frame(line[-1], x=line[-1] - line[-2], z=(1.0, 0.0, 0.05)),
            "lever": frame(arm[-1], x=out),
        },
    )


TOYS = (
    Family(
        "toy_airplane",
        {
            "length": (0.15, 0.25),
            "fuselage": (0.022, 0.05),
            "fuselage_ratio": (0.8, 1.3),
            "fuselage_exponent": (2.0, 4.0),
            "nose": (0.3, 0.9),
            "waist": (0.6, 1.0),
            "tail": (0.2, 0.55),
            "tail_lift": (0.0, 0.5),
            "span": (0.16, 0.29),
            "chord": (0.035, 0.075),
            "wing_taper": (0.35, 1.0),
            "wing_thickness": (0.08, 0.14),
            "wing_at": (-0.02, 0.16),
            "wing_level": (-0.9, 1.0),
            "dihedral": (0.0, 0.12),
            "sweep": (-0.05, 0.3),
            "tail_span": (0.28, 0.5),
            "fin_height": (0.04, 0.08),
            "fin_sweep": (0.1, 0.9),
            "engine": (0.008, 0.026),
        },
        _toy_airplane,
        density=400.0,
    ),
    Family(
        "toy_car",
        {
            "length": (0.12, 0.24),
            "width": (0.055, 0.1),
            "body_height": (0.025, 0.055),
            "rear_end": (0.5, 1.2),
            "hood": (0.55, 1.0),
            "front_end": (0.3, 0.8),
            "drop": (0.0, 0.5),
            "tail_width": (0.7, 1.0),
            "nose_width": (0.6, 1.0),
            "exponent": (2.5, 7.0),
            "cabin_length": (0.3, 0.62),
            "cabin_height": (0.02, 0.06),
            "cabin_at": (-0.17, 0.02),
            "cabin_taper": (0.55, 0.95),
            "rake": (-0.5, 0.3),
            "wheel": (0.03, 0.055),
            "rear_wheel": (0.9, 1.35),
            "tyre": (0.01, 0.025),
            "axles": (0.25, 0.36),
            "spoiler": (0.0, 0.025),
        },
        _toy_car,
        density=500.0,
    ),
    Family(
        "guitar",
        {
            "body_length": (0.08, 0.14),
            "body_width": (0.05, 0.125),
            "depth": (0.014, 0.05),
            "waist": (0.35, 0.85),
            "upper": (0.55, 1.05),
            "cutaway": (0.0, 0.55),
            "edge": (0.002, 0.012),
            "arch": (-0.5, 0.5),
            "neck_length": (0.035, 0.13),
            "neck_width": (0.011, 0.02),
            "head_length": (0.025, 0.055),
            "head_width": (1.1, 1.9),
            "head_end": (0.6, 1.6),
            "head_tilt": (0.0, 0.35),
            "peg": (0.005, 0.012),
            "bridge": (0.25, 0.6),
            "bridge_at": (0.2, 0.4),
        },
        _guitar,
        symmetry=Symmetry("z", 2, exact=False),
        density=500.0,
    ),
    Family(
        "tap",
        {
            "foot": (0.035, 0.06),
            "flange": (0.004, 0.016),
            "exponent": (2.0, 6.0),
            "height": (0.09, 0.17),
            "column": (0.5, 0.85),
            "waist": (0.65, 1.0),
            "spout": (0.45, 0.75),
            "spout_at": (0.45, 0.85),
            "reach": (0.07, 0.15),
            "rise": (0.0, 0.09),
            "fall": (0.015, 0.035),
            "nozzle": (0.85, 1.25),
            "spout_exponent": (2.0, 5.0),
            "lever": (0.035, 0.085),
            "lever_width": (0.008, 0.018),
            "lever_tilt": (0.05, 1.0),
            "lever_turn": (-1.2, 1.2),
            "lever_end": (0.5, 1.5),
        },
        _tap,
        density=1500.0,
    ),
)
