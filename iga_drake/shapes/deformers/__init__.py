"""Deformers: maps from a shape to a new instance of it that keep the correspondence of vertices.

The one that needs PyTorch, `iga_drake.shapes.deformers.dif_net.DifNetDeformer`, is not imported
here, so that this package stays cheap.
"""

from iga_drake.shapes.deformers.lattice import LatticeDeformer
from iga_drake.shapes.deformers.parts import PartDeformer
from iga_drake.shapes.deformers.protocol import DeformableShape, Deformer, PointDeformer
from iga_drake.shapes.deformers.reinstancing import ReinstancingDeformer

__all__ = [
    "DeformableShape",
    "Deformer",
    "LatticeDeformer",
    "PartDeformer",
    "PointDeformer",
    "ReinstancingDeformer",
]
