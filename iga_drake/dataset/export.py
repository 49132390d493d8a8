"""Samples as files: shards in the safetensors format and a manifest, made by one machine or many.

A shard holds every array field of `Sample` stacked over its samples; its header holds the rest as
JSON. A shard's bytes depend on its samples alone, wherever they were made.
"""

import dataclasses
import hashlib
import json
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from iga_drake.cluster import connect_cluster
from iga_drake.dataset.loader import SampleDataset, collate, sample_loader
from iga_drake.dataset.samples import Sample, SampleConfig, make_sample
from iga_drake.dataset.splits import sample_set
from iga_drake.errors import IgaDrakeError
from iga_drake.files import write_bytes
from iga_drake.progress import progress as followed

FORMAT = "iga-drake-samples"
VERSION = 1
MANIFEST = "manifest.json"
# A file's metadata is written in no certain order: one entry keeps the bytes the same.
_HEADER = "iga-drake"
_ROUND = 4  # shards a job that are in memory at once, at most


class ExportError(IgaDrakeError):
    """Shards can't be written or read; the message names the file and the remedy."""


@dataclass(frozen=True)
class Exported:
    """The result of `export_shards`."""

    manifest: Path
    made: int  # shards
    kept: int  # shards that were there already


@dataclass(frozen=True)
class _Shard:
    split: str
    config: SampleConfig
    first: int  # index of the first sample
    count: int

    def header(self) -> dict[str, Any]:
        return {
            "format": FORMAT,
            "version": VERSION,
            "split": self.split,
            "config": _plain(self.config),
            "first": self.first,
            "count": self.count,
        }


def _plain(config: SampleConfig) -> dict[str, Any]:
    """The options as JSON gives them back: lists instead of tuples."""
    return json.loads(json.dumps(dataclasses.asdict(config)))


def sample_digest(sample: Sample) -> str:
    """SHA-256 (hexadecimal) of a sample: names, types, shapes and exact bytes of its fields."""
    total = hashlib.sha256()
    for field in dataclasses.fields(sample):
        value = getattr(sample, field.name)
        if isinstance(value, np.ndarray):
            total.update(f"{field.name} {value.dtype.str} {value.shape}\n".encode())
            total.update(np.ascontiguousarray(value).tobytes())
        else:
            total.update(f"{field.name} {json.dumps(value)}\n".encode())
    return total.hexdigest()


def set_digest(
    split: str, count: int, *, config: SampleConfig | None = None, workers: int = 0, first: int = 0
) -> str:
    """SHA-256 over the digests of samples `first` to `first + count - 1` in order."""
    loader = sample_loader(
        split,
        batch=1,
        workers=workers,
        config=config,
        first=first,
        count=count,
        make=_digest_alone,
    )
    return _join(batch["value"][0] for batch in followed(loader, split, total=count))


@dataclass(frozen=True)
class _Digest:
    value: str


def _digest_alone(split: str, index: int, config: SampleConfig | None) -> _Digest:
    return _Digest(sample_digest(make_sample(split, index, config)))


def _join(digests: Iterable[str]) -> str:
    total = hashlib.sha256()
    for one in digests:
        total.update(one.encode())
    return total.hexdigest()


def shard_bytes(
    split: str, first: int, count: int, config: SampleConfig | None = None, make: Any = make_sample
) -> bytes:
    """The file of samples `first` to `first + count - 1` of a set."""
    config = config or SampleConfig()
    dataset = SampleDataset(split, config, make)
    samples = [dataset[index][1] for index in range(first, first + count)]
    header = _Shard(split, config, first, count).header()
    header["digest"] = _join(map(sample_digest, samples))
    fields = collate(samples)
    # Contiguous, as `collate` makes them: safetensors ignores an array's strides.
    tensors = {name: value.numpy() for name, value in fields.items() if torch.is_tensor(value)}
    header["fields"] = {name: value for name, value in fields.items() if name not in tensors}
    return save(tensors, {_HEADER: json.dumps(header, sort_keys=True)})


def _header(path: Path) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    if not path.is_file():
        raise ExportError(f"{path}: no such shard; write some with `iga dataset export`")
    try:
        with safe_open(path, framework="numpy") as file:
            metadata = file.metadata() or {}
            if _HEADER not in metadata:
                raise ExportError(f"{path}: a safetensors file, but no shard of samples")
            header = json.loads(metadata[_HEADER])
            tensors = {name: file.get_tensor(name) for name in file.keys()}
    except (SafetensorError, OSError, ValueError) as error:
        raise ExportError(f"{path}: damaged or no safetensors file ({error})") from error
    if header.get("format") != FORMAT or header.get("version") != VERSION:
        raise ExportError(
            f"{path}: format '{header.get('format')}' version {header.get('version')}, expected "
            f"'{FORMAT}' version {VERSION}: export the samples again"
        )
    return header, tensors


def read_shard(path: Path | str) -> list[Sample]:
    """The samples of a shard. Raises `ExportError` for a missing, damaged or foreign file."""
    path = Path(path)
    header, tensors = _header(path)
    names = {field.name for field in dataclasses.fields(Sample)}
    found = set(tensors) | set(header["fields"])
    if found != names:
        raise ExportError(
            f"{path}: fields {sorted(found)}, expected {sorted(names)}: written by another version "
            "of this package; export the samples again"
        )
    samples = []
    for n in range(header["count"]):
        fields: dict[str, Any] = {name: value[n] for name, value in tensors.items()}
        fields |= {
            name: tuple(values[n]) if isinstance(values[n], list) else values[n]
            for name, values in header["fields"].items()
        }
        samples.append(Sample(**fields))
    if _join(map(sample_digest, samples)) != header["digest"]:
        raise ExportError(f"{path}: its samples don't have its digest: damaged; export them again")
    return samples


def export_shards(
    split: str,
    count: int,
    out: Path | str,
    *,
    config: SampleConfig | None = None,
    shard_size: int = 256,
    jobs: int = 1,
    backend: str = "loky",
    address: str | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Exported:
    """Writes samples 0 to `count - 1` of the set `split` into the folder `out`.

    Shards that are there already and whole are kept, so an export that was stopped goes on. The
    files are written on the machine that calls; only samples are made elsewhere.

    Args:
      shard_size: samples a file.
      jobs: processes that make samples; -1 for one a core (of the whole cluster with Ray).
      backend: "loky", processes on this machine, or "ray", a Ray cluster (through joblib).
      address: of the Ray cluster ("auto", "ray://host:10001"); None: the one that this process is
        connected to, or a new one on this machine.
      progress: called with the numbers of finished shards and of all.

    Raises `ExportError` for bad arguments, an `out` that holds another export, or packages that
    aren't installed; `SplitError` for an unknown set.
    """
    if count < 1 or shard_size < 1:
        raise ExportError(f"count {count} and shard_size {shard_size} must be at least 1")
    if jobs < 1 and jobs != -1:
        raise ExportError(f"jobs: {jobs}, must be at least 1, or -1 for all cores")
    if backend not in ("loky", "ray"):
        raise ExportError(f"backend '{backend}': expected 'loky' or 'ray'")
    sample_set(split)
    config, out = config or SampleConfig(), Path(out)
    if out.exists() and not out.is_dir():
        raise ExportError(f"{out}: is a file, expected a folder")
    manifest = _manifest(split, count, shard_size, config)
    _check_folder(out / MANIFEST, manifest)
    out.mkdir(parents=True, exist_ok=True)
    shards = [
        _Shard(split, config, first, min(shard_size, count - first))
        for first in range(0, count, shard_size)
    ]
    sums = {shard.first: _finished(_file(out, shard, shard_size), shard) for shard in shards}
    missing = [shard for shard in shards if not sums[shard.first]]
    kept = len(shards) - len(missing)
    _write_manifest(out, manifest, shards, sums)
    if progress is not None:
        progress(kept, len(shards))
    if missing:
        with _jobs(jobs, backend, address) as (run, width):
            for start in range(0, len(missing), _ROUND * width):
                part = missing[start : start + _ROUND * width]
                for shard, data in zip(part, run(part), strict=True):
                    write_bytes(_file(out, shard, shard_size), data)
                    sums[shard.first] = hashlib.sha256(data).hexdigest()
                _write_manifest(out, manifest, shards, sums)
                if progress is not None:
                    progress(kept + start + len(part), len(shards))
    return Exported(out / MANIFEST, len(missing), kept)


def _file(out: Path, shard: _Shard, shard_size: int) -> Path:
    return out / f"shard-{shard.first // shard_size:05d}.safetensors"


def _manifest(split: str, count: int, shard_size: int, config: SampleConfig) -> dict[str, Any]:
    return {
        "format": FORMAT,
        "version": VERSION,
        "split": split,
        "count": count,
        "shard_size": shard_size,
        "config": _plain(config),
    }


def _check_folder(path: Path, manifest: dict[str, Any]) -> None:
    """Refuses a folder whose manifest is of another export; a larger `count` is fine."""
    if not path.exists():
        return
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
        differs = [k for k in manifest if k != "count" and found.get(k) != manifest[k]]
        fewer = manifest["count"] < found["count"]
    except (OSError, ValueError, KeyError, AttributeError, TypeError) as error:
        raise ExportError(f"{path}: no manifest of an export ({error}); remove it") from error
    if differs:
        raise ExportError(
            f"{path}: another export, which differs in {', '.join(differs)}; choose another folder"
        )
    if fewer:
        raise ExportError(
            f"{path}: holds {found['count']} samples, more than {manifest['count']}; choose "
            "another folder"
        )


def _write_manifest(
    out: Path, manifest: dict[str, Any], shards: list[_Shard], sums: dict[int, str]
) -> None:
    """Lists the shards that are finished."""
    rows = [
        {
            "file": _file(out, shard, manifest["shard_size"]).name,
            "first": shard.first,
            "count": shard.count,
            "sha256": sums[shard.first],
        }
        for shard in shards
        if sums[shard.first]
    ]
    text = json.dumps({**manifest, "shards": rows}, indent=1) + "\n"
    write_bytes(out / MANIFEST, text.encode())


def _finished(path: Path, shard: _Shard) -> str:
    """SHA-256 of a shard's file that is whole and holds what it should; else empty."""
    if not path.is_file():
        return ""
    try:
        header, _ = _header(path)
        read_shard(path)
    except ExportError:
        return ""
    if {name: header.get(name) for name in shard.header()} != shard.header():
        return ""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _make(shard: _Shard) -> bytes:
    return shard_bytes(shard.split, shard.first, shard.count, shard.config)


def _make_alone(shard: _Shard) -> bytes:
    """`_make` on one thread, in a process that shares its machine with others."""
    torch.set_num_threads(1)
    return _make(shard)


@contextmanager
def _jobs(
    jobs: int, backend: str, address: str | None
) -> Iterator[tuple[Callable[[list[_Shard]], Iterable[bytes]], int]]:
    """A function from shards to their bytes, in order, and how many it makes at once."""
    if backend == "loky" and jobs == 1:
        yield lambda shards: map(_make, shards), 1
        return
    try:
        import joblib
    except ImportError as error:
        raise ExportError(f"{error}: pip install 'iga-drake[cluster]', or use one job") from error
    if backend == "ray":
        ray = connect_cluster(address)
        from ray.util.joblib import register_ray

        register_ray()
        width = int(ray.cluster_resources().get("CPU", 1)) if jobs == -1 else jobs
    else:
        width = joblib.cpu_count() if jobs == -1 else jobs
    with joblib.parallel_config(backend=backend, n_jobs=width):
        yield (
            lambda shards: joblib.Parallel()(
                joblib.delayed(_make_alone)(shard) for shard in shards
            ),
            width,
        )
