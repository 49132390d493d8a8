"""Task success with fixed seeds: the learned aligner on objects that were never demonstrated.

Each episode runs in a process of its own through the `iga` command, as a user would run it. The
bounds are well below what is measured on more seeds, and well above chance.
"""

import pytest

from iga_drake.testing import assert_success

# task -> seeds, and how many of them have to succeed.
CASES = {
    "grasp": ((3, 4, 5, 6), 3),
    "stack": ((3, 4, 5, 6), 3),
    "hang": ((3,), 1),
    "insert": ((3,), 1),
    "pick_and_stack": ((3,), 1),
    "pick_and_insert": ((3,), 1),
}


@pytest.mark.parametrize("task", CASES)
def test_learned_aligner_does_the_task(task: str):
    seeds, needed = CASES[task]
    assert_success(task, seeds=seeds, at_least=needed / len(seeds))


@pytest.mark.parametrize("task", [*CASES, "pour", "sweep"])
def test_expert_does_the_task(task: str):
    """What fails here is not perception: the motion, the contact or the verdict."""
    (result,) = assert_success(task, seeds=[3], at_least=1, aligner="expert")
    assert result.position_error == pytest.approx(0.0, abs=1e-4)
