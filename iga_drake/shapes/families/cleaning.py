"""Things to clean with: brush, broom head and dustpan. They lie on z = 0, the handle towards +x.

Frames: `grip` in the middle of the handle, x along it outwards; `bristles` in the middle of the
bristles' ends, z up from them; `socket` in the mouth of a broom head's socket, x out of it;
`edge` in the middle of a dustpan's edge, x outwards over the ground.
"""

import numpy as np

from iga_drake.shapes.families.blocks import (
    hulls,
    rings,
    sheet,
    sheet_pieces,
    spline,
    stand,
    stations,
    straight,
    tubes,
)
from iga_drake.shapes.family import Draft, Family, Parameters, Part
from iga_drake.shapes.instance import frame
from iga_drake.shapes.surfaces import Surface, loft, superellipse
from iga_drake.shapes.symmetry import Symmetry


def _bristles(length: float, width: float, p: Parameters, top: float) -> Surface:
    """A body of bristles from z = 0 to `top`, as wide as a block (m) at the top."""
    section = superellipse(32, 5.0)
    scale = spline([p["flare"], 0.5 * (1 + p["flare"]), 1.0, 1.0], 7)
    z = top * stations(7)
    levels = rings(section, 0.5 * length * scale, 0.5 * width * (0.4 + 0.6 * scale), z)
    # Trimmed askew: the lower end rises towards one end of the block.
    slope = p["trim"] * levels[0, :, 0] / (0.5 * length)
    levels[..., 2] += np.outer(1 - stations(7), slope) * 0.3 * top
    return loft(levels)


def _brush(p: Parameters) -> Draft:
    length, wide, thick, fall = p["length"], p["width"], p["block"], p["bristle_length"]
    s = stations(12)
    profile = spline([p["front"], 1.0, 1.0, p["waist"], p["rear"]], 12)
    arch = p["arch"] * length * 4 * s * (1 - s)
    path = np.stack([length * (0.5 - s), 0 * s, fall + 0.5 * thick + arch], axis=1)[::-1]
    block = tubes(
        path[None],
        width=(wide * profile)[::-1],
        height=thick * (1 - 0.3 * (2 * s - 1) ** 2),
        exponent=p["exponent"],
        segments=20,
        caps=(0.004, 0.004),
    )
    bristles = _bristles(0.9 * length, 0.8 * wide * min(1.0, p["waist"]), p, fall + 0.4 * thick)
    reach, rise = p["handle_length"], p["handle_rise"]
    start = path[-1] - [0.012, 0.0, 0.0]
    bow = p["handle_bow"] * reach
    line = spline(
        [
            start,
            start + [0.35 * reach, 0.0, 0.2 * rise * reach + bow],
            start + [0.7 * reach, 0.0, 0.6 * rise * reach + bow],
            start + [reach, 0.0, rise * reach],
        ],
        16,
    )
    grip = p["handle_width"]
    swell = spline([p["neck"], p["neck"], 1.0, 1.1, p["end"]], 16)
    handle = tubes(
        line[None],
        width=grip * swell,
        height=grip * p["handle_flatness"] * (0.5 + 0.5 * swell),
        exponent=2.5,
        segments=14,
        caps=(0.001, 0.3 * grip),
    )
    return stand(
        Draft(
            (
                Part("block", block, hulls(block, segments=20, lengths=4)),
                Part("bristles", bristles, lambda: [bristles.vertices]),
                Part("handle", handle, hulls(handle, segments=14, lengths=5)),
            ),
            {
                "bristles": frame((0.0, 0.0, 0.0)),
                "grip": frame(line[9], x=line[10] - line[8]),
            },
        )
    )


def _broom_head(p: Parameters) -> Draft:
    # The block runs along y; the socket leans from its middle towards +x.
    length, wide, thick, fall = p["length"], p["width"], p["block"], p["bristle_length"]
    s = stations(15)
    profile = spline([p["ends"], 1.0, p["middle"], 1.0, p["ends"]], 15)
    arch = p["arch"] * thick * 4 * s * (1 - s)
    path = np.stack([0 * s, length * (s - 0.5), fall + 0.5 * thick + arch], axis=1)
    block = tubes(
        path[None],
        width=wide * profile,
        height=thick * (0.7 + 0.3 * profile),
        exponent=p["exponent"],
        segments=20,
        caps=(0.004, 0.004),
    )
    section = superellipse(36, 5.0)
    z = (fall + 0.4 * thick) * stations(7)
    flare = spline([p["flare"], 0.5 + 0.5 * p["flare"], 1.0, 1.0], 7)
    levels = rings(section, 0.42 * wide * min(1.0, p["middle"]) * flare, 0.48 * length * flare, z)
    levels[..., 0] += p["sweep"] * fall * (1 - stations(7))[:, None] ** 2
    bristles = loft(levels)
    lean = p["lean"]
    out = np.array([np.sin(lean), 0.0, np.cos(lean)])
    foot = path[7] + [0.0, 0.0, 0.2 * thick]
    tall, tube = p["socket_length"], p["socket_width"]
    swell = spline([p["socket_foot"], 1.0, 1.0, 1.0, p["socket_lip"]], 12)
    socket = tubes(
        straight([foot], [foot + tall * out], 12),
        width=tube * swell,
        height=tube * swell,
        up=(0.0, 1.0, 0.0),
        segments=20,
        caps=(0.001, 0.001),
    )
    return stand(
        Draft(
            (
                Part("block", block, hulls(block, segments=20, lengths=6)),
                Part("bristles", bristles, hulls(bristles, segments=36, lengths=3)),
                Part("socket", socket, hulls(socket, segments=20, lengths=2)),
            ),
            {
                "bristles": frame((0.0, 0.0, 0.0)),
                "socket": frame(foot + tall * out, x=out, z=(-out[2], 0.0, out[0])),
            },
        )
    )


def _dustpan(p: Parameters) -> Draft:
    length, wide, deep = p["length"], p["width"], p["depth"]
    rows, columns = 14, 25
    # The scoop: rows from the edge at -x to the back wall, columns across; sides rise.
    s, t = stations(rows)[:, None], np.linspace(-1.0, 1.0, columns)
    half = 0.5 * wide * (p["rear_width"] + (1 - p["rear_width"]) * (1 - s))
    side = np.clip((np.abs(t) - 0.68) / 0.32, 0, 1) ** p["side_edge"]
    back = np.clip((s - 0.7) / 0.3, 0, 1) ** p["back_edge"]
    grid = np.empty((rows, columns, 3))
    grid[..., 0] = -0.5 * length + length * np.minimum(s, 0.7 + 0.15 * s) * np.ones(columns)
    grid[..., 1] = half * np.clip(t / 0.78, -1, 1) * (1 - p["lean_in"] * side) + 0.02 * t * side
    height = (s ** p["side_rise"] * side) * p["side_height"] * deep
    grid[..., 2] = np.maximum(height, back * deep) + p["hump"] * deep * s * (1 - s) * 4
    scoop = sheet(grid, p["wall"] * (0.6 + 0.4 * np.minimum(4 * s, 1)) * np.ones(columns))
    back_x = grid[-1, columns // 2, 0]
    reach, rise = p["handle_length"], p["handle_rise"]
    low = p["handle_level"] * deep
    start = np.array([back_x - 0.006, 0.0, low])
    line = spline(
        [
            start,
            start + [0.35 * reach, 0.0, 0.1 * rise * reach],
            start + [0.7 * reach, 0.0, (0.6 * rise + p["handle_bow"]) * reach],
            start + [reach, 0.0, rise * reach],
        ],
        16,
    )
    grip = p["handle_width"]
    swell = spline([p["handle_root"], 0.8, 1.0, p["handle_end"]], 16)
    handle = tubes(
        line[None],
        width=grip * swell,
        height=grip * p["handle_flatness"] * (0.6 + 0.4 * swell),
        exponent=2.8,
        segments=14,
        caps=(0.001, 0.3 * grip),
    )
    return stand(
        Draft(
            (
                Part("scoop", scoop, sheet_pieces(scoop, (rows, columns), cuts=(5, 8))),
                Part("handle", handle, hulls(handle, segments=14, lengths=5)),
            ),
            {
                "edge": frame(grid[0, columns // 2], x=(-1.0, 0.0, 0.0)),
                "grip": frame(line[9], x=line[10] - line[8]),
            },
        )
    )


CLEANING = (
    Family(
        "brush",
        {
            "length": (0.06, 0.15),
            "width": (0.025, 0.07),
            "block": (0.01, 0.026),
            "front": (0.5, 1.0),
            "waist": (0.75, 1.15),
            "rear": (0.4, 1.0),
            "exponent": (2.5, 7.0),
            "arch": (0.0, 0.08),
            "bristle_length": (0.03, 0.065),
            "flare": (0.8, 1.3),
            "trim": (-0.6, 0.6),
            "handle_length": (0.07, 0.17),
            "handle_rise": (-0.08, 0.5),
            "handle_bow": (-0.08, 0.12),
            "handle_width": (0.014, 0.028),
            "handle_flatness": (0.45, 1.0),
            "neck": (0.5, 1.1),
            "end": (0.6, 1.4),
        },
        _brush,
        density=500.0,
    ),
    Family(
        "broom_head",
        {
            "length": (0.15, 0.31),
            "width": (0.03, 0.07),
            "block": (0.014, 0.035),
            "ends": (0.45, 1.0),
            "middle": (0.8, 1.4),
            "exponent": (2.5, 7.0),
            "arch": (-0.2, 0.6),
            "bristle_length": (0.03, 0.1),
            "flare": (0.85, 1.1),
            "sweep": (-0.35, 0.35),
            "lean": (0.15, 0.9),
            "socket_length": (0.04, 0.09),
            "socket_width": (0.02, 0.036),
            "socket_foot": (1.0, 1.7),
            "socket_lip": (0.8, 1.2),
        },
        _broom_head,
        symmetry=Symmetry("z", 2, exact=False),
        density=400.0,
    ),
    Family(
        "dustpan",
        {
            "length": (0.12, 0.19),
            "width": (0.12, 0.22),
            "rear_width": (0.6, 1.05),
            "depth": (0.025, 0.06),
            "side_height": (0.6, 1.2),
            "side_rise": (0.3, 1.2),
            "side_edge": (0.9, 1.6),
            "back_edge": (0.9, 1.6),
            "lean_in": (-0.05, 0.08),
            "hump": (0.0, 0.08),
            "wall": (0.002, 0.005),
            "handle_length": (0.07, 0.15),
            "handle_level": (0.3, 0.9),
            "handle_rise": (-0.1, 0.6),
            "handle_bow": (-0.1, 0.15),
            "handle_width": (0.014, 0.034),
            "handle_flatness": (0.4, 1.0),
            "handle_root": (0.7, 1.8),
            "handle_end": (0.6, 1.3),
        },
        _dustpan,
        density=900.0,
    ),
)
