"""The wheel, away from the checkout: it brings models and diagrams, and its `iga` simulates."""

import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel of this checkout."""
    folder = tmp_path_factory.mktemp("wheel")
    command = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(folder)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    (path,) = folder.glob("*.whl")
    return path


def test_every_file_of_package_models_and_diagrams_is_in_it(wheel: Path) -> None:
    held = set(zipfile.ZipFile(wheel).namelist())
    for folder, place in (("iga_drake", ""), ("models", "_data/"), ("diagrams", "_data/")):
        files = [p for p in (ROOT / folder).rglob("*") if p.is_file() and p.suffix != ".pyc"]
        assert files
        for path in files:
            inside = path.relative_to(ROOT).as_posix()
            assert (f"iga_drake/{place}{inside}" if place else inside) in held


def test_it_simulates_in_an_empty_folder(wheel: Path, tmp_path: Path) -> None:
    """Beside the packages that are installed here. The time limit ends the episode as soon as the
    first pose is inferred, with the packaged weights and demonstrations."""
    site, empty = tmp_path / "site", tmp_path / "empty"
    empty.mkdir()
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-index"]
    subprocess.run([*pip, "--target", str(site), str(wheel)], check=True)
    environment = os.environ | {"PYTHONPATH": str(site), "XDG_CACHE_HOME": str(tmp_path / "cache")}

    def iga(*arguments: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [sys.executable, site / "bin" / "iga", *arguments],
            cwd=empty, env=environment, capture_output=True, text=True,
        )  # fmt: skip

    version = iga("--version")
    assert version.returncode == 0 and wheel.name.split("-")[1] in version.stdout
    limits = ("--set", "task.time_limit=0.6", "--set", "policy.infer_limit=600")
    short = iga("simulate", "grasp", "--seed", "3", *limits)
    assert short.returncode == 1, short.stderr
    assert "move grasp" in short.stdout and "time" in short.stdout
    where = [sys.executable, "-c", "import iga_drake.paths as p; print(p.models_dir())"]
    found = subprocess.run(where, cwd=empty, env=environment, capture_output=True, text=True)
    assert Path(found.stdout.strip()) == site / "iga_drake" / "_data" / "models"
    assert not list(empty.iterdir())
