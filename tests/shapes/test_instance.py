"""Validation and mass properties of shape instances."""

import dataclasses

import numpy as np
import pytest

from iga_drake.shapes import surfaces
from iga_drake.shapes.errors import ShapeError
from iga_drake.shapes.families import FAMILIES
from iga_drake.shapes.instance import ShapeInstance, frame
from iga_drake.shapes.symmetry import NO_SYMMETRY, Symmetry


def _box(density: float = 500.0, offset: float = 0.0) -> ShapeInstance:
    corners = np.array([[0, 0], [0.2, 0], [0.2, 0.1], [0, 0.1]]) + offset
    surface = surfaces.prism(corners, bottom=0.0, top=0.3)
    return ShapeInstance(
        family="box",
        parameters={"size": 1},
        vertices=surface.vertices,
        faces=surface.faces,
        part_labels=np.zeros(len(surface.faces)),
        part_names=("all",),
        frames={"top": frame((0, 0, 0.3))},
        density=density,
    )


def test_mass_properties_of_a_box_are_the_textbook_s() -> None:
    properties = _box(density=500.0, offset=1.0).mass_properties
    mass = 500.0 * 0.2 * 0.1 * 0.3
    assert properties.mass == pytest.approx(mass)
    np.testing.assert_allclose(properties.p_OCcm, [1.1, 1.05, 0.15])
    squares = np.array([0.1**2 + 0.3**2, 0.2**2 + 0.3**2, 0.2**2 + 0.1**2])
    np.testing.assert_allclose(properties.I_CcmO, np.diag(mass / 12 * squares), atol=1e-12)


def test_part_vertices_are_those_of_the_part_s_faces() -> None:
    mug = FAMILIES["mug"].build(FAMILIES["mug"].sample_parameters(np.random.default_rng(0)))
    handle = mug.part_vertices("handle")
    assert 0 < len(handle) < len(mug.vertices) and handle[:, 0].min() > 0.0
    np.testing.assert_array_equal(mug.part_vertices(*mug.part_names), mug.vertices)
    with pytest.raises(ShapeError, match="no part lid: underside"):
        mug.part_vertices("handle", "lid")


def test_part_pieces_are_those_that_lie_in_the_part() -> None:
    brush = FAMILIES["brush"].build(FAMILIES["brush"].sample_parameters(np.random.default_rng(0)))
    (index,) = brush.part_pieces("bristles")
    bristles = brush.part_vertices("bristles")
    piece = np.unique(brush.convex_pieces[index], axis=0)
    np.testing.assert_array_equal(piece, np.unique(bristles, axis=0))
    pieces = [brush.part_pieces(name) for name in brush.part_names]
    assert sorted(i for part in pieces for i in part) == list(range(len(brush.convex_pieces)))


def test_with_mass_scales_mass_and_inertia() -> None:
    light, heavy = _box(), _box().with_mass(6.0)
    assert heavy.mass_properties.mass == pytest.approx(6.0)
    np.testing.assert_allclose(
        heavy.mass_properties.I_CcmO, 2 * light.mass_properties.I_CcmO, atol=1e-12
    )


def test_symmetry_is_the_family_s_and_stays_through_changes_of_mass() -> None:
    assert _box().symmetry == NO_SYMMETRY
    quarter_turns = Symmetry("z", 4)
    turned = dataclasses.replace(_box(), symmetry=quarter_turns)
    assert turned.with_mass(2.0).symmetry == quarter_turns
    for family in FAMILIES.values():
        parameters = {name: sum(limits) / 2 for name, limits in family.ranges.items()}
        assert family.build(parameters).symmetry == family.symmetry


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"vertices": np.zeros((3, 2))}, "vertices"),
        ({"vertices": np.full((10, 3), np.nan)}, "finite"),
        ({"faces": np.array([[0, 1, 99]] * 4)}, "99"),
        ({"part_labels": np.zeros(3)}, "part_labels"),
        ({"part_names": ()}, "part names"),
        ({"density": -1.0}, "density"),
        ({"frames": {"bent": np.ones((4, 4))}}, "bent"),
        ({"convex_pieces": (np.zeros((3, 3)),)}, "convex_pieces"),
    ],
)
def test_bad_fields_are_named(change: dict, message: str) -> None:
    with pytest.raises(ShapeError, match=message):
        dataclasses.replace(_box(), **change)


def test_open_and_inverted_meshes_are_refused() -> None:
    box = _box()
    opened = dataclasses.replace(box, faces=box.faces[1:], part_labels=box.part_labels[1:])
    with pytest.raises(ShapeError, match="watertight"):
        opened.check_closed()
    with pytest.raises(ShapeError, match="inwards"):
        _ = dataclasses.replace(box, faces=box.faces[:, ::-1]).mass_properties


def test_frame_is_rigid_and_keeps_x() -> None:
    X = frame((1, 2, 3), x=(0, 3, 4), z=(0, 0, 1))
    np.testing.assert_allclose(X[:3, :3].T @ X[:3, :3], np.eye(3), atol=1e-12)
    np.testing.assert_allclose(X[:3, 0], [0, 0.6, 0.8])
    assert X[2, 2] > 0
    with pytest.raises(ShapeError):
        frame((0, 0, 0), x=(0, 0, 1))
