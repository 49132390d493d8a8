"""Parametric families for training: each draws one product of its kind with a fixed topology.

A family is a function of a random generator to closed surfaces that overlap where parts join. All
draws of a family share faces and vertex order, so correspondence is exact. Metres, z up.
"""

from collections.abc import Callable

import numpy as np

from iga_drake.shapes.surfaces import (
    Surface,
    bezier,
    ellipsoid,
    join,
    lathe,
    loft,
    prism,
    ring_tube,
    rounded_box,
    shell_profile,
    superellipse,
    transform,
    tube,
)

Rng = np.random.Generator


def _at(position: tuple[float, float, float] | np.ndarray, rotation: np.ndarray | None = None):
    X = np.eye(4)
    X[:3, 3] = position
    if rotation is not None:
        X[:3, :3] = rotation
    return X


def _turn_y(angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])


def _vessel(rng: Rng, radius: float, height: float, *, taper=(0.6, 1.25), belly=(-0.1, 0.35)):
    """A turned shell; returns its surface and the outer radius as a function of height."""
    low = radius * rng.uniform(*taper)
    bulge = radius * rng.uniform(*belly)
    z = np.linspace(0, 1, 12)
    r = low + (radius - low) * z ** rng.uniform(0.6, 1.6) + bulge * np.sin(np.pi * z)
    r = np.maximum(r, 0.3 * radius)
    outer = np.column_stack((r, z * height))
    wall = rng.uniform(0.002, 0.005)
    profile = shell_profile(outer, thickness=wall, base_thickness=rng.uniform(0.004, 0.01))
    surface = lathe(profile.profile, segments=32, exponent=rng.uniform(2.0, 3.0))
    return surface, lambda h: float(np.interp(h, z * height, r))


def _loop_handle(rng: Rng, radius_at, low: float, high: float, reach: float) -> Surface:
    start = np.array([radius_at(high) - 0.004, 0, high])
    end = np.array([radius_at(low) - 0.004, 0, low])
    out = np.array([reach, 0, 0])
    tilt = np.array([0, 0, rng.uniform(-0.02, 0.04)])
    path = bezier(np.array([start, start + out + tilt, end + out * rng.uniform(0.6, 1.3), end]), 14)
    thick = rng.uniform(0.006, 0.016)
    return tube(
        path, width=thick * rng.uniform(0.8, 2.0), height=thick, up=(0, 1, 0.01), segments=10
    )


def mug(rng: Rng) -> list[Surface]:
    height, radius = rng.uniform(0.07, 0.14), rng.uniform(0.03, 0.055)
    body, radius_at = _vessel(rng, radius, height)
    handle = _loop_handle(
        rng,
        radius_at,
        height * rng.uniform(0.12, 0.35),
        height * rng.uniform(0.65, 0.9),
        rng.uniform(0.03, 0.06),
    )
    return [body, handle]


def teapot(rng: Rng) -> list[Surface]:
    height, radius = rng.uniform(0.09, 0.18), rng.uniform(0.04, 0.07)
    body, radius_at = _vessel(rng, radius, height, belly=(0.1, 0.7))
    handle = _loop_handle(
        rng,
        radius_at,
        height * rng.uniform(0.1, 0.35),
        height * rng.uniform(0.65, 0.95),
        rng.uniform(0.04, 0.08),
    )
    foot = height * rng.uniform(0.25, 0.6)
    start = np.array([-radius_at(foot) + 0.006, 0, foot])
    reach, rise = rng.uniform(0.04, 0.1), height * rng.uniform(0.8, 1.15) - foot
    path = bezier(
        np.array(
            [
                start,
                start + [-reach, 0, 0.1 * rise],
                start + [-reach * 0.8, 0, rise],
                start + [-reach * rng.uniform(1, 1.3), 0, rise],
            ]
        ),
        14,
    )
    wide = rng.uniform(0.02, 0.036)
    spout = tube(
        path,
        width=np.linspace(wide, wide * rng.uniform(0.35, 0.8), 14),
        height=np.linspace(wide, wide * rng.uniform(0.35, 0.8), 14),
        up=(0, 1, 0.01),
        segments=12,
    )
    return [body, handle, spout]


def jug(rng: Rng) -> list[Surface]:
    height, radius = rng.uniform(0.15, 0.28), rng.uniform(0.045, 0.08)
    body, radius_at = _vessel(rng, radius, height, taper=(0.7, 1.4))
    handle = _loop_handle(
        rng,
        radius_at,
        height * rng.uniform(0.1, 0.4),
        height * rng.uniform(0.7, 0.97),
        rng.uniform(0.04, 0.09),
    )
    lip = ellipsoid(
        (rng.uniform(0.015, 0.035), rng.uniform(0.01, 0.02), rng.uniform(0.01, 0.03)),
        rings=9,
        segments=16,
    )
    return [body, handle, transform(lip, _at((-radius_at(height), 0, height - 0.01)))]


def bottle(rng: Rng) -> list[Surface]:
    radius, height = rng.uniform(0.025, 0.05), rng.uniform(0.15, 0.32)
    neck, shoulder = rng.uniform(0.01, 0.02), rng.uniform(0.45, 0.75)
    z = np.array([0, 0.02, 0.05, 0.2, 0.4, 1.0, 1.3, 1.6, 2.0, 2.15, 2.2, 2.4]) / 2.4
    z = np.where(z < 0.42, z / 0.42 * shoulder, shoulder + (z - 0.42) / 0.58 * (1 - shoulder))
    waist = 1 - rng.uniform(0, 0.2)
    r = radius * np.array([0.85, 0.97, 1, waist, waist, 1, 0.85, 0.5, 0, 0, 0, 0])
    cap = neck * rng.uniform(1.0, 1.35)
    r[7] = max(r[7], neck)
    r[8:] = (neck, neck, cap, cap)
    profile = np.column_stack(
        (np.concatenate(([0], r, [0])), np.concatenate(([0], z, [1])) * height)
    )
    body = lathe(profile, segments=32, ratio=rng.uniform(0.55, 1.0), exponent=rng.uniform(2, 5))
    return [body]


def spray_bottle(rng: Rng) -> list[Surface]:
    (body,) = bottle(rng)
    top = body.vertices[:, 2].max()
    wide = rng.uniform(0.014, 0.024)
    head = rounded_box((rng.uniform(0.06, 0.11), wide, rng.uniform(0.02, 0.04)), radius=0.005)
    head = transform(head, _at((rng.uniform(-0.03, -0.01), 0, top + 0.008)))
    start = np.array([-rng.uniform(0.025, 0.045), 0, top + 0.004])
    drop = rng.uniform(0.035, 0.06)
    path = bezier(np.array([start, start + [-0.008, 0, -drop / 2], start + [0.012, 0, -drop]]), 10)
    trigger = tube(path, width=wide * 0.6, height=0.009, up=(0, 1, 0.01), segments=10)
    return [body, head, trigger]


def hammer(rng: Rng) -> list[Surface]:
    length = rng.uniform(0.2, 0.33)
    path = np.column_stack((np.zeros(16), np.zeros(16), np.linspace(0, length, 16)))
    bulge = 1 + rng.uniform(-0.2, 0.4) * np.sin(np.linspace(0, 2.5 * np.pi, 16)) * 0.5
    thick = rng.uniform(0.018, 0.034)
    handle = tube(
        path,
        width=thick * bulge,
        height=thick * rng.uniform(0.6, 1) * bulge,
        up=(1, 0, 0),
        exponent=rng.uniform(2, 4),
        segments=14,
    )
    reach, face = rng.uniform(0.07, 0.14), rng.uniform(0.02, 0.04)
    back = rng.uniform(0.35, 0.6)
    x = np.linspace(-back * reach, (1 - back) * reach, 14)
    droop = -rng.uniform(0, 0.04) * (np.clip(-x / reach, 0, 1)) ** 2
    head_path = np.column_stack((x, np.zeros(14), length - 0.01 + droop))
    taper = np.interp(
        x, [x[0], -0.1 * reach, 0.1 * reach, x[-1]], [rng.uniform(0.15, 0.9), 0.8, 0.8, 1]
    )
    head = tube(
        head_path,
        width=face * rng.uniform(0.8, 1.3),
        height=face * taper,
        exponent=rng.uniform(2, 5),
        segments=14,
    )
    return [handle, head]


def brush(rng: Rng) -> list[Surface]:
    length, wide = rng.uniform(0.1, 0.2), rng.uniform(0.04, 0.08)
    block = rounded_box((length, wide, rng.uniform(0.015, 0.03)), radius=rng.uniform(0.004, 0.007))
    fall = rng.uniform(0.02, 0.06)
    flare = rng.uniform(0.85, 1.25)
    outline = superellipse(32, rng.uniform(4, 8)) * [length * 0.46, wide * 0.42]
    rings = [
        np.column_stack((outline * scale, np.full(32, z)))
        for scale, z in ((flare, -fall), ((1 + flare) / 2, -fall / 2), (1.0, 0.0))
    ]
    bristles = loft(np.stack(rings))
    start = np.array([length / 2 - 0.01, 0, 0])
    reach = rng.uniform(0.1, 0.2)
    rise = rng.uniform(-0.02, 0.09)
    path = bezier(np.array([start, start + [reach / 2, 0, 0], start + [reach, 0, rise]]), 14)
    thick = rng.uniform(0.014, 0.026)
    handle = tube(
        path,
        width=thick * rng.uniform(1, 1.6),
        height=thick * np.linspace(0.7, 1.2, 14),
        segments=12,
        caps=(0.002, 0.01),
    )
    return [block, bristles, handle]


def ladle(rng: Rng) -> list[Surface]:
    radius, depth = rng.uniform(0.02, 0.05), rng.uniform(0.3, 1.0)
    angle = np.linspace(0.25, np.pi / 2, 12)
    outer = np.column_stack((radius * np.sin(angle), radius * depth * (1 - np.cos(angle))))
    profile = shell_profile(outer, thickness=0.0025, base_thickness=0.003)
    cup = lathe(profile.profile, segments=28, ratio=rng.uniform(0.65, 1.0))
    start = np.array([radius - 0.003, 0, radius * depth - 0.003])
    reach, tilt = rng.uniform(0.12, 0.25), rng.uniform(0.05, 1.3)
    direction = np.array([np.cos(tilt), 0, np.sin(tilt)]) * reach
    bend = np.array([0.3 * reach * rng.uniform(-0.5, 1), 0, 0])
    path = bezier(np.array([start, start + direction / 2 + bend * 0.5, start + direction]), 16)
    handle = tube(
        path,
        width=np.linspace(0.008, rng.uniform(0.01, 0.028), 16),
        height=rng.uniform(0.005, 0.011),
        up=(-np.sin(tilt), 0.0, np.cos(tilt)),
        segments=10,
    )
    return [cup, handle]


def chair(rng: Rng) -> list[Surface]:
    width, depth, seat = rng.uniform(0.1, 0.16), rng.uniform(0.1, 0.16), rng.uniform(0.08, 0.15)
    thick = rng.uniform(0.01, 0.025)
    parts = [transform(rounded_box((depth, width, thick), radius=0.004), _at((0, 0, seat)))]
    high, lean = rng.uniform(0.08, 0.18), rng.uniform(-0.3, 0.02)
    back = rounded_box((rng.uniform(0.01, 0.02), width * rng.uniform(0.7, 1), high), radius=0.0045)
    parts.append(
        transform(
            back, _at((-depth / 2 + 0.008 + lean * high / 2, 0, seat + high / 2), _turn_y(lean))
        )
    )
    leg, splay = rng.uniform(0.01, 0.02), rng.uniform(0, 0.02)
    for sx in (-1, 1):
        for sy in (-1, 1):
            top = np.array([sx * (depth / 2 - leg), sy * (width / 2 - leg), seat])
            foot = top + [sx * splay, sy * splay, -seat]
            parts.append(
                tube(
                    np.linspace(top, foot, 6),
                    width=leg,
                    height=leg,
                    up=(1, 0, 0.01),
                    exponent=4.0,
                    segments=8,
                )
            )
    return parts


def lamp(rng: Rng) -> list[Surface]:
    base = rng.uniform(0.03, 0.06)
    foot = lathe(
        np.array([[0, 0], [base, 0], [base, 0.008], [base * 0.5, 0.02], [0, 0.022]]), segments=28
    )
    height, reach = rng.uniform(0.12, 0.25), rng.uniform(0.0, 0.12)
    path = bezier(np.array([[0, 0, 0.01], [0, 0, height], [reach, 0, height]]), 16)
    pole = tube(path, width=rng.uniform(0.008, 0.016), height=0.01, up=(0, 1, 0), segments=10)
    top, low, high = rng.uniform(0.015, 0.04), rng.uniform(0.035, 0.07), rng.uniform(0.04, 0.08)
    outer = np.column_stack((np.linspace(top, low, 8), np.linspace(high, 0, 8)))[::-1]
    shade = lathe(np.concatenate(([[0, 0.0]], outer, [[0, high]])), segments=28)
    return [foot, pole, transform(shade, _at((reach, 0, height - high * 0.6)))]


def shoe(rng: Rng) -> list[Surface]:
    length, wide = rng.uniform(0.18, 0.3), rng.uniform(0.06, 0.1)
    t = np.linspace(0, 1, 20)
    ankle, toe = rng.uniform(0.06, 0.15), rng.uniform(0.03, 0.05)
    height = np.interp(
        t, [0, 0.25, 0.45, 0.75, 1], [ankle * 0.9, ankle, (ankle + toe) / 2, toe * 1.15, toe]
    )
    width = wide * np.interp(t, [0, 0.3, 0.7, 0.9, 1], [0.65, 0.75, 1.0, 0.85, 0.5])
    path = np.column_stack((t * length, 0.01 * rng.uniform(-1, 1) * np.sin(2 * t), height / 2))
    upper = tube(
        path, width=width, height=height, exponent=rng.uniform(2.2, 3.5), segments=20, up=(0, 0, 1)
    )
    heel = rng.uniform(0.008, 0.03)
    outline = np.column_stack(
        (np.concatenate((t, t[::-1])) * length, np.concatenate((-width, width[::-1])) * 0.53)
    )
    sole = prism(outline, bottom=-heel, top=0.006)
    return [upper, sole]


def basket(rng: Rng) -> list[Surface]:
    radius, height = rng.uniform(0.05, 0.1), rng.uniform(0.05, 0.12)
    outer = np.column_stack(
        (np.linspace(radius * rng.uniform(0.7, 0.95), radius, 8), np.linspace(0, height, 8))
    )
    profile = shell_profile(outer, thickness=0.004, base_thickness=0.005)
    ratio = rng.uniform(0.55, 0.9)
    body = lathe(profile.profile, segments=40, ratio=ratio, exponent=rng.uniform(2, 7))
    rise = rng.uniform(0.05, 0.13)
    a = np.linspace(0, np.pi, 20)
    path = np.column_stack(
        (np.zeros(20), np.cos(a) * (radius * ratio - 0.003), height - 0.01 + rise * np.sin(a))
    )
    handle = tube(path, width=rng.uniform(0.008, 0.025), height=0.007, up=(1, 0, 0.0), segments=10)
    return [body, handle]


def dustpan(rng: Rng) -> list[Surface]:
    length, wide, side = rng.uniform(0.12, 0.2), rng.uniform(0.13, 0.22), rng.uniform(0.02, 0.05)
    floor = transform(rounded_box((length, wide, 0.006), radius=0.002), _at((0, 0, 0.003)))
    back = rounded_box((0.007, wide, side), radius=0.002)
    parts = [floor, transform(back, _at((length / 2, 0, side / 2)))]
    for s in (-1, 1):
        wall = rounded_box((length, 0.006, side * 0.8), radius=0.002)
        parts.append(transform(wall, _at((0, s * wide / 2, side * 0.4))))
    start = np.array([length / 2, 0, side * rng.uniform(0.3, 0.9)])
    reach = rng.uniform(0.08, 0.16)
    path = bezier(
        np.array(
            [start, start + [reach / 2, 0, 0.0], start + [reach, 0, rng.uniform(-0.02, 0.06)]]
        ),
        12,
    )
    parts.append(
        tube(
            path,
            width=rng.uniform(0.018, 0.035),
            height=rng.uniform(0.012, 0.025),
            segments=12,
            caps=(0.002, 0.01),
        )
    )
    return parts


def cap(rng: Rng) -> list[Surface]:
    radius, high = rng.uniform(0.07, 0.1), rng.uniform(0.5, 1.1)
    angle = np.linspace(0.0, np.pi / 2, 12)
    outer = np.column_stack((radius * np.cos(angle), radius * high * np.sin(angle)))
    inner = outer[::-1] * [0.96, 0.96]
    outer[-1, 0] = 0
    inner[0, 0] = 0
    # The outline of an open dome: along the inside from the pole down, then up the outside.
    profile = np.concatenate((inner[:-1], outer))
    dome = lathe(profile, segments=36, ratio=rng.uniform(0.8, 1.0))
    reach, wide = rng.uniform(0.04, 0.08), rng.uniform(0.6, 0.95)
    a = np.linspace(0, 2 * np.pi, 32, endpoint=False)
    outline = np.column_stack((radius * 0.85 + reach * np.cos(a), radius * wide * np.sin(a)))
    return [dome, prism(outline, bottom=0.0, top=rng.uniform(0.003, 0.006))]


def hook_stand(rng: Rng) -> list[Surface]:
    base = rng.uniform(0.05, 0.09)
    foot = prism(
        superellipse(32, rng.uniform(2, 8)) * [base, base * rng.uniform(0.7, 1)],
        bottom=0,
        top=0.015,
    )
    height = rng.uniform(0.18, 0.3)
    pole = tube(
        np.column_stack((np.zeros(10), np.zeros(10), np.linspace(0.01, height, 10))),
        width=rng.uniform(0.012, 0.03),
        height=rng.uniform(0.012, 0.03),
        up=(1, 0, 0),
        segments=12,
    )
    parts = [foot, pole]
    for level, side in ((rng.uniform(0.75, 0.95), 1.0), (rng.uniform(0.4, 0.65), -1.0)):
        start = np.array([0, 0, height * level])
        reach, rise = rng.uniform(0.05, 0.1) * side, rng.uniform(0.0, 0.05)
        path = bezier(np.array([start, start + [reach * 0.8, 0, 0], start + [reach, 0, rise]]), 12)
        parts.append(
            tube(
                path,
                width=rng.uniform(0.008, 0.016),
                height=0.01,
                up=(0, 1, 0.01),
                segments=10,
                caps=(0.001, 0.004),
            )
        )
    return parts


def screwdriver(rng: Rng) -> list[Surface]:
    grip, thick = rng.uniform(0.08, 0.13), rng.uniform(0.02, 0.04)
    z = np.linspace(0, 1, 12)
    r = (
        thick
        / 2
        * (1 + rng.uniform(-0.25, 0.25) * np.sin(2 * np.pi * z))
        * np.interp(z, [0, 0.1, 0.85, 1], [0.7, 1, 1, 0.6])
    )
    profile = np.column_stack(
        (np.concatenate(([0], r, [0])), np.concatenate(([0], z * grip, [grip])))
    )
    handle = lathe(profile, segments=24, exponent=rng.uniform(2, 4))
    shaft = rng.uniform(0.06, 0.15)
    n = 10
    tip = np.interp(np.linspace(0, 1, n), [0, 0.8, 1], [1, 1, rng.uniform(0.15, 0.6)])
    wide = rng.uniform(0.006, 0.01)
    rod = tube(
        np.column_stack((np.zeros(n), np.zeros(n), np.linspace(grip - 0.01, grip + shaft, n))),
        width=wide,
        height=wide * tip,
        up=(1, 0, 0),
        segments=10,
    )
    return [handle, rod]


def glasses_tray(rng: Rng) -> list[Surface]:
    """A tray with a raised end and a knob: no symmetry but its mirror plane."""
    length, wide, high = rng.uniform(0.14, 0.26), rng.uniform(0.08, 0.16), rng.uniform(0.012, 0.03)
    parts = [rounded_box((length, wide, high), radius=0.005)]
    end = rounded_box(
        (length * rng.uniform(0.1, 0.25), wide, rng.uniform(0.03, 0.08)), radius=0.005
    )
    parts.append(transform(end, _at((length * 0.42, 0, 0.015))))
    ring = np.linspace(0, 2 * np.pi, 20, endpoint=False)
    radius = wide * rng.uniform(0.2, 0.4)
    loop = np.column_stack((np.cos(ring) * radius, np.sin(ring) * radius, np.full(20, high / 2)))
    thick = rng.uniform(0.006, 0.014)
    parts.append(
        transform(
            ring_tube(loop, width=thick, height=thick, segments=8), _at((-length * 0.2, 0, 0))
        )
    )
    return parts


FAMILIES: dict[str, Callable[[Rng], list[Surface]]] = {
    f.__name__: f
    for f in (
        mug,
        teapot,
        jug,
        bottle,
        spray_bottle,
        hammer,
        brush,
        ladle,
        chair,
        lamp,
        shoe,
        basket,
        dustpan,
        cap,
        hook_stand,
        screwdriver,
        glasses_tray,
    )
}


def draw(name: str, rng: Rng) -> tuple[np.ndarray, np.ndarray]:
    """One product of a family: vertices (V, 3) m and faces (F, 3)."""
    surface, _ = join(FAMILIES[name](rng))
    return surface.vertices, surface.faces
