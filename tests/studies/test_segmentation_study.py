import numpy as np
import pytest

from iga_drake.station.scenario import load_scenario
from iga_drake.studies.segmentation import RoleCounts, measure_segmentation, result_table


def test_counts_are_those_of_sets():
    rng = np.random.default_rng(0)
    counts = RoleCounts()
    true, labelled = set(), set()
    for look in range(3):
        truth, label = rng.integers(0, 3, (2, 200))
        counts = counts.add(truth, label, 1)
        true |= {(look, i) for i in np.flatnonzero(truth == 1)}
        labelled |= {(look, i) for i in np.flatnonzero(label == 1)}
    assert counts.precision == pytest.approx(len(true & labelled) / len(labelled))
    assert counts.recall == pytest.approx(len(true & labelled) / len(true))
    assert counts.overlap == pytest.approx(len(true & labelled) / len(true | labelled))
    assert (counts.looks, counts.refused) == (3, 0)
    blind = counts.add(np.ones(5, int), np.zeros(5, int), 1)
    assert (blind.looks, blind.refused) == (4, 1)
    assert np.isnan(RoleCounts().precision)


def test_labels_of_a_rendered_scene_are_nearly_the_true_ones(tmp_path):
    scenario = load_scenario("stack")
    for camera in scenario.cameras.values():
        k = camera.intrinsics
        k.width, k.height, k.fx, k.fy, k.cx, k.cy = 320, 240, 308.0, 308.0, 159.5, 119.5
    result = measure_segmentation(scenario, [0], png=tmp_path / "labels.png")
    assert result.looks == 2
    for name in ("target", "grasped"):
        assert result.roles[name].true > 2000
        assert result.roles[name].overlap > 0.9
    assert result.robot_as_object < 0.02 * result.roles["grasped"].true
    assert not result.problems
    assert (tmp_path / "labels.png").stat().st_size > 10_000
    assert "stack" in result_table([result])
