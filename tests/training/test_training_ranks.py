"""Two processes that train together under torchrun, against one."""

import dataclasses
from pathlib import Path

import torch
from descriptor_runs import command, log, state, write_settings

from iga_drake import cli
from iga_drake.training import dif_net, encoder

TORCHRUN = ("-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2")


def test_two_processes_average_to_the_gradients_of_one(tmp_path: Path, monkeypatch) -> None:
    """Over two steps of 4 samples; the first moments hold both gradients."""
    settings = write_settings(tmp_path, steps=2, learning_rate=0.0, weight_decay=0.0)
    together = command(
        "--config", settings, "--out", tmp_path / "two", "--batch", 2, launcher=TORCHRUN
    )
    one = ["--out", str(tmp_path / "one"), "--config", str(settings), "--batch", "4"]
    assert cli.main(["train", "descriptor", *one, "--device", "cpu"]) == 0
    out, _ = together.communicate()
    assert together.returncode == 0, out
    assert out.count("8 samples seen") == 1  # one of them reports
    single, card = state(tmp_path / "one")
    double, other = state(tmp_path / "two")
    assert (card["processes"], other["processes"]) == (1, 2)
    assert card["samples_seen"] == other["samples_seen"] == 8
    moments = [name for name in single if name.startswith("m.")]
    assert max(float(single[name].abs().max()) for name in moments) > 1e-3
    for name in moments:  # a tenth of the gradient
        torch.testing.assert_close(double[name], single[name], atol=1e-7, rtol=0, msg=name)
    torch.testing.assert_close(double["rng"], single["rng"], atol=0, rtol=0)
    for a, b in zip(log(tmp_path / "one"), log(tmp_path / "two"), strict=True):
        assert abs(a["loss"] - b["loss"]) < 1e-5 and a["step"] == b["step"]


def test_all_trainings_draw_the_same_however_passes_are_divided() -> None:
    """Two processes of one pass each draw what one process of two passes draws."""
    for draw, config in (
        (encoder._draw, encoder.EncoderTraining(batch=3)),
        (dif_net._draw, dif_net.DifNetTraining(batch=3, shapes=7, points=8)),
    ):
        drawn = []
        for accumulate, world in ((2, 1), (1, 2)):
            torch.manual_seed(5)
            chosen = dataclasses.replace(config, accumulate=accumulate)
            given = (chosen, world) if draw is dif_net._draw else (50, chosen, world)
            drawn.append([torch.as_tensor(part) for part in draw(*given)])
        for one, two in zip(*drawn, strict=True):
            assert torch.equal(one.flatten(), two.flatten())
