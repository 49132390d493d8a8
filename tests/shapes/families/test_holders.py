"""Peg tree, hook rail, crate: the properties that every family has."""

from collections.abc import Callable

import pytest
from family_properties import CHECKS, corners, draws, stands_on_the_ground

from iga_drake.shapes.families.holders import HOLDERS
from iga_drake.shapes.family import Family


@pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.__name__)
@pytest.mark.parametrize("family", HOLDERS, ids=lambda family: family.name)
def test_properties(family: Family, check: Callable[[Family], None]) -> None:
    check(family)


@pytest.mark.parametrize("family", HOLDERS, ids=lambda family: family.name)
def test_stands_on_the_ground(family: Family) -> None:
    assert all(stands_on_the_ground(instance) for instance in draws(family) + corners(family))
