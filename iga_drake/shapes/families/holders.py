"""Holders with thin parts: a tree of pegs, a rail of hooks, a crate with a low side. They stand on
z = 0.

Frames: `base` on the ground; `peg_top` and `peg_low` at the tips of a tree's highest and lowest
peg, x along it outwards; `hook_first` and `hook_last` at the tips of a rail's outer hooks, x along
them; `opening` in the middle of a crate's mouth, z out of it; `floor` on its inner floor; `sill` in
the middle of the rim of its low side, x outwards.
"""

import numpy as np

from iga_drake.shapes.families.blocks import (
    SHELL_BANDS,
    hulls,
    rings,
    shell,
    shell_bands,
    spline,
    straight,
    tubes,
    wall_hulls,
)
from iga_drake.shapes.family import Draft, Family, Parameters, Part
from iga_drake.shapes.instance import frame
from iga_drake.shapes.surfaces import loft, superellipse

_PEGS = 6
_HOOKS = 4
_SEGMENTS = 48


def _peg_tree(p: Parameters) -> Draft:
    foot, high, thick = 0.5 * p["foot"], p["height"], p["foot_height"]
    z = thick * np.array([0.0, 0.1, 0.6, 0.9, 1.0])
    scale = foot * np.array([0.97, 1.0, 1.0, 0.8, p["foot_top"]])
    section = superellipse(32, p["foot_exponent"])
    base = loft(rings(section, scale, p["foot_ratio"] * scale, z))
    pole = p["pole"]
    stem = tubes(
        straight([[0, 0, 0.5 * thick]], [[0, 0, high]], 14),
        width=pole * np.linspace(1.15, 0.9, 14),
        height=pole * np.linspace(1.15, 0.9, 14),
        up=(1.0, 0.0, 0.0),
        segments=14,
        caps=(0.001, 0.5 * pole),
    )
    # From the top down, in turn about the stem.
    order = np.arange(_PEGS)
    level = high * np.linspace(p["highest"], p["lowest"], _PEGS)
    angle = p["first_angle"] + p["turn"] * order
    out = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    length = p["peg_length"] * np.linspace(1.0, p["low_length"], _PEGS)[:, None]
    rise = np.array([0.0, 0.0, 1.0])
    root = level[:, None] * rise
    tip = root + length * (np.cos(p["peg_rise"]) * out + np.sin(p["peg_rise"]) * rise)
    middle = 0.5 * (root + tip) - p["peg_sag"] * length * rise
    lines = spline(np.stack([root, middle, tip]), 8).transpose(1, 0, 2)
    pegs = tubes(
        lines,
        width=p["peg"] * np.linspace(1.1, p["peg_taper"], 8),
        height=p["peg"] * np.linspace(1.1, p["peg_taper"], 8),
        up=np.stack([-out[:, 1], out[:, 0], 0 * angle], axis=1)[:, None],
        segments=10,
        caps=(0.001, 0.5 * p["peg"]),
    )

    def at_tip(k: int) -> np.ndarray:
        along = lines[k, -1] - lines[k, -2]
        return frame(lines[k, -1], x=along, z=np.cross(along, [-out[k, 1], out[k, 0], 0]))

    return Draft(
        (
            Part("foot", base, lambda: [base.vertices]),
            Part("stem", stem, hulls(stem, segments=14, lengths=3)),
            Part("pegs", pegs, hulls(pegs, _PEGS, segments=10, lengths=2)),
        ),
        {"base": frame((0.0, 0.0, 0.0)), "peg_top": at_tip(0), "peg_low": at_tip(_PEGS - 1)},
    )


def _hook_rail(p: Parameters) -> Draft:
    # A board that stands across x on two feet; hooks reach out to +x.
    wide, high, thick = p["width"], p["height"], p["thickness"]
    y = 0.5 * wide
    board = tubes(
        straight([[0, -y, p["board_low"] * high + 0.5 * p["board"]]] * 1,
                 [[0, y, p["board_low"] * high + 0.5 * p["board"]]], 9),
        width=thick,
        height=p["board"],
        exponent=p["exponent"],
        segments=20,
    )  # fmt: skip
    middle = p["board_low"] * high + 0.5 * p["board"]
    at = y * p["feet_apart"]
    posts = tubes(
        straight([[0, s * at, 0.004] for s in (1, -1)], [[0, s * at, middle] for s in (1, -1)], 6),
        width=p["post"],
        height=p["post"],
        up=(1.0, 0.0, 0.0),
        segments=10,
        caps=(0.0, 0.001),
    )
    reach = p["foot_reach"]
    feet = tubes(
        straight(
            [[-0.2 * reach, s * at, 0.5 * p["post"]] for s in (1, -1)],
            [[reach, s * at, 0.5 * p["post"]] for s in (1, -1)],
            6,
        ),
        width=1.4 * p["post"],
        height=p["post"],
        exponent=6.0,
        segments=12,
    )
    lowest = feet.vertices[:, 2].min()
    place = y * np.linspace(-1, 1, _HOOKS) * p["spread"] + p["shift"] * y * (1 - p["spread"])
    size = p["hook_reach"] * np.linspace(1.0, p["last_hook"], _HOOKS)
    start = np.stack([0 * place, place, 0 * place + middle], axis=1)
    ahead, rise = np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0])
    control = np.stack(
        [
            start,
            start + size[:, None] * (0.7 * ahead - 0.1 * rise),
            start + size[:, None] * (1.1 * ahead - p["sag"] * rise),
            start + size[:, None] * (ahead + p["rise"] * rise),
        ]
    )
    lines = spline(control, 12).transpose(1, 0, 2)
    hooks = tubes(
        lines,
        width=p["hook"] * np.linspace(1.1, 0.85, 12),
        height=p["hook"] * np.linspace(1.1, 0.85, 12),
        up=(0.0, 1.0, 0.0),
        segments=10,
        caps=(0.001, 0.5 * p["hook"]),
    )
    down = np.array([0.0, 0.0, -lowest])
    for surface in (board, posts, feet, hooks):
        surface.vertices[:] += down
    posts.vertices[:, 2] = np.maximum(posts.vertices[:, 2], 0.001)
    lines = lines + down

    def at_tip(k: int) -> np.ndarray:
        along = lines[k, -1] - lines[k, -2]
        return frame(lines[k, -1], x=along, z=(0.0, 1.0, 0.0))

    return Draft(
        (
            Part("board", board, hulls(board, segments=20)),
            Part("posts", posts, hulls(posts, 2, segments=10)),
            Part("feet", feet, hulls(feet, 2, segments=12)),
            Part("hooks", hooks, hulls(hooks, _HOOKS, segments=10, lengths=4)),
        ),
        {"base": frame((0.0, 0.0, 0.0)), "hook_first": at_tip(0), "hook_last": at_tip(_HOOKS - 1)},
    )


def _crate(p: Parameters) -> Draft:
    # The side at +x is low.
    high, wall, floor = p["height"], p["wall"], 1.3 * p["wall"]
    z = high * np.array([0.0, 0.03, 0.1, 0.3, 0.5, 0.7, 0.9, 1.0])
    scale = np.interp(z / high, [0, 1], [p["taper"], 1.0])
    scale[0] *= 0.97
    a, b = 0.5 * p["length"], 0.5 * p["length"] * p["ratio"]
    section = superellipse(_SEGMENTS, p["exponent"])
    outer = rings(section, a * scale, b * scale, z)
    inside = floor + z * (1 - floor / high)
    inner_scale = np.interp(inside / high, [0, 1], [p["taper"], 1.0])
    inner = rings(section, a * inner_scale - wall, b * inner_scale - wall, inside)
    # How far a place is towards +x says how low its rim is.
    towards = np.clip((section[:, 0] / np.abs(section[:, 0]).max() - p["edge"]) / 0.3, 0, 1)
    low = 1 - (1 - p["low_side"]) * towards * towards * (3 - 2 * towards)  # (segments,)
    outer[..., 2] = outer[..., 2] * low
    inner[..., 2] = floor + (inner[..., 2] - floor) * (low - floor / high) / (1 - floor / high)
    body = shell(outer, inner)
    return Draft(
        (
            Part(
                "body",
                body,
                wall_hulls(body, 8, sectors=16, cuts=(0, 7)),
                bands=(SHELL_BANDS, shell_bands(8, 8, _SEGMENTS)),
            ),
        ),
        {
            "base": frame((0.0, 0.0, 0.0)),
            "floor": frame((0.0, 0.0, floor)),
            "opening": frame((0.0, 0.0, high)),
            "sill": frame((a - 0.5 * wall, 0.0, high * p["low_side"])),
        },
    )


HOLDERS = (
    Family(
        "peg_tree",
        {
            "foot": (0.07, 0.16),
            "foot_ratio": (0.7, 1.0),
            "foot_height": (0.006, 0.025),
            "foot_top": (0.2, 0.7),
            "foot_exponent": (2.0, 8.0),
            "height": (0.15, 0.27),
            "pole": (0.008, 0.022),
            "highest": (0.8, 0.96),
            "lowest": (0.3, 0.6),
            "first_angle": (-0.6, 0.6),
            "turn": (1.7, 2.6),
            "peg_length": (0.035, 0.09),
            "low_length": (0.7, 1.4),
            "peg_rise": (0.1, 1.0),
            "peg_sag": (-0.05, 0.2),
            "peg": (0.004, 0.01),
            "peg_taper": (0.6, 1.2),
        },
        _peg_tree,
        density=700.0,
    ),
    Family(
        "hook_rail",
        {
            "width": (0.13, 0.28),
            "height": (0.11, 0.24),
            "thickness": (0.006, 0.016),
            "board": (0.02, 0.07),
            "board_low": (0.5, 0.8),
            "exponent": (4.0, 12.0),
            "feet_apart": (0.5, 0.9),
            "post": (0.007, 0.014),
            "foot_reach": (0.06, 0.12),
            "spread": (0.55, 0.9),
            "shift": (-0.6, 0.6),
            "hook_reach": (0.035, 0.075),
            "last_hook": (0.6, 1.0),
            "sag": (0.0, 0.5),
            "rise": (0.2, 0.7),
            "hook": (0.004, 0.009),
        },
        _hook_rail,
        density=700.0,
    ),
    Family(
        "crate",
        {
            "length": (0.12, 0.26),
            "ratio": (0.5, 1.3),
            "height": (0.05, 0.16),
            "exponent": (4.0, 16.0),
            "taper": (0.7, 1.0),
            "wall": (0.003, 0.007),
            "low_side": (0.3, 0.75),
            "edge": (0.3, 0.65),
        },
        _crate,
        density=500.0,
    ),
)
