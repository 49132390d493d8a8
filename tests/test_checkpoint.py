"""Checkpoints come back whole, and foreign or damaged files are refused by name."""

import resource
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file

from iga_drake.checkpoint import FORMAT, CheckpointError, load_checkpoint, save_checkpoint

TENSORS = {"a": torch.arange(6.0).reshape(2, 3), "b": torch.tensor([1, 2], dtype=torch.uint8)}


def test_round_trip(tmp_path: Path) -> None:
    path = tmp_path / "deep" / "x.safetensors"
    save_checkpoint(path, TENSORS, kind="thing", card={"step": 3, "names": ["é"]})
    tensors, card = load_checkpoint(path, kind="thing")
    assert card == {"step": 3, "names": ["é"]}
    assert all(torch.equal(tensors[k], v) for k, v in TENSORS.items())
    assert [p.name for p in path.parent.iterdir()] == ["x.safetensors"]


def test_a_missing_file(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match=r"none\.safetensors: no such checkpoint"):
        load_checkpoint(tmp_path / "none.safetensors", kind="thing")


def test_another_kind(tmp_path: Path) -> None:
    path = tmp_path / "x.safetensors"
    save_checkpoint(path, TENSORS, kind="other", card={})
    with pytest.raises(
        CheckpointError, match=r"x\.safetensors: kind 'other'.*expected kind 'thing'"
    ):
        load_checkpoint(path, kind="thing")


def test_a_foreign_safetensors_file(tmp_path: Path) -> None:
    path = tmp_path / "x.safetensors"
    save_file(TENSORS, path)
    with pytest.raises(CheckpointError, match="not a checkpoint of this package"):
        load_checkpoint(path, kind="thing")


@pytest.mark.parametrize("keep", [0, 5, 60, -4])
def test_a_truncated_file(tmp_path: Path, keep: int) -> None:
    path = tmp_path / "x.safetensors"
    save_checkpoint(path, TENSORS, kind="thing", card={})
    path.write_bytes(path.read_bytes()[:keep])
    with pytest.raises(CheckpointError, match=r"x\.safetensors"):
        load_checkpoint(path, kind="thing")


@pytest.mark.parametrize("card", ["[]", "3", "null", "{", "[" * 100_000, "\ud800"])
def test_a_card_that_is_none(tmp_path: Path, card: str) -> None:
    path = tmp_path / "x.safetensors"
    metadata = {"format": FORMAT, "version": "1", "kind": "thing", "card": card}
    try:
        save_file(TENSORS, path, metadata)
    except UnicodeEncodeError:  # safetensors itself refuses it
        return
    with pytest.raises(CheckpointError, match=r"x\.safetensors: ") as error:
        load_checkpoint(path, kind="thing")
    assert len(str(error.value)) < 3000


def test_a_full_disk_leaves_the_old_checkpoint(tmp_path: Path) -> None:
    path = tmp_path / "x.safetensors"
    save_checkpoint(path, TENSORS, kind="thing", card={})
    whole = path.read_bytes()
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, before[1]))
    try:
        with pytest.raises((CheckpointError, OSError), match=r"x\.safetensors"):
            save_checkpoint(path, {"a": torch.zeros(5000)}, kind="thing", card={})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert path.read_bytes() == whole and list(tmp_path.iterdir()) == [path]
