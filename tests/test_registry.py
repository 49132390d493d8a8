"""Names from a package's modules and from entry points of installed distributions."""

import subprocess
import sys
from pathlib import Path

import pytest

from iga_drake.errors import IgaDrakeError
from iga_drake.registry import Registry


@pytest.fixture
def registry(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, request) -> Registry:
    """Of a package with two modules, in a folder on sys.path."""
    package = f"cups_{abs(hash(request.node.name))}"
    folder = tmp_path / package
    folder.mkdir()
    (folder / "__init__.py").touch()
    (folder / "tea.py").write_text("CUPS = {'tea': lambda: 'a cup of tea'}\n")
    (folder / "nothing.py").write_text("import json\n")
    monkeypatch.syspath_prepend(tmp_path)
    return Registry(
        "cup", package=package, attribute="CUPS", group="cups", error=IgaDrakeError,
        reserved=("empty",),
    )  # fmt: skip


def add_module(registry: Registry, tmp_path: Path, name: str, text: str) -> None:
    (tmp_path / registry.package / f"{name}.py").write_text(text)


def add_distribution(tmp_path: Path, *lines: str, name: str = "cafe") -> None:
    """The metadata that installing a distribution leaves."""
    info = tmp_path / f"{name}-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("\n".join(("[cups]", *lines, "")))


def test_one_file_is_enough(registry: Registry, tmp_path: Path) -> None:
    assert registry.names() == ["tea"]
    add_module(registry, tmp_path, "mocha", "CUPS = {'mocha': lambda: 'a cup of mocha'}\n")
    assert registry.names() == ["mocha", "tea"]
    assert registry.factory("mocha")() == "a cup of mocha"


def test_a_place_is_imported_when_it_is_asked_for(registry: Registry, tmp_path: Path) -> None:
    (tmp_path / "slow_cups.py").write_text("def make(): return 'a cup of mocha'\n")
    add_module(registry, tmp_path, "mocha", "CUPS = {'mocha': 'slow_cups:make'}\n")
    assert registry.names() == ["mocha", "tea"] and "slow_cups" not in sys.modules
    assert registry.factory("mocha")() == "a cup of mocha"


def test_an_entry_point_is_loaded_when_it_is_asked_for(registry: Registry, tmp_path: Path) -> None:
    (tmp_path / "cafe_module.py").write_text("def make(): return 'a cup of water'\n")
    add_distribution(tmp_path, "water = cafe_module:make")
    assert registry.names() == ["tea", "water"] and "cafe_module" not in sys.modules
    assert registry.factory("water")() == "a cup of water"


def test_a_broken_entry_point_leaves_the_others_alone(registry: Registry, tmp_path: Path) -> None:
    (tmp_path / "shards.py").write_text("raise RuntimeError('dropped')\n")
    (tmp_path / "drained.py").write_text("make = 3\n")
    add_distribution(tmp_path, "broken = shards:make", "number = drained:make", "gone = none:make")
    assert registry.names() == ["broken", "gone", "number", "tea"]
    assert registry.factory("tea")() == "a cup of tea"
    for name, words in (
        ("broken", "'broken = shards:make' of distribution 'cafe' .*RuntimeError: dropped"),
        ("gone", "'gone = none:make' of distribution 'cafe' .*No module named 'none'"),
        ("number", "'number = drained:make' of distribution 'cafe' is a int"),
    ):
        with pytest.raises(IgaDrakeError, match=f"cup '{name}': the entry point {words}"):
            registry.factory(name)


def test_a_name_stated_twice_is_refused(registry: Registry, tmp_path: Path) -> None:
    add_module(registry, tmp_path, "green", "CUPS = {'tea': str}\n")
    with pytest.raises(IgaDrakeError, match=r"'tea' is stated twice: by .*green and by .*\.tea"):
        registry.names()
    add_module(registry, tmp_path, "green", "")
    sys.modules.pop(f"{registry.package}.green")
    add_distribution(tmp_path, "tea = cafe_module:make")
    with pytest.raises(IgaDrakeError, match=r"'tea' .*\.tea and by the entry .* 'cafe': rename"):
        registry.factory("tea")


def test_reserved_names_are_refused(registry: Registry, tmp_path: Path) -> None:
    add_distribution(tmp_path, "empty = cafe_module:make")
    with pytest.raises(IgaDrakeError, match="'empty' is stated twice"):
        registry.names()


def test_unknown_names_list_the_known_ones(registry: Registry) -> None:
    with pytest.raises(IgaDrakeError, match="unknown cup 'ale': one of: tea"):
        registry.factory("ale")


def test_listing_aligners_imports_nothing_heavy() -> None:
    code = (
        "import sys\n"
        "from iga_drake.aligners.registry import aligner_names\n"
        "assert len(aligner_names()) > 5\n"
        "heavy = {'torch', 'open3d', 'scipy', 'pydrake'} & set(sys.modules)\n"
        "assert not heavy, heavy\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
