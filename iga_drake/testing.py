"""For teams whose tests are task success: assert that a scenario succeeds often enough.

from iga_drake.testing import assert_success

def test_our_cell_still_stacks():
    assert_success("cell.yaml", seeds=range(15), at_least=0.9)
"""

import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path

from iga_drake.errors import IgaDrakeError
from iga_drake.evaluation.task_success import Trial, TrialResult, evaluate, format_table
from iga_drake.station.scenario import load_scenario, scenario_path
from iga_drake.tasks.task import Split


def assert_success(
    scenario: str | Path,
    *,
    seeds: Iterable[int],
    at_least: float,
    aligner: str | None = None,
    split: Split = "test",
    options: Sequence[str] = (),
    processes: int | None = None,
    replays: Path | str | None = None,
    on_results: Callable[[list[TrialResult]], None] = lambda results: None,
) -> list[TrialResult]:
    """Runs one episode for each seed, each in a process of its own, and returns their results.

    In pytest the fixture of the same name does so with the replays of failures in the test's own
    folder and the rate in the terminal's summary (`iga_drake.pytest_plugin`).

    Args:
      scenario: its file, or the name of one that comes with the package.
      seeds: of the episodes: scene, noise and the aligner's random choices.
      at_least: share of the episodes that have to succeed, in [0, 1].
      aligner: its name, or "expert"; default: the scenario's.
      split: whose objects: "test" (never demonstrated) or "demonstration".
      options: further ones of `iga simulate`, such as "--set=control.linear_speed=0.1" or
        "--demonstrations=FOLDER".
      processes: episodes at a time; default: one for each processor.
      replays: a folder where the episodes that fail leave a replay to look at.
      on_results: called with all results before they are judged.

    Raises:
      AssertionError: fewer succeeded. It shows the rate with its interval, the cause of every
        failure and where its replay is.
      IgaDrakeError: bad input.
    """
    chosen = list(seeds)
    if not chosen:
        raise IgaDrakeError("assert_success: no seeds, at least one is needed")
    if not 0 <= at_least <= 1:
        raise IgaDrakeError(f"assert_success: at_least = {at_least}, must lie in [0, 1]")
    path = scenario_path(str(scenario))
    described = load_scenario(path)
    trials = [
        Trial(
            task=described.task.name,
            scenario=path.stem,
            arguments=(str(path), *options),
            aligner=aligner or described.aligner.name,
            seed=seed,
            split=split,
        )
        for seed in chosen
    ]
    pages: dict[int, Path] = {}
    if replays is not None:
        folder = Path(replays)
        folder.mkdir(parents=True, exist_ok=True)
        pages = {t.seed: folder / f"{t.scenario}_{t.aligner}_seed_{t.seed}.html" for t in trials}
        trials = [
            replace(t, arguments=(*t.arguments, "--html", str(pages[t.seed]))) for t in trials
        ]
    results = evaluate(trials, processes=processes or os.cpu_count() or 1)
    for result in results:
        if result.success and result.seed in pages:
            pages[result.seed].unlink(missing_ok=True)
    on_results(results)
    succeeded = sum(result.success for result in results)
    if succeeded < at_least * len(results):
        left = [f"replay: {page}" for page in pages.values() if page.is_file()]
        raise AssertionError(
            f"{path}: {succeeded} of {len(results)} episodes succeeded, {100 * at_least:g} % are "
            "asked for\n" + "\n".join([format_table(results), *left])
        )
    return results
