"""Data folders of a wheel and of a checkout."""

from pathlib import Path

import pytest

from iga_drake import paths
from iga_drake.errors import IgaDrakeError


def test_the_checkouts_folders_are_found():
    assert (paths.models_dir() / "panda" / "panda.urdf").is_file()
    assert (paths.diagrams_dir() / "grasp.yaml").is_file()


def test_a_wheel_takes_its_own_folder_before_a_stranger_beside_it(monkeypatch, tmp_path: Path):
    package = tmp_path / "site-packages" / "iga_drake"
    monkeypatch.setattr(paths, "__file__", str(package / "paths.py"))
    stranger, own = package.parent / "models", package / "_data" / "models"
    stranger.mkdir(parents=True)
    own.mkdir(parents=True)
    assert paths.models_dir() == own
    with pytest.raises(IgaDrakeError, match="'diagrams' not found"):
        paths.diagrams_dir()
