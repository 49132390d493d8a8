"""Vessels with handles: the properties that every family has."""

from collections.abc import Callable

import pytest
from family_properties import CHECKS

from iga_drake.shapes.families.vessels import VESSELS
from iga_drake.shapes.family import Family


@pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.__name__)
@pytest.mark.parametrize("family", VESSELS, ids=lambda family: family.name)
def test_properties(family: Family, check: Callable[[Family], None]) -> None:
    check(family)
