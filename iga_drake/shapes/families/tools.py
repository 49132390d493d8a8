"""Hand tools: hammer, screwdriver, spatula, trowel, knife and pliers.

They stand on the end of the grip: the grip's axis is O's z axis, the lowest point at z = 0. Frames:
`grip` in the middle of the grip, x along it towards the working end; `striking_face`, `claw`,
`tip` and `jaws` at the working end, x outwards; `blade` in the middle of a blade, z off its upper
side; `blade_edge` on the edge that works, x outwards.
"""

import numpy as np

from iga_drake.shapes.families.blocks import (
    hulls,
    rounded_edge,
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
from iga_drake.shapes.surfaces import Surface, loft_face_bands
from iga_drake.shapes.symmetry import Symmetry

_UP = (0.0, 0.0, 1.0)


def _grip(
    path: np.ndarray, width: np.ndarray, height: np.ndarray, exponent: float, cap: float
) -> Surface:
    """A handle along a path (N, 3) that rises from z = 0; `width` is along y, `height` along x."""
    return tubes(
        path[None],
        width=width,
        height=height,
        exponent=exponent,
        up=(1.0, 0.0, 0.0),
        segments=16,
        caps=(cap, 0.5 * cap),
    )


def _rise(length: float, bend: float, count: int, start: float = 0.0) -> np.ndarray:
    """(count, 3) a path from z = `start` up, bowed by `bend` (m) along x."""
    s = stations(count)
    return np.stack([bend * 4 * s * (1 - s), 0 * s, start + s * (length - start)], axis=1)


def _hammer(p: Parameters) -> Draft:
    length, wide = p["length"], p["grip_width"]
    profile = spline([0.85, 1 + p["grip_swell"], 1.0, p["neck"], p["neck"], 0.9 * p["neck"]], 28)
    cap = 0.25 * wide
    handle = _grip(
        _rise(length, p["grip_bend"], 28, cap),
        wide * p["grip_flatness"] * profile,
        wide * profile,
        p["grip_exponent"],
        cap,
    )
    size, reach = p["head_size"], p["head_length"]
    front, back = (1 - p["claw_share"]) * reach, p["claw_share"] * reach
    x = np.concatenate([np.linspace(-back, -0.12 * back, 9), np.linspace(0, front, 9)])
    behind = np.clip(-x / back, 0, 1)
    z = length - 0.25 * size - p["claw_droop"] * behind**2
    thick = np.interp(
        x / reach,
        [-p["claw_share"], -0.12, 0.12, 0.3, 0.38, 1 - p["claw_share"]],
        [p["claw_thin"], 1.0, 1.0, p["cheek"], p["face"], p["face"]],
    )
    broad = np.interp(
        x / reach,
        [-p["claw_share"], -0.12, 0.12, 0.3, 0.38, 1 - p["claw_share"]],
        [p["claw_spread"], 1.0, 1.0, p["cheek"], p["face"], p["face"]],
    )
    head = tubes(
        np.stack([x, 0 * x, z], axis=1)[None],
        width=size * p["head_ratio"] * broad,
        height=size * thick,
        exponent=p["head_exponent"],
        segments=16,
        caps=(0.002, 0.002),
    )
    band = loft_face_bands(22, 16)
    of_band = np.repeat([0, 1, 2], [9, 7, 7])
    return stand(
        Draft(
            (
                Part("handle", handle, hulls(handle, segments=16, lengths=4)),
                Part(
                    "head",
                    head,
                    hulls(head, segments=16, lengths=6),
                    bands=(("claw", "cheek", "striking_face"), of_band[band]),
                ),
            ),
            {
                "grip": frame((p["grip_bend"], 0.0, 0.35 * length), x=_UP, z=(1.0, 0.0, 0.0)),
                "striking_face": frame((front + 0.002, 0.0, z[-1])),
                "claw": frame((-back - 0.002, 0.0, z[0]), x=(x[0] - x[1], 0.0, z[0] - z[1])),
            },
        )
    )


def _screwdriver(p: Parameters) -> Draft:
    grip, wide, shaft = p["grip_length"], p["grip_width"], p["shaft_length"]
    profile = spline(
        [p["butt"], 1.0 + p["bulge"], 1.0 - p["waist"], 1.05, p["collar"], 0.6 * p["collar"]], 18
    )
    cap = 0.3 * wide
    handle = tubes(
        straight([[0, 0, cap]], [[0, 0, grip]], 18),
        width=wide * profile,
        height=wide * profile,
        exponent=p["grip_exponent"],
        up=(1.0, 0.0, 0.0),
        segments=24,
        caps=(cap, 0.002),
    )
    thick = p["shaft_width"]
    s = stations(16)
    flat = np.interp(s, [0, 1 - p["blade"], 1], [1, 1, p["tip_thin"]])
    broad = np.interp(s, [0, 1 - p["blade"], 1 - 0.6 * p["blade"], 1], [1, 1, p["flare"], 0.9])
    end = grip + shaft
    rod = tubes(
        straight([[0, 0, grip - 0.008]], [[0, 0, end]], 16),
        width=thick * broad,
        height=thick * flat,
        up=(1.0, 0.0, 0.0),
        segments=14,
        exponent=p["shaft_exponent"],
    )
    ferrule = tubes(
        straight([[0, 0, grip - 0.004]], [[0, 0, grip + p["ferrule"]]], 4),
        width=thick * p["ferrule_width"],
        height=thick * p["ferrule_width"],
        up=(1.0, 0.0, 0.0),
        segments=16,
    )
    return stand(
        Draft(
            (
                Part("handle", handle, hulls(handle, segments=24, lengths=4)),
                Part("ferrule", ferrule, hulls(ferrule, segments=16)),
                Part("shaft", rod, hulls(rod, segments=14, lengths=3)),
            ),
            {
                "grip": frame((0.0, 0.0, 0.5 * grip), x=_UP, z=(1.0, 0.0, 0.0)),
                "tip": frame((0.0, 0.0, end), x=_UP, z=(1.0, 0.0, 0.0)),
            },
        )
    )


def _handle_and_neck(p: Parameters) -> tuple[Surface, Surface, np.ndarray]:
    """A flat handle and a neck that leans towards +x; also the neck's path (N, 3)."""
    length, wide = p["handle_length"], p["handle_width"]
    profile = spline([p["butt"], 1.0, 1 - p["waist"], p["shoulder"], 0.5 * p["shoulder"]], 14)
    cap = 0.3 * wide
    handle = _grip(
        _rise(length, p["handle_bow"], 14, cap),
        wide * profile,
        wide * p["handle_flatness"] * profile,
        p["handle_exponent"],
        cap,
    )
    reach, step = p["neck_length"], p["neck_offset"]
    path = spline(
        [
            [0.0, 0.0, length - 0.012],
            [0.0, 0.0, length + 0.4 * reach],
            [step, 0.0, length + 0.6 * reach],
            [step, 0.0, length + reach + 0.01],
        ],
        14,
    )
    thick = p["neck_width"]
    neck = tubes(
        path[None],
        width=np.linspace(thick, 1.4 * thick, 14),
        height=np.linspace(thick, 0.5 * thick, 14),
        up=(1.0, 0.0, 0.0),
        segments=12,
    )
    return handle, neck, path


def _handle_parts(handle: Surface, neck: Surface) -> tuple[Part, Part]:
    return (
        Part("handle", handle, hulls(handle, segments=16, lengths=4)),
        Part("neck", neck, hulls(neck, lengths=4)),
    )


def _blade_grid(
    origin: np.ndarray, half: np.ndarray, length: float, angle: float, columns: int, curl: float
) -> np.ndarray:
    """(M, N, 3) a blade that starts at `origin`, leans by `angle` from z to x and spans y.

    `half` (M,) is its half width, `curl` (m) how far its end bends out of its plane.
    """
    s = stations(len(half))
    along = s[:, None] * length
    off = curl * s[:, None] ** 2
    grid = np.empty((len(half), columns, 3))
    grid[..., 0] = origin[0] + along * np.sin(angle) + off * np.cos(angle)
    grid[..., 1] = half[:, None] * np.linspace(-1, 1, columns)
    grid[..., 2] = origin[2] + along * np.cos(angle) - off * np.sin(angle)
    return grid


def _spatula(p: Parameters) -> Draft:
    handle, neck, path = _handle_and_neck(p)
    wide = 0.5 * p["blade_width"]
    half = wide * spline([p["blade_start"], 1.0, 1.0, p["blade_end"], 0.75 * p["blade_end"]], 14)
    start = path[-1] - [0.0, 0.0, 0.008]
    angle = p["blade_angle"]
    grid = _blade_grid(start, half, p["blade_length"], angle, 13, p["blade_curl"])
    corner = p["tip_round"] * p["blade_length"] * (grid[-1, :, 1] / half[-1]) ** 2
    grid[..., 2] -= corner * stations(14)[:, None] ** 3 * np.cos(angle)
    grid[..., 0] -= corner * stations(14)[:, None] ** 3 * np.sin(angle)
    camber = p["camber"] * p["blade_width"] * (grid[..., 1] / wide) ** 2
    grid[..., 0] += camber * np.cos(angle)
    grid[..., 2] -= camber * np.sin(angle)
    blade = sheet(grid, p["blade_thickness"] * rounded_edge(14, 13, 0.5))
    middle, edge = grid[7, 6], grid[-1, 6]
    direction = np.array([np.sin(angle), 0.0, np.cos(angle)])
    off = np.array([np.cos(angle), 0.0, -np.sin(angle)])
    return stand(
        Draft(
            (
                *_handle_parts(handle, neck),
                Part("blade", blade, sheet_pieces(blade, (14, 13), cuts=(4, 3))),
            ),
            {
                "grip": frame(
                    (p["handle_bow"], 0.0, 0.5 * p["handle_length"]), x=_UP, z=(1.0, 0.0, 0.0)
                ),
                "blade": frame(middle, x=direction, z=off),
                "blade_edge": frame(edge, x=direction, z=off),
            },
        )
    )


def _trowel(p: Parameters) -> Draft:
    handle, neck, path = _handle_and_neck(p)
    wide = 0.5 * p["blade_width"]
    s = stations(16)
    half = wide * spline([p["blade_start"], 1.0, 1.0, p["blade_point"], 0.06], 16)
    start = path[-1] - [0.0, 0.0, 0.01]
    grid = _blade_grid(start, half, p["blade_length"], p["blade_angle"], 15, p["blade_curl"])
    # A trough: the sides rise in x, less towards the point.
    t = grid[..., 1] / wide
    grid[..., 0] += p["trough"] * wide * t * t * (1 - p["flatten"] * s[:, None])
    blade = sheet(grid, p["blade_thickness"] * rounded_edge(16, 15, 0.6))
    angle = p["blade_angle"]
    direction = np.array([np.sin(angle), 0.0, np.cos(angle)])
    off = np.array([np.cos(angle), 0.0, -np.sin(angle)])
    return stand(
        Draft(
            (
                *_handle_parts(handle, neck),
                Part("blade", blade, sheet_pieces(blade, (16, 15), cuts=(4, 4))),
            ),
            {
                "grip": frame(
                    (p["handle_bow"], 0.0, 0.5 * p["handle_length"]), x=_UP, z=(1.0, 0.0, 0.0)
                ),
                "blade": frame(grid[8, 7], x=direction, z=off),
                "tip": frame(grid[-1, 7], x=direction, z=off),
            },
        )
    )


def _knife(p: Parameters) -> Draft:
    length, wide = p["handle_length"], p["handle_width"]
    profile = spline([1 + p["pommel"], 1.0, 1.0 + p["belly"], 1 - p["waist"], 1.0, 0.9], 16)
    cap = 0.2 * wide
    handle = tubes(
        _rise(length, p["handle_bow"], 16, cap)[None],
        width=wide * p["handle_flatness"] * profile,
        height=wide * profile,
        exponent=p["handle_exponent"],
        up=(1.0, 0.0, 0.0),
        segments=16,
        caps=(cap, 0.002),
    )
    bolster = tubes(
        straight([[0, 0, length - 0.004]], [[0, 0, length + p["bolster"]]], 5),
        width=0.8 * wide * p["handle_flatness"],
        height=wide * p["guard"],
        exponent=3.0,
        up=(1.0, 0.0, 0.0),
        segments=16,
    )
    # The blade lies in the xz plane: its back at -x, its edge at +x.
    reach, deep, rows, columns = p["blade_length"], p["blade_depth"], 18, 7
    base = length + p["bolster"] - 0.006
    back = -0.45 * wide + deep * p["drop"] * stations(rows) ** 2.5
    depth = deep * spline([p["heel"], 1.0, 1.0, p["belly_point"], 0.05], rows)
    across = stations(columns)
    grid = np.empty((rows, columns, 3))
    grid[..., 0] = back[:, None] + depth[:, None] * across
    grid[..., 1] = 0.0
    grid[..., 2] = base + stations(rows)[:, None] * reach
    thickness = (
        p["blade_thickness"] * np.linspace(1.0, 0.3, columns) * np.linspace(1, 0.6, rows)[:, None]
    )
    blade = sheet(grid, thickness, normal=(0.0, 1.0, 0.0))
    return stand(
        Draft(
            (
                Part("handle", handle, hulls(handle, segments=16, lengths=4)),
                Part("bolster", bolster, hulls(bolster, segments=16)),
                Part("blade", blade, sheet_pieces(blade, (rows, columns), cuts=(5, 1))),
            ),
            {
                "grip": frame((p["handle_bow"], 0.0, 0.5 * length), x=_UP, z=(-1.0, 0.0, 0.0)),
                "blade_edge": frame(grid[8, -1], x=(1.0, 0.0, 0.0)),
                "tip": frame(grid[-1, 3], x=_UP, z=(-1.0, 0.0, 0.0)),
            },
        )
    )


def _pliers(p: Parameters) -> Draft:
    grip, jaw, thick = p["grip_length"], p["jaw_length"], p["thickness"]
    half = 0.5 * p["opening"]
    apart, layer = p["spread"], 0.22 * thick
    # One lever from the handle's end at -x through the joint to the jaw at +x; the other is the
    # same turned half about z.
    start = -0.5 * p["handle_gap"]
    low = 0.5 * p["grip_width"]
    joint = low + grip
    lever = spline(
        [
            [start, layer, low],
            [start - apart, layer, low + 0.3 * grip],
            [start - apart, layer, low + 0.65 * grip],
            [-0.2 * p["joint"], layer, joint - 0.1 * grip],
            [0.2 * p["joint"], layer, joint + 0.1 * jaw],
            [half + p["jaw_bow"], layer, joint + 0.55 * jaw],
            [half + 0.35 * p["jaw_width"] * p["jaw_taper"], 0.0, joint + jaw],
        ],
        30,
    )
    both = np.stack([lever, lever * [-1, -1, 1]])
    wide = spline(
        [
            p["grip_width"],
            p["grip_width"],
            0.9 * p["grip_width"],
            p["grip_width"],
            p["joint"],
            p["jaw_width"],
            p["jaw_width"] * p["jaw_taper"],
        ],
        30,
    )
    levers = tubes(
        both,
        width=thick * spline([1.2, 1.2, 1.1, 0.8, 0.75, 0.9, 0.8], 30),
        height=wide,
        exponent=p["exponent"],
        up=(1.0, 0.0, 0.0),
        segments=14,
        caps=(low, 0.002),
    )
    pin = tubes(
        straight([[0, -0.8 * thick, joint]], [[0, 0.8 * thick, joint]], 5),
        width=p["joint"] * p["pin"],
        height=p["joint"] * p["pin"],
        segments=20,
    )
    band = loft_face_bands(34, 14)
    of_band = np.repeat([0, 1, 2], [19, 5, 11])[band]
    return stand(
        Draft(
            (
                Part(
                    "levers",
                    levers,
                    hulls(levers, 2, segments=14, lengths=9),
                    bands=(("grip", "joint", "jaw"), np.tile(of_band, 2)),
                ),
                Part("pin", pin, hulls(pin, segments=20)),
            ),
            {
                "grip": frame((0.0, 0.0, low + 0.4 * grip), x=_UP, z=(0.0, 1.0, 0.0)),
                "pin": frame((0.0, 0.0, joint), x=_UP, z=(0.0, 1.0, 0.0)),
                "jaws": frame((0.0, 0.0, joint + jaw), x=_UP, z=(0.0, 1.0, 0.0)),
            },
        )
    )


_BLADED = {
    "handle_length": (0.07, 0.14),
    "handle_width": (0.016, 0.032),
    "handle_flatness": (0.45, 1.0),
    "handle_exponent": (2.0, 5.0),
    "handle_bow": (-0.012, 0.012),
    "butt": (0.6, 1.3),
    "waist": (-0.2, 0.35),
    "shoulder": (0.55, 1.2),
    "neck_length": (0.02, 0.075),
    "neck_width": (0.005, 0.011),
}

TOOLS = (
    Family(
        "hammer",
        {
            "length": (0.16, 0.27),
            "grip_width": (0.018, 0.034),
            "grip_flatness": (0.6, 1.0),
            "grip_swell": (-0.25, 0.35),
            "neck": (0.5, 0.95),
            "grip_exponent": (2.0, 5.0),
            "grip_bend": (-0.012, 0.012),
            "head_length": (0.07, 0.14),
            "head_size": (0.02, 0.042),
            "head_ratio": (0.7, 1.3),
            "head_exponent": (2.0, 7.0),
            "cheek": (0.55, 1.0),
            "face": (0.75, 1.3),
            "claw_share": (0.4, 0.65),
            "claw_droop": (0.0, 0.04),
            "claw_thin": (0.12, 0.9),
            "claw_spread": (0.5, 1.6),
        },
        _hammer,
        symmetry=Symmetry("z", 2, exact=False),
        density=1500.0,
    ),
    Family(
        "screwdriver",
        {
            "grip_length": (0.07, 0.13),
            "grip_width": (0.02, 0.042),
            "grip_exponent": (2.0, 4.5),
            "butt": (0.65, 1.1),
            "bulge": (-0.15, 0.3),
            "waist": (-0.15, 0.45),
            "collar": (0.45, 1.05),
            "shaft_length": (0.05, 0.19),
            "shaft_width": (0.005, 0.011),
            "shaft_exponent": (2.0, 6.0),
            "ferrule": (0.002, 0.02),
            "ferrule_width": (1.2, 1.9),
            "blade": (0.08, 0.3),
            "flare": (0.8, 1.7),
            "tip_thin": (0.15, 0.7),
        },
        _screwdriver,
        # Square grips and flat tips turn by 180 degrees; to a noisy view any angle will do.
        symmetry=Symmetry("z", 0, exact=False),
        density=1500.0,
    ),
    Family(
        "spatula",
        {
            **_BLADED,
            "neck_offset": (0.0, 0.02),
            "blade_length": (0.07, 0.12),
            "blade_width": (0.05, 0.11),
            "blade_start": (0.25, 0.95),
            "blade_end": (0.6, 1.2),
            "blade_angle": (0.2, 0.9),
            "blade_curl": (-0.01, 0.015),
            "tip_round": (0.0, 0.3),
            "camber": (-0.02, 0.08),
            "blade_thickness": (0.0015, 0.004),
        },
        _spatula,
        density=700.0,
    ),
    Family(
        "trowel",
        {
            **_BLADED,
            "neck_offset": (0.0, 0.03),
            "blade_length": (0.08, 0.13),
            "blade_width": (0.045, 0.1),
            "blade_start": (0.3, 1.0),
            "blade_point": (0.5, 1.0),
            "blade_angle": (0.0, 0.35),
            "blade_curl": (-0.01, 0.02),
            "trough": (0.1, 0.7),
            "flatten": (0.0, 0.9),
            "blade_thickness": (0.0015, 0.004),
        },
        _trowel,
        density=1200.0,
    ),
    Family(
        "knife",
        {
            "handle_length": (0.08, 0.13),
            "handle_width": (0.018, 0.034),
            "handle_flatness": (0.45, 0.9),
            "handle_exponent": (2.0, 5.0),
            "handle_bow": (-0.008, 0.008),
            "pommel": (-0.2, 0.35),
            "belly": (-0.1, 0.25),
            "waist": (-0.1, 0.3),
            "bolster": (0.006, 0.02),
            "guard": (0.8, 1.6),
            "blade_length": (0.07, 0.19),
            "blade_depth": (0.018, 0.06),
            "heel": (0.6, 1.1),
            "belly_point": (0.5, 1.1),
            "drop": (0.0, 0.7),
            "blade_thickness": (0.002, 0.004),
        },
        _knife,
        symmetry=Symmetry("z", 2, exact=False),
        density=1500.0,
    ),
    Family(
        "pliers",
        {
            "grip_length": (0.08, 0.14),
            "grip_width": (0.01, 0.018),
            "handle_gap": (0.012, 0.045),
            "spread": (0.0, 0.025),
            "jaw_length": (0.035, 0.085),
            "jaw_width": (0.008, 0.02),
            "jaw_taper": (0.35, 1.0),
            "jaw_bow": (0.0, 0.02),
            "opening": (0.002, 0.03),
            "thickness": (0.008, 0.015),
            "joint": (0.014, 0.03),
            "pin": (0.4, 0.9),
            "exponent": (2.0, 5.0),
        },
        _pliers,
        symmetry=Symmetry("z", 2),
        density=2500.0,
    ),
)
