"""`iga shapes`: families listed, instances written, meshes read and reported."""

import argparse
import json
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest
import trimesh

from iga_drake.cli import shapes
from iga_drake.shapes.errors import ShapeError
from iga_drake.shapes.families import FAMILIES


def run(*arguments: str) -> int:
    parser = argparse.ArgumentParser()
    shapes.add_arguments(parser)
    return shapes.run(parser.parse_args(arguments))


def test_list_names_every_family(capsys: pytest.CaptureFixture) -> None:
    assert run("list") == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines[1:-1]] == sorted(FAMILIES)
    assert lines[-1].startswith(f"{len(FAMILIES)} families")


def test_list_as_json_has_what_the_families_declare(capsys: pytest.CaptureFixture) -> None:
    assert run("list", "--json") == 0
    rows = {row["family"]: row for row in json.loads(capsys.readouterr().out)}
    assert set(rows) == set(FAMILIES)
    for name, family in FAMILIES.items():
        ranges = {key: list(limits) for key, limits in family.ranges.items()}
        assert rows[name]["parameters"] == ranges
        assert rows[name]["symmetry"]["order"] == family.symmetry.order
        assert rows[name]["parts"]


def written(folder: Path, *options: str) -> ET.Element:
    assert run("sdf", "mug", "--out", str(folder), *options) == 0
    (path,) = folder.glob("*.sdf")
    model = ET.parse(path).getroot().find("model")
    assert model is not None and model.get("name") == path.stem
    return model


def test_sdf_writes_the_seed_s_instance(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    model = written(tmp_path, "--seed", "5")
    assert model.get("name") == "mug_5"
    assert str(tmp_path / "mug_5.sdf") in capsys.readouterr().out
    family = FAMILIES["mug"]
    expected = family.build(family.sample_parameters(np.random.default_rng(5)))
    uri = model.findtext("link/visual/geometry/mesh/uri")
    assert uri is not None
    mesh = trimesh.load_mesh(tmp_path / uri, process=False)
    np.testing.assert_allclose(np.sort(mesh.bounds), np.sort(expected.mesh.bounds), atol=1e-6)
    assert float(model.findtext("link/inertial/mass")) == pytest.approx(
        expected.mass_properties.mass
    )


def test_sdf_takes_a_name_and_a_mass(tmp_path: Path) -> None:
    model = written(tmp_path, "--name", "my-mug", "--mass", "0.25")
    assert model.get("name") == "my-mug"
    assert float(model.findtext("link/inertial/mass")) == pytest.approx(0.25)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["dragon"], "family 'dragon': unknown; one of: .*mug"),
        (["mug", "--seed", "-1"], "--seed -1"),
        (["mug", "--mass", "0"], "--mass 0"),
        (["mug", "--mass", "nan"], "--mass nan"),
        (["mug", "--name", "a b"], "name 'a b'"),
    ],
)
def test_sdf_refuses_bad_input(options: list[str], words: str, tmp_path: Path) -> None:
    with pytest.raises(ShapeError, match=words):
        run("sdf", *options, "--out", str(tmp_path / "out"))
    assert not (tmp_path / "out").exists()


def test_read_reports_broken_meshes(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    folder = tmp_path / "meshes"
    folder.mkdir()
    trimesh.creation.box((300, 200, 100)).export(folder / "good.stl")
    (folder / "bad.stl").touch()
    assert run("read", str(folder), "--scale", "0.001") == 0
    out = capsys.readouterr().out
    assert "meshes/good: 8 vertices, 12 faces, 0.3 x 0.2 x 0.1 m, watertight, " in out
    assert "1 meshes read, 1 skipped\n  skipped meshes/bad: the file is empty\n" in out


def test_read_fails_where_nothing_could_be_read(tmp_path: Path) -> None:
    (tmp_path / "bad.stl").touch()
    assert run("read", str(tmp_path)) == 1
    with pytest.raises(ShapeError, match="no such folder"):
        run("read", str(tmp_path / "nowhere"))
    with pytest.raises(ShapeError, match=r"taxonomy\.json"):
        run("read", str(tmp_path), "--category", "mug")
