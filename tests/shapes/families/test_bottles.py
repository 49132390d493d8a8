"""Bottles and jars: the properties that every family has."""

from collections.abc import Callable

import pytest
from family_properties import CHECKS

from iga_drake.shapes.families.bottles import BOTTLES
from iga_drake.shapes.family import Family


@pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.__name__)
@pytest.mark.parametrize("family", BOTTLES, ids=lambda family: family.name)
def test_properties(family: Family, check: Callable[[Family], None]) -> None:
    check(family)
