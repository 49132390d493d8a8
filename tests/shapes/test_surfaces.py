"""Blocks are closed, look outwards, keep their topology and have the volumes of textbooks."""

import numpy as np
import pytest
import trimesh
from scipy.interpolate import BSpline
from scipy.spatial import ConvexHull, Delaunay

from iga_drake.shapes import surfaces
from iga_drake.shapes.errors import ShapeError

ANGLE = np.linspace(0, 2 * np.pi, 24, endpoint=False)
CIRCLE = np.stack([np.cos(ANGLE), np.sin(ANGLE), 0 * ANGLE], axis=1)
LINE = np.linspace([0, 0, 0], [0.2, 0, 0], 9)


def _cup(scale: float = 1.0) -> surfaces.ShellProfile:
    wall = np.array([[0.03, 0.0], [0.04, 0.08]]) * scale
    return surfaces.shell_profile(wall, thickness=0.003, base_thickness=0.004)


BLOCKS = {
    "lathe": lambda s: surfaces.lathe(_cup(s).profile),
    "oval": lambda s: surfaces.lathe(_cup(s).profile, ratio=0.7, exponent=3.0),
    "tube": lambda s: surfaces.tube(LINE * s, width=0.02, height=0.01, exponent=3.0),
    "capped": lambda s: surfaces.tube(LINE * s, width=0.02, height=0.01, caps=(0.004, 0.006)),
    "ring": lambda s: surfaces.ring_tube(CIRCLE * 0.1 * s, width=0.02, height=0.01),
    "prism": lambda s: surfaces.prism(CIRCLE[:, :2] * s, bottom=0.0, top=0.5),
    "bevel": lambda s: surfaces.prism(CIRCLE[:, :2] * s, bottom=0.0, top=0.5, inset=0.1),
    "box": lambda s: surfaces.rounded_box((0.1 * s, 0.2, 0.05), radius=0.01),
    "ellipsoid": lambda s: surfaces.ellipsoid((0.1 * s, 0.2, 0.05)),
}


def _mesh(surface: surfaces.Surface) -> trimesh.Trimesh:
    return trimesh.Trimesh(surface.vertices, surface.faces, process=False)


@pytest.mark.parametrize("name", BLOCKS)
def test_blocks_are_closed_and_look_outwards(name: str) -> None:
    mesh = _mesh(BLOCKS[name](1.0))
    assert mesh.is_watertight and mesh.is_winding_consistent
    assert mesh.volume > 0
    assert mesh.area_faces.min() > 0
    assert len(np.unique(mesh.faces)) == len(mesh.vertices)


@pytest.mark.parametrize("name", BLOCKS)
def test_topology_does_not_depend_on_sizes(name: str) -> None:
    one, other = BLOCKS[name](1.0), BLOCKS[name](1.7)
    np.testing.assert_array_equal(one.faces, other.faces)
    assert one.vertices.shape == other.vertices.shape
    assert not np.allclose(one.vertices, other.vertices)


def test_volumes_of_analytic_bodies() -> None:
    ball = surfaces.ellipsoid((0.1, 0.2, 0.05), rings=60, segments=120)
    assert _mesh(ball).volume == pytest.approx(4 / 3 * np.pi * 0.1 * 0.2 * 0.05, rel=3e-3)
    rod = surfaces.tube(LINE, width=0.02, height=0.01, segments=128)
    assert _mesh(rod).volume == pytest.approx(np.pi * 0.01 * 0.005 * 0.2, rel=3e-3)
    torus = surfaces.ring_tube(CIRCLE, width=0.2, height=0.2, segments=64)
    pappus = np.pi * 0.1**2 * 2 * np.pi
    assert _mesh(torus).volume == pytest.approx(pappus, rel=2e-2)
    a, b, c, r = 0.08, 0.18, 0.03, 0.01
    steiner = a * b * c + 2 * r * (a * b + b * c + c * a) + np.pi * r**2 * (a + b + c)
    steiner += 4 / 3 * np.pi * r**3
    box = surfaces.rounded_box((a + 2 * r, b + 2 * r, c + 2 * r), radius=r, arc=8)
    assert _mesh(box).volume == pytest.approx(steiner, rel=1e-3)


def test_cylinder_shell_has_the_volume_of_its_wall_and_floor() -> None:
    shell = surfaces.shell_profile(
        np.array([[0.04, 0.0], [0.04, 0.1]]), thickness=0.004, base_thickness=0.005, rim_points=9
    )
    floor = np.pi * 0.04**2 * 0.005
    wall = np.pi * (0.04**2 - 0.036**2) * 0.095
    rim = np.pi * 0.002**2 / 2 * 2 * np.pi * 0.038
    mesh = _mesh(surfaces.lathe(shell.profile, segments=256))
    assert mesh.volume == pytest.approx(floor + wall + rim, rel=5e-3)
    np.testing.assert_allclose(shell.inner[:, 0], 0.036, atol=1e-12)


def test_bands_name_each_face_of_a_shell() -> None:
    shell = _cup()
    surface = surfaces.lathe(shell.profile, segments=32)
    band = shell.bands[surfaces.lathe_face_bands(len(shell.profile), 32)]
    centres = surface.vertices[surface.faces].mean(axis=1)
    assert band.shape == (len(surface.faces),)
    np.testing.assert_allclose(centres[band == surfaces.BAND_UNDERSIDE, 2], 0.0, atol=1e-12)
    np.testing.assert_allclose(centres[band == surfaces.BAND_FLOOR, 2], 0.004, atol=1e-12)
    assert centres[band == surfaces.BAND_RIM, 2].min() > 0.078
    radius = np.linalg.norm(centres[:, :2], axis=1)
    inner, outer = radius[band == surfaces.BAND_INNER], radius[band == surfaces.BAND_OUTER]
    assert inner.mean() < outer.mean()


def test_pieces_cover_a_turned_wall_and_a_tube() -> None:
    shell = _cup()
    pieces = surfaces.shell_pieces(shell.outer[[0, -1]], shell.inner[[0, -1]], sectors=16)
    assert len(pieces) == 16
    volume = sum(trimesh.convex.convex_hull(piece).volume for piece in pieces)
    mesh = _mesh(surfaces.lathe(shell.profile))
    assert volume == pytest.approx(mesh.volume - np.pi * 0.03**2 * 0.004, rel=0.25)
    rod = surfaces.tube(LINE, width=0.02, height=0.01, segments=16, caps=(0.003, 0.003))
    rings = (len(rod.vertices) - 2) // 16
    halves = surfaces.tube_pieces(rod, segments=16, cuts=(0, rings // 2, rings - 1))
    total = sum(trimesh.convex.convex_hull(piece).volume for piece in halves)
    assert total == pytest.approx(_mesh(rod).volume, rel=1e-6)


def test_superellipse_satisfies_its_equation() -> None:
    for exponent in (1.5, 2.0, 4.0):
        point = surfaces.superellipse(40, exponent)
        np.testing.assert_allclose((np.abs(point) ** exponent).sum(axis=1), 1.0)


def test_bezier_ends_and_spacing() -> None:
    control = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]])
    curve = surfaces.bezier(control, 20)
    np.testing.assert_allclose(curve[[0, -1]], control[[0, -1]])
    step = np.linalg.norm(np.diff(curve, axis=0), axis=1)
    assert step.max() / step.min() < 1.02


def test_joined_surfaces_stay_closed_and_labelled() -> None:
    parts = [surfaces.ellipsoid((1, 1, 1)), surfaces.rounded_box((1, 1, 1), radius=0.1)]
    joined, label = surfaces.join(parts)
    mesh = _mesh(joined)
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(sum(_mesh(part).volume for part in parts))
    assert np.bincount(label).tolist() == [len(part.faces) for part in parts]


@pytest.mark.parametrize(
    "call",
    [
        lambda: surfaces.lathe(np.array([[0.1, 0.0], [0.1, 0.1], [0.0, 0.1]])),
        lambda: surfaces.rounded_box((0.1, 0.1, 0.01), radius=0.02),
        lambda: surfaces.tube(LINE, width=0.01, height=0.01, up=(1.0, 0.0, 0.0)),
        lambda: surfaces.shell_profile(
            np.array([[0.03, 0.0], [0.03, 0.01]]), thickness=0.001, base_thickness=0.02
        ),
        lambda: surfaces.loft(np.zeros((3, 2, 3))),
    ],
)
def test_bad_sizes_are_refused(call) -> None:
    with pytest.raises(ShapeError):
        call()


def test_a_bspline_is_the_one_of_scipy_and_stays_in_the_hull() -> None:
    rng = np.random.default_rng(0)
    control = rng.normal(size=(6, 2))
    curve = surfaces.bspline(control, 50)
    knots = [0, 0, 0, 0, 1 / 3, 2 / 3, 1, 1, 1, 1]
    expected = BSpline(np.array(knots), control, 3)(np.linspace(0, 1, 50))
    np.testing.assert_allclose(curve, expected, atol=1e-12)
    np.testing.assert_allclose(curve[[0, -1]], control[[0, -1]], atol=1e-12)
    hull = Delaunay(control)
    assert (hull.find_simplex(curve[1:-1] * (1 - 1e-9) + control.mean(axis=0) * 1e-9) >= 0).all()


def test_chords_of_an_arc_are_as_near_as_asked_and_as_few_as_can_be() -> None:
    angle = np.linspace(0, np.pi, 181)
    arc = 0.1 * np.column_stack([np.cos(angle), np.sin(angle)])
    cuts = surfaces.chord_cuts(arc[None], 0.002)
    assert cuts[0] == 0 and cuts[-1] == 180
    # The sagitta of a chord over the angle a is r (1 - cos(a / 2)).
    steps = np.radians(np.diff(cuts))
    assert (0.1 * (1 - np.cos(steps / 2)) <= 0.002 + 1e-9).all()
    widest = np.floor(np.degrees(2 * np.arccos(1 - 0.002 / 0.1)))  # the curve has whole degrees
    assert len(steps) == np.ceil(180 / widest)
    assert surfaces.chord_cuts(np.stack([arc * [1, 0]]), 1e-6) == [0, 180]  # a straight line


@pytest.mark.parametrize("exponent", [2.0, 4.0])
def test_wall_pieces_cover_a_cylinder_and_leave_its_cavity(exponent: float) -> None:
    height = np.linspace(0, 0.1, 8)
    ring = surfaces.superellipse(36, exponent)
    outer, inner = (
        np.concatenate([np.broadcast_to(r * ring, (8, 36, 2)), np.repeat(height, 36).reshape(
            8, 36, 1)], axis=2) for r in (0.05, 0.047)
    )  # fmt: skip
    pieces = surfaces.wall_pieces(outer, inner, (outer[-1] + inner[-1]) / 2 + [0, 0, 0.001])
    hulls = [ConvexHull(piece).equations for piece in pieces]

    def inside(points: np.ndarray, tolerance: float) -> np.ndarray:
        return np.any([(points @ h[:, :3].T + h[:, 3] <= tolerance).all(axis=1) for h in hulls], 0)

    middle = ((outer[1:-1] + inner[1:-1]) / 2).reshape(-1, 3)
    assert inside(middle, 0.0016).all()
    free = np.concatenate([s * inner[1:-1].reshape(-1, 3) * [1, 1, 0] for s in (0.9, 0.5, 0.0)])
    assert not inside(free + [0, 0, 0.05], 0.0).any()
    assert len(pieces) <= 16
