"""Parametric families of objects, one module a kind; `FAMILIES` holds them all by name."""

from iga_drake.shapes.families.bottles import BOTTLES
from iga_drake.shapes.families.cleaning import CLEANING
from iga_drake.shapes.families.containers import CONTAINERS
from iga_drake.shapes.families.furniture import FURNITURE
from iga_drake.shapes.families.holders import HOLDERS
from iga_drake.shapes.families.stands import STANDS
from iga_drake.shapes.families.tableware import TABLEWARE
from iga_drake.shapes.families.tools import TOOLS
from iga_drake.shapes.families.toys import TOYS
from iga_drake.shapes.families.vessels import VESSELS
from iga_drake.shapes.families.wearables import WEARABLES
from iga_drake.shapes.family import Family

# One tuple a module.
_GROUPS: tuple[tuple[Family, ...], ...] = (
    VESSELS,
    TABLEWARE,
    BOTTLES,
    TOOLS,
    CLEANING,
    FURNITURE,
    STANDS,
    CONTAINERS,
    WEARABLES,
    TOYS,
    HOLDERS,
)

FAMILIES: dict[str, Family] = {family.name: family for group in _GROUPS for family in group}
