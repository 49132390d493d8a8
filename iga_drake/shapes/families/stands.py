"""Stands that hold other objects: hook stand, dish rack and coat hanger. They stand on z = 0.

Frames: `base` on the ground; `hook_upper`, `hook_lower`, `hook` and `peg` at the tip of a hook or
peg, x along it outwards; `hook_seat` on top of the upper hook where it is lowest, x level and
outwards; `opening` in the mouth of a rack's holder, z out of it; `bar` in the
middle of a hanger's bar; `shoulder` at the end of a hanger's arm, x outwards.
"""

import numpy as np

from iga_drake.shapes.families.blocks import (
    SHELL_BANDS,
    hulls,
    rings,
    shell,
    shell_bands,
    spline,
    stand,
    stations,
    straight,
    tubes,
    wall_hulls,
)
from iga_drake.shapes.family import Draft, Family, Parameters, Part
from iga_drake.shapes.instance import frame
from iga_drake.shapes.surfaces import loft, superellipse
from iga_drake.shapes.symmetry import Symmetry


def _hook_stand(p: Parameters) -> Draft:
    foot, high, thick = p["foot_width"], p["height"], p["foot_height"]
    z = thick * np.array([0.0, 0.1, 0.6, 0.9, 1.0])
    scale = np.array([0.97, 1.0, 1.0, 0.5 * (1 + p["foot_dome"]), p["foot_dome"]])
    section = superellipse(32, p["foot_exponent"])
    base = loft(rings(section, 0.5 * foot * scale, 0.5 * foot * p["foot_ratio"] * scale, z))

    def foot_pieces() -> list[np.ndarray]:
        # Quarters, each of which touches the ground at a place of its own.
        levels, ends = base.vertices[1:-1].reshape(len(z), -1, 3), base.vertices[[0, -1]]
        quarters = [np.arange(k, k + 9) % 32 for k in (0, 8, 16, 24)]
        return [np.concatenate([levels[:, q].reshape(-1, 3), ends]) for q in quarters]

    pole = p["pole"]
    swell = spline([1.0 + p["pole_root"], 1.0, 1.0, p["pole_top"]], 14)
    stem = tubes(
        straight([[0, 0, 0.5 * thick]], [[0, 0, high]], 14),
        width=pole * swell,
        height=pole * swell,
        up=(1.0, 0.0, 0.0),
        exponent=p["pole_exponent"],
        segments=14,
        caps=(0.001, 0.5 * pole),
    )
    # Two pairs of hooks, the upper pair along x, the lower one turned about the stem.
    level = np.array([p["upper"], p["upper"] - p["stagger"], p["lower"], p["lower"]]) * high
    angle = np.array([0.0, np.pi, p["twist"], p["twist"] + np.pi])
    reach = np.array([1.0, p["rear"], p["lower_reach"], p["lower_reach"] * p["rear"]]) * p["reach"]
    out = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    start = level[:, None] * [0.0, 0.0, 1.0]
    up = np.array([0.0, 0.0, 1.0])
    rise, sag = p["rise"] * p["reach"], p["sag"] * p["reach"]
    control = np.stack(
        [
            start,
            start + 0.55 * reach[:, None] * out - 0.4 * sag * up,
            start + 1.0 * reach[:, None] * out - sag * up,
            start + reach[:, None] * out + rise * up,
        ]
    )
    lines = spline(control, 12).transpose(1, 0, 2)
    thickness = p["hook"] * np.linspace(1.15, 0.85, 12)
    hooks = tubes(
        lines,
        width=thickness,
        height=thickness,
        up=np.stack([-out[:, 1], out[:, 0], 0 * angle], axis=1)[:, None],
        segments=10,
        caps=(0.001, 0.5 * p["hook"]),
    )
    tips = [
        frame(
            lines[k, -1],
            x=lines[k, -1] - lines[k, -2],
            z=np.cross(lines[k, -1] - lines[k, -2], [-out[k, 1], out[k, 0], 0]),
        )
        for k in (0, 2)
    ]
    # Beyond the stem, which the hook begins in.
    lowest = 3 + int(lines[0, 3:, 2].argmin())
    seat = lines[0, lowest] + [0.0, 0.0, 0.5 * thickness[lowest]]
    return Draft(
        (
            Part("foot", base, foot_pieces),
            Part("stem", stem, hulls(stem, segments=14, lengths=3)),
            Part("hooks", hooks, hulls(hooks, 4, segments=10, lengths=4)),
        ),
        {
            "base": frame((0.0, 0.0, 0.0)),
            "hook_upper": tips[0],
            "hook_lower": tips[1],
            "hook_seat": frame(seat),
        },
    )


_PEGS = 6


def _rack(p: Parameters) -> Draft:
    # Pegs stand in two rows along x on a frame of rods; a holder for cutlery at the end at +x.
    length, wide, rod = p["length"], p["width"], p["rod"]
    level = p["clearance"] + 0.5 * rod
    x, y = 0.5 * length, 0.5 * wide
    corners = np.array([[x, y], [-x, y], [-x, -y], [x, -y]])
    frame_rods = tubes(
        straight(
            [[-x, y, level], [-x, -y, level], [x, -y, level], [-x, -y, level], [0, -y, level]],
            [[x, y, level], [x, -y, level], [x, y, level], [-x, y, level], [0, y, level]],
            5,
        ),
        width=rod,
        height=rod,
        segments=10,
        caps=(0.4 * rod, 0.4 * rod),
    )
    ground = np.column_stack([corners * [1.0, 1.0 + p["foot_splay"]], np.full(4, 0.002)])
    feet = tubes(
        straight(ground, np.column_stack([corners, np.full(4, level)]), 4),
        width=p["foot"] * np.linspace(1.0, 0.8, 4),
        height=p["foot"] * np.linspace(1.0, 0.8, 4),
        up=(1.0, 0.0, 0.0),
        segments=10,
    )
    feet.vertices.reshape(4, -1, 3)[:, :11, 2] = 0.0
    along = np.linspace(-0.92, p["peg_end"], _PEGS) * x
    lean, tall = p["peg_lean"], p["peg_height"]
    root = np.concatenate(
        [
            np.stack([along, np.full(_PEGS, s * y * p["peg_rows"]), 0 * along + level], axis=1)
            for s in (1, -1)
        ]
    )
    rows = np.repeat([1.0, p["second_row"]], _PEGS)[:, None]
    tip = root + tall * rows * [np.sin(lean), 0.0, np.cos(lean)]
    tip[:, 1] += np.repeat([1.0, -1.0], _PEGS) * p["peg_spread"] * tall
    pegs = tubes(
        straight(root, tip, 6),
        width=p["peg"] * np.linspace(1.1, p["peg_taper"], 6),
        height=p["peg"] * np.linspace(1.1, p["peg_taper"], 6),
        up=(0.0, 1.0, 0.0),
        segments=8,
        caps=(0.001, 0.5 * p["peg"]),
    )
    bearers = tubes(
        straight(
            [[-x, s * y * p["peg_rows"], level] for s in (1, -1)],
            [[x, s * y * p["peg_rows"], level] for s in (1, -1)],
            5,
        ),
        width=1.2 * rod,
        height=rod,
        segments=10,
    )
    # The holder: an open box at the end.
    deep, high, wall = 0.5 * p["holder_depth"], p["holder_height"], 0.0025
    section = superellipse(24, 6.0)
    z = high * np.array([0.0, 0.04, 0.35, 0.7, 1.0])
    scale = np.array([0.86, 0.9, 0.93, 0.97, 1.0])
    half = 0.5 * p["holder_width"] * wide
    outer = rings(section, deep * scale, half * scale, z)
    z = np.maximum(z, 0.003) + np.array([0.0, 0.003, 0.0, 0.0, 0.0])
    inner = rings(section, deep * scale - wall, half * scale - wall, z)
    centre = np.array([x + deep - 0.004, 0.0, max(level - 0.3 * high, 0.0)])
    outer, inner = outer + centre, inner + centre
    holder = shell(outer, inner)

    return Draft(
        (
            Part("rods", frame_rods, hulls(frame_rods, 5, segments=10)),
            Part("feet", feet, hulls(feet, 4, segments=10)),
            Part("bearers", bearers, hulls(bearers, 2, segments=10)),
            Part("pegs", pegs, hulls(pegs, 2 * _PEGS, segments=8)),
            Part(
                "holder",
                holder,
                wall_hulls(holder, 5, sectors=12, cuts=(0, 4)),
                bands=(tuple(f"holder_{name}" for name in SHELL_BANDS), shell_bands(5, 5, 24)),
            ),
        ),
        {
            "base": frame((0.0, 0.0, 0.0)),
            "peg": frame(tip[0], x=tip[0] - root[0], z=(-np.cos(lean), 0.0, np.sin(lean))),
            "opening": frame(centre + [0.0, 0.0, high]),
        },
    )


def _coat_hanger(p: Parameters) -> Draft:
    # In the xz plane: the arms along x, the hook up along z and open towards -x.
    half, fall, thick = 0.5 * p["width"], p["fall"], p["thickness"]
    arch = p["arch"] * fall
    forward = p["forward"] * half
    left = np.array(
        [
            [-half, forward, 0.0],
            [-half * 0.75, 0.5 * forward, 0.3 * fall + arch],
            [-half * 0.3, 0.0, 0.85 * fall + arch],
            [0.0, 0.0, fall + p["peak"] * fall],
        ]
    )
    arms = spline(np.concatenate([left, left[2::-1] * [-1, 1, 1]]), 33)
    arms[:, 1] -= 0.4 * forward
    swell = spline([p["end"], p["shoulder"], 1.0, 1.0, 1.0, p["shoulder"], p["end"]], 33)
    arm = tubes(
        arms[None],
        width=thick * swell,
        height=thick * p["flatness"] * (0.4 + 0.6 * swell),
        exponent=p["exponent"],
        segments=14,
        caps=(0.3 * thick, 0.3 * thick),
    )
    inset = p["bar_inset"]
    end = np.array([np.interp(inset, stations(33), arms[:, k]) for k in range(3)])
    drop = p["bar_drop"] * fall
    bar_path = spline(
        [
            end,
            end + [-0.02 * half, 0.0, -drop],
            end * [0.85, 1, 1] + [0.0, 0.0, -1.2 * drop],
            end * [-0.85, 1, 1] + [0.0, 0.0, -1.2 * drop],
            end * [-1, 1, 1] + [0.02 * half, 0.0, -drop],
            end * [-1, 1, 1],
        ],
        31,
    )
    bar = tubes(bar_path[None], width=p["bar"], height=p["bar"], up=(0.0, 1.0, 0.0), segments=10)
    top = arms[16, 2]
    neck, round_ = p["neck"], p["hook_radius"]
    turn = np.linspace(-0.5 * np.pi, p["hook_turn"], 22)
    # From the foot of the neck up, then round clockwise seen from -y.
    circle = np.stack(
        [round_ * np.cos(turn), 0 * turn, top + neck + round_ + round_ * np.sin(turn)], axis=1
    )
    stem = straight(
        [[0.0, 0.5 * arms[16, 1], top - 0.3 * thick]], [[0.0, 0.0, top + neck - 0.25 * round_]], 5
    )[0]
    line = np.concatenate([stem, circle[1:]])
    hook = tubes(
        line[None],
        width=p["wire"],
        height=p["wire"],
        up=(0.0, 1.0, 0.0),
        segments=10,
        caps=(0.001, 0.5 * p["wire"]),
    )
    return stand(
        Draft(
            (
                Part("arms", arm, hulls(arm, segments=14, lengths=10)),
                Part("bar", bar, hulls(bar, segments=10, lengths=8)),
                Part("hook", hook, hulls(hook, segments=10, lengths=10)),
            ),
            {
                "hook": frame(line[-1], x=line[-1] - line[-2], z=(0.0, 1.0, 0.0)),
                "bar": frame(bar_path[15]),
                "shoulder": frame(arms[-1]),
            },
        )
    )


STANDS = (
    Family(
        "hook_stand",
        {
            "foot_width": (0.09, 0.17),
            "foot_ratio": (0.6, 1.0),
            "foot_height": (0.008, 0.024),
            "foot_dome": (0.25, 0.95),
            "foot_exponent": (2.0, 8.0),
            "height": (0.17, 0.29),
            "pole": (0.01, 0.024),
            "pole_root": (-0.1, 0.8),
            "pole_top": (0.5, 1.4),
            "pole_exponent": (2.0, 6.0),
            "upper": (0.78, 0.96),
            "stagger": (0.0, 0.2),
            "lower": (0.3, 0.6),
            "twist": (-1.2, 1.2),
            "reach": (0.045, 0.085),
            "rear": (0.25, 0.9),
            "lower_reach": (0.5, 1.1),
            "rise": (0.2, 0.7),
            "sag": (-0.1, 0.15),
            "hook": (0.006, 0.012),
        },
        _hook_stand,
        symmetry=Symmetry("z", 2, exact=False),
        density=700.0,
    ),
    Family(
        "rack",
        {
            "length": (0.14, 0.24),
            "width": (0.09, 0.17),
            "rod": (0.005, 0.01),
            "clearance": (0.015, 0.035),
            "foot": (0.008, 0.018),
            "foot_splay": (-0.05, 0.08),
            "peg": (0.005, 0.009),
            "peg_height": (0.04, 0.11),
            "peg_lean": (-0.1, 0.5),
            "peg_taper": (0.5, 1.1),
            "peg_rows": (0.3, 0.85),
            "peg_end": (0.55, 0.92),
            "peg_spread": (-0.15, 0.25),
            "second_row": (0.6, 1.0),
            "holder_depth": (0.03, 0.055),
            "holder_width": (0.4, 0.95),
            "holder_height": (0.05, 0.11),
        },
        _rack,
        density=900.0,
    ),
    Family(
        "coat_hanger",
        {
            "width": (0.19, 0.305),
            "fall": (0.03, 0.075),
            "arch": (-0.15, 0.5),
            "forward": (0.0, 0.12),
            "peak": (-0.1, 0.25),
            "thickness": (0.008, 0.014),
            "flatness": (0.8, 1.8),
            "shoulder": (0.9, 2.4),
            "end": (0.6, 1.6),
            "exponent": (2.0, 4.0),
            "bar": (0.004, 0.009),
            "bar_inset": (0.05, 0.2),
            "bar_drop": (-0.1, 0.5),
            "neck": (0.004, 0.035),
            "wire": (0.004, 0.007),
            "hook_radius": (0.014, 0.028),
            "hook_turn": (2.4, 3.6),
        },
        _coat_hanger,
        symmetry=Symmetry("z", 2, exact=False),
        density=800.0,
    ),
)
