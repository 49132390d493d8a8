"""All families: the properties that every one has."""

from collections.abc import Callable

import pytest
from family_properties import CHECKS, corners, draws, stands_on_the_ground

from iga_drake.shapes.families import FAMILIES
from iga_drake.shapes.family import Family

# Their origin is at what they stand on or are held at; a handle or spout may reach below it.
REACH_BELOW = {"pan", "spoon", "teapot", "watering_can"}


@pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.__name__)
@pytest.mark.parametrize("family", FAMILIES.values(), ids=FAMILIES)
def test_properties(family: Family, check: Callable[[Family], None]) -> None:
    check(family)


@pytest.mark.parametrize("name", sorted(FAMILIES.keys() - REACH_BELOW))
def test_stands_on_the_ground(name: str) -> None:
    family = FAMILIES[name]
    assert all(stands_on_the_ground(instance) for instance in draws(family) + corners(family))
