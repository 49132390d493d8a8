"""What every training shares, on a network of one layer, and the command under kill -9."""

import json
import os
import re
import signal
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from descriptor_runs import assert_same, command, log, state, write_settings
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from torch import Tensor, nn

from iga_drake import cli
from iga_drake.checkpoint import load_checkpoint
from iga_drake.training import run as training_run
from iga_drake.training.run import (
    RunConfig,
    RunOptions,
    SavedState,
    Term,
    TrainingRun,
    flushed_denormals,
    learning_rate,
)
from iga_drake.training.settings import TrainingError

TARGET = torch.tensor([[1.0, -2.0, 0.5]])


def _train(folder: Path, config: RunConfig, *, errors: list[float] | None = None, **options):
    """Fits a line to random points; validation answers with `errors` in turn."""
    saved = SavedState.read(folder, "line")
    torch.manual_seed(0)
    net = nn.Linear(3, 1)
    seen: list[dict[str, Tensor]] = []

    def validate(weights: dict[str, Tensor]) -> dict[str, float]:
        seen.append(weights)
        torch.rand(7)
        return {"error": errors[len(seen) - 1], "other": 0.0}

    run = TrainingRun(
        folder, "line", net, config, saved=saved, card={"model": "line"},
        options=RunOptions(**options), validate=validate if errors else None,
    )  # fmt: skip

    def terms() -> Iterator[Term]:
        for _ in range(config.accumulate):
            x = torch.randn(config.batch, 3)
            square = (net(x) - x @ TARGET.T).square()
            yield Term(square.sum(), torch.tensor(len(x)), {"largest": square.max()})

    while run.goes_on():
        run.advance(terms())
    run.save()
    run.close()
    return run, seen


def test_a_run_learns_and_logs(tmp_path: Path) -> None:
    run, _ = _train(tmp_path, RunConfig(steps=200, learning_rate=0.1, warmup=1, log_every=50))
    torch.testing.assert_close(run.net.weight.detach(), TARGET, atol=0.05, rtol=0)
    rows = log(tmp_path)
    assert [row["step"] for row in rows] == [50, 100, 150, 200]
    assert rows[-1]["loss"] < 1e-2 * rows[0]["loss"] and rows[0]["largest"] > rows[0]["loss"]
    assert rows[-1]["gradient_norm"] < 0.2 * rows[0]["gradient_norm"]
    row = json.loads((tmp_path / "log.jsonl").read_text().splitlines()[0])
    assert row["samples_per_second"] > 0 and row["memory_mib"] > 10 and row["workers_mib"] >= 0
    # Of the whole process, that of Python with PyTorch at the least.
    assert 50 < row["memory_mib"] < 1e5


def test_denormal_numbers_are_as_before_after_a_training() -> None:
    small = np.array([sys.float_info.min])
    assert small[0] / 2 > 0
    with pytest.raises(KeyError), flushed_denormals():
        assert small[0] / 2 == 0
        with flushed_denormals():
            pass
        assert small[0] / 2 == 0
        raise KeyError
    assert small[0] / 2 > 0


def test_the_learning_rate_warms_up_and_decays() -> None:
    config = RunConfig(steps=100, learning_rate=2.0, warmup=10, decay_share=0.5)
    values = [learning_rate(step, config) for step in range(100)]
    assert values[0] == pytest.approx(0.2) and values[4] == pytest.approx(1.0)
    assert values[9:51] == [2.0] * 42
    assert values[75] == pytest.approx(1.0) and values[99] == pytest.approx(0.04)
    config = RunConfig(steps=100, learning_rate=2.0, warmup=1, decay_share=1.0, decay="cosine")
    optimizer = torch.optim.SGD([torch.zeros(1)], lr=2.0)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, 100)
    for step in range(90):
        assert learning_rate(step, config) == pytest.approx(optimizer.param_groups[0]["lr"])
        optimizer.step()
        schedule.step()
    assert learning_rate(99, config) == pytest.approx(0.04)


def test_the_best_weights_are_kept_beside_the_last(tmp_path: Path) -> None:
    config = RunConfig(steps=10, learning_rate=0.1, validate_every=3)
    _run, seen = _train(tmp_path, config, errors=[3.0, 1.0, 2.0, 5.0])
    best, card = load_checkpoint(tmp_path / "best.safetensors", kind="line")
    last, last_card = load_checkpoint(tmp_path / "line.safetensors", kind="line")
    assert_same(best, seen[1])
    assert_same(last, seen[3])
    assert card["step"] == 6 and card["errors"]["best"] == {"step": 6, "error": 1.0, "other": 0.0}
    assert last_card["step"] == 10 and last_card["errors"]["best"] == card["errors"]["best"]
    assert last_card["errors"]["latest"]["error"] == 5.0
    rows = [row for row in log(tmp_path) if "validation" in row]
    assert [(r["step"], r["validation"]["error"]) for r in rows] == [
        (3, 3.0), (6, 1.0), (9, 2.0), (10, 5.0),
    ]  # fmt: skip


def test_the_best_so_far_outlives_a_stop(tmp_path: Path) -> None:
    config = RunConfig(steps=9, validate_every=3)
    _train(tmp_path, config, errors=[1.0], stop_at=4)
    _train(tmp_path, config, errors=[2.0, 3.0])
    _, card = load_checkpoint(tmp_path / "best.safetensors", kind="line")
    assert card["step"] == 3 and card["errors"]["best"]["error"] == 1.0


def test_weights_average_as_an_exponential_mean_would(tmp_path: Path) -> None:
    config = RunConfig(steps=4, learning_rate=0.1, warmup=1, ema=0.5, validate_every=1)
    run, _ = _train(tmp_path / "whole", config, errors=[1.0] * 4)
    torch.manual_seed(0)
    average = nn.Linear(3, 1).weight.detach()
    for stop in range(1, 5):
        run, _ = _train(tmp_path / "steps", config, errors=[1.0], stop_at=stop)
        rate = min(0.5, (1 + stop) / (10 + stop))
        average = rate * average + (1 - rate) * run.net.weight.detach()
        torch.testing.assert_close(run.ema["weight"], average)


def test_checkpoints_are_due_by_time_too(tmp_path: Path, monkeypatch) -> None:
    written: list[tuple[str, int]] = []
    monkeypatch.setattr(
        training_run,
        "save_checkpoint",
        lambda path, tensors, *, kind, card: written.append((path.name, card["step"])),
    )
    config = RunConfig(steps=5)
    _train(tmp_path, config, checkpoint_every=1000, checkpoint_minutes=60.0)
    assert [step for name, step in written if name == "state.safetensors"] == [5]
    written.clear()
    clock = iter(range(0, 100_000, 40))  # s, at every look
    monkeypatch.setattr(training_run.time, "monotonic", lambda: float(next(clock)))
    _train(tmp_path, config, checkpoint_every=1000, checkpoint_minutes=5.0)
    assert {step for _, step in written} > {5}


def test_tensorboard_holds_what_the_log_holds(tmp_path: Path) -> None:
    config = RunConfig(steps=4, log_every=2, validate_every=4)
    _train(tmp_path, config, errors=[2.5], tensorboard=True)
    events = EventAccumulator(str(tmp_path / "tensorboard"))
    events.Reload()
    losses = [(e.step, pytest.approx(e.value)) for e in events.Scalars("training/loss")]
    assert [(r["step"], r["loss"]) for r in log(tmp_path) if "loss" in r] == losses
    assert [(e.step, e.value) for e in events.Scalars("validation/error")] == [(4, 2.5)]
    names = ("gradient_norm", "learning_rate", "memory_mib", "samples_per_second", "largest")
    assert {f"training/{name}" for name in names} < set(events.Tags()["scalars"])


def test_tensorboard_that_is_not_there_is_an_error(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", None)
    with pytest.raises(TrainingError, match=r"pip install 'iga-drake\[train\]'"):
        _train(tmp_path, RunConfig(steps=1), tensorboard=True)
    _train(tmp_path, RunConfig(steps=1))


def test_ctrl_c_ends_a_training_with_one_line_that_says_what_is_kept(tmp_path: Path) -> None:
    """As a terminal sends it: to all processes of the command."""
    settings = write_settings(tmp_path, steps=100_000)
    options = ("--config", settings, "--workers", 1, "--checkpoint-every", 1)
    process = command("--out", tmp_path / "run", *options, own_group=True)
    while process.poll() is None and not (tmp_path / "run" / "state.safetensors").is_file():
        time.sleep(0.01)
    os.killpg(process.pid, signal.SIGINT)
    try:
        said, _ = process.communicate(timeout=300)
    finally:
        process.kill()
    assert process.returncode == cli.INTERRUPTED, said
    told = [line for line in said.splitlines() if not line.startswith("step ")]
    assert len(told) == 1, said
    found = re.match(r"iga train: interrupted; step (\d+) is kept in \S+/run, the same", told[0])
    assert found and int(found[1]) == state(tmp_path / "run")[1]["step"] >= 1, said


def test_a_run_killed_at_any_moment_ends_as_if_it_had_not_been(tmp_path: Path) -> None:
    """kill -9 of the command; also torn and left-over files as a kill may leave them."""
    settings = write_settings(
        tmp_path, steps=7, log_every=2, validate_every=5, validation_samples=1
    )
    options = ("--config", settings, "--checkpoint-every", 3)
    assert cli.main(["train", "descriptor", "--out", f"{tmp_path}/whole", *map(str, options)]) == 0
    killed = tmp_path / "killed"
    process = command("--out", killed, *options)
    # Past the first checkpoint, and past what it holds of the log.
    while process.poll() is None:
        if (killed / "log.jsonl").is_file() and any(r["step"] >= 4 for r in _rows(killed)):
            process.send_signal(signal.SIGKILL)
            process.wait()
        time.sleep(0.005)
    assert process.returncode == -signal.SIGKILL, process.stdout.read()
    assert 3 <= state(killed)[1]["step"] < 7
    with (killed / "log.jsonl").open("a") as file:
        file.write('{"loss": 1.2')
    (killed / f".state.safetensors.{os.getpid()}.partial").write_bytes(b"half")
    process = command("--out", killed, *options)
    out, _ = process.communicate()
    assert process.returncode == 0 and "step 7, 14 samples seen" in out
    whole, card = state(tmp_path / "whole")
    tensors, other = state(killed)
    assert_same(whole, tensors)
    assert other == card and card["step"] == 7
    assert log(killed) == log(tmp_path / "whole")
    for name in ("descriptor", "best"):
        first, second = (
            load_checkpoint(folder / f"{name}.safetensors", kind="descriptor")[0]
            for folder in (tmp_path / "whole", killed)
        )
        assert_same(first, second)
    assert sorted(p.name for p in killed.iterdir()) == [
        "best.safetensors", "descriptor.safetensors", "log.jsonl", "state.safetensors",
    ]  # fmt: skip


def _rows(folder: Path) -> list[dict]:
    """The whole lines of a log that is being written."""
    text = (folder / "log.jsonl").read_text(encoding="utf-8")
    return [json.loads(line) for line in text[: text.rfind("\n") + 1].splitlines()]


def test_muon_makes_steps_of_a_known_length(tmp_path: Path) -> None:
    """Orthogonalised: a row moves by the learning rate times 0.2 sqrt(3), whatever the
    gradient (its five iterations leave singular values between about 0.7 and 1.2)."""
    for learning_rate_ in (1e-3, 1e-2):
        config = RunConfig(
            steps=1, optimizer="muon", learning_rate=learning_rate_, warmup=1, weight_decay=0.0
        )
        torch.manual_seed(0)
        before = nn.Linear(3, 1)
        run, _ = _train(tmp_path / str(learning_rate_), config)
        moved = float((run.net.weight - before.weight).detach().norm())
        assert 0.65 < moved / (learning_rate_ * 0.2 * 3**0.5) < 1.25
        # What isn't a matrix moves as AdamW moves it at its first step: by the learning rate.
        assert float((run.net.bias - before.bias).detach().abs()) == pytest.approx(
            learning_rate_, rel=1e-3
        )


@pytest.mark.parametrize("optimizer", ["adamw", "muon"])
def test_a_stopped_run_goes_on_as_if_it_had_not(tmp_path: Path, optimizer: str) -> None:
    config = RunConfig(steps=9, optimizer=optimizer, learning_rate=0.01)
    _train(tmp_path / "whole", config)
    for stop in (4, 9):
        _train(tmp_path / "parts", config, stop_at=stop)
    whole, parts = (SavedState.read(tmp_path / name, "line") for name in ("whole", "parts"))
    assert whole is not None and parts is not None
    assert_same(whole.tensors, parts.tensors)


def test_a_run_may_change_its_optimizer(tmp_path: Path) -> None:
    for steps, optimizer in ((3, "adamw"), (6, "muon"), (400, "adamw")):
        config = RunConfig(steps=steps, optimizer=optimizer, learning_rate=0.1, warmup=1)
        run, _ = _train(tmp_path, config)
    torch.testing.assert_close(run.net.weight.detach(), TARGET, atol=0.05, rtol=0)
    with pytest.raises(TrainingError, match=r"optimizer = 'sgd', must be one of: adamw, muon"):
        RunConfig(optimizer="sgd")
