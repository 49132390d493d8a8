from pathlib import Path

import numpy as np
from demonstration_fakes import make_set
from pydrake.geometry import Rgba

from iga_drake.viewing.replay import (
    demonstrations_html,
    quiet_meshcat,
    show_cloud,
    show_demonstrations,
    write_or_serve,
)

RED = Rgba(1, 0, 0, 1)
POINTS = np.random.default_rng(0).normal(size=(50, 3))


def test_an_empty_cloud_removes_the_old_one():
    meshcat = quiet_meshcat()
    show_cloud(meshcat, "cloud", POINTS, RED)
    assert meshcat.HasPath("/drake/cloud")
    show_cloud(meshcat, "cloud", np.zeros((0, 3)), RED)
    assert not meshcat.HasPath("/drake/cloud")


def test_what_is_shown_is_written_as_a_page(tmp_path: Path):
    meshcat = quiet_meshcat()
    show_cloud(meshcat, "cloud", POINTS, RED)
    write_or_serve(meshcat, tmp_path / "new" / "page.html")
    text = (tmp_path / "new" / "page.html").read_text()
    assert text.lstrip().lower().startswith("<!doctype html>")
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["page.html"]


def test_page_of_demonstrations():
    meshcat = quiet_meshcat()
    show_demonstrations(meshcat, make_set())
    for path in ("0/grasp/X_WE", "1/place/goal", "1/place/thing in the hand", "0/trajectory of E"):
        assert meshcat.HasPath(f"/drake/demonstrations/{path}")
    text = demonstrations_html(make_set())
    assert text.lstrip().lower().startswith("<!doctype html>")
