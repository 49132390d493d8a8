"""Open containers with straight sides: a box with its lid ajar, and a tray. They stand on z = 0.

Frames: `base` on the ground; `opening` in the middle of the mouth, z out of it; `floor` on the
inner floor; `lid` in the middle of a box's lid, z off its upper side; `lid_edge` at its free edge,
x outwards; `handle` and `handle_left` on a tray's handles, x outwards.
"""

import numpy as np

from iga_drake.shapes.families.blocks import (
    SHELL_BANDS,
    dome,
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
from iga_drake.shapes.surfaces import Surface, superellipse
from iga_drake.shapes.symmetry import Symmetry

_ROWS = 8


def _vessel(
    half_x: np.ndarray,
    half_y: np.ndarray,
    z: np.ndarray,
    *,
    exponent: float,
    wall: float,
    floor: float,
    segments: int,
) -> Surface:
    """A shell with level rings; `half_x`, `half_y` (R,) at heights `z` (R,) from 0 to the rim."""
    section = superellipse(segments, exponent)
    outer = rings(section, half_x, half_y, z)
    inside = floor + (z - z[0]) * (1 - floor / (z[-1] - z[0]))
    inner_x, inner_y = (np.interp(inside, z, half) - wall for half in (half_x, half_y))
    return shell(outer, rings(section, inner_x, inner_y, inside))


def _box(p: Parameters) -> Draft:
    # The lid is hinged on the side at -x.
    high, wall = p["height"], p["wall"]
    z = high * np.array([0.0, 0.03, 0.1, 0.3, 0.5, 0.7, 0.9, 1.0])
    taper = spline([p["taper"], p["taper"] + p["belly"], 1.0 + p["belly"], 1.0], 24)
    scale = np.interp(z / high, stations(24), taper)
    scale[0] *= 0.97
    a, b = 0.5 * p["width"], 0.5 * p["width"] * p["ratio"]
    body = _vessel(
        a * scale, b * scale, z, exponent=p["exponent"], wall=wall, floor=1.3 * wall, segments=48
    )
    # The lid, a shallow dome about its hinge, opened by an angle.
    lid_high, over = p["lid_height"], p["overhang"]
    lid_z = lid_high * np.array([0.0, 0.3, 0.6, 0.85, 0.97, 1.0])
    crown = np.array([1.0, 1.0, 1.0, 0.99, 0.95, 0.5])
    crown = crown - (1 - p["lid_crown"]) * stations(6) ** 2 * 0.5
    x, y = (a + over) * crown, (b + over) * crown
    section = superellipse(48, p["exponent"])
    outer = rings(section, x, y, lid_z)
    inner = rings(section, x - wall, y - wall, lid_z * (lid_high - wall) / lid_high)
    tab = tubes(
        straight(
            [[a + over - 0.003, 0, 0.4 * lid_high]], [[a + over + p["tab"], 0, 0.4 * lid_high]], 4
        ),
        width=p["tab_width"],
        height=0.5 * lid_high,
        exponent=4.0,
        segments=14,
        caps=(0.001, 0.002),
    )
    c, s = np.cos(p["lid_angle"]), np.sin(p["lid_angle"])
    R = np.array([[c, 0.0, -s], [0.0, 1.0, 0.0], [s, 0.0, c]])
    hinge = np.array([-a, 0.0, high - 0.001])
    shift = np.array([a, 0.0, 0.0])

    def open_up(surface: Surface) -> Surface:
        return Surface((surface.vertices + shift) @ R.T + hinge, surface.faces)

    lid, tab = open_up(dome(outer, inner)), open_up(tab)
    top, edge = (
        np.array(point) @ R.T + hinge for point in ([a, 0, lid_high], [2 * a + over, 0, 0.0])
    )
    return Draft(
        (
            Part(
                "body",
                body,
                wall_hulls(body, _ROWS, sectors=16, cuts=(0, 7)),
                bands=(SHELL_BANDS, shell_bands(_ROWS, _ROWS, 48)),
            ),
            Part("lid", lid, wall_hulls(lid, 6, sectors=16, cuts=(0, 4, 5), domed=True)),
            Part("tab", tab, hulls(tab, segments=14)),
        ),
        {
            "base": frame((0.0, 0.0, 0.0)),
            "floor": frame((0.0, 0.0, 1.3 * wall)),
            "opening": frame((0.0, 0.0, high)),
            "lid": frame(top, x=R[:, 0], z=R[:, 2]),
            "lid_edge": frame(edge, x=R[:, 0], z=R[:, 2]),
        },
    )


def _tray(p: Parameters) -> Draft:
    high, wall = p["height"], p["wall"]
    flare = p["flare"] * high
    a, b = 0.5 * p["length"], 0.5 * p["length"] * p["ratio"]
    z = high * np.array([0.0, 0.08, 0.25, 0.45, 0.65, 0.82, 0.93, 1.0])
    t = spline([0.0, p["curve"], 1.0, 1.0 + p["lip"]], _ROWS)
    body = _vessel(
        a - flare * (1 - t),
        b - flare * (1 - t),
        z,
        exponent=p["exponent"],
        wall=wall,
        floor=1.2 * wall,
        segments=48,
    )
    half, rise, out = p["handle_span"] * b, p["handle_rise"], p["handle_reach"]
    x = a + flare * p["lip"] - 0.5 * wall
    low = high - 0.4 * p["handle"]
    path = spline(
        [
            [x - 0.002, -half, low],
            [x + 0.8 * out, -half, low + rise],
            [x + out, -0.4 * half, low + rise],
            [x + out, 0.4 * half, low + rise],
            [x + 0.8 * out, half, low + rise],
            [x - 0.002, half, low],
        ],
        21,
    )
    handles = tubes(
        np.stack([path, path * [-1, -1, 1]]),
        width=p["handle"] * p["handle_ratio"],
        height=p["handle"],
        exponent=2.5,
        up=(0.0, 0.05, 1.0),
        segments=12,
    )
    X = frame(path[10])
    left = frame(path[10] * [-1, -1, 1], x=(-1.0, 0.0, 0.0))
    return stand(
        Draft(
            (
                Part(
                    "body",
                    body,
                    wall_hulls(body, _ROWS, sectors=24, cuts=(0, 7)),
                    bands=(SHELL_BANDS, shell_bands(_ROWS, _ROWS, 48)),
                ),
                Part("handles", handles, hulls(handles, 2, lengths=7)),
            ),
            {
                "base": frame((0.0, 0.0, 0.0)),
                "floor": frame((0.0, 0.0, 1.2 * wall)),
                "opening": frame((0.0, 0.0, high)),
                "handle": X,
                "handle_left": left,
            },
        )
    )


CONTAINERS = (
    Family(
        "box",
        {
            "width": (0.085, 0.14),
            "ratio": (0.75, 1.7),
            "height": (0.035, 0.12),
            "exponent": (3.0, 14.0),
            "taper": (0.75, 1.05),
            "belly": (-0.04, 0.05),
            "wall": (0.003, 0.006),
            "lid_angle": (0.3, 2.0),
            "lid_height": (0.01, 0.035),
            "lid_crown": (0.6, 1.0),
            "overhang": (0.0, 0.004),
            "tab": (0.004, 0.016),
            "tab_width": (0.012, 0.04),
        },
        _box,
        density=700.0,
    ),
    Family(
        "tray",
        {
            "length": (0.15, 0.25),
            "ratio": (0.5, 1.0),
            "height": (0.012, 0.05),
            "exponent": (2.2, 12.0),
            "flare": (0.1, 0.6),
            "curve": (0.0, 1.0),
            "lip": (0.0, 0.3),
            "wall": (0.0025, 0.005),
            "handle_span": (0.25, 0.6),
            "handle_rise": (0.0, 0.035),
            "handle_reach": (0.012, 0.032),
            "handle": (0.006, 0.012),
            "handle_ratio": (0.8, 1.8),
        },
        _tray,
        symmetry=Symmetry("z", 2),
        density=700.0,
    ),
)
