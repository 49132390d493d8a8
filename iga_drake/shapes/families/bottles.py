"""Bottles and jars: bottle, spray bottle, jar, vase.

All stand on z = 0 with the body's axis on z; a spray bottle's nozzle points to -x. Frames: base
(below), opening (its z out of the opening; on the cap where there is one), shoulder (where the body
narrows), nozzle (x along the spray), trigger, knob.
"""

import numpy as np

from iga_drake.shapes import surfaces
from iga_drake.shapes.families.attachments import in_plane, swept
from iga_drake.shapes.families.turned import outline, solid, vessel
from iga_drake.shapes.family import Draft, Family, Parameters
from iga_drake.shapes.instance import frame
from iga_drake.shapes.symmetry import Symmetry


def _bottle_outlines(p: Parameters, neck: float, collar: np.ndarray) -> list[np.ndarray]:
    """Body, neck and closure of a bottle, (n, 2) (r, z) each."""
    h, radius = p["height"], p["radius"]
    shoulder = p["shoulder_height"] * h
    at = p["waist_height"] * shoulder
    slope = shoulder + p["shoulder_slope"] * (0.9 * h - shoulder)
    body = outline(
        [0.0, 0.004, 0.03 * h, at, 0.5 * (at + shoulder), shoulder, 0.5 * (shoulder + slope)],
        [
            radius * p["base_ratio"] - 0.003,
            radius * p["base_ratio"],
            radius * p["base_ratio"],
            radius * p["waist"],
            radius,
            radius,
            0.5 * (radius + neck) + p["shoulder_round"] * (radius - neck),
        ],
        20,
    )
    throat = outline(
        [body[-1, 1] + 0.002, slope, 0.5 * (slope + 0.93 * h), 0.93 * h],
        [body[-1, 0] - 0.03 * (body[-1, 0] - neck), neck, neck, neck],
        9,
    )
    return [body, throat, collar]


def _bottle(p: Parameters) -> Draft:
    h, neck = p["height"], p["neck_ratio"] * p["radius"]
    cap, low = neck * p["cap_ratio"], 0.93 * h + 0.0005
    top = low + p["cap_height"]
    collar = np.array(
        [
            [cap - 0.0005, low],
            [cap, low + 0.0008],
            [cap, 0.5 * (low + top)],
            [cap * p["cap_taper"], top - 0.001],
            [cap * p["cap_taper"] - 0.001, top],
        ]
    )
    outlines = _bottle_outlines(p, neck, collar)
    # The body's section is an oval or a rounded rectangle, the neck round.
    levels = np.concatenate(outlines)[:, 1]
    slope = outlines[1][0, 1]
    square = np.clip((slope - levels) / (0.25 * slope), 0.0, 1.0)
    part = solid(
        ("body", "neck", "cap"),
        outlines,
        exponent=2.0 + max(0.0, p["exponent"] - 2.0) * square,
    )
    oval = 1.0 - (1.0 - p["oval"]) * np.concatenate([[1.0], square, [0.0]])
    rings = np.concatenate([[0], np.repeat(np.arange(1, len(oval) - 1), 36), [len(oval) - 1]])
    part.surface.vertices[:, 1] *= oval[rings]
    frames = {
        "base": frame((0.0, 0.0, 0.0)),
        "shoulder": frame((0.0, 0.0, p["shoulder_height"] * h)),
        "opening": frame((0.0, 0.0, top)),
    }
    return Draft((part,), frames)


_BOTTLE = {
    "height": (0.14, 0.28),
    "radius": (0.024, 0.045),
    "base_ratio": (0.8, 1.0),
    "waist": (0.7, 1.05),
    "waist_height": (0.25, 0.7),
    "shoulder_height": (0.45, 0.8),
    "shoulder_slope": (0.2, 1.0),
    "shoulder_round": (-0.3, 0.35),
    "oval": (0.55, 1.0),
    "exponent": (0.5, 5.0),  # of the body's section; at most 2: an oval
}
BOTTLE = Family(
    "bottle",
    _BOTTLE
    | {
        "neck_ratio": (0.28, 0.6),
        "cap_ratio": (1.0, 1.35),
        "cap_taper": (0.75, 1.0),
        "cap_height": (0.008, 0.03),
    },
    _bottle,
    symmetry=Symmetry("z", 2),
    density=600.0,
)


def _spray_bottle(p: Parameters) -> Draft:
    q = {**p, "waist_height": 0.45, "shoulder_round": 0.1}
    h, neck = p["height"], 0.011
    low = 0.93 * h + 0.0005
    collar = np.array(
        [[0.013, low], [0.0135, low + 0.001], [0.0135, low + 0.012], [0.011, low + 0.016]]
    )
    outlines = _bottle_outlines(q, neck, collar)
    levels = np.concatenate(outlines)[:, 1]
    slope = outlines[1][0, 1]
    square = np.clip((slope - levels) / (0.25 * slope), 0.0, 1.0)
    body = solid(
        ("body", "neck", "collar"),
        outlines,
        segments=32,
        exponent=2.0 + max(0.0, p["exponent"] - 2.0) * square,
    )
    oval = 1.0 - (1.0 - p["oval"]) * np.concatenate([[1.0], square, [0.0]])
    rings = np.concatenate([[0], np.repeat(np.arange(1, len(oval) - 1), 32), [len(oval) - 1]])
    body.surface.vertices[:, 1] *= oval[rings]
    # The neck sits behind the body's axis, above a hollow for the hand.
    vertices = body.surface.vertices
    back_shift = p["neck_back"] * p["radius"]
    hip = 0.5 * p["shoulder_height"] * h
    share = np.clip((vertices[:, 2] - hip) / (slope - hip), 0.0, 1.0)
    vertices[:, 0] += back_shift * share**2 * (3 - 2 * share)
    level = low + 0.012 + 0.5 * p["head_height"]
    back, front = back_shift + p["head_back"], back_shift - p["head_front"]
    tall = p["head_height"]
    x = np.linspace(back, front, 9)
    s = np.linspace(0.0, 1.0, 9)
    rise = level + p["head_arch"] * tall * np.sin(np.pi * s)
    head = swept(
        "head",
        in_plane(np.column_stack([x, rise])),
        width=tall * np.interp(s, [0.0, 0.3, 0.8, 1.0], [0.5, 1.1, 0.9, 0.75]),
        height=p["head_width"],
        exponent=3.5,
        segments=16,
        caps=(0.004, 0.003),
    )
    nozzle_radius = p["nozzle_radius"]
    start = np.array([front + 0.002, level])
    nozzle_path = in_plane(start + np.linspace(0.0, 1.0, 4)[:, None] * [-p["nozzle_length"], 0.0])
    nozzle = swept(
        "nozzle",
        nozzle_path,
        width=2 * nozzle_radius * np.array([1.0, 1.0, 1.0, 0.9]),
        height=2 * nozzle_radius * np.array([1.0, 1.0, 1.0, 0.9]),
        segments=12,
        opening=0.003,
    )
    root = np.array([0.55 * front + 0.45 * back_shift, level - 0.2 * tall])
    fall, out = p["trigger_length"], p["trigger_out"]
    control = np.array(
        [
            root,
            root + [-0.3 * out, -0.3 * fall],
            root + [p["trigger_bend"] * out, -0.7 * fall],
            root + [-0.9 * out, -fall],
        ]
    )
    trigger_path = in_plane(surfaces.bspline(control, 12))
    trigger = swept(
        "trigger",
        trigger_path,
        width=0.006,
        height=0.6 * p["head_width"],
        exponent=3.0,
        caps=(0.001, 0.003),
    )
    frames = {
        "base": frame((0.0, 0.0, 0.0)),
        "shoulder": frame((0.0, 0.0, p["shoulder_height"] * h)),
        "nozzle": frame(nozzle_path[-1], x=(-1.0, 0.0, 0.0)),
        "trigger": frame(trigger_path[7], x=(-1.0, 0.0, 0.0)),
    }
    return Draft((body, head, nozzle, trigger), frames)


SPRAY_BOTTLE = Family(
    "spray_bottle",
    {
        **{
            name: limits
            for name, limits in _BOTTLE.items()
            if name not in ("waist_height", "shoulder_round")
        },
        "height": (0.11, 0.19),
        "radius": (0.026, 0.042),
        "head_back": (0.016, 0.034),
        "head_front": (0.045, 0.07),
        "neck_back": (0.5, 1.1),
        "head_height": (0.022, 0.036),
        "head_width": (0.016, 0.028),
        "head_arch": (-0.1, 0.4),
        "nozzle_radius": (0.004, 0.008),
        "nozzle_length": (0.008, 0.022),
        "trigger_length": (0.038, 0.06),
        "trigger_out": (0.012, 0.03),
        "trigger_bend": (-0.6, 0.5),
    },
    _spray_bottle,
    density=450.0,
)


def _jar(p: Parameters) -> Draft:
    h, radius = p["height"], p["radius"]
    base, mouth = p["base_ratio"] * radius, p["mouth_ratio"] * radius
    at = p["belly_height"]
    body = outline(
        np.array([0.0, 0.02, at, 0.5 + 0.45 * at, 0.95, 1.0]) * h,
        [base - 0.003, base, radius * 1.05, radius, mouth, mouth],
        20,
    )
    lid, brim = mouth * p["lid_ratio"], p["lid_height"]
    low = h + 0.0005
    crest = low + brim + p["lid_dome"] * lid
    cover = np.concatenate(
        [
            [[lid - 0.0005, low], [lid, low + 0.001], [lid, low + brim]],
            outline(
                [low + brim + 0.0008, 0.7 * crest + 0.3 * (low + brim), crest + 0.0012],
                [lid - 0.001, 0.7 * lid, 0.5 * p["knob_radius"]],
                7,
            ),
        ]
    )
    knob, tall = p["knob_radius"], p["knob_height"]
    top = crest + 0.0015 + tall
    button = outline(
        crest + 0.0015 + tall * np.array([0.02, 0.3, 0.5, 0.85, 1.0]),
        [0.5 * knob, p["knob_neck"] * knob, 1.3 * knob, knob, 0.25 * knob],
        9,
    )
    part = solid(("body", "lid", "knob"), [body, cover, button], exponent=max(2.0, p["exponent"]))
    frames = {
        "base": frame((0.0, 0.0, 0.0)),
        "opening": frame((0.0, 0.0, h)),
        "knob": frame((0.0, 0.0, top)),
    }
    return Draft((part,), frames)


JAR = Family(
    "jar",
    {
        "height": (0.07, 0.2),
        "radius": (0.04, 0.07),
        "base_ratio": (0.6, 1.0),
        "mouth_ratio": (0.45, 1.0),
        "belly_height": (0.25, 0.75),
        "lid_ratio": (0.95, 1.15),
        "lid_height": (0.003, 0.02),
        "lid_dome": (0.02, 0.5),
        "knob_radius": (0.006, 0.014),
        "knob_height": (0.008, 0.028),
        "knob_neck": (0.35, 0.9),
        "exponent": (0.5, 4.5),  # of the section; at most 2: round
    },
    _jar,
    symmetry=Symmetry("z", 4),
    density=500.0,
)


def _vase(p: Parameters) -> Draft:
    h, belly = p["height"], p["belly_ratio"] * p["height"]
    base, neck, rim = (p[key] * belly for key in ("base_ratio", "neck_ratio", "rim_ratio"))
    at = p["belly_height"]
    throat = at + p["neck_height"] * (0.95 - at)
    wall = outline(
        np.array([0.0, 0.015, 0.5 * at, at, 0.5 * (at + throat), throat, 0.97, 1.0]) * h,
        [
            base - 0.002,
            base,
            0.5 * (base + belly) + p["low_round"] * belly,
            1.1 * belly,
            0.5 * (belly + neck) + p["high_round"] * belly,
            neck,
            0.3 * neck + 0.7 * rim,
            rim,
        ],
        64,
    )
    body = vessel(
        wall,
        thickness=p["wall"],
        base_thickness=0.006,
        points=18,
        segments=40,
        exponent=p["exponent"],
    )
    # The square section turns with height.
    vertices = body.surface.vertices
    angle = p["twist"] * (vertices[:, 2] / h) ** p["twist_rise"]
    c, s = np.cos(angle), np.sin(angle)
    x, y = vertices[:, 0].copy(), vertices[:, 1].copy()
    vertices[:, 0], vertices[:, 1] = c * x - s * y, s * x + c * y
    frames = {
        "base": frame((0.0, 0.0, 0.0)),
        "opening": frame((0.0, 0.0, body.top)),
        "belly": frame((0.0, 0.0, at * h)),
    }
    return Draft((body.part(),), frames)


VASE = Family(
    "vase",
    {
        "height": (0.13, 0.28),
        "belly_ratio": (0.15, 0.27),
        "base_ratio": (0.45, 1.0),
        "neck_ratio": (0.4, 0.85),
        "rim_ratio": (0.5, 1.25),
        "belly_height": (0.2, 0.6),
        "neck_height": (0.35, 0.9),
        "low_round": (-0.15, 0.25),
        "high_round": (-0.25, 0.25),
        "wall": (0.0022, 0.0045),
        "exponent": (2.0, 3.1),
        "twist": (-0.35, 0.35),
        "twist_rise": (0.8, 1.6),
    },
    _vase,
    symmetry=Symmetry("z", 4),
    density=1100.0,
)

BOTTLES = (BOTTLE, SPRAY_BOTTLE, JAR, VASE)
