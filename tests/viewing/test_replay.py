from pathlib import Path

import numpy as np
from demonstration_fakes import make_set
from pydrake.geometry import Rgba
from pydrake.math import RigidTransform, RollPitchYaw

from iga_drake.viewing.replay import (
    demonstrations_html,
    quiet_meshcat,
    show_cloud,
    show_demonstrations,
    show_prediction,
    write_html,
)

RED = Rgba(1, 0, 0, 1)
POINTS = np.random.default_rng(0).normal(size=(50, 3))


def test_prediction_shows_both_clouds_and_the_pose(tmp_path: Path):
    meshcat = quiet_meshcat()
    X_WE = RigidTransform(RollPitchYaw(1, 2, 3), [0.5, 0.0, 0.2])
    show_prediction(meshcat, target=POINTS, grasped_E=POINTS[:20], X_WE=X_WE)
    for name in ("target cloud", "predicted pose", "grasped cloud at the predicted pose"):
        assert meshcat.HasPath(f"/drake/perception/{name}")
    write_html(meshcat, tmp_path / "new" / "replay.html")
    text = (tmp_path / "new" / "replay.html").read_text()
    assert text.lstrip().lower().startswith("<!doctype html>")
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["replay.html"]


def test_nothing_is_predicted_before_there_is_a_pose():
    meshcat = quiet_meshcat()
    show_prediction(meshcat, target=POINTS, grasped_E=POINTS)
    assert not meshcat.HasPath("/drake/perception/predicted pose")


def test_an_empty_cloud_removes_the_old_one():
    meshcat = quiet_meshcat()
    show_cloud(meshcat, "cloud", POINTS, RED)
    assert meshcat.HasPath("/drake/cloud")
    show_cloud(meshcat, "cloud", np.zeros((0, 3)), RED)
    assert not meshcat.HasPath("/drake/cloud")


def test_page_of_demonstrations():
    meshcat = quiet_meshcat()
    show_demonstrations(meshcat, make_set())
    for path in ("0/grasp/X_WE", "1/place/goal", "1/place/thing in the hand", "0/trajectory of E"):
        assert meshcat.HasPath(f"/drake/demonstrations/{path}")
    text = demonstrations_html(make_set())
    assert text.lstrip().lower().startswith("<!doctype html>")
