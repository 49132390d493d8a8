"""Pans: topology, a handle that a hand can take, pieces that leave the cavity free."""

from pathlib import Path

import numpy as np
import pytest
from family_checks import check_inertia, check_mesh_and_parts, inside_pieces, solid_points

from iga_drake.shapes.errors import ShapeError
from iga_drake.shapes.families import pan
from iga_drake.shapes.instance import ShapeInstance

REFERENCE = pan.build(pan.sample_parameters(np.random.default_rng(1000)))


@pytest.fixture(params=range(8))
def instance(request: pytest.FixtureRequest) -> ShapeInstance:
    return pan.build(pan.sample_parameters(np.random.default_rng(request.param)))


def test_mesh_and_parts(instance: ShapeInstance) -> None:
    check_mesh_and_parts(instance, REFERENCE)
    body = instance.vertices[np.unique(instance.faces[instance.part_labels < 5])]
    assert np.ptp(body[:, 1]) == pytest.approx(instance.parameters["diameter"], rel=0.02)
    assert instance.mass_properties.mass == pytest.approx(instance.parameters["mass"])
    assert 500 < instance.density < 4000


def test_inertia(instance: ShapeInstance, tmp_path: Path) -> None:
    check_inertia(instance, tmp_path)


def test_pieces_cover_the_solid(instance: ShapeInstance) -> None:
    assert inside_pieces(instance, solid_points(instance, 4000, 1, 0.001), 0.001).mean() > 0.98


def test_pieces_leave_the_cavity_free(instance: ShapeInstance) -> None:
    shell = pan.profile(instance.parameters)
    rng = np.random.default_rng(2)
    z = rng.uniform(shell.inner[0, 1] + 0.004, shell.inner[-1, 1], 4000)
    radius = np.interp(z, shell.inner[:, 1], shell.inner[:, 0]) - 0.01
    r = radius * np.sqrt(rng.uniform(size=len(z)))
    angle = rng.uniform(0, 2 * np.pi, len(z))
    points = np.stack([r * np.cos(angle), r * np.sin(angle), z], axis=1)
    assert inside_pieces(instance, points, 0.0).mean() < 0.02


def test_the_handle_frame_lies_in_a_handle_that_a_hand_can_take(instance: ShapeInstance) -> None:
    X = instance.frames["handle"]
    handle = instance.vertices[np.unique(instance.faces[instance.part_labels == 5])]
    p_H = (handle - X[:3, 3]) @ X[:3, :3]
    near = p_H[np.abs(p_H[:, 0]) < 0.012]
    assert 0.013 < np.ptp(near[:, 1]) < 0.034  # the hand opens by 0.08
    assert near[:, 1].max() == pytest.approx(-near[:, 1].min(), abs=1e-3)
    # Fingers reach 9 mm below the frame's origin, measured along its z, and stay off the table.
    tips = X[:3, 3] - 0.0095 * X[:3, 2]
    assert tips[2] - 0.009 * abs(X[2, 0]) > 0.008
    # The hand, 0.045 m above and 0.033 m to each side, stays clear of the body.
    body = instance.vertices[np.unique(instance.faces[instance.part_labels < 5])]
    assert ((body - X[:3, 3]) @ X[:3, :3])[:, 0].max() < -0.012


def test_unknown_and_missing_parameters_are_named() -> None:
    parameters = dict(REFERENCE.parameters)
    parameters["colour"] = parameters.pop("wall")
    with pytest.raises(ShapeError, match=r"missing parameters \['wall'\].*'colour'"):
        pan.build(parameters)
