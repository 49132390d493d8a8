"""Wearables: shoe, boot, cap and hat. They stand on z = 0, the front towards +x.

Frames: `sole` under the middle of a sole, z up; `opening` in the middle of a shoe's or boot's
opening, z out of it; `insole` on the inner sole below that, z up; `toe` and `heel` at the ends of a
sole, x outwards; `head_opening` in the opening of a cap or hat, z down out of it; `crown` on top of
it, z up; `brim` at the front of the brim, x outwards.
"""

from collections.abc import Callable
from itertools import pairwise

import numpy as np

from iga_drake.shapes.families.blocks import (
    SHELL_BANDS,
    closed_outline,
    dome,
    hulls,
    rings,
    sheet,
    shell,
    shell_bands,
    spline,
    stand,
    stations,
    tubes,
    wall_hulls,
)
from iga_drake.shapes.family import Draft, Family, Parameters, Part
from iga_drake.shapes.instance import frame
from iga_drake.shapes.surfaces import loft, superellipse
from iga_drake.shapes.symmetry import Symmetry

_ROUND = 40  # points round a shoe
_ROWS = 14  # rings from a shoe's sole to its opening


def _footwear(p: Parameters) -> Draft:
    long, wide, wall = p["length"], p["width"], p["wall"]
    heel, waist, ball, toe = p["heel_width"], p["waist_width"], 1.0, p["toe_width"]
    widths = wide * np.array([heel, heel, waist, ball, ball, toe])
    plan, t = closed_outline(long, widths.tolist(), _ROUND)
    bend = p["bend"] * wide * (t - 0.4) ** 2  # a left shoe's inside is the other's outside
    plan = plan + np.column_stack([0 * t, bend])
    direction = superellipse(_ROUND, 2.0)

    smooth = t * t * (3 - 2 * t)
    spring = p["toe_spring"] * np.clip((t - 0.6) / 0.4, 0, 1) ** 2
    ground = p["arch"] * p["heel_height"] * 4 * np.clip(0.9 * t * (1 - t) - 0.08, 0, 1) + spring
    above = p["heel_height"] * (1 - smooth) + p["fore_height"] * smooth + spring
    sole_rings = np.empty((4, _ROUND, 3))
    for k, (level, scale) in enumerate(((0.0, 0.93), (0.08, 1.0), (0.9, 1.03), (1.0, 1.0))):
        sole_rings[k, :, :2] = plan * scale
        sole_rings[k, :, 2] = ground + level * (above - ground)
    centre = np.array([0.0, float(bend.mean()), 0.0])
    middle = np.abs(t - 0.5) < 0.1
    sole = loft(
        sole_rings,
        start=centre + [0, 0, float(ground[middle].mean())],
        end=centre + [0, 0, float(above[middle].mean())],
    )

    # The upper: from the sole's edge to the ankle, then up the shaft.
    front = np.clip(2.2 * t - 0.6, 0, 1)[:, None]
    ankle_x = long * (p["opening_at"] - 0.5)
    ankle = direction * [p["opening_length"] * long, p["opening_width"] * wide] + [ankle_x, 0.0]
    ankle_z = above.max() + p["ankle_height"] * (1 - 0.3 * p["collar_slope"] * direction[:, 0])
    shaft_x = p["shaft_lean"] * p["shaft_height"]
    shaft = (ankle - [ankle_x, 0.0]) * p["shaft_width"] + [ankle_x + shaft_x, 0.0]
    shaft_z = ankle_z + p["shaft_height"] * (1 + 0.15 * p["collar_slope"] * direction[:, 0])
    toe_z = above + p["toe_height"]

    def control(inward: float, low: float) -> np.ndarray:
        base = plan - inward * direction
        ankle_in, shaft_in = ankle - inward * direction, shaft - inward * direction
        down = inward * front[:, 0]
        levels = (
            (base * 0.99, above + low),
            (base * 1.01, above + 0.6 * p["toe_height"] - down),
            (base + 0.3 * (ankle_in - base), toe_z + 0.12 * (ankle_z - toe_z) - down),
            (base + 0.72 * (ankle_in - base), toe_z + 0.55 * (ankle_z - toe_z) - 0.8 * down),
            (ankle_in, ankle_z),
            (0.5 * (ankle_in + shaft_in), 0.5 * (ankle_z + shaft_z)),
            (shaft_in, shaft_z),
        )
        return np.stack([np.column_stack(level) for level in levels])

    both = spline(np.concatenate([control(0.0, -0.002), control(wall, 0.004)], axis=1), _ROWS)
    upper = shell(both[:, :_ROUND], both[:, _ROUND:])
    top = both[-1, :_ROUND].mean(axis=0)
    # The inner sole is a fan from its edge to the edge's middle.
    edge = both[0, _ROUND:]
    middle_sole = edge.mean(axis=0)
    away, spokes = (top - middle_sole)[:2], (edge - middle_sole)[:, :2]
    lengths = np.linalg.norm(spokes, axis=1)
    spoke = int((spokes @ away / lengths).argmax())
    share = float(np.linalg.norm(away) / lengths[spoke])
    insole = [*top[:2], (1 - share) * middle_sole[2] + share * edge[spoke, 2]]
    return stand(
        Draft(
            (
                Part("sole", sole, _sole_pieces(sole.vertices, t)),
                Part(
                    "upper",
                    upper,
                    wall_hulls(upper, _ROWS, sectors=10, cuts=(0, 3, 5, 7, 10, _ROWS - 1)),
                    bands=(SHELL_BANDS, shell_bands(_ROWS, _ROWS, _ROUND)),
                ),
            ),
            {
                "sole": frame((0.0, 0.0, 0.0)),
                "opening": frame(top, x=both[-1, 0] - both[-1, _ROUND // 2]),
                "insole": frame(np.array(insole)),
                "toe": frame(0.5 * (sole_rings[1, 0] + sole_rings[2, 0])),
                "heel": frame(
                    0.5 * (sole_rings[1, _ROUND // 2] + sole_rings[2, _ROUND // 2]),
                    x=(-1.0, 0.0, 0.0),
                ),
            },
        )
    )


def _sole_pieces(vertices: np.ndarray, t: np.ndarray) -> Callable[[], list[np.ndarray]]:
    """Convex pieces of a sole by lengths along it, the left and the right apart: each touches the
    ground at a place of its own, so that a shoe stands firm."""

    def pieces() -> list[np.ndarray]:
        levels = vertices[1:-1].reshape(-1, len(t), 3)
        found = []
        half = len(t) // 2
        for a, b in pairwise((0.0, 0.15, 0.3, 0.45, 0.65, 0.85, 1.0)):
            # From heel to toe one index on either side: `t` falls from 1 to 0 over the first half.
            near = [int(np.abs(t[: half + 1] - v).argmin()) for v in (a, b)]
            side = np.arange(near[1], near[0] + 1)
            middle = 0.5 * (levels[:, side] + levels[:, -side])
            for edge in (side, -side):
                found.append(np.concatenate([levels[:, edge], middle]).reshape(-1, 3))
        return found

    return pieces


def _cap(p: Parameters) -> Draft:
    radius, ratio, high, wall = p["radius"], p["ratio"], p["height"], p["wall"]
    rows, segments = 14, 36
    profile = spline(
        [
            [1.0, 0.0],
            [1.0 + p["flare"], 0.3],
            [p["upper"] + 0.1, 0.95],
            [0.5 * p["upper"], 1.0],
            [0.06, 1.0],
        ],
        rows,
    )
    section = superellipse(segments, p["exponent"])

    def levels(shrink: float) -> np.ndarray:
        r = profile[:, 0] * (radius - shrink)
        out = rings(section, r, ratio * r, profile[:, 1] * (high - shrink))
        # The crown leans forwards, its front panel stands up.
        out[..., 0] += p["lean"] * out[..., 2]
        return out

    crown = dome(levels(0.0), levels(wall))
    top = np.array([p["lean"] * high, 0.0, high])
    button = tubes(
        np.stack([top - [0, 0, 0.002], top + [0, 0, 0.5 * p["button"]]])[None],
        width=p["button"],
        height=p["button"],
        up=(1.0, 0.0, 0.0),
        segments=12,
        caps=(0.001, 0.25 * p["button"]),
    )
    # The peak: rows outwards, columns round the front.
    across, out = 21, 8
    angle = np.linspace(-1.0, 1.0, across) * p["peak_angle"]
    s = stations(out)[:, None]
    base = 2.0 ** (1 / p["exponent"] - 0.5)
    inner = (radius - 0.7 * wall) * np.stack([np.cos(angle), ratio * np.sin(angle)], axis=1)
    norm = (np.abs(np.cos(angle)) ** p["exponent"] + np.abs(np.sin(angle)) ** p["exponent"]) ** (
        -1 / p["exponent"]
    )
    inner = inner * np.minimum(norm, base * 1.05)[:, None]
    reach = p["peak_reach"] * (1 - p["peak_round"] * np.abs(angle / p["peak_angle"]) ** 2.5)
    grid = np.empty((out, across, 3))
    grid[..., 0] = inner[:, 0] + s * reach
    grid[..., 1] = inner[:, 1] * (1 - (1 - p["peak_taper"]) * s)
    side = (angle / p["peak_angle"]) ** 2
    droop = (p["peak_drop"] + p["peak_curl"] * side) * p["peak_reach"]
    grid[..., 2] = 0.5 * p["peak_thickness"] + 0.002 - droop * s
    peak = sheet(grid, p["peak_thickness"])

    def peak_pieces() -> list[np.ndarray]:
        # Straight outwards and nearly flat: corners say it all, and contact is quick with few
        # faces. An odd number, so that a hand may hold the one in the middle.
        corners = peak.vertices.reshape(2, out, across, 3)[:, [0, -1], ::4]
        return [corners[:, :, k : k + 2].reshape(-1, 3) for k in range(5)]

    return stand(
        Draft(
            (
                Part(
                    "crown",
                    crown,
                    wall_hulls(crown, rows, sectors=12, cuts=(0, 3, 6, 9, 13), domed=True),
                ),
                Part("button", button, hulls(button)),
                Part("peak", peak, peak_pieces),
            ),
            {
                "head_opening": frame((0.0, 0.0, 0.0), z=(0.0, 0.0, -1.0)),
                "crown": frame(top),
                "brim": frame(grid[-1, across // 2], x=grid[-1, 10] - grid[-2, 10]),
            },
        )
    )


def _hat(p: Parameters) -> Draft:
    radius, ratio, high, wall = p["radius"], p["ratio"], p["height"], p["wall"]
    rows, segments = 22, 36
    edge = radius + p["brim"]
    profile = spline(
        [
            [edge, 0.0],
            [0.5 * (edge + radius), 0.0],
            [radius + 0.004, 0.0],
            [radius, 0.25 * high],
            [radius * p["upper"], 0.85 * high],
            [radius * p["upper"] * 0.95, high],
            [0.5 * radius * p["upper"], high],
            [0.05 * radius, high],
        ],
        rows,
    )
    step = np.gradient(profile, axis=0)
    normal = np.stack([step[:, 1], -step[:, 0]], axis=1)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    under = profile - wall * normal
    section = superellipse(segments, p["exponent"])

    outer, inner = (
        rings(section, curve[:, 0], ratio * curve[:, 0], curve[:, 1]) for curve in (profile, under)
    )
    # Both sides are bent by what the outer one says, so that the felt keeps its thickness.
    x, y = outer[..., 0] / edge, outer[..., 1] / edge
    outside = np.clip((profile[:, 0] - radius) / p["brim"], 0, 1)[:, None]
    level = np.clip(profile[:, 1] / high, 0, 1)[:, None] ** 6
    ridge = np.clip(1 - (outer[..., 1] / (0.75 * ratio * radius * p["upper"])) ** 2, 0, 1)
    lift = outside * edge * (p["curl"] * y * y - p["dip"] * x + p["droop"] * x * x)
    lift -= p["crease"] * high * level * ridge**2  # along the crown
    pinch = 1 - p["pinch"] * level * np.clip(outer[..., 0] / radius, 0, 1)
    for side in (outer, inner):
        side[..., 2] += lift
        side[..., 1] *= pinch
    hat = dome(outer, inner)
    top = outer[-1].mean(axis=0)
    return stand(
        Draft(
            (
                Part(
                    "hat",
                    hat,
                    wall_hulls(hat, rows, sectors=12, cuts=(0, 3, 6, 12, 17, 21), domed=True),
                ),
            ),
            {
                "head_opening": frame((0.0, 0.0, 0.0), z=(0.0, 0.0, -1.0)),
                "crown": frame(top),
                "brim": frame(0.5 * (outer[0, 0] + inner[0, 0])),
            },
        )
    )


_FOOT = {
    "length": (0.15, 0.24),
    "width": (0.06, 0.095),
    "heel_width": (0.6, 0.85),
    "waist_width": (0.5, 0.95),
    "toe_width": (0.35, 0.95),
    "bend": (-0.5, 0.5),
    "heel_height": (0.012, 0.04),
    "fore_height": (0.008, 0.018),
    "arch": (0.0, 0.6),
    "toe_spring": (0.0, 0.012),
    "toe_height": (0.022, 0.042),
    "opening_at": (0.24, 0.3),
    "opening_width": (0.27, 0.36),
    "wall": (0.003, 0.006),
    "collar_slope": (-0.3, 1.0),
}

WEARABLES = (
    Family(
        "shoe",
        {
            **_FOOT,
            "opening_length": (0.16, 0.21),
            "ankle_height": (0.06, 0.085),
            "shaft_height": (0.004, 0.025),
            "shaft_width": (0.85, 1.05),
            "shaft_lean": (-0.3, 0.3),
        },
        _footwear,
        density=450.0,
    ),
    Family(
        "boot",
        {
            **_FOOT,
            "opening_length": (0.15, 0.2),
            "ankle_height": (0.065, 0.085),
            "shaft_height": (0.06, 0.165),
            "shaft_width": (0.95, 1.35),
            "shaft_lean": (-0.15, 0.12),
        },
        _footwear,
        density=450.0,
    ),
    Family(
        "cap",
        {
            "radius": (0.065, 0.095),
            "ratio": (0.78, 1.0),
            "height": (0.055, 0.12),
            "flare": (-0.05, 0.08),
            "upper": (0.6, 1.0),
            "lean": (-0.15, 0.3),
            "exponent": (2.0, 2.6),
            "wall": (0.002, 0.004),
            "button": (0.006, 0.016),
            "peak_angle": (0.75, 1.25),
            "peak_reach": (0.03, 0.085),
            "peak_round": (0.7, 0.95),
            "peak_taper": (0.65, 1.05),
            "peak_drop": (0.0, 0.4),
            "peak_curl": (-0.1, 0.3),
            "peak_thickness": (0.002, 0.005),
        },
        _cap,
        density=350.0,
    ),
    Family(
        "hat",
        {
            "radius": (0.055, 0.08),
            "ratio": (0.75, 0.98),
            "height": (0.05, 0.13),
            "upper": (0.6, 1.05),
            "brim": (0.018, 0.065),
            "curl": (-0.08, 0.15),
            "dip": (0.0, 0.1),
            "droop": (-0.12, 0.06),
            "crease": (0.0, 0.22),
            "pinch": (0.0, 0.3),
            "exponent": (2.0, 2.5),
            "wall": (0.002, 0.004),
        },
        _hat,
        symmetry=Symmetry("z", 2, exact=False),
        density=350.0,
    ),
)
