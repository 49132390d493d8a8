"""The figure of a training's log."""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from iga_drake import cli
from iga_drake.studies.training_log import LogError, read_log, series, smooth


def _log(folder: Path, steps: int = 40) -> Path:
    folder.mkdir()
    rows = []
    for step in range(1, steps + 1):
        row = {"loss": 5 / step, "energy_min": -step, "energy_max": step, "energy_true": -step / 2}
        rows.append(row | {"step": step, "seconds": 1.0})
        if step % 10 == 0:
            error = {"rotation_deg": abs(step - 20) + 3.0, "rotation_deg_median": 2.0}
            rows.append({"validation": error, "step": step, "seconds": 1.0})
    text = "".join(json.dumps(row) + "\n" for row in rows) + '{"loss": 1.2'
    (folder / "log.jsonl").write_text(text, encoding="utf-8")
    return folder


def test_reads_what_is_whole(tmp_path: Path) -> None:
    training, validation = read_log(_log(tmp_path / "run"))
    assert len(training) == 40 and [row["step"] for row in validation] == [10, 20, 30, 40]
    steps, values = series(training, "energy_min")
    np.testing.assert_array_equal(values, -steps)
    assert len(series(training, "nothing")[0]) == 0


def test_running_mean() -> None:
    np.testing.assert_allclose(smooth(np.array([2.0, 4, 6, 8]), 2), [2, 3, 5, 7])


def test_draws_and_says_where_it_ends(tmp_path: Path, capsys) -> None:
    runs = [str(_log(tmp_path / name)) for name in ("rotation", "translation")]
    png = tmp_path / "figure.png"
    assert cli.main(["evaluate", "training-log", *runs, "--png", str(png)]) == cli.SUCCESS
    out = capsys.readouterr().out
    assert "rotation: loss 5.000 at step 1, 0.125 at step 40, energies -40.00 to 40.00" in out
    assert "lowest rotation_deg 3.00 at step 20" in out
    picture = np.asarray(Image.open(png))[..., :3]
    assert (picture < 200).any(-1).mean() > 0.01


def test_bad_logs_are_named(tmp_path: Path) -> None:
    with pytest.raises(LogError, match=r"log\.jsonl: no readable log"):
        read_log(tmp_path)
    (tmp_path / "log.jsonl").write_text('{"loss": 1.0, "step": 1}\nnothing\n')
    with pytest.raises(LogError, match="line 2"):
        read_log(tmp_path)
    (tmp_path / "log.jsonl").write_text("")
    with pytest.raises(LogError, match="no row"):
        read_log(tmp_path)
