"""Bowls: topology, sizes, pieces that cover the wall and leave the cavity free."""

from pathlib import Path

import numpy as np
import pytest
from family_checks import check_inertia, check_mesh_and_parts, inside_pieces, solid_points
from family_properties import turned_distances

from iga_drake.shapes.errors import ShapeError
from iga_drake.shapes.families import bowl
from iga_drake.shapes.instance import ShapeInstance

REFERENCE = bowl.build(bowl.sample_parameters(np.random.default_rng(1000)))


@pytest.fixture(params=range(8))
def instance(request: pytest.FixtureRequest) -> ShapeInstance:
    return bowl.build(bowl.sample_parameters(np.random.default_rng(request.param)))


def test_mesh_and_parts(instance: ShapeInstance) -> None:
    check_mesh_and_parts(instance, REFERENCE)
    width, depth, height = instance.mesh.extents
    assert width == pytest.approx(instance.parameters["diameter"], rel=0.02)
    assert depth == pytest.approx(width, rel=0.01)
    assert height == pytest.approx(instance.frames["opening"][2, 3])
    assert instance.mass_properties.mass == pytest.approx(instance.parameters["mass"])
    assert 500 < instance.density < 3000


def test_inertia(instance: ShapeInstance, tmp_path: Path) -> None:
    check_inertia(instance, tmp_path)


def test_pieces_cover_the_solid(instance: ShapeInstance) -> None:
    assert inside_pieces(instance, solid_points(instance, 4000, 1, 0.001), 0.001).mean() > 0.98


def test_pieces_leave_the_cavity_free(instance: ShapeInstance) -> None:
    shell = bowl.profile(instance.parameters)
    rng = np.random.default_rng(2)
    z = rng.uniform(shell.inner[0, 1] + 0.003, shell.inner[-1, 1], 4000)
    radius = np.interp(z, shell.inner[:, 1], shell.inner[:, 0]) - 0.0045
    r = radius.clip(0) * np.sqrt(rng.uniform(size=len(z)))
    angle = rng.uniform(0, 2 * np.pi, len(z))
    points = np.stack([r * np.cos(angle), r * np.sin(angle), z], axis=1)
    assert inside_pieces(instance, points, 0.0).mean() < 0.015


def test_any_turn_about_z_carries_the_bowl_onto_itself(instance: ShapeInstance) -> None:
    assert (instance.symmetry.axis, instance.symmetry.order) == ("z", 0)
    turns = instance.symmetry.rotations(steps=5)[1:]
    assert turned_distances(instance, turns, np.zeros(3)).max() < 0.005


def test_the_rim_frame_stands_on_the_rim_across_the_wall(instance: ShapeInstance) -> None:
    X = instance.frames["rim"]
    assert X[2, 3] == pytest.approx(instance.mesh.bounds[1, 2], abs=1e-6)
    nearest = np.linalg.norm(instance.vertices - X[:3, 3], axis=1).min()
    assert nearest < 0.003
    assert X[0, 0] > 0.7 and X[2, 2] > 0.7


def test_unknown_and_missing_parameters_are_named() -> None:
    parameters = dict(REFERENCE.parameters)
    parameters["colour"] = parameters.pop("wall")
    with pytest.raises(ShapeError, match=r"missing parameters \['wall'\].*'colour'"):
        bowl.build(parameters)
