"""Vessels with handles: mug, jug, teapot, kettle, watering can, pot, bucket, basket.

All stand on z = 0 with the body's axis on z; a handle is at +x, a spout or lip at -x. Frames: base
(below), opening (its z out of the opening; below a lid where there is one), handle (in its middle,
x outwards), spout or lip (at its tip, x along the flow outwards).
"""

import numpy as np

from iga_drake.shapes import surfaces
from iga_drake.shapes.families.attachments import in_plane, loop_handle, swept
from iga_drake.shapes.families.turned import outline, solid, vessel, wall_anchor
from iga_drake.shapes.family import Draft, Family, Parameters, Part
from iga_drake.shapes.instance import frame
from iga_drake.shapes.symmetry import Symmetry


def _handle_frame(path: np.ndarray) -> np.ndarray:
    """X_OF in the middle of a handle's path (N, 3) in the plane y = 0, x away from its ends."""
    middle = len(path) // 2
    along = path[middle + 1] - path[middle - 1]
    outward = np.array([-along[2], 0.0, along[0]])
    outward *= np.sign(outward @ (path[middle] - (path[0] + path[-1]) / 2))
    return frame(path[middle], x=outward, z=(0, 0, 1) if abs(outward[0]) > 1e-9 else (1, 0, 0))


def _tip_frame(path: np.ndarray) -> np.ndarray:
    """Frame X_OF at the end of a spout's path (N, 3) in the plane y = 0, x along it."""
    along = path[-1] - path[-2]
    return frame(path[-1], x=along, z=np.cross(along, (0.0, 1.0, 0.0)) * np.sign(-along[0] or 1.0))


def _mug(p: Parameters) -> Draft:
    h = p["height"]
    rim = p["radius_ratio"] * h
    base, belly = p["base_ratio"] * rim, p["belly_ratio"] * rim
    at = p["belly_height"]
    wall = outline(
        np.array([0.0, 0.03, at, 0.5 + 0.5 * at, 0.94, 1.0]) * h,
        [base - p["edge"], base, belly, 0.5 * (belly + rim), rim, rim * (1 + p["flare"])],
        48,
    )
    body = vessel(
        wall,
        thickness=p["wall"],
        base_thickness=p["base_thickness"],
        exponent=max(2.0, p["exponent"]),
    )
    high = p["handle_high"] * h
    low = high - p["handle_span"] * h
    handle, path = loop_handle(
        body.anchor(low),
        body.anchor(high),
        reach=p["handle_reach"] * h,
        lower_reach=p["handle_reach"] * p["handle_lower"] * h,
        thickness=p["handle_thickness"],
        breadth=p["handle_breadth"],
        rise=p["handle_rise"] * h,
        taper=p["handle_taper"],
        exponent=p["handle_exponent"],
    )
    frames = {
        "base": frame((0.0, 0.0, 0.0)),
        "opening": frame((0.0, 0.0, body.top)),
        "rim": frame((-rim * (1 + p["flare"]), 0.0, body.top), x=(-1.0, 0.0, 0.0)),
        "handle": _handle_frame(path),
    }
    return Draft((body.part(), handle), frames)


MUG = Family(
    "mug",
    {
        "height": (0.08, 0.135),
        "radius_ratio": (0.3, 0.56),  # of the rim, to the height
        "base_ratio": (0.6, 1.15),
        "belly_ratio": (0.8, 1.4),
        "belly_height": (0.25, 0.7),
        "flare": (-0.06, 0.14),
        "edge": (0.0015, 0.009),
        "wall": (0.002, 0.0045),
        "base_thickness": (0.003, 0.008),
        "exponent": (1.0, 3.6),  # of the section; at most 2: round,
        "handle_high": (0.68, 0.9),
        "handle_span": (0.38, 0.56),
        "handle_reach": (0.26, 0.56),
        "handle_lower": (0.45, 1.15),
        "handle_rise": (-0.08, 0.16),
        "handle_thickness": (0.006, 0.011),
        "handle_breadth": (0.008, 0.02),
        "handle_taper": (0.65, 1.2),
        "handle_exponent": (2.0, 4.5),
    },
    _mug,
    density=1500.0,
)


def _jug(p: Parameters) -> Draft:
    h = p["height"]
    belly = p["belly_ratio"] * h
    base, neck, rim = (p[key] * belly for key in ("base_ratio", "neck_ratio", "rim_ratio"))
    at, throat = p["belly_height"], p["neck_height"]
    wall = outline(
        np.array([0.0, 0.02, at, 0.5 * (at + throat), throat, 0.5 + 0.5 * throat, 1.0]) * h,
        [base - 0.004, base, 1.15 * belly, belly, neck, 0.5 * (neck + rim), rim],
        48,
    )
    body = vessel(wall, thickness=p["wall"], base_thickness=0.006, exponent=max(2.0, p["exponent"]))
    vertices = body.surface.vertices
    # The lip: the upper wall drawn out at -x.
    above = np.clip((vertices[:, 2] / h - p["lip_start"]) / (1 - p["lip_start"]), 0.0, 1.0) ** 2
    across = np.exp(-((vertices[:, 1] / (p["lip_width"] * rim)) ** 2))
    share = above * across * np.clip(-vertices[:, 0] / rim, 0.0, 1.2)
    vertices[:, 0] -= p["lip_reach"] * rim * share
    vertices[:, 2] += p["lip_rise"] * rim * share
    high = p["handle_high"] * h
    low = high - p["handle_span"] * h
    handle, path = loop_handle(
        body.anchor(low),
        body.anchor(high),
        reach=p["handle_reach"] * h,
        lower_reach=p["handle_reach"] * p["handle_lower"] * h,
        thickness=p["handle_thickness"],
        breadth=p["handle_breadth"],
        rise=p["handle_rise"] * h,
        exponent=2.5,
    )
    lip = vertices[np.argmin(vertices[:, 0] - vertices[:, 2])]
    frames = {
        "base": frame((0.0, 0.0, 0.0)),
        "opening": frame((0.0, 0.0, h)),
        "lip": frame(lip, x=(-1.0, 0.0, 0.0)),
        "handle": _handle_frame(path),
    }
    return Draft((body.part(), handle), frames)


JUG = Family(
    "jug",
    {
        "height": (0.14, 0.24),
        "belly_ratio": (0.18, 0.31),
        "base_ratio": (0.7, 1.15),
        "neck_ratio": (0.45, 0.85),
        "rim_ratio": (0.6, 1.1),
        "belly_height": (0.22, 0.5),
        "neck_height": (0.65, 0.85),
        "wall": (0.0022, 0.0045),
        "exponent": (1.2, 3.2),
        "lip_start": (0.6, 0.85),
        "lip_width": (0.25, 0.6),
        "lip_reach": (0.35, 1.0),
        "lip_rise": (0.1, 0.6),
        "handle_high": (0.8, 0.95),
        "handle_span": (0.3, 0.52),
        "handle_reach": (0.22, 0.38),
        "handle_lower": (0.4, 1.1),
        "handle_rise": (-0.03, 0.1),
        "handle_thickness": (0.011, 0.019),
        "handle_breadth": (0.012, 0.026),
    },
    _jug,
    density=1200.0,
)


def _lidded(p: Parameters, body: np.ndarray) -> tuple[Part, float, float]:
    """A solid body with a lid and a knob; the heights (m) below the lid and of the knob's top."""
    mouth, height = body[-1]
    lid, dome = 1.06 * mouth, p["lid_dome"] * mouth
    knob, neck = p["knob_radius"], 0.55 * p["knob_radius"]
    brim = 0.003
    top = height + brim + dome
    cover = np.concatenate(
        [
            [[lid, height + 0.0005], [lid, height + brim]],
            outline(
                np.array([height + brim, height + brim + 0.75 * dome, top]) + [0.0005, 0.0, 0.0],
                [lid - 0.001, 0.75 * lid, neck],
                6,
            ),
        ]
    )
    tall = p["knob_height"] * knob
    button = outline(
        top + tall * np.array([0.08, 0.25, 0.4, 0.8, 1.0, 1.03]),
        [neck, 0.9 * neck, 1.25 * knob, 1.25 * knob, 0.7 * knob, 0.2 * knob],
        9,
    )
    part = solid(("body", "lid", "knob"), [body, cover, button])
    return part, float(height), float(top + tall)


def _spout_path(body: np.ndarray, p: Parameters, depth: float) -> np.ndarray:
    """(14, 3) from within the body (K, 2) (r, z) outwards at -x, in the plane y = 0."""
    h = float(body[-1, 1])
    root = wall_anchor(body, p["spout_low"] * h, depth).opposite()
    reach, rise = p["spout_reach"] * h, p["spout_rise"] * h
    out = float(-np.abs(body[:, 0]).max())
    tip = np.array([out - reach, max(root.point[1] + 0.3 * h, root.point[1] + rise)])
    knee = np.array([out - p["spout_bend"] * reach, root.point[1] + 0.15 * rise])
    lip = tip - p["spout_lip"] * reach * np.array([-1.0, 0.35])
    control = [root.point, root.point + (depth + 0.2 * reach) * root.normal, knee, lip, tip]
    return in_plane(surfaces.resample(surfaces.bspline(np.array(control), 42), 14))


def _spout(path: np.ndarray, p: Parameters) -> Part:
    width = p["spout_width"] * np.linspace(1.0, p["spout_taper"], len(path)) ** 1.3
    return swept("spout", path, width=width, height=width, opening=0.6 * width[-1], segments=14)


def _teapot(p: Parameters) -> Draft:
    h = p["height"]
    belly = p["belly_ratio"] * h
    base, mouth = p["base_ratio"] * belly, p["mouth_ratio"] * belly
    at = p["belly_height"]
    body = outline(
        np.array([0.0, 0.02, 0.6 * at, at, 0.5 + 0.5 * at, 0.97, 1.0]) * h,
        [base - 0.003, base, 1.08 * belly, 1.12 * belly, belly, mouth, mouth],
        20,
    )
    part, opening, top = _lidded(p, body)
    high = p["handle_high"] * h
    low = high - p["handle_span"] * h
    handle, path = loop_handle(
        wall_anchor(body, low, 0.004),
        wall_anchor(body, high, 0.004),
        reach=p["handle_reach"] * h,
        lower_reach=p["handle_reach"] * p["handle_lower"] * h,
        thickness=p["handle_thickness"],
        breadth=1.3 * p["handle_thickness"],
        rise=0.1 * h,
        exponent=2.3,
    )
    tube = _spout_path(body, p, 0.2 * belly)
    frames = {
        "base": frame((0.0, 0.0, 0.0)),
        "opening": frame((0.0, 0.0, opening)),
        "knob": frame((0.0, 0.0, top)),
        "handle": _handle_frame(path),
        "spout": _tip_frame(tube),
    }
    return Draft((part, handle, _spout(tube, p)), frames)


_SPOUT = {
    "spout_low": (0.18, 0.42),
    "spout_reach": (0.35, 0.75),
    "spout_rise": (0.45, 0.9),
    "spout_bend": (0.25, 0.75),
    "spout_lip": (0.05, 0.4),
    "spout_width": (0.02, 0.034),
    "spout_taper": (0.4, 0.85),
}
TEAPOT = Family(
    "teapot",
    {
        "height": (0.07, 0.115),
        "belly_ratio": (0.36, 0.72),
        "base_ratio": (0.4, 1.1),
        "mouth_ratio": (0.35, 0.9),
        "belly_height": (0.25, 0.55),
        "lid_dome": (0.1, 0.6),
        "knob_radius": (0.006, 0.012),
        "knob_height": (1.2, 2.4),
        "handle_high": (0.68, 0.85),
        "handle_span": (0.36, 0.52),
        "handle_reach": (0.34, 0.56),
        "handle_lower": (0.5, 1.1),
        "handle_thickness": (0.007, 0.013),
    }
    | _SPOUT,
    _teapot,
    density=450.0,
)


def _kettle(p: Parameters) -> Draft:
    h = p["height"]
    belly = p["belly_ratio"] * h
    base, mouth = p["base_ratio"] * belly, p["mouth_ratio"] * belly
    at = p["belly_height"]
    body = outline(
        np.array([0.0, 0.03, at, 0.5 + 0.5 * at, 0.97, 1.0]) * h,
        [base - 0.004, base, 1.1 * belly, p["shoulder_ratio"] * belly, mouth, mouth],
        20,
    )
    part, opening, top = _lidded(p, body)
    root = wall_anchor(body, p["handle_height"] * h, 0.004)
    crest = top + p["handle_clearance"]
    across = p["handle_square"] * (root.point[0] + 0.01)
    lean = p["handle_lean"] * across
    out = root.point + 0.02 * root.normal + [0.0, 0.4 * (crest - root.point[1])]
    mirror = np.array([-1.0, 1.0])
    control = [root.point, out, [across + lean, crest], [lean - across, crest]]
    control += [out * mirror, root.point * mirror]
    path = in_plane(surfaces.resample(surfaces.bspline(np.array(control), 54), 18))
    grip = 1 + p["handle_grip"] * np.sin(np.linspace(0, np.pi, len(path))) ** 4
    handle = swept(
        "handle",
        path,
        width=p["handle_thickness"] * grip,
        height=p["handle_breadth"] * grip,
        exponent=3.0,
    )
    tube = _spout_path(body, p, 0.2 * belly)
    frames = {
        "base": frame((0.0, 0.0, 0.0)),
        "opening": frame((0.0, 0.0, opening)),
        "knob": frame((0.0, 0.0, top)),
        "handle": frame(path[len(path) // 2]),
        "spout": _tip_frame(tube),
    }
    return Draft((part, handle, _spout(tube, p)), frames)


KETTLE = Family(
    "kettle",
    {
        "height": (0.075, 0.125),
        "belly_ratio": (0.5, 0.85),
        "base_ratio": (0.6, 1.15),
        "mouth_ratio": (0.35, 0.6),
        "shoulder_ratio": (0.75, 1.05),
        "belly_height": (0.2, 0.55),
        "lid_dome": (0.1, 0.5),
        "knob_radius": (0.007, 0.012),
        "knob_height": (1.2, 2.2),
        "handle_height": (0.72, 0.9),
        "handle_clearance": (0.025, 0.06),
        "handle_square": (0.5, 1.1),
        "handle_lean": (-0.2, 0.5),
        "handle_thickness": (0.005, 0.009),
        "handle_breadth": (0.009, 0.018),
        "handle_grip": (0.0, 0.8),
        "spout_reach": (0.3, 0.6),
        "spout_rise": (0.35, 0.6),
        "spout_width": (0.022, 0.034),
        "spout_taper": (0.4, 0.8),
    },
    lambda p: _kettle({**p, "spout_low": 0.35, "spout_bend": 0.45, "spout_lip": 0.2}),
    density=450.0,
)


def _watering_can(p: Parameters) -> Draft:
    h = p["height"]
    rim = p["radius_ratio"] * h
    base = p["base_ratio"] * rim
    wall = outline(
        np.array([0.0, 0.03, 0.5, 0.95, 1.0]) * h,
        [base - 0.003, base, p["belly_ratio"] * 0.5 * (base + rim), rim, rim],
        40,
    )
    body = vessel(
        wall,
        thickness=0.0025,
        base_thickness=0.004,
        points=12,
        ratio=p["oval"],
        exponent=p["exponent"],
    )
    high = body.anchor(0.9 * h)
    handle, path = loop_handle(
        body.anchor((0.9 - p["handle_span"]) * h),
        high,
        reach=p["handle_reach"] * h,
        lower_reach=0.8 * p["handle_reach"] * h,
        thickness=p["handle_thickness"],
        breadth=1.5 * p["handle_thickness"],
        rise=p["handle_rise"] * h,
    )
    root = body.anchor(p["spout_low"] * h).opposite()
    reach = p["spout_reach"] * h
    end = root.point + [-reach, p["spout_rise"] * h]
    knee = root.point + [-p["spout_bend"] * reach, 0.1 * p["spout_rise"] * h]
    start = root.point + 0.012 * root.normal
    control = np.array([root.point, start, knee, 0.3 * knee + 0.7 * end, end])
    stem = in_plane(surfaces.resample(surfaces.bspline(control, 42), 14))
    width = p["spout_width"] * np.linspace(1.0, p["spout_taper"], len(stem))
    spout = swept("spout", stem, width=width, height=width, segments=14)
    rose, tip = _rose(stem, 0.5 * width[-1], p)
    frames = {
        "base": frame((0.0, 0.0, 0.0)),
        "opening": frame((0.0, 0.0, h)),
        "handle": _handle_frame(path),
        "spout": _tip_frame(np.stack([stem[-1], tip])),
    }
    return Draft((body.part(), handle, spout, rose), frames)


def _rose(stem: np.ndarray, radius: float, p: Parameters) -> tuple[Part, np.ndarray]:
    """The head of a watering can's spout as a widening tube, and its middle's place in front."""
    along = (stem[-1] - stem[-2]) / np.linalg.norm(stem[-1] - stem[-2])
    length = p["rose_length"]
    place = stem[-1] + along * (np.array([-0.2, 0.15, 0.85, 1.0])[:, None] * length)
    wide = 2 * radius * p["rose_ratio"]
    width = np.array([2.1 * radius, 2.2 * radius, max(wide, 2.3 * radius), max(wide, 2.2 * radius)])
    part = swept("rose", place, width=width, height=width, segments=20, caps=(0.0005, 0.002))
    return part, place[-1]


WATERING_CAN = Family(
    "watering_can",
    {
        "height": (0.085, 0.115),
        "radius_ratio": (0.3, 0.44),
        "base_ratio": (0.9, 1.3),
        "belly_ratio": (0.9, 1.25),
        "oval": (0.65, 1.0),
        "exponent": (2.0, 3.5),
        "handle_span": (0.45, 0.72),
        "handle_reach": (0.3, 0.55),
        "handle_rise": (0.1, 0.5),
        "handle_thickness": (0.007, 0.012),
        "spout_low": (0.15, 0.4),
        "spout_reach": (0.6, 1.05),
        "spout_rise": (0.45, 0.95),
        "spout_bend": (0.3, 0.9),
        "spout_width": (0.019, 0.028),
        "spout_taper": (0.45, 0.8),
        "rose_length": (0.01, 0.022),
        "rose_ratio": (1.15, 3.0),
    },
    _watering_can,
    density=900.0,
)


def _pot(p: Parameters) -> Draft:
    radius = p["radius"]
    h = p["height_ratio"] * radius
    base = p["base_ratio"] * radius
    wall = outline(
        np.array([0.0, 0.03, 0.12, 0.5, 0.95, 1.0]) * h,
        [
            base - p["edge"],
            base,
            0.6 * base + 0.4 * radius,
            p["belly_ratio"] * radius,
            radius,
            radius * (1 + p["flare"]),
        ],
        44,
    )
    body = vessel(wall, thickness=p["wall"], base_thickness=p["base_thickness"])
    level = p["handle_height"] * h
    inner = body.anchor(level).point[0]
    half = p["handle_width"] / 2
    reach = p["handle_reach"]
    x = np.sqrt(inner**2 - half**2)
    tilt, square = p["handle_tilt"] * reach, p["handle_square"]
    tip = [inner + reach, square * half * 1.3, level + tilt]
    knee = [x + 0.6 * reach, half * (0.5 + square), level + 0.4 * tilt]
    flip = np.array([1.0, -1.0, 1.0])
    control = np.array([[x, half, level], knee, tip, tip * flip, knee * flip, [x, -half, level]])
    path = surfaces.resample(surfaces.bspline(control, 40), 13)
    parts = [body.part()]
    for name, side in (("handle", 1.0), ("handle_opposite", -1.0)):
        parts.append(
            swept(
                name,
                path * [side, side, 1.0],
                width=p["handle_thickness"],
                height=p["handle_breadth"],
                exponent=3.0,
                up=(0.0, 0.0, 1.0),
            )
        )
    middle = path[len(path) // 2]
    frames = {
        "base": frame((0.0, 0.0, 0.0)),
        "opening": frame((0.0, 0.0, body.top)),
        "handle": frame(middle),
        "handle_opposite": frame(middle * [-1.0, 1.0, 1.0], x=(-1.0, 0.0, 0.0)),
    }
    return Draft(tuple(parts), frames)


POT = Family(
    "pot",
    {
        "radius": (0.055, 0.11),
        "height_ratio": (0.6, 1.7),
        "base_ratio": (0.7, 0.98),
        "belly_ratio": (0.92, 1.18),
        "flare": (-0.08, 0.08),
        "edge": (0.002, 0.01),
        "wall": (0.002, 0.004),
        "base_thickness": (0.003, 0.007),
        "handle_height": (0.6, 0.85),
        "handle_width": (0.04, 0.08),
        "handle_reach": (0.02, 0.042),
        "handle_square": (0.3, 0.85),
        "handle_tilt": (-0.25, 0.6),
        "handle_thickness": (0.006, 0.011),
        "handle_breadth": (0.006, 0.014),
    },
    _pot,
    symmetry=Symmetry("z", 2),
    density=1800.0,
)


def _bucket(p: Parameters) -> Draft:
    rim = p["radius"]
    h = p["height_ratio"] * rim
    base = p["base_ratio"] * rim
    band = p["band"]
    wall = outline(
        np.array([0.0, 0.02, 0.3, 0.6, 0.9, 0.93, 0.97, 1.0]) * h,
        [
            base - 0.003,
            base,
            base + 0.3 * (rim - base) + 0.5 * p["bulge"] * rim,
            base + 0.6 * (rim - base) + p["bulge"] * rim,
            0.97 * rim,
            0.97 * rim + band,
            rim + band,
            rim,
        ],
        56,
    )
    body = vessel(wall, thickness=p["wall"], base_thickness=0.004)
    ear = body.anchor(p["ear_height"] * h)
    across = p["bail_width"] * ear.point[0]
    rise = p["bail_rise"] * rim
    n = 17
    angle = np.linspace(0.0, np.pi, n)
    e = 2.0 / p["bail_square"]
    y = np.sign(np.cos(angle)) * np.abs(np.cos(angle)) ** e * across
    up = np.sin(angle) ** e * rise
    y[[0, -1]] = ear.point[0], -ear.point[0]
    arc = np.column_stack([y, up])
    arc = surfaces.resample(arc, n)
    tilt = p["bail_tilt"]
    direction = np.array([np.sin(tilt), 0.0, np.cos(tilt)])
    path = np.array([0.0, 1.0, 0.0]) * arc[:, :1] + direction * arc[:, 1:]
    path += [0.0, 0.0, ear.point[1]]
    normal = np.array([np.cos(tilt), 0.0, -np.sin(tilt)])
    swell = np.clip(1.5 - np.abs(np.linspace(-4.0, 4.0, n)), 0.0, 1.0)
    thick = p["bail_thickness"] + (p["grip"] - p["bail_thickness"]) * swell
    bail = swept("handle", path, width=thick, height=thick, up=tuple(normal))
    frames = {
        "base": frame((0.0, 0.0, 0.0)),
        "opening": frame((0.0, 0.0, h)),
        "handle": frame(path[n // 2], x=normal, z=direction),
    }
    return Draft((body.part(), bail), frames)


BUCKET = Family(
    "bucket",
    {
        "radius": (0.05, 0.085),
        "height_ratio": (1.1, 2.0),
        "base_ratio": (0.55, 0.95),
        "bulge": (-0.05, 0.12),
        "band": (-0.002, 0.006),
        "wall": (0.002, 0.0035),
        "ear_height": (0.82, 0.93),
        "bail_width": (1.0, 1.12),
        "bail_rise": (0.95, 1.5),
        "bail_square": (1.7, 3.0),
        "bail_tilt": (-1.1, 1.1),
        "bail_thickness": (0.004, 0.007),
        "grip": (0.006, 0.018),
    },
    _bucket,
    symmetry=Symmetry("z", 2, exact=False),
    density=900.0,
)


def _basket(p: Parameters) -> Draft:
    rim = p["length"] / 2
    h = p["height_ratio"] * p["length"]
    base = p["base_ratio"] * rim
    band = p["band"]
    wall = outline(
        np.array([0.0, 0.03, 0.45, 0.85, 0.9, 0.96, 1.0]) * h,
        [
            base - 0.004,
            base,
            0.5 * (base + rim) + p["belly"] * rim,
            rim - 0.002,
            rim + band,
            rim + band,
            rim,
        ],
        48,
    )
    body = vessel(
        wall,
        thickness=p["wall"],
        base_thickness=0.005,
        points=12,
        ratio=p["oval"],
        exponent=p["exponent"],
    )
    root = body.anchor(0.8 * h).point
    y = root[0] * p["oval"] - 0.5 * p["wall"] * (1 - p["oval"])
    rise = p["handle_rise"]
    angle = np.linspace(0.0, np.pi, 60)
    e = 2.0 / p["handle_square"]
    arc = np.column_stack(
        [np.sign(np.cos(angle)) * np.abs(np.cos(angle)) ** e * y, np.sin(angle) ** e * rise]
    )
    arc = surfaces.resample(arc, 19)
    path = np.column_stack([np.zeros(19), arc[:, 0], arc[:, 1] + root[1]])
    waist = 1 - p["handle_waist"] * np.sin(np.linspace(0, np.pi, 19)) ** 2
    handle = swept(
        "handle",
        path,
        width=p["handle_thickness"],
        height=p["handle_breadth"] * waist,
        exponent=p["handle_exponent"],
        up=(1.0, 0.0, 0.0),
    )
    frames = {
        "base": frame((0.0, 0.0, 0.0)),
        "opening": frame((0.0, 0.0, h)),
        "handle": frame(path[9], x=(0.0, 1.0, 0.0)),
    }
    return Draft((body.part(), handle), frames)


BASKET = Family(
    "basket",
    {
        "length": (0.13, 0.24),
        "height_ratio": (0.25, 0.5),
        "base_ratio": (0.7, 1.0),
        "belly": (-0.06, 0.14),
        "band": (0.0, 0.006),
        "wall": (0.0035, 0.006),
        "oval": (0.55, 0.95),
        "exponent": (2.0, 5.0),
        "handle_rise": (0.06, 0.15),
        "handle_square": (1.8, 3.2),
        "handle_thickness": (0.005, 0.01),
        "handle_breadth": (0.012, 0.03),
        "handle_waist": (0.0, 0.5),
        "handle_exponent": (2.0, 5.0),
    },
    _basket,
    symmetry=Symmetry("z", 2),
    density=500.0,
)

VESSELS = (MUG, JUG, TEAPOT, KETTLE, WATERING_CAN, POT, BUCKET, BASKET)
