"""Checks of deformed meshes, and their pictures."""

from pathlib import Path

import numpy as np
import pytest
import torch

from iga_drake.shapes.deformers import LatticeDeformer
from iga_drake.shapes.deformers.dif_net import DifNetDeformer
from iga_drake.shapes.dif_net import DifNet, DifNetConfig
from iga_drake.shapes.errors import ShapeError
from iga_drake.shapes.surfaces import ellipsoid, join, transformed
from iga_drake.studies.deformations import (
    correspondence_errors,
    crossings,
    deformation_sheet,
    validity,
)
from iga_drake.training.dif_net import DifNetTraining

SMALL = DifNetConfig(latent=8, width=16, hidden=2, template_width=16, template_hidden=2)


def _net(displacement: float) -> DifNet:
    torch.manual_seed(0)
    net = DifNet(SMALL, 4)
    with torch.no_grad():
        net.hyper[-1][2].weight *= displacement
        net.hyper[-1][2].bias *= displacement
    return net


def test_a_pole_pushed_through_the_other_side_crosses_it() -> None:
    ball = ellipsoid((1.0, 1.0, 1.0))
    assert not crossings(ball.vertices, ball.faces)
    pushed = ball.vertices.copy()
    cap = pushed[:, 2] > 0.9
    pushed[cap, 2] -= 2.3
    found = crossings(pushed, ball.faces)
    assert found
    # Each pair: one face of the wall below, one of the tube through it.
    heights = np.abs(pushed[ball.faces, 2].mean(1) + 1)
    assert all(min(heights[list(pair)]) < 0.2 for pair in found)


def test_parts_that_overlap_do_not_count_as_crossed() -> None:
    ball, X = ellipsoid((1.0, 1.0, 1.0)), np.eye(4)
    X[0, 3] = 1.0
    both, _ = join([ball, transformed(ball, X)])
    assert not crossings(both.vertices, both.faces)


def test_validity_tells_gentle_fields_from_wild_ones() -> None:
    gentle = validity(DifNetDeformer(_net(2.0), checked_points=0), ["mug"], 2)
    wild = validity(DifNetDeformer(_net(300.0), checked_points=0), ["mug"], 2)
    assert gentle.valid == 1.0
    assert wild.closed == 1.0 and wild.unfolded == 0.0 and wild.uncrossed == 0.0
    assert wild.valid == 0.0


def test_without_displacement_the_template_is_the_normalised_space() -> None:
    errors = correspondence_errors(_net(0.0), DifNetTraining(shapes=4), pairs=3, points=300)
    assert errors.template_mean == pytest.approx(errors.baseline_mean, rel=1e-3)
    assert 0.01 < errors.baseline_median < 0.3


def test_the_sheet_shows_the_shape_and_deformed_ones_in_colours(tmp_path: Path) -> None:
    image = deformation_sheet(LatticeDeformer(), "mug", 2, columns=2)
    first, second = image[:, :200].astype(int), image[:, 200:].astype(int)
    drawn = [(tile.min(-1) < 250).mean() for tile in (first, second)]
    assert min(drawn) > 0.05
    assert np.abs(first - second).mean() > 1.0
    assert len(np.unique(first.reshape(-1, 3) // 32, axis=0)) > 10
    with pytest.raises(ShapeError, match="'sofa': unknown"):
        deformation_sheet(LatticeDeformer(), "sofa")
