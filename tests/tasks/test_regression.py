"""Task success with fixed seeds: the learned aligner on objects that were never demonstrated.

Each episode runs in a process of its own through the `iga` command, as a user would run it. The
bounds are well below what is measured on more seeds, and well above chance.
"""

import os

import pytest

from iga_drake.evaluation.task_success import Trial, evaluate, format_table

# task -> seeds, and how many of them have to succeed.
CASES = {"grasp": ((3, 4, 5, 6), 3), "stack": ((3, 4, 5, 6), 3)}


@pytest.mark.parametrize("task", CASES)
def test_learned_aligner_does_the_task(task: str):
    seeds, needed = CASES[task]
    trials = [
        Trial(task=task, scenario=task, arguments=(task,), aligner="iga", seed=seed)
        for seed in seeds
    ]
    results = evaluate(trials, processes=os.cpu_count() or 1)
    assert sum(result.success for result in results) >= needed, "\n" + format_table(results)


@pytest.mark.parametrize("task", [*CASES, "pour", "sweep"])
def test_expert_does_the_task(task: str):
    """What fails here is not perception: the motion, the contact or the verdict."""
    (result,) = evaluate(
        [Trial(task=task, scenario=task, arguments=(task,), aligner="expert", seed=3)]
    )
    assert result.success, result.reason
    assert result.position_error == pytest.approx(0.0, abs=1e-4)
