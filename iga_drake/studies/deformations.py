"""Quality of the deformed implicit field: correspondence, validity of deformed meshes, pictures.

`iga view deformations --out DIR` writes contact sheets of deformed shapes whose colours are the
canonical positions of their points, so that equal colours correspond.
"""

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import trimesh
from scipy.spatial import cKDTree

from iga_drake.files import output_folder
from iga_drake.paths import landed_weights
from iga_drake.progress import progress
from iga_drake.shapes.deformers import LatticeDeformer, PartDeformer, ReinstancingDeformer
from iga_drake.shapes.deformers.dif_net import DifNetDeformer
from iga_drake.shapes.deformers.protocol import DeformableShape, Deformer
from iga_drake.shapes.dif_net import DifNet, Normalisation, load_dif_net
from iga_drake.shapes.errors import ShapeError
from iga_drake.shapes.families import FAMILIES
from iga_drake.training.dif_net import DifNetTraining, training_shapes
from iga_drake.viewing.shape_sheets import canonical_colors, contact_sheet, write_png

DEFORMERS = ("dif-net", "lattice", "parts", "reinstancing")


@dataclass(frozen=True)
class CorrespondenceErrors:
    """Distance from the match to the true place, as a share of the second shape's largest extent,
    over all pairs and points."""

    pairs: int
    template_mean: float  # nearest neighbour in the template space
    template_median: float
    baseline_mean: float  # nearest neighbour in the normalised space
    baseline_median: float

    def row(self) -> str:
        """The values as one line of text."""
        return (
            f"{self.pairs} pairs: nearest in the template space {100 * self.template_mean:.1f} % "
            f"mean, {100 * self.template_median:.1f} % median; nearest in the normalised space "
            f"{100 * self.baseline_mean:.1f} % mean, {100 * self.baseline_median:.1f} % median"
        )


def correspondence_errors(
    net: DifNet, config: DifNetTraining, *, pairs: int, points: int = 2000, seed: int = 0
) -> CorrespondenceErrors:
    """Matches of random pairs of training shapes against the family's own correspondence.

    The same random places on the faces, the true matches of each other, are taken on both shapes.
    """
    rng = np.random.default_rng(seed)
    shapes = training_shapes(config)
    faces = shapes[0][1]
    errors: list[list[np.ndarray]] = [[], []]
    for _ in progress(range(pairs), "pairs"):
        pair = rng.choice(len(shapes), 2, replace=False)
        mesh = trimesh.Trimesh(shapes[pair[1]][0], faces, process=False)
        face = rng.choice(len(faces), points, p=mesh.area_faces / mesh.area)
        barycentric = rng.dirichlet(np.ones(3), points)
        places = []
        for k in pair:
            vertices = Normalisation.of(shapes[k][0]).apply(shapes[k][0])
            places.append(np.einsum("pk,pkc->pc", barycentric, vertices[faces[face]]))
        with torch.inference_mode():
            template = net.to_template(
                torch.from_numpy(np.stack(places).astype(np.float32)),
                net.latents[torch.from_numpy(pair)],
            ).numpy()
        size = np.ptp(places[1], axis=0).max()
        for space, at in zip(errors, (template, np.stack(places)), strict=True):
            match = cKDTree(at[1]).query(at[0])[1]
            space.append(np.linalg.norm(places[1][match] - places[1], axis=1) / size)
    own, base = (np.concatenate(space) for space in errors)
    return CorrespondenceErrors(
        pairs, float(own.mean()), float(np.median(own)), float(base.mean()), float(np.median(base))
    )


def crossings(vertices: np.ndarray, faces: np.ndarray) -> set[tuple[int, int]]:
    """Pairs of faces of one closed part that share no vertex and cut each other.

    Different parts of a shape may overlap. Needs libigl and rtree.
    """
    import igl

    mesh = trimesh.Trimesh(vertices, faces, process=False)
    triangles = np.array(mesh.triangles)
    corners = [[row[None] for row in triangle] for triangle in triangles]
    low, high = triangles.min(1), triangles.max(1)
    part = trimesh.graph.connected_component_labels(mesh.face_adjacency, node_count=len(faces))
    found = set()
    for i, hits in enumerate(
        mesh.triangles_tree.intersection(box) for box in np.hstack((low, high))
    ):
        for j in hits:
            if j <= i or part[i] != part[j] or set(faces[i]) & set(faces[j]):
                continue
            if igl.tri_tri_intersection_test_3d(*corners[i], *corners[j])[0]:
                found.add((i, int(j)))
    return found


@dataclass(frozen=True)
class Validity:
    """Shares of draws for which a deformed mesh is as it should be."""

    draws: int
    closed: float  # watertight, consistently wound
    volume: float  # every closed part has positive volume
    unfolded: float  # the map's Jacobian has a positive determinant at every vertex
    uncrossed: float  # no two faces cut each other that didn't before
    valid: float  # all of these

    def row(self) -> str:
        """The values as one line of text."""
        return (
            f"{self.draws} draws: closed {100 * self.closed:.1f} %, positive volume "
            f"{100 * self.volume:.1f} %, unfolded {100 * self.unfolded:.1f} %, no new crossings "
            f"{100 * self.uncrossed:.1f} %; all {100 * self.valid:.1f} %"
        )


def validity(
    deformer: DifNetDeformer, names: Sequence[str], draws: int, *, seed: int = 0
) -> Validity:
    """Validity of deformed meshes over `draws` random instances of each of the families `names`."""
    rows = []
    for name in progress(names, "families"):
        for k in range(draws):
            rng = np.random.default_rng((seed, k))
            family = FAMILIES[name]
            vertices, faces = family.surface(family.sample_parameters(rng))
            moved = deformer.deform(DeformableShape(vertices, faces), k)
            mesh = trimesh.Trimesh(moved, faces, process=False)
            parts = mesh.split(only_watertight=False)
            rows.append(
                (
                    mesh.is_watertight and mesh.is_winding_consistent,
                    all(part.volume > 0 for part in parts),
                    deformer.jacobian_determinants(vertices, k).min() > 0,
                    not crossings(moved, faces) - crossings(vertices, faces),
                )
            )
    table = np.array(rows)
    closed, volume, unfolded, uncrossed = (float(share) for share in table.mean(0))
    return Validity(len(table), closed, volume, unfolded, uncrossed, float(table.all(1).mean()))


def deformation_sheet(
    deformer: Deformer, family_name: str, count: int = 24, seed: int = 0, *, columns: int = 6
) -> np.ndarray:
    """(H, W, 3) uint8: an instance of the family, then `count` - 1 deformed ones of it."""
    if family_name not in FAMILIES:
        raise ShapeError(f"family '{family_name}': unknown; one of: {', '.join(sorted(FAMILIES))}")
    family = FAMILIES[family_name]
    parameters = family.sample_parameters(np.random.default_rng(seed))
    vertices, faces = family.surface(parameters)
    shape = DeformableShape(vertices, faces, None, family_name, parameters)
    colors = canonical_colors(vertices)
    meshes = [vertices] + [deformer.deform(shape, seed + k) for k in range(1, count)]
    return contact_sheet([(mesh, faces, colors) for mesh in meshes], columns=columns)


def make_deformer(name: str, scale: float, weights: Path | None = None) -> Deformer:
    """The deformer `name` of DEFORMERS, `scale` times as strong as by default.

    `weights`: checkpoint of DIF-Net, unused by the others; None: the default one.
    """
    if name == "lattice":
        return LatticeDeformer(amplitude=0.06 * scale, scale=0.2 * scale)
    if name == "parts":
        return PartDeformer(
            scale=0.2 * scale, bend=0.1 * scale, taper=0.15 * scale, common=0.1 * scale
        )
    if name == "reinstancing":
        return ReinstancingDeformer(spread=0.15 * scale)
    net = None if weights is None else load_dif_net(weights)[0]
    return DifNetDeformer(net, scale=scale)


def add_view_deformations(parser: argparse.ArgumentParser) -> None:
    """Options of `iga view deformations`."""
    parser.add_argument(
        "--family", action="append", metavar="NAME", help="repeatable (default: mug and bottle)"
    )
    parser.add_argument("--out", type=output_folder, required=True, metavar="DIR")
    parser.add_argument("--count", type=int, default=24)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--deformer", choices=DEFORMERS, default=DEFORMERS[0])
    parser.add_argument("--scale", type=float, default=1.0, help="how strong, times the default")
    parser.add_argument("--weights", type=Path, help="of DIF-Net (default: the package's)")


def view_deformations(arguments: argparse.Namespace) -> int:
    """Writes one contact sheet a family."""
    deformer = make_deformer(arguments.deformer, arguments.scale, arguments.weights)
    for name in arguments.family or ("mug", "bottle"):
        path = arguments.out / f"{name}-{arguments.deformer}.png"
        write_png(deformation_sheet(deformer, name, arguments.count, arguments.seed), path)
        print(f"written: {path}")
    return 0


def add_evaluate_deformations(parser: argparse.ArgumentParser) -> None:
    """Options of `iga evaluate deformations`."""
    parser.add_argument("--pairs", type=int, default=200, help="of training shapes, matched")
    parser.add_argument("--draws", type=int, default=17, help="deformed instances a family")
    parser.add_argument(
        "--family", action="append", metavar="NAME",
        help="repeatable (default: mug, bottle and hammer)",
    )  # fmt: skip
    parser.add_argument("--scale", type=float, action="append", help="repeatable (default: 1, 2)")
    parser.add_argument("--weights", type=Path, help="of DIF-Net (default: the package's)")


def evaluate_deformations(arguments: argparse.Namespace) -> int:
    """Prints the errors of DIF-Net's correspondence and how many deformed meshes are valid."""
    net, card = load_dif_net(arguments.weights or landed_weights("dif_net"))
    config = DifNetTraining(**card["training"])
    print(f"correspondence, {correspondence_errors(net, config, pairs=arguments.pairs).row()}")
    names = arguments.family or ["mug", "bottle", "hammer"]
    for scale in arguments.scale or [1.0, 2.0]:
        deformer = DifNetDeformer(net, scale=scale)
        result = validity(deformer, names, arguments.draws)
        print(f"validity, {', '.join(names)}, scale {scale:g}, {result.row()}", flush=True)
    return 0
