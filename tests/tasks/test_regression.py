"""Task success with fixed seeds: the learned aligner on objects that were never demonstrated.

Each episode runs in a process of its own through the `iga` command, as a user would run it. How
often they succeed is measured on many seeds with `iga evaluate tasks`.
"""

import pytest

from iga_drake.testing import assert_success

SEEDS = {
    "grasp": 3, "stack": 4, "hang": 3, "insert": 3, "pick_and_stack": 3, "pick_and_insert": 3,
}  # fmt: skip


@pytest.mark.parametrize("task", SEEDS)
def test_learned_aligner_does_the_task(task: str):
    assert_success(task, seeds=[SEEDS[task]], at_least=1)


@pytest.mark.parametrize("task", ["pour", "sweep"])
def test_expert_does_the_task(task: str):
    """What no other test does as a whole episode: the motion, the contact and the verdict."""
    (result,) = assert_success(task, seeds=[3], at_least=1, aligner="expert")
    assert result.position_error == pytest.approx(0.0, abs=1e-4)
