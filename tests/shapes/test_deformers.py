"""Deformers: same seed, same instance; correspondence, attachment and inside are kept."""

import numpy as np
import pytest
import trimesh

from iga_drake.shapes.deformers import (
    DeformableShape,
    Deformer,
    LatticeDeformer,
    PartDeformer,
    ReinstancingDeformer,
)
from iga_drake.shapes.errors import ShapeError
from iga_drake.shapes.family import Draft, Family, Part
from iga_drake.shapes.surfaces import Surface, ellipsoid, join, rounded_box, transformed


def _at(*place: float) -> np.ndarray:
    X = np.eye(4)
    X[:3, 3] = place
    return X


def _hammer(parameters=None) -> list[Surface]:
    length = 0.2 if parameters is None else parameters["length"]
    return [
        rounded_box((0.02, 0.02, length), radius=0.004, flat=8),
        transformed(rounded_box((0.08, 0.03, 0.03), radius=0.005), _at(0, 0, length / 2)),
    ]


HAMMER = Family(
    name="hammer_of_two_boxes",
    ranges={"length": (0.15, 0.3)},
    draft=lambda p: Draft(tuple(Part(f"{i}", s, lambda: ()) for i, s in enumerate(_hammer(p)))),
)


def _shape(surfaces: list[Surface] | None = None) -> DeformableShape:
    surface, labels = join(_hammer() if surfaces is None else surfaces)
    return DeformableShape(surface.vertices, surface.faces, labels, HAMMER.name, {"length": 0.2})


DEFORMERS = {
    "lattice": LatticeDeformer(),
    "parts": PartDeformer(),
    "reinstancing": ReinstancingDeformer(families={HAMMER.name: HAMMER}),
}


@pytest.mark.parametrize("name", DEFORMERS)
def test_a_seed_names_an_instance(name: str) -> None:
    deformer, shape = DEFORMERS[name], _shape()
    assert isinstance(deformer, Deformer)
    first = [deformer.deform(shape, seed) for seed in range(5)]
    for seed in (3, 0):  # in any order
        np.testing.assert_array_equal(deformer.deform(shape, seed), first[seed])
    for a in range(5):
        assert first[a].shape == shape.vertices.shape
        for b in range(a):
            assert np.abs(first[a] - first[b]).max() > 1e-5


@pytest.mark.parametrize("name", DEFORMERS)
def test_instances_stay_closed_solids(name: str) -> None:
    shape = _shape()
    before = trimesh.Trimesh(shape.vertices, shape.faces, process=False).volume
    for seed in range(20):
        vertices = DEFORMERS[name].deform(shape, seed)
        mesh = trimesh.Trimesh(vertices, shape.faces, process=False)
        assert mesh.is_watertight
        assert 0.2 * before < mesh.volume < 5 * before


@pytest.mark.parametrize("name", ["lattice", "parts"])
def test_deformers_follow_the_shape_in_place_and_size(name: str) -> None:
    """Relative to size: a shape of another size, elsewhere, changes in the same proportions."""
    shape = _shape()
    other = DeformableShape(3 * shape.vertices + [1.0, -2.0, 0.5], shape.faces, shape.part_labels)
    a, b = (DEFORMERS[name].deform(s, 7) for s in (shape, other))
    spread = [np.linalg.norm(v - v.mean(0), axis=1) for v in (a, b)]
    np.testing.assert_allclose(spread[1], 3 * spread[0], rtol=1e-6, atol=1e-9)


def test_the_lattice_moves_points_as_it_moves_vertices() -> None:
    shape = _shape()
    deformer = LatticeDeformer()
    whole = deformer.deform(shape, 4)
    some = deformer.deform_points(shape.vertices[5:40], 4, reference=shape.vertices)
    np.testing.assert_allclose(some, whole[5:40], atol=1e-12)


def test_the_lattice_without_amplitude_and_scale_is_a_translation() -> None:
    shape = _shape()
    moved = LatticeDeformer(amplitude=0.0, scale=0.0).deform(shape, 1)
    np.testing.assert_allclose(moved, shape.vertices - shape.vertices.mean(0), atol=1e-12)


def test_the_part_deformer_without_changes_is_the_identity() -> None:
    shape = _shape()
    still = PartDeformer(scale=0.0, bend=0.0, taper=0.0, common=0.0)
    np.testing.assert_allclose(still.deform(shape, 3), shape.vertices, atol=1e-12)


def test_parts_change_in_their_own_ways_and_stay_attached() -> None:
    surfaces = _hammer()
    shape = _shape(surfaces)
    n = len(surfaces[0].vertices)
    joint = np.array([0.0, 0.0, 0.1])
    at_joint = np.linalg.norm(shape.vertices[:n] - joint, axis=1) < 0.02
    ratios, gaps = [], []
    for seed in range(30):
        vertices = PartDeformer(common=0.0).deform(shape, seed)
        shaft, head = vertices[:n], vertices[n:]
        ratios.append((np.ptp(shaft[:, 2]) / 0.2, np.ptp(head[:, 0]) / 0.08))
        # The shaft's end was inside the head: it still is.
        solid = trimesh.Trimesh(head, surfaces[1].faces, process=False)
        ends = shaft[at_joint & (np.abs(shape.vertices[:n, 2] - 0.1) < 0.004)]
        gaps.append(solid.contains(ends).mean())
    ratios = np.log(np.array(ratios))
    assert np.all(ratios.std(0) > 0.08)
    assert abs(np.corrcoef(ratios.T)[0, 1]) < 0.6
    assert np.mean(gaps) > 0.95


def test_one_component_is_taken_apart_by_its_labels() -> None:
    surface = ellipsoid((0.02, 0.02, 0.1))
    upper = (surface.vertices[surface.faces].mean(1)[:, 2] > 0).astype(int)
    shape = DeformableShape(surface.vertices, surface.faces, upper)
    logs = []
    for seed in range(30):
        vertices = PartDeformer(common=0.0, bend=0.0).deform(shape, seed)
        z = surface.vertices[:, 2]
        logs.append(
            [np.log(np.ptp(vertices[side & (np.abs(z) > 0.05), 0])) for side in (z > 0, z < 0)]
        )
    whole = DeformableShape(surface.vertices, surface.faces, None)
    together = []
    for seed in range(30):
        vertices = PartDeformer(common=0.0, bend=0.0, taper=0.0).deform(whole, seed)
        together.append([np.log(np.ptp(vertices[side, 0])) for side in (z > 0.05, z < -0.05)])
    difference = [np.std(np.subtract(*np.array(rows).T)) for rows in (logs, together)]
    assert difference[0] > 0.08 > 1e-6 > difference[1]


def test_reinstancing_keeps_near_the_product_and_inside_the_ranges() -> None:
    shape = _shape()
    lengths = {}
    for spread in (0.05, None):
        deformer = ReinstancingDeformer(spread=spread, families={HAMMER.name: HAMMER})
        n = len(_hammer()[0].vertices)
        lengths[spread] = np.array(
            [np.ptp(deformer.deform(shape, seed)[:n, 2]) for seed in range(100)]
        )
    assert 0.15 <= lengths[None].min() and lengths[None].max() <= 0.3
    assert lengths[None].std() > 0.03
    assert abs(lengths[0.05].mean() - 0.2) < 0.004
    assert 0.004 < lengths[0.05].std() < 0.011  # 0.05 of 0.15 m


@pytest.mark.parametrize(
    ("change", "found"),
    [
        ({"family": None}, "no family"),
        ({"family": "teacup"}, "teacup"),
        ({"vertices": np.zeros((5, 3))}, "vertices, the shape 5"),
    ],
)
def test_reinstancing_says_what_it_cannot_do(change: dict, found: str) -> None:
    fields = vars(_shape()) | change
    with pytest.raises(ShapeError, match=found):
        DEFORMERS["reinstancing"].deform(DeformableShape(**fields), 0)
