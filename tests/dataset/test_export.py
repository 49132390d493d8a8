"""Exported samples: exact, resumable, the same from one machine or a cluster."""

import dataclasses
import hashlib
import json
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import load_file, save_file

from iga_drake.dataset import export
from iga_drake.dataset.export import (
    ExportError,
    export_shards,
    read_shard,
    sample_digest,
    set_digest,
)
from iga_drake.dataset.samples import SampleConfig, make_sample
from iga_drake.dataset.splits import SplitError

SMALL = SampleConfig(
    surface_points=400, cloud_points=48, least_seen=8, deformations=(1.0, 0.0, 0.0, 0.0)
)


@pytest.fixture(scope="module")
def local(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Five samples in shards of two."""
    out = tmp_path_factory.mktemp("shards") / "export"
    export_shards("train", 5, out, config=SMALL, shard_size=2)
    return out


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_shards_hold_the_samples_exactly(local: Path) -> None:
    samples = [s for path in sorted(local.glob("*.safetensors")) for s in read_shard(path)]
    assert len(samples) == 5
    for index, sample in enumerate(samples):
        expected = make_sample("train", index, SMALL)
        for field in dataclasses.fields(expected):
            value = getattr(expected, field.name)
            np.testing.assert_array_equal(getattr(sample, field.name), value)
        assert sample_digest(sample) == sample_digest(expected)
        assert sample.category == expected.category


def test_the_format_is_open(local: Path) -> None:
    """safetensors alone reads the arrays; the manifest lists the files with their SHA-256."""
    manifest = json.loads((local / "manifest.json").read_text())
    assert (manifest["split"], manifest["count"], manifest["shard_size"]) == ("train", 5, 2)
    assert manifest["config"] == json.loads(json.dumps(dataclasses.asdict(SMALL)))
    assert [(s["first"], s["count"]) for s in manifest["shards"]] == [(0, 2), (2, 2), (4, 1)]
    for shard in manifest["shards"]:
        path = local / shard["file"]
        assert hashlib.sha256(path.read_bytes()).hexdigest() == shard["sha256"]
        assert load_file(path)["points"].shape == (shard["count"], 2, 5, 48, 3)
    assert len(contents(local)) == 4  # no temporary file remains


def test_digests_tell_samples_apart_and_add_up() -> None:
    a, b = make_sample("train", 0, SMALL), make_sample("train", 1, SMALL)
    assert sample_digest(a) == sample_digest(make_sample("train", 0, SMALL)) != sample_digest(b)
    points = a.points.copy()
    points[0, 0, 0, 0] = np.nextafter(points[0, 0, 0, 0], np.float32(9))
    assert sample_digest(dataclasses.replace(a, points=points)) != sample_digest(a)
    assert sample_digest(dataclasses.replace(a, category=("mug", "other"))) != sample_digest(a)
    both = hashlib.sha256((sample_digest(a) + sample_digest(b)).encode()).hexdigest()
    assert set_digest("train", 2, config=SMALL) == both
    assert set_digest("train", 2, config=SMALL, workers=2) == both
    assert set_digest("train", 1, first=1, config=SMALL) != both


def test_an_export_goes_on_where_it_stopped(local: Path, tmp_path: Path) -> None:
    """Whole shards are kept; missing, cut, changed and foreign ones are made again."""
    expected = contents(local)
    shards = []
    assert (
        export_shards(
            "train", 5, tmp_path, config=SMALL, shard_size=2, progress=lambda *n: shards.append(n)
        ).made
        == 3
    )
    assert shards[0] == (0, 3) and shards[-1] == (3, 3)
    first, second, third = sorted(tmp_path.glob("*.safetensors"))
    kept = first.stat().st_mtime_ns
    second.write_bytes(second.read_bytes()[:-100])
    changed = bytearray(third.read_bytes())
    changed[-1] ^= 1
    third.write_bytes(changed)
    done = export_shards("train", 5, tmp_path, config=SMALL, shard_size=2)
    assert (done.made, done.kept) == (2, 1)
    assert first.stat().st_mtime_ns == kept
    assert contents(tmp_path) == expected
    # Without the manifest (a run killed early) shards are known by themselves; a shard in the
    # wrong place isn't taken for another.
    (tmp_path / "manifest.json").unlink()
    second.write_bytes(first.read_bytes())
    done = export_shards("train", 5, tmp_path, config=SMALL, shard_size=2)
    assert (done.made, done.kept) == (1, 2)
    assert contents(tmp_path) == expected
    # More samples than before: the last, short shard is made anew.
    done = export_shards("train", 6, tmp_path, config=SMALL, shard_size=2)
    assert (done.made, done.kept) == (1, 2)


def test_processes_make_the_same_bytes(local: Path, tmp_path: Path) -> None:
    export_shards("train", 5, tmp_path / "two", config=SMALL, shard_size=2, jobs=2)
    assert contents(tmp_path / "two") == contents(local)


def test_bad_input_is_refused(local: Path, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for arguments, message in [
        ({"count": 0}, "count 0"),
        ({"shard_size": 0}, "shard_size 0 must be"),
        ({"jobs": 0}, "jobs: 0"),
        ({"backend": "threads"}, "backend 'threads': expected 'loky' or 'ray'"),
        ({"out": tmp_path / "file"}, "is a file, expected a folder"),
        ({"out": local, "split": "validation"}, "another export, which differs in split"),
        ({"out": local, "shard_size": 3}, "differs in shard_size"),
        ({"out": local, "config": SampleConfig()}, "differs in config"),
        ({"out": local, "count": 4}, "holds 5 samples, more than 4"),
    ]:
        values = {
            "split": "train", "count": 5, "out": tmp_path / "new", "config": SMALL, "shard_size": 2,
            **arguments,
        }  # fmt: skip
        with pytest.raises(ExportError, match=message):
            export_shards(**values)
    with pytest.raises(SplitError, match="nowhere"):
        export_shards("nowhere", 5, tmp_path / "new")
    assert not (tmp_path / "new").exists()
    (tmp_path / "manifest.json").write_text("[")
    with pytest.raises(ExportError, match="no manifest of an export"):
        export_shards("train", 5, tmp_path)


def test_files_that_are_no_shards_are_named(local: Path, tmp_path: Path) -> None:
    with pytest.raises(ExportError, match=r"absent\.safetensors: no such shard"):
        read_shard(tmp_path / "absent.safetensors")
    whole = sorted(local.glob("*.safetensors"))[0].read_bytes()
    bad = tmp_path / "bad.safetensors"
    bad.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ExportError, match="damaged or no safetensors file"):
        read_shard(bad)
    bad.write_bytes(whole[:-1] + bytes([whole[-1] ^ 1]))
    with pytest.raises(ExportError, match="its samples don't have its digest"):
        read_shard(bad)
    save_file({"points": np.zeros(3)}, bad)
    with pytest.raises(ExportError, match="no shard of samples"):
        read_shard(bad)
    header = json.dumps({"format": export.FORMAT, "version": 99})
    save_file({"points": np.zeros(3)}, bad, {"iga-drake": header})
    with pytest.raises(ExportError, match="version 99, expected 'iga-drake-samples' version 1"):
        read_shard(bad)
