"""Tables and figures of alignment errors."""

import re
from pathlib import Path

import numpy as np
import pytest

from iga_drake.aligners.registry import ORACLE
from iga_drake.evaluation.alignment import SampleErrors, summarise_errors
from iga_drake.evaluation.alignment_reports import draw_errors, markdown_errors


def _errors(aligner: str, split: str, centimetres, degrees, *, up: bool = False, field: str = ""):
    """What was measured of samples with these errors."""
    return summarise_errors(
        SampleErrors(
            aligner, split, k, "mug", "bowl", 1.0, 1.0, cm / 100, np.radians(deg), 0.25, up, field
        )
        for k, (cm, deg) in enumerate(zip(centimetres, degrees, strict=True))
    )


@pytest.fixture
def errors():
    return [
        _errors("iga", "multi_modal", [0.5, 1.5, 1.0], [2.0, 4.0, 90.0]),
        _errors("iga", "cross_instance", [1.0, 2.0], [4.0, 6.0], up=True),
        _errors("icp", "multi_modal", [4.0, 6.0, 8.0], [30.0, 40.0, 170.0]),
        _errors(ORACLE, "cross_instance", [0.5], [3.0]),
    ]


def test_tables_hold_the_errors_modulo_symmetry(errors):
    overview, detail = markdown_errors(errors).split("Modulo symmetry, mean")
    rows = {row.split(" | ")[0]: row for row in re.findall(r"^\| (.*) \|$", overview, re.M)}
    assert rows["clouds"] == "clouds | iga | icp | oracle"
    assert rows["multi_modal"] == "multi_modal | 1.00 / 32.0 | 6.00 / 80.0 | -"
    # The oracle needs no ways up: it stands beside those that had them.
    assert rows["cross_instance, up known"].endswith("| 1.50 / 5.0 | - | 0.50 / 3.0")
    first = next(line for line in detail.splitlines() if line.startswith("| iga | multi_modal"))
    assert first == (
        "| iga | multi_modal | 3 | 1.00 ± 0.41 (1.00) | 32.0 ± 41.0 (4.0) | 33 % | 67 % | 67 % "
        "| 33.3 % | 0.25 |"
    )
    columns = {line.count("|") for line in detail.splitlines() if line.startswith("|")}
    assert columns == {first.count("|")}


def test_the_figure_shows_every_aligner(errors, tmp_path: Path):
    from matplotlib.image import imread

    draw_errors(errors, tmp_path / "all.png")
    draw_errors(errors[:2], tmp_path / "one.png")
    colors = []
    for name in ("all.png", "one.png"):
        image = imread(tmp_path / name)[..., :3]
        orange = np.abs(image - [1.0, 0.498, 0.055]).max(-1) < 0.02
        blue = np.abs(image - [0.122, 0.467, 0.706]).max(-1) < 0.02
        colors.append((blue.sum(), orange.sum()))
    assert colors[0][1] > colors[0][0] > 500  # ICP's errors are the larger ones
    assert colors[1][1] == 0
    assert colors[1][0] > 500
