"""Damaged and foreign files at every boundary are read as what they are or refused by name."""

import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from mutations import mutated

from iga_drake.aligners.iga.descriptor import DescriptorConfig, DescriptorNet
from iga_drake.aligners.iga.weights import load_descriptor
from iga_drake.checkpoint import save_checkpoint
from iga_drake.demonstrations.demonstration import DemonstrationError
from iga_drake.demonstrations.store import read_demonstrations
from iga_drake.errors import IgaDrakeError
from iga_drake.evaluation.results import ResultsError, ResultsStore
from iga_drake.files import OutputError
from iga_drake.paths import diagrams_dir, models_dir
from iga_drake.shapes.errors import ShapeError
from iga_drake.shapes.readers import list_folder, read_mesh
from iga_drake.station.scenario import ScenarioError, load_scenario

LONGEST = 3000  # characters of a refusal
MESHES = ("obj", "stl", "ply", "glb")


def refuses(error: IgaDrakeError, path: Path) -> None:
    """A refusal names the file and is short."""
    assert path.name in str(error) and len(str(error)) < LONGEST


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("mutated")


@given(st.data())
def test_a_scenario(place: Path, data: st.DataObject) -> None:
    path = place / "scenario.yaml"
    text = (diagrams_dir() / "one_of_everything.yaml").read_bytes()
    path.write_bytes(data.draw(mutated(text)))
    try:
        load_scenario(path).to_yaml()
    except ScenarioError as error:
        refuses(error, path)


@pytest.fixture(scope="module")
def demonstrations(place: Path) -> Path:
    folder = place / "stack"
    shutil.copytree(models_dir() / "demonstrations" / "stack", folder)
    return folder


@pytest.mark.parametrize("name", ["manifest.json", "demonstration_0.safetensors"])
@given(st.data())
def test_demonstrations(demonstrations: Path, name: str, data: st.DataObject) -> None:
    path = demonstrations / name
    before = path.read_bytes()
    path.write_bytes(data.draw(mutated(before)))
    try:
        found = read_demonstrations(demonstrations)
        for one in found.demonstrations:
            assert all(np.isfinite(seen.points).all() for seen in one.observations.values())
    except DemonstrationError as error:
        refuses(error, demonstrations)
    finally:
        path.write_bytes(before)


@pytest.fixture(scope="module")
def checkpoint(place: Path) -> bytes:
    net = DescriptorNet(
        DescriptorConfig(scalars=8, vectors=4, heads=2, layers=2, pair_hidden=4, descriptor=8)
    )
    card = {"model": vars(net.config) | {"shells": list(net.config.shells)}}
    path = place / "whole.safetensors"
    save_checkpoint(path, dict(net.state_dict()), kind="descriptor", card=card)
    return path.read_bytes()


@given(st.data())
def test_a_checkpoint(place: Path, checkpoint: bytes, data: st.DataObject) -> None:
    path = place / "weights.safetensors"
    # The head of the file says what is in it: most changes go there.
    head = data.draw(st.sampled_from((400, len(checkpoint))))
    path.write_bytes(data.draw(mutated(checkpoint[:head])) + checkpoint[head:])
    try:
        net, _ = load_descriptor(path)
        assert all(bool(torch.isfinite(each).all()) for each in net.state_dict().values())
    except IgaDrakeError as error:
        refuses(error, path)


@pytest.mark.parametrize("kind", MESHES)
@given(st.data())
def test_a_mesh(place: Path, kind: str, data: st.DataObject) -> None:
    folder = place / kind
    folder.mkdir(exist_ok=True)
    path = folder / f"box.{kind}"
    whole = trimesh.creation.box((0.1, 0.2, 0.05)).export(file_type=kind)
    path.write_bytes(data.draw(mutated(whole.encode() if isinstance(whole, str) else whole)))
    try:
        (entry,) = list_folder(folder)
        shape = read_mesh(entry)
        assert np.isfinite(shape.mesh.vertices).all() and len(shape.mesh.faces) > 0
    except ShapeError as error:
        refuses(error, path)


@given(st.data())
def test_results(place: Path, data: st.DataObject) -> None:
    path = place / "results.jsonl"
    path.unlink(missing_ok=True)
    store = ResultsStore(path)
    for k in range(3):
        store.add({"trial": k}, {"success": True, "time": 0.5 * k})
    whole = path.read_bytes()
    content = data.draw(mutated(whole))
    path.write_bytes(content)
    try:
        assert all(isinstance(result, dict) for _, result in ResultsStore(path).rows())
    except (ResultsError, OutputError) as error:
        refuses(error, path)
        assert path.read_bytes() == content  # nothing of somebody else's is lost
