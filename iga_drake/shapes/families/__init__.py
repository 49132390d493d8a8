"""Parametric families for training, one module a kind of object."""

from iga_drake.shapes.families.legacy import FAMILIES, draw

__all__ = ["FAMILIES", "draw"]
